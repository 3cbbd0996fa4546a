"""EKF-SLAM composed of its pieces: how the camera moves, what it measures, and what is kept.

A frame is `predict`, `update`, `compose`, `close`. The motion is composed after the update, as the
paper has it, or before. What the stages are made of are functions of this module, for filters
that are built around this one and for the methods by which landmarks enter (`AbstractEntry`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import fields, replace
from typing import get_args, get_type_hints

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray, cast, precision
from jaxslam.filters.forms.blocks import Change, Landmark, Prior
from jaxslam.filters.forms.covariance import Covariance
from jaxslam.filters.forms.form import AbstractForm
from jaxslam.filters.forms.state import State
from jaxslam.filters.model import COMPOSED, Context, Core, SlamModel
from jaxslam.filters.protocol import (
    AbstractFilter,
    AbstractStaged,
    Belief,
    CameraView,
    Corrected,
    EachMoments,
    Expected,
    LandmarkView,
    Moments,
    OfCamera,
    OfLandmark,
    PoseError,
)
from jaxslam.geometry import Pose, SplitPose, difference, identity
from jaxslam.landmarks import INVERSE_SCALING, Parametrization
from jaxslam.models.calibration import AbstractCalibration, Known, check_calibration
from jaxslam.models.coordinates import ROBOCENTRIC, SUBMAP, Coordinates, KeyframePose
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import AbstractMotion, Control, check_control
from jaxslam.models.observations import Capacity, Features, Slots
from jaxslam.models.scale import Metre, ScaleGauge, prior_in_gauge
from jaxslam.models.sensors import AbstractSensor


class AbstractEntry(eqx.Module):
    """The treatment of new landmarks, and of those whose initialisation is not finished.

    A *landmark* has one number for everybody outside; inside, it may own several slots of the
    state. What a method remembers beside the Gaussian is `State.memory`. Unless a method says
    otherwise, a landmark has one slot, and is a Gaussian from the first.
    """

    def slots(self, landmarks: int) -> int:
        """The number of slots of the state that so many landmarks need."""
        return landmarks

    def memory(self, landmarks: int, dtype: DTypeLike) -> PyTree:
        """The memory of an empty map."""
        del landmarks, dtype
        return ()

    @abstractmethod
    def update(
        self, slam: EkfSlam, state: Belief, control: Control, features: Features
    ) -> Corrected:
        """Correct by the features of landmarks, finished or not."""

    @abstractmethod
    def initialise(self, slam: EkfSlam, state: Belief, features: Features) -> Belief:
        """Begin new landmarks, seen from the current camera."""

    def collapsed(self, state: Belief) -> Belief:
        """The state with one slot, and one Gaussian, a landmark."""
        return state

    def initialised(self, state: Belief) -> Bool[Array, " landmarks"]:
        """Whether each landmark is in the map as one Gaussian."""
        return state.active


class Undelayed(AbstractEntry):
    """A landmark is a Gaussian from its first measurement on (P22–P26)."""

    def update(self, slam, state, control, features):
        return correct(slam, state, control, features)

    def initialise(self, slam, state, features):
        return insert(slam, state, features)


class EkfSlam(AbstractStaged):
    """An EKF for SLAM. Its numbers are leaves: they can be batched and differentiated.

    `jaxslam.EkfSlam(motion=ConstantVelocity(…), sensor=Pinhole(camera, 0.3))` is the paper's
    filter of a camera whose calibration is known. Raises ValueError for pieces that do not go
    together.
    """

    motion: AbstractMotion
    sensor: AbstractSensor
    landmark: Parametrization = eqx.field(static=True, default=INVERSE_SCALING)
    """What is estimated of a landmark, one of `LANDMARKS`."""
    coordinates: Coordinates = eqx.field(static=True, default=ROBOCENTRIC)
    """Of which frame landmarks are: `ROBOCENTRIC`, `WORLD`, `KEYFRAME` or `SUBMAP`."""
    calibration: AbstractCalibration = Known()
    depth: InverseDepth = InverseDepth.beyond(1.0)
    """The prior on 1/z of a camera's landmarks."""
    scale: Metre | ScaleGauge = Metre()
    """The unit of length in the state."""
    form: AbstractForm = Covariance()
    """How the uncertainty is kept; a remedy is a correction of the covariance form."""
    entry: AbstractEntry = Undelayed()
    """How landmarks enter the map."""

    def __check_init__(self) -> None:
        _check_pieces(self)
        _check_gauge(self)
        _check_entry(self)

    @property
    def model(self) -> SlamModel:
        """The pure functions of core and landmark."""
        return SlamModel(**{piece.name: getattr(self, piece.name) for piece in fields(SlamModel)})

    @property
    def gaussian_form(self) -> Covariance:
        """The form, which keeps a Gaussian everywhere but inside a window."""
        assert isinstance(self.form, Covariance)
        return self.form

    @property
    def compose_first(self) -> bool:
        """Whether the motion is composed before the update: where landmarks stay where they are."""
        return not self.coordinates.moves_landmarks

    def init(self, capacity: int | Capacity, first: Features | None = None) -> Belief:
        """An exactly known pose at the origin of B, the motion's start, an empty map.

        Raises ValueError for a capacity that is none, and for features of another shape.
        """
        state = _empty(self, Capacity.of(capacity).landmarks, precision(self))
        if first is None:
            return state
        check_features(self, first)
        return self.close(_with_frames_calibration(self, state), first)

    def predict(self, state: Belief, control: Control) -> Belief:
        """Append this step's noise; move already where the motion is composed first."""
        check_control(self.motion, control)
        return composed_first(self, append_noise(self, state), control)

    def predict_features(self, state: Belief, control: Control, slots: Slots) -> Expected:
        context = context_of(self, control)
        model, core = self.model, state.core
        measured, covariance, possible = self.gaussian_form.predict_features(
            model, state, slots, self.sensor.noise, context
        )
        if not self.compose_first:
            core = model.compose_core(core, context)
        view = model.view(state.core, context)
        points, omegas = jax.vmap(model.metric_point, in_axes=(None, 0))(
            view, state.landmarks[slots]
        )
        possible = possible & state.active[slots]
        return Expected(measured, covariance, possible, model.camera_pose(core), points, omegas)

    def update(self, state: Belief, control: Control, seen: Features) -> Corrected:
        """Correct by the features seen (P16, P17)."""
        check_features(self, seen)
        return self.entry.update(self, state, control, seen)

    def compose(self, state: Belief, control: Control) -> Belief:
        """Move into the new camera frame, after the update (P18–P21); convert landmarks; make the
        camera a keyframe where one is due."""
        if not self.compose_first:
            state = self.form.compose(self.model, state, Context(control))
        if self.coordinates.reanchor is not None:
            due = self.model.reanchoring_due(state)
            state = jax.lax.cond(due, lambda state: reanchored(self, state), lambda s: s, state)
        if self.landmark.convert is None:
            return state
        return self.gaussian_form.convert(self.model, state, COMPOSED)

    def close(self, state: Belief, new: Features) -> Belief:
        """Begin new landmarks seen from the current camera (P22–P26), and end the frame."""
        check_features(self, new)
        return _forgotten(self, self.entry.initialise(self, state, new))

    def remove(self, state: Belief, gone: Bool[AnyArray, " capacity"]) -> Belief:
        return self.gaussian_form.remove(state, gone)

    def marginal(self, state: Belief, function: OfCamera) -> Moments:
        """The marginal of the state at the end of a frame, to first order: `J P Jᵀ`."""

        def of_core(core: Core) -> PyTree:
            return function(CameraView(self.model.camera_pose(core), core, core.log_scale))

        return self.form.core_covariance(of_core, state)

    def landmark_marginal(self, state: Belief, function: OfLandmark, slots: Slots) -> EachMoments:
        """The same of landmarks."""
        return self.gaussian_form.landmark_covariance(
            composed, of_landmark(self, function), self.entry.collapsed(state), slots
        )

    def in_map(self, state: Belief) -> Bool[Array, " capacity"]:
        return self.entry.collapsed(state).active

    def pose_error(self, state: Belief, T_BC: Pose) -> PoseError:
        """`T_true ⊟ T_est` of the pose that the coordinates hold, and its covariance."""
        coordinates = self.coordinates
        estimate, covariance = self.form.core_covariance(self.model.estimate, state)
        return difference(
            coordinates.estimate(coordinates.from_base_pose(T_BC)), estimate
        ), covariance


def composed(core: Core) -> Core:
    """The part of a core on which camera and landmarks depend once the motion is composed."""
    nothing = core.noise[:0]
    return replace(
        core, motion=None, noise=nothing, calibration=nothing, depth_error=None, base_motion=None
    )


def of_landmark(slam: EkfSlam, function: OfLandmark) -> Landmark:
    """A function of a landmark's view as one of the core, as `composed` leaves it, and of the
    landmark."""

    def value(core: Core, landmark: Array) -> Float[Array, " k"]:
        seen = slam.model.metric_point(slam.model.view(core, COMPOSED), landmark)
        return function(LandmarkView(slam.model.camera_pose(core), *seen, core.log_scale))

    return value


def append_noise(slam: EkfSlam, state: Belief) -> Belief:
    """Append this step's motion noise and calibration error (P10, P11, P15)."""
    start, sigma = state.core.part("noise").start, slam.model.noise_sigma
    state = slam.form.augment(state, start, jnp.diag(sigma**2))
    return _with_frames_calibration(slam, state)


def composed_first(slam: EkfSlam, state: Belief, control: Control) -> Belief:
    """Move already, where the motion is composed before the update."""
    if not slam.compose_first:
        return state
    return slam.form.compose(slam.model, state, Context(control))


def context_of(slam: EkfSlam, control: Control) -> Context:
    """The context of a predicted state's functions: the motion that is not yet composed."""
    return COMPOSED if slam.compose_first else Context(control)


def correct(
    slam: EkfSlam, state: Belief, control: Control, seen: Features
) -> tuple[Belief, PyTree]:
    """The Kalman update by features of slots, and what the form says that it compared."""
    noise = slam.sensor.noise
    if seen.noise_factor is not None:
        noise = noise * seen.noise_factor[:, None, None]
    context = context_of(slam, control)
    left = slice(0, 0) if slam.calibration.corrected else state.core.part("calibration")
    return slam.form.update(slam.model, state, seen, noise, context, left)


def init_with_depths(
    slam: EkfSlam, capacity: int | Capacity, first: Features, prior: Prior
) -> Belief:
    """`init` of landmarks each of which has a prior of its own: mean and σ of 1/z."""
    check_features(slam, first)
    state = _with_frames_calibration(slam, slam.init(capacity))
    return _forgotten(slam, insert(slam, state, first, prior))


def insert(slam: EkfSlam, state: Belief, new: Features, prior: Prior | None = None) -> Belief:
    """Insert Gaussians into slots; 1/z has the filter's prior, or one for each slot."""
    context = COMPOSED
    prior = _depth_prior(slam, state) if prior is None else prior
    if slam.landmark.anchored:
        anchor = _free_anchor(state)
        state = slam.form.reparametrise(state, slam.model.anchoring(anchor))
        context = Context(None, anchor)
    return slam.form.initialise(slam.model, state, new, slam.sensor.noise, prior, context)


def reanchored(slam: EkfSlam, state: Belief) -> Belief:
    """The current camera as the keyframe: landmarks move to it, and T_KC is known."""
    change = slam.model.reanchoring()
    return state if change is None else slam.form.reparametrise(state, change)


def rebased(slam: EkfSlam, state: Belief) -> Belief:
    """The current camera as the one in which a submap begins: `T_BK ← T_BK T_KC`, T_KC is the
    identity, and the motion's variables are kept as they are now."""

    def core(core: Core) -> Core:
        assert isinstance(core.pose, KeyframePose)
        return replace(core, pose=core.pose.reanchored(), base_motion=core.motion)

    return slam.form.reparametrise(state, Change(core=core, view=lambda core: (), landmark=None))


def each_gaussian(belief: Belief, function: Callable[[State], State]) -> Belief:
    """The belief with a function of every Gaussian in it, of which sums have batches."""

    def one(node: PyTree) -> PyTree:
        if not isinstance(node, State):
            return node
        return jax.vmap(function)(node) if node.covariance.ndim == 3 else function(node)

    return jax.tree.map(one, belief, is_leaf=lambda node: isinstance(node, State))


def check_features(slam: EkfSlam, features: Features) -> None:
    """Raise ValueError unless they are measurements of the filter's sensor."""
    m, p = features.slots.shape[-1], slam.sensor.size
    wanted = {"slots": (m,), "measured": (m, p), "valid": (m,)}
    for name, shape in wanted.items():
        found = getattr(features, name).shape
        if found[-len(shape) :] != shape:
            raise ValueError(
                f"features.{name} has shape {found}; {type(slam.sensor).__name__} measures "
                f"{p} numbers of each of {m} landmarks: it needs {shape}"
            )


def ekf_inside(slam: AbstractFilter, what: str) -> EkfSlam:
    """The `EkfSlam` that a filter is, or is built around.

    Raises ValueError, saying what is done with it ("noise is fitted"), where there is none.
    """
    inner = slam.unwrapped
    if not isinstance(inner, EkfSlam):
        raise ValueError(
            f"{what} for an EkfSlam, and {type(slam).__name__} is none and is around none"
        )
    return inner


def check_can_track(slam: AbstractFilter, name: str) -> None:
    """Raise ValueError unless features can be sought where the filter of this name expects them."""
    inner = slam.unwrapped
    if not isinstance(slam, AbstractStaged):
        wrong = f"{type(slam).__name__} takes a frame as a whole"
    elif isinstance(inner, EkfSlam) and not isinstance(inner.entry, Undelayed):
        wrong = f"{type(inner.entry).__name__} begins a landmark that is not one Gaussian"
    else:
        return
    raise ValueError(
        f"filter {name} cannot track: {wrong}; accepted is an `AbstractStaged`, whose frames are "
        "taken in stages, with landmarks that are Gaussians from the first (`Undelayed`)"
    )


def check_one_gaussian(base: AbstractFilter, what: str, corrected: bool = False) -> None:
    """Raise ValueError, saying of what, unless all that `base` knows is in one covariance.

    `corrected` by something else than the plain update is accepted too, on demand.
    """
    if not isinstance(base, EkfSlam):
        raise ValueError(f"{what} is around an EkfSlam, not around a {type(base).__name__}")
    plain = base.form.plain or (corrected and base.form.divisible)
    for wrong, why in (
        (not plain, "is for filters in covariance form"),
        (not isinstance(base.entry, Undelayed), "does not know delayed landmarks"),
        (base.landmark.convert is not None, f"cannot switch the form of {base.landmark.name}"),
    ):
        if wrong:
            raise ValueError(f"{what} {why}")


def _empty(slam: EkfSlam, capacity: int, dtype: DTypeLike) -> Belief:
    geometry, held = slam.motion.geometry, slam.coordinates.from_base_pose
    slam = cast(slam, dtype)
    variables, log_scale, covariance = slam.scale.start(slam.motion)
    depth = slam.depth
    unit = None if log_scale is None else depth.unit
    if log_scale is not None and unit is not None:
        log_scale = jnp.append(log_scale, 0.0)
    core = Core(
        pose=held(identity(geometry, dtype)),
        motion=variables,
        log_scale=log_scale,
        noise=jnp.zeros(slam.model.noise_sigma.size, dtype),
        calibration=jnp.zeros(slam.calibration.sigma.shape, dtype),
        anchors=_no_anchors(slam, capacity, dtype),
        depth_error=None if depth.common is None else jnp.zeros(1, dtype),
        base_motion=variables if slam.coordinates is SUBMAP else None,
    )
    # An empty slot holds a point straight ahead: finite in every formula.
    ahead = jnp.zeros(geometry.point_dim, dtype).at[-1].set(1.0)
    empty = slam.landmark.initialise(ahead, depth.mean, jnp.asarray(slam.sensor.focal, dtype))
    state = slam.gaussian_form.empty(core, jnp.tile(empty, (slam.entry.slots(capacity), 1)))
    state = replace(state, memory=slam.entry.memory(capacity, dtype))
    state = slam.form.augment(state, core.part("motion").start, covariance)
    if unit is not None:
        variance = jnp.reshape(unit**2, (1, 1))
        state = slam.form.augment(state, core.part("log_scale").start + 1, variance)
    if depth.common is not None:
        common = jnp.reshape(depth.common**2, (1, 1))
        state = slam.form.augment(state, core.part("depth_error").start, common)
    if slam.coordinates is SUBMAP:
        state = rebased(slam, state)
    return state if slam.calibration.each_frame else _with_calibration(slam, state)


def _no_anchors(slam: EkfSlam, capacity: int, dtype: DTypeLike) -> SplitPose | None:
    if not slam.landmark.anchored:
        return None
    origin = SplitPose.of(identity(slam.motion.geometry, dtype))
    return jax.tree.map(lambda x: jnp.tile(x, (capacity, 1)), origin)


def _with_calibration(slam: EkfSlam, state: Belief) -> Belief:
    covariance = jnp.diag(jnp.asarray(slam.calibration.sigma) ** 2)
    return slam.form.augment(state, state.core.part("calibration").start, covariance)


def _with_frames_calibration(slam: EkfSlam, state: Belief) -> Belief:
    return _with_calibration(slam, state) if slam.calibration.each_frame else state


def _forgotten(slam: EkfSlam, state: Belief) -> Belief:
    """The state without the frame's calibration error, where the next frame draws another."""
    if not slam.calibration.each_frame:
        return state
    part = state.core.part("calibration")
    core = replace(state.core, calibration=jnp.zeros_like(state.core.calibration))
    return replace(slam.form.marginalise(state, part.start, part.stop - part.start), core=core)


def _depth_prior(slam: EkfSlam, state: Belief) -> Prior:
    """Mean and σ of what a measurement hides of a landmark, its own part alone."""
    hidden, depth = slam.sensor.hidden, slam.depth
    mean, sigma = jnp.tile(depth.mean, hidden), jnp.tile(depth.sigma, hidden)
    if not isinstance(slam.scale, ScaleGauge):
        return mean, sigma
    _, variance = slam.form.core_covariance(lambda core: core.log_scale, state)
    return prior_in_gauge(mean, sigma, variance[0, 0])


def _free_anchor(state: State) -> Int[Array, ""]:
    """One that no landmark refers to; there are as many anchors as landmarks."""
    number = jnp.where(state.active, state.landmarks[:, -1].astype(int), state.active.size)
    return jnp.argmin(jnp.zeros(state.active.size, bool).at[number].set(True, mode="drop"))


def _check_pieces(slam: EkfSlam) -> None:
    for name, kind in get_type_hints(EkfSlam).items():
        if not isinstance(getattr(slam, name), kind):
            wanted = " or a ".join(one.__name__ for one in get_args(kind) or (kind,))
            raise ValueError(f"{name} is a {wanted}, not {getattr(slam, name)!r}")
    n, found = slam.motion.geometry.point_dim, slam.sensor.point_dim
    if found != n:
        raise ValueError(
            f"{type(slam.motion).__name__} moves in a {slam.motion.geometry.name} world, where "
            f"points have {n} coordinates, and {type(slam.sensor).__name__} measures points of "
            f"{found}"
        )
    check_calibration(slam.calibration, slam.sensor)
    slam.form.check(slam)


def _check_gauge(slam: EkfSlam) -> None:
    motion, sensor = slam.motion, slam.sensor
    if isinstance(slam.scale, ScaleGauge) and not (motion.has_velocity and sensor.hidden):
        raise ValueError(
            f"a scale gauge is for a camera with a velocity: {type(motion).__name__} and "
            f"{type(sensor).__name__} measure metres"
        )


def _check_entry(slam: EkfSlam) -> None:
    """Delayed initialisations have depths of their own, in metres, in place of the prior."""
    if isinstance(slam.entry, Undelayed):
        return
    for wrong, what in (
        (slam.depth.common is not None, "depths with a common part"),
        (isinstance(slam.scale, ScaleGauge), "a scale gauge"),
    ):
        if wrong:
            raise ValueError(
                f"{what} cannot go with a delayed initialisation, which replaces the prior "
                "on depth by depths of its own, in metres"
            )
