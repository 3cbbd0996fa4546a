"""`Slam`: a filter as a record of its pieces, and what excludes what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any, get_type_hints

from jaxtyping import Array, Bool

from jaxslam._numerics.arrays import AnyArray, check_kinds, check_leaves
from jaxslam.filters.gate import Gate
from jaxslam.filters.gaussian import OneGaussian
from jaxslam.filters.layer import AbstractLayer, AbstractSlam
from jaxslam.filters.linear.kalman import AbstractCorrection, Kalman
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.protocol import (
    AbstractStaged,
    Belief,
    Corrected,
    EachMoments,
    Expected,
    Moments,
    OfCamera,
    OfLandmark,
    PoseError,
)
from jaxslam.filters.submaps.handover import Handover
from jaxslam.filters.window.start import FromWindow
from jaxslam.geometry import Pose
from jaxslam.landmarks import AbstractLandmark, InverseScaling
from jaxslam.models.calibration import AbstractCalibration, Known, check_calibration
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import AbstractFrame, Robocentric
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Capacity, Features, PriorMap, Slots
from jaxslam.models.scale import AbstractScale, Metre
from jaxslam.models.sensors import AbstractSensor

Piece = Any
"""A piece of a filter as `Slam` takes it: a motion, a sensor, a landmark, a calibration."""
_ONE = OneGaussian()


class Slam(AbstractSlam):
    """A filter for SLAM: a record of its pieces, in any order. Its numbers are leaves, which can
    be batched and differentiated.

    `jaxslam.Slam(motion=ConstantVelocity(…), sensor=Pinhole(camera, 0.3))` is the paper's filter of
    a camera whose calibration is known; `dataclasses.replace(slam, mixture=Mixture(17))` is another
    one. A piece that is not used costs nothing. Raises ValueError for pieces that do not go
    together (`compatible`).
    """

    motion: AbstractMotion
    """The model of the camera's motion, and what is known of its start."""
    sensor: AbstractSensor
    """The measurement model."""
    landmark: AbstractLandmark = InverseScaling()
    """The parametrization of a point, as in `LANDMARKS`."""
    frame: AbstractFrame = Robocentric()
    """The frame in which landmarks are held: `Robocentric`, `WorldCentric`, `Keyframe`, or
    `Submaps`, with which what leaves the map is kept and costs a frame nothing."""
    calibration: AbstractCalibration = Known()
    """The treatment of the uncertainty of the sensor's calibration."""
    depth: InverseDepth = InverseDepth.beyond(1.0)
    """The prior on 1/z of a camera's landmarks."""
    scale: AbstractScale = Metre()
    """The unit of length in the state: the metre, or one of its own (`ScaleGauge`)."""
    correction: AbstractCorrection = Kalman()
    """The update by measurements; a remedy for an inconsistent filter is another one."""
    mixture: Mixture | None = None
    """A sum of Gaussians in place of one."""
    start: FromWindow | None = None
    """The search for an unknown velocity; None where the motion's prior is one."""
    gate: Gate | None = None
    """The test that measurements pass which are believed; None where all are."""

    def __check_init__(self) -> None:
        compatible(self)

    @property
    def layer(self) -> AbstractLayer:
        """The outermost of the layers, which stand in this order."""
        submaps = self.frame.handed_over
        handover = None if submaps is None else Handover(submaps)
        around = (self.gate, handover, self.start, self.mixture)
        return next((layer for layer in around if layer is not None), _ONE)

    @property
    def layered(self) -> bool:
        return self.layer is not _ONE

    @property
    def inner(self) -> Slam:
        if self.gate is not None:
            return _without(self, gate=None)
        if self.frame.handed_over is not None:
            return _without(self, frame=_unending(self.frame))
        if self.start is not None:
            return _without(self, start=None)
        return _without(self, mixture=None)

    @property
    def one(self) -> Slam:
        frame = _unending(self.frame)
        return _without(self, gate=None, start=None, mixture=None, frame=frame)

    @property
    def ambiguous_start(self) -> bool:
        return self.layer.ambiguous_start(self)

    def init(
        self, capacity: int | Capacity, first: Features | None = None, known: PriorMap | None = None
    ) -> Belief:
        return self.layer.init(self, capacity, first, known)

    def step(self, state: Belief, control: Control, seen: Features, new: Features) -> Corrected:
        return self.layer.step(self, state, control, seen, new)

    def predict(self, state: Belief, control: Control) -> Belief:
        return self.layer.predict(self, state, control)

    def predict_features(self, state: Belief, control: Control, slots: Slots) -> Expected:
        return self.layer.predict_features(self, state, control, slots)

    def gaussian(self, state: Belief, control: Control) -> tuple[AbstractStaged, Belief]:
        return self.layer.gaussian(self, state, control)

    def update(self, state: Belief, control: Control, seen: Features) -> Corrected:
        return self.layer.update(self, state, control, seen)

    def compose(self, state: Belief, control: Control) -> Belief:
        return self.layer.compose(self, state, control)

    def close(self, state: Belief, new: Features) -> Belief:
        return self.layer.close(self, state, new)

    def remove(self, state: Belief, gone: Bool[AnyArray, " capacity"]) -> Belief:
        return self.layer.remove(self, state, gone)

    def marginal(self, state: Belief, function: OfCamera) -> Moments:
        return self.layer.marginal(self, state, function)

    def landmark_marginal(self, state: Belief, function: OfLandmark, slots: Slots) -> EachMoments:
        return self.layer.landmark_marginal(self, state, function, slots)

    def in_map(self, state: Belief) -> Bool[Array, " capacity"]:
        return self.layer.in_map(self, state)

    def pose_error(self, state: Belief, T_BC: Pose) -> PoseError:
        return self.layer.pose_error(self, state, T_BC)

    def unit_fixed(self, state: Belief) -> Bool[Array, ""]:
        return self.layer.unit_fixed(self, state)


def _without(slam: Slam, **changed) -> Slam:
    """`replace` of pieces that are known to go together, as it is asked for in every stage."""
    made = object.__new__(Slam)
    for piece in fields(Slam):
        object.__setattr__(made, piece.name, changed.get(piece.name, getattr(slam, piece.name)))
    return made


def _unending(frame: AbstractFrame) -> AbstractFrame:
    """The frame without what ends a submap."""
    submaps = frame.handed_over
    return frame if submaps is None else replace(submaps, spare=None)


def compatible(slam: Slam) -> None:
    """Raise ValueError, naming both and why, for pieces of which one excludes the other."""
    check_kinds(slam, get_type_hints(Slam))
    n, found = slam.motion.geometry.point_dim, slam.sensor.point_dim
    if found != n:
        raise ValueError(
            f"{type(slam.motion).__name__} moves in a {slam.motion.geometry.name} world, where "
            f"points have {n} coordinates, and {type(slam.sensor).__name__} measures points of "
            f"{found}"
        )
    check_leaves(slam)
    check_calibration(slam.calibration, slam.sensor)
    for excluded, told in _excluded(slam):
        if excluded:
            raise ValueError(told)


def _excluded(slam: Slam) -> Iterator[tuple[bool, str]]:
    """What excludes what, and why: the only place that says so."""
    motion, sensor = type(slam.motion).__name__, type(slam.sensor).__name__
    frame, landmark, correction = slam.frame, slam.landmark, slam.correction.base
    update, moves, hides = correction.name, slam.motion.has_velocity, slam.sensor.hidden > 0
    estimated = slam.motion.estimates_velocity
    yield (
        slam.scale.free and not (estimated and hides),
        f"a scale gauge is for a camera whose velocity is estimated: {motion} or {sensor} has none",
    )
    yield (
        correction.world_centric and (frame.moves_landmarks or frame.reanchors),
        f"{update} is for world-centric filters: a {frame.name} one moves its landmarks",
    )
    yield (
        correction.metric and slam.scale.free,
        f"{update} is for filters in metres, without a scale gauge",
    )
    yield (
        correction.one_form and (landmark.anchored or landmark.converts),
        f"{update} needs landmarks that are written in one form, in themselves, not "
        f"{landmark.name}",
    )
    yield (
        correction.knows_gauge and frame.reanchors,
        f"{update} is not for {frame.name} filters, whose unobservable directions are not known",
    )
    yield (
        slam.sensor.rolling and not moves,
        f"a rolling shutter is for a motion whose variables are a velocity; {motion} has others",
    )
    if slam.mixture is not None:
        yield not estimated, f"a mixture divides a velocity: {motion} has none"
    if slam.start is not None:
        yield (
            slam.mixture is None or not slam.mixture.split,
            "a start from a window is of a mixture that is split (+mixture): members are its modes",
        )
        yield not moves, f"a start from a window is of a velocity, which {motion} lacks"
        yield not hides, f"a start from a window is for a camera; {sensor} measures metres"
        yield landmark.anchored, f"a start from a window is without anchors ({landmark.name})"
        yield (
            type(slam.sensor).noise_at is not AbstractSensor.noise_at,
            f"a start from a window has one noise for all measurements, {sensor} one for each",
        )
    if frame.begins_submaps:
        yield landmark.anchored, f"submaps are of landmarks without an anchor, not {landmark.name}"
    for what, piece in (
        ("a mixture that is split", slam.mixture is not None and slam.mixture.split),
        ("a filter with submaps", frame.begins_submaps),
    ):
        yield piece and not correction.divisible, f"{what} does not go with {update}"
        yield (piece and landmark.converts, f"{what} cannot switch the form of {landmark.name}")
