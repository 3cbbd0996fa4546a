"""The filter as a tracker runs it: its state, and compiled programs for fixed numbers of features.

Features beyond those that there are have no valid pixel, so that no frame compiles anything anew.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import cast
from jaxslam._runtime.programs import QUICK, Program, in_background
from jaxslam.filters.association import (
    ASSOCIATIONS,
    Association,
    Candidates,
    candidates,
    second_order,
)
from jaxslam.filters.gaussian import each_gaussian, init_with_depths
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.covariance import augmented, marginalised
from jaxslam.filters.linear.state import State
from jaxslam.filters.protocol import AbstractStaged, Belief, CameraView
from jaxslam.filters.readouts import (
    camera_pose_in_unit,
    landmarks_in_unit,
    landmarks_on_sides,
    log_unit,
)
from jaxslam.geometry import log, scaled
from jaxslam.models.imu import Imu
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features, Status
from jaxslam.models.sensors import Pinhole
from jaxslam.tracking.inertial import Inertial
from jaxslam.tracking.matching import PEAKS, Matches
from jaxslam.tracking.observations import NOTHING, Observations, Prediction, Slots
from jaxslam.tracking.places.submaps import compile_graph, in_submaps, left
from jaxslam.tracking.pose_with_covariance import Depths, Pixels, Positions, Spreads, Transform
from jaxslam.tracking.settings import TrackerSettings

_NOWHERE = np.zeros(0, int), np.zeros((0, 2))

Report = tuple[jax.Array, ...]
"""A `CameraReport`, as a program returns it."""


class Predicted(NamedTuple):
    """A state of the filter before a frame's measurements, and what it expects of them."""

    control: Control
    """The motion since the frame before: its seconds, or what an inertial unit reads."""
    state: Belief
    gaussian: Belief
    """The same as one Gaussian."""
    joint: np.ndarray
    """The covariance of the innovations of all slots, (n, 2, n, 2)."""
    view: Prediction
    """The camera in the filter's own unit, from where the map begins."""


class Correction(NamedTuple):
    """The outcome of an update."""

    used: np.ndarray
    """Whether each was used."""
    nis: np.ndarray
    nis_dof: np.ndarray
    status: np.ndarray
    """A `Status`."""

    @property
    def failed(self) -> bool:
        """Whether the covariance is not positive afterwards: then nothing was corrected."""
        return bool(self.status >= Status.NOT_POSITIVE)


class CameraReport(NamedTuple):
    """The filter's estimate of its camera, in its own unit, from where the map begins."""

    T_wc: np.ndarray
    covariance: np.ndarray
    log_scale: np.ndarray
    """Mean of the log of that unit in metres, and its variance."""
    variance: np.ndarray
    unit_fixed: np.ndarray
    left: np.ndarray
    """Whether the camera has left the scene in which its submap began."""
    in_map: np.ndarray
    """Which slots hold a landmark: a filter gives up those that contradict a start."""


@dataclass(frozen=True)
class Estimator:
    """A filter as the tracker runs it, in 64 bits: functions of its state.

    Raises FloatingPointError where the camera's pose is not finite.
    """

    slam: AbstractStaged
    settings: TrackerSettings
    inertial: Inertial | None = None
    """What tells the motion, if anything does."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "slam", cast(self.slam, jnp.float64))

    def empty(self, before: Belief | None = None) -> Belief:
        """The state of a map without landmarks, whose inertial unit goes on as `before`."""
        return _empty(self.slam, self.settings.capacity, before)

    def control(self, time: float, seconds: float) -> Control:
        """The control of the motion in so many seconds before a time."""
        # A number of Python's would be compiled into the program.
        if self.inertial is None:
            return np.asarray(seconds)
        return self.inertial.control(time - seconds, time)

    def predict(self, state: Belief, control: Control, livelier: float = 1.0) -> Predicted:
        """Return what the filter expects after the motion of this control, as seconds, of a camera
        whose accelerations have so many times their σ, where that is a field of the motion."""
        control = np.asarray(control) if isinstance(control, float) else control
        slam = self.slam
        # One of one's own may compute it.
        scalable = isinstance(slam, AbstractSlam) and "noise_sigma" in vars(slam.motion)
        if livelier != 1.0 and scalable:
            sigma = livelier * slam.motion.noise_sigma
            slam = replace(slam, motion=replace(slam.motion, noise_sigma=sigma))
        (state, gaussian), joint, view = _predict(slam, state, control)
        joint, view = jax.device_get((joint, view))
        view = Prediction(*view)
        _check_finite(view.T_wc)
        return Predicted(control, state, gaussian, joint, view)

    def believes(
        self, predicted: Predicted, slots: Slots, matches: Matches, wide: Association | None = None
    ) -> Bool[np.ndarray, " m"]:
        """Return which matches, of landmarks in these slots, agree, by an association for `wide`
        ellipses or the settings'."""
        association = ASSOCIATIONS[self.settings.association] if wide is None else wide
        found = self.candidates(predicted, slots, matches, curved=wide is not None)
        believed = _believed(association, self._of_fixed_size(found, several=wide is not None))
        return np.asarray(believed)[: len(slots)]

    def candidates(
        self, predicted: Predicted, slots: Int[np.ndarray, " m"], matches: Matches, *, curved: bool
    ) -> Candidates:
        """Return the innovations of matches, and their slots as landmarks."""
        R, i = self.settings.pixel_sigma**2 * np.eye(2), np.arange(len(slots))
        S = predicted.joint[slots][:, :, slots]
        same = slots[:, None] == slots
        # Two matches of one landmark share all but their noise.
        first, second = np.nonzero(same & ~np.eye(len(slots), dtype=bool))
        S[first, :, second] -= R
        if curved:
            S[i, :, i] += np.asarray(_curved(self.slam, *predicted[1:3], predicted.control))[slots]
        more = self.settings.noise_factors(matches.variances) - 1 + self.settings.tolerance**2
        S[i, :, i] += more[:, None, None] * R
        view = predicted.view
        return Candidates(matches.pixels - view.pixels[slots], S, view.usable[slots], slots)

    def nis(self, predicted: Predicted, seen: Observations) -> tuple[float, int]:
        """Return the NIS `rᵀ S⁻¹ r` of what was seen, all together, and its degrees of freedom."""
        S, residual = self._innovations(predicted, seen)
        return float(residual @ np.linalg.solve(S, residual)), len(residual)

    def each_given_others(self, predicted: Predicted, seen: Observations) -> Pixels:
        """Return the innovation of each that was seen given those of all others, whitened:
        `L⁻¹ (S⁻¹ r)_i` with `L Lᵀ = (S⁻¹)_ii`, of unit covariance."""
        S, residual = self._innovations(predicted, seen)
        try:
            root = np.linalg.inv(np.linalg.cholesky(S))
        except np.linalg.LinAlgError:  # nothing can be said
            return np.zeros((len(seen.slots), 2))
        of_each = (root.T @ (root @ residual)).reshape(-1, 2, 1)
        whitening = root.reshape(len(S), -1, 2)
        blocks = np.einsum("nki,nkj->kij", whitening, whitening)
        return np.linalg.solve(np.linalg.cholesky(blocks), of_each)[..., 0]

    def given(self, predicted: Predicted, seen: Observations) -> Prediction:
        """Return what the filter expects of the frame given that it shows what was seen, to first
        order and neglecting that landmarks drift."""
        view, (n, p, _, _) = predicted.view, predicted.joint.shape
        S = predicted.joint.reshape(n * p, n * p)
        known = (p * seen.slots[:, None] + np.arange(p)).ravel()
        of_known, residual = self._innovations(predicted, seen)
        gain = np.linalg.solve(of_known, S[known]).T
        # The noise of a pixel that is known is no part of what else is to be expected there.
        moved = (gain @ residual).reshape(n, p)
        left = np.einsum("npk,nqk->npq", gain.reshape(n, p, -1), S[:, known].reshape(n, p, -1))
        return view._replace(pixels=view.pixels + moved, covariances=view.covariances - left)

    def correct(
        self, predicted: Predicted, seen: Observations = NOTHING
    ) -> tuple[Belief, Correction]:
        """A prediction updated by what is matched, in the new camera; nothing to go on with where
        that has `failed`."""
        slots, wanted = seen.slots, self.settings.wanted
        factors = self.settings.noise_factors(seen.variances)
        features = _measured(_padded(slots, seen.believed, wanted), factors)
        state, correction = _correct(self.slam, predicted.state, predicted.control, features)
        correction = Correction(*jax.device_get(correction))
        return state, correction._replace(used=correction.used[: len(slots)])

    @property
    def displaceable(self) -> bool:
        """Whether the filter has a velocity, by which a camera can be elsewhere at once."""
        model = self.slam.model
        return model is not None and model.motion.has_velocity

    def displaced(
        self, state: Belief, T: Transform, sigma: Float[np.ndarray, " 6"], seconds: float
    ) -> Predicted:
        """Return what the filter expects of a camera that is at T from its latest one, in its own
        unit, known with this σ: it has moved there within so many seconds."""
        dt = np.asarray(seconds)
        return self.predict(_moving(self.slam, state, T, sigma, dt), dt)

    def at_rest(self, state: Belief) -> Belief:
        """The state without what it knows of the camera's motion: it is as at a start."""
        return _at_rest(self.slam, state)

    def begin(
        self, state: Belief, slots: Slots, pixels: Pixels, depths: Depths | None = None
    ) -> tuple[Belief, CameraReport]:
        """Begin a map with landmarks at these pixels; `depths` are means and σ of 1/z of all
        features, where they are known."""
        known = jax.tree.map(jnp.asarray, depths)
        return self._created(_begin_map, state, slots, pixels, known)

    def renew(self, state: Belief, slots: Slots, pixels: Pixels) -> tuple[Belief, CameraReport]:
        """End the frame with new landmarks at these pixels."""
        return self._created(_renew_map, state, slots, pixels)

    def remove(self, state: Belief, slots: list[int]) -> Belief:
        """Marginalise the landmarks in these slots."""
        return _remove(self.slam, state, np.isin(np.arange(self.settings.capacity), slots))

    def points(self, state: Belief) -> tuple[Positions, Spreads]:
        """Landmarks with their covariances, in the filter's own unit, from where the map begins."""
        return jax.device_get(_world_points(self.slam, state, self.settings.capacity))

    def camera(self, state: Belief) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Return how the calibration is treated, and fx, fy, cx, cy in pixels, and k1 and k2 of a
        lens that has them, with their covariance. None of a filter without a pinhole camera."""
        model = self.slam.model
        if model is None or not isinstance(model.sensor, Pinhole):
            return None
        mean, covariance = jax.device_get(_intrinsics(self.slam, state))
        return model.calibration.name, mean, covariance

    def biases(self, state: Belief) -> tuple[np.ndarray, np.ndarray]:
        """Return the biases of gyroscope, rad/s, and accelerometer, m/s², and, where it is
        estimated, by how much the unit's clock is ahead beside what is known, s; and their σ."""
        mean, covariance = jax.device_get(_biases(self.slam, state))
        return mean, np.sqrt(np.diagonal(covariance))

    def compile(self, wide: list[Association]) -> list[threading.Thread]:
        """Start threads that compile all programs: the longest first, beside those that are needed
        first."""
        slam, state, still = self.slam, self.empty(), np.zeros(())
        if self.inertial is not None:
            still = self.inertial.imu.still(jnp.float64)
        new = _padded(*_NOWHERE, self.settings.wanted)
        none, gone = _measured(new, np.zeros(0)), np.zeros(self.settings.capacity, bool)

        def predicted() -> Predicted:
            (ahead, gaussian), joint, view = _predict.compile(slam, state, still)
            return Predicted(still, ahead, gaussian, joint, Prediction(*view))

        def believed(association: Association | None) -> None:
            S, slots, several = np.zeros((0, 2, 0, 2)), np.zeros(0, int), association is not None
            nothing = Candidates(np.zeros((0, 2)), S, np.zeros(0, bool), slots)
            one = association or ASSOCIATIONS[self.settings.association]
            _believed.compile(one, self._of_fixed_size(nothing, several=several))
            if several:
                _curved.compile(slam, *predicted()[1:3], still)

        back = (
            lambda: _moving.compile(slam, state, np.eye(4), np.zeros(6), still),
            lambda: _at_rest.compile(slam, state),
        )
        graph = [compile_graph(slam, state, self.settings)] if in_submaps(slam) else []
        return in_background(
            lambda: _renew_map.compile(slam, state, new),
            lambda: _begin_map.compile(slam, state, new, None),
            lambda: _correct.compile(slam, predicted().state, still, none),
            *(partial(believed, one) for one in (None, *wide)),
            lambda: _world_points.compile(slam, state, self.settings.capacity),
            lambda: _remove.compile(slam, state, gone),
            *(back if self.inertial is None else ()),
            lambda: self.camera(state),
            *graph,
            threads=2,
        )

    def _of_fixed_size(self, found: Candidates, *, several: bool) -> Candidates:
        """Return as many as there can be, by their landmarks: those added are not valid."""
        slots, m = found.landmark, len(found.landmark)
        size = self.settings.wanted * (PEAKS if several else 1)
        padded = np.tile(np.eye(2)[:, None], (size, 1, size, 1)) * np.eye(size)[:, None, :, None]
        padded[:m, :, :m] = found.covariance
        landmark = np.argmax(slots == slots[:, None], axis=1) if m else slots
        more = (0, size - m)
        landmark = np.pad(landmark, more, constant_values=size - 1)
        residual, valid = np.pad(found.residual, (more, (0, 0))), np.pad(found.valid, more)
        return Candidates(residual, padded, valid, landmark)

    def _innovations(
        self, predicted: Predicted, seen: Observations
    ) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Return the joint covariance of what was seen, and by how much it is not as expected."""
        size = 2 * len(seen.slots)
        S = predicted.joint[seen.slots][:, :, seen.slots].reshape(size, size)
        more = (self.settings.noise_factors(seen.variances) - 1) * self.settings.pixel_sigma**2
        residual = seen.pixels - predicted.view.pixels[seen.slots]
        return S + np.diag(np.repeat(more, 2)), residual.ravel()

    def _created(
        self, create: Program, state: Belief, slots: Slots, pixels: Pixels, *depths: PyTree
    ) -> tuple[Belief, CameraReport]:
        new = _padded(slots, pixels, self.settings.wanted)
        state, found = create(self.slam, state, new, *depths)
        report = CameraReport(*jax.device_get(found))
        _check_finite(report.T_wc, report.covariance)
        return state, report


def _check_finite(*arrays: np.ndarray) -> None:
    if not all(np.isfinite(x).all() for x in arrays):
        raise FloatingPointError("the camera's pose is not finite")


def _padded(slots: Slots, pixels: Pixels, size: int) -> Features:
    """Features of fixed number; NaN pixels and padding are not valid."""
    missing = size - len(slots)
    valid = np.pad(np.isfinite(pixels).all(axis=1), (0, missing))
    pixels = np.pad(np.nan_to_num(pixels), ((0, missing), (0, 0)))
    return Features(np.pad(slots, (0, missing)), pixels, valid)


def _measured(features: Features, factors: Float[np.ndarray, " k"]) -> Features:
    """The features with these factors of their noise."""
    more = np.pad(factors, (0, len(features.slots) - len(factors)), constant_values=1.0)
    return replace(features, noise_factor=more)


@partial(Program, options=QUICK)
def _empty(slam: AbstractStaged, capacity: int, before: Belief | None) -> Belief:
    return _going_on(slam, before).init(capacity)


def _going_on(slam: AbstractStaged, state: Belief | None) -> AbstractStaged:
    """The filter whose inertial unit, if it has one, starts as it is in this state; what is not
    finite of its covariance is as little known as at a start in motion."""
    if state is None or not (isinstance(slam, AbstractSlam) and isinstance(slam.motion, Imu)):
        return slam
    _, now = slam.gaussian(state, None)
    part = now.core.part("motion")
    size = part.stop - part.start
    # The length of gravity's direction has no variance, but for rounding.
    root = jnp.linalg.cholesky(now.covariance[part, part] + 1e-12 * jnp.eye(size))
    started = slam.motion.begun(now.core.motion, root)
    wide = replace(started, root=None).start()[1]
    root = jnp.where(jnp.isfinite(root).all(), root, wide)
    return replace(slam, motion=replace(started, root=root))


@Program
def _remove(slam: AbstractStaged, state: Belief, gone: jax.Array) -> Belief:
    return slam.remove(state, gone)


@Program
def _moving(
    slam: AbstractStaged, state: Belief, T: jax.Array, sigma: jax.Array, dt: jax.Array
) -> Belief:
    return _with_velocity(state, log(jaxlie.SE3.from_matrix(T)) / dt, jnp.diag((sigma / dt) ** 2))


@Program
def _at_rest(slam: AbstractSlam, state: Belief) -> Belief:
    velocity, root = slam.motion.start()
    return _with_velocity(state, velocity, root @ root.T)


def _with_velocity(state: Belief, velocity: jax.Array, covariance: jax.Array) -> Belief:
    """Every Gaussian with another velocity, of which nothing was known."""

    def one(state: State) -> State:
        part = state.core.part("motion")
        state = marginalised(state, part.start, len(covariance))
        state = replace(state, core=replace(state.core, motion=velocity))
        return augmented(state, part.start, covariance)

    return each_gaussian(state, one)


@Program
def _predict(
    slam: AbstractStaged, state: Belief, control: Control
) -> tuple[tuple[Belief, Belief], jax.Array, tuple[PyTree, ...]]:
    """The predicted state, as it is and as one Gaussian, and of that the covariance of all
    innovations and the `Prediction`."""
    state = slam.predict(state, control)
    one, gaussian = slam.gaussian(state, control)
    slots = jnp.arange(slam.in_map(state).size)
    seen = one.predict_features(gaussian, control, slots)
    usable = seen.possible & jnp.isfinite(seen.covariance).all(axis=(1, 2))
    joint = candidates(one, gaussian, control, Features(slots, seen.measured, usable)).covariance
    metres = jnp.exp(log_unit(one, gaussian))
    pose, omegas = scaled(seen.pose, 1 / metres).as_matrix(), metres * seen.omegas
    sides = landmarks_on_sides(one, gaussian, slots)
    prediction = seen.measured, seen.covariance, usable, pose, seen.points, omegas, sides
    return (state, gaussian), joint, prediction


@Program
def _believed(association: Association, found: Candidates) -> Bool[jax.Array, " m"]:
    return association(found)


@Program
def _curved(slam: AbstractStaged, state: Belief, gaussian: Belief, control: Control) -> jax.Array:
    """The terms of second order of every slot's measurement, (n, 2, 2)."""
    one, _ = slam.gaussian(state, control)
    if not isinstance(one, AbstractSlam):
        return jnp.zeros(())
    return second_order(one, gaussian, control, jnp.arange(slam.in_map(state).size))


@Program
def _correct(
    slam: AbstractStaged, state: Belief, control: Control, features: Features
) -> tuple[Belief, tuple[jax.Array, ...]]:
    state, innovation = slam.update(state, control, features)
    state = slam.compose(state, control)
    return state, (innovation.used, innovation.nis, innovation.nis_dof, innovation.status)


@partial(Program, options=QUICK)
def _begin_map(
    slam: AbstractStaged, state: Belief, new: Features, depths: tuple[jax.Array, jax.Array] | None
) -> tuple[Belief, Report]:
    capacity, slam = slam.in_map(state).size, _going_on(slam, state)
    if depths is None:
        state = slam.init(capacity, new)
    else:
        assert isinstance(slam, AbstractSlam)
        state = init_with_depths(slam, capacity, new, depths)
    return state, _reported(slam, state)


@Program
def _renew_map(slam: AbstractStaged, state: Belief, new: Features) -> tuple[Belief, Report]:
    state = slam.close(state, new)
    return state, _reported(slam, state)


def _reported(slam: AbstractStaged, state: Belief) -> Report:
    seen = camera_pose_in_unit(slam, state)
    fixed, gone = slam.unit_fixed(state), left(slam, state)
    return seen.pose.as_matrix(), *seen[1:], fixed, gone, slam.in_map(state)


@Program
def _intrinsics(slam: AbstractStaged, state: Belief) -> tuple[jax.Array, jax.Array]:
    model = slam.model
    assert model is not None

    def intrinsics(view: CameraView) -> jax.Array:
        sensor = model.sensor_at(view.core.calibration)
        assert isinstance(sensor, Pinhole)
        return sensor.camera.intrinsics

    return slam.marginal(state, intrinsics)


@Program
def _biases(slam: AbstractStaged, state: Belief) -> tuple[jax.Array, jax.Array]:
    return slam.marginal(state, lambda x: jnp.append(x.core.motion.bias, x.core.motion.clock))


@Program
def _world_points(
    slam: AbstractStaged, state: Belief, capacity: int
) -> tuple[jax.Array, jax.Array]:
    return landmarks_in_unit(slam, state, jnp.arange(capacity))
