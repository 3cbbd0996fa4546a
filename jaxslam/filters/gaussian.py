"""The frames of a filter that is one Gaussian: an EKF composed of its pieces.

A frame is `predict`, `update`, `compose`, `close`. The motion is composed after the update, as the
paper has it, or before. What the stages are made of are functions of this file, for the layers
around a Gaussian and for filters that are built of these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray, cast, check_numbers, check_shape, is_known, precision
from jaxslam.filters.layer import AbstractLayer, AbstractSlam
from jaxslam.filters.linear import covariance as linear
from jaxslam.filters.linear.blocks import Change, Landmark, Noise, Prior
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.filters.protocol import Belief, CameraView, Expected, LandmarkView, OfLandmark
from jaxslam.geometry import SplitPose, difference, identity
from jaxslam.models.motion import Control, check_control
from jaxslam.models.observations import Capacity, Features, Innovation, PriorMap
from jaxslam.models.sensors import noises


class OneGaussian(AbstractLayer):
    """The innermost layer: the stages of an extended Kalman filter."""

    def ambiguous_start(self, slam):
        return False

    def init(self, slam, capacity, first, known):
        """An exactly known pose at the origin of B, the motion's start, an empty map.

        Raises ValueError for a capacity that is none, and for features of another shape.
        """
        state = _empty(slam, Capacity.of(capacity).landmarks, precision(slam))
        if known is not None:
            state = _with_prior_map(slam, state, known)
        if first is None:
            return state
        check_features(slam, first, len(state.landmarks))
        return slam.close(with_frames_calibration(slam, state), first)

    def predict(self, slam, state, control):
        """Append this step's noise; move already where the motion is composed first."""
        check_control(slam.motion, control)
        return composed_first(slam, append_noise(slam, state), control)

    def predict_features(self, slam, state, control, slots):
        context = context_of(slam, control)
        model, core = slam.model, state.core
        measured, covariance, possible = linear.expected(model, state, slots, context)
        if not compose_first(slam):
            core = model.compose_core(core, context)
        view = model.view(state.core, context)
        points, omegas = jax.vmap(model.metric_point, in_axes=(None, 0))(
            view, state.landmarks[slots]
        )
        possible = possible & state.active[slots]
        covariance = covariance + noises(slam.sensor, measured)
        return Expected(measured, covariance, possible, model.camera_pose(core), points, omegas)

    def gaussian(self, slam, state, control):
        del control
        return slam, state

    def update(self, slam, state, control, seen):
        check_features(slam, seen)
        return correct(slam, state, control, seen)

    def compose(self, slam, state, control):
        """Move into the new camera frame, after the update (P18–P21); convert landmarks; make the
        camera a keyframe where one is due."""
        if not compose_first(slam):
            state = linear.composed(slam.model, state, Context(control))
        if slam.frame.reanchors:
            due = slam.model.keyframe_left(state)
            state = jax.lax.cond(due, lambda state: reanchored(slam, state), lambda s: s, state)
        if not slam.landmark.converts:
            return state
        return linear.converted(slam.model, state, COMPOSED)

    def close(self, slam, state, new):
        check_features(slam, new)
        return forgotten(slam, insert(slam, state, new))

    def remove(self, slam, state, gone):
        return linear.removed(state, gone)

    def marginal(self, slam, state, function):
        """The marginal of the state at the end of a frame, to first order: `J P Jᵀ`."""

        def of_core(core: Core) -> PyTree:
            return function(CameraView(slam.model.camera_pose(core), core, core.log_scale))

        return linear.core_moments(of_core, state)

    def landmark_marginal(self, slam, state, function, slots):
        return linear.landmark_moments(composed, of_landmark(slam, function), state, slots)

    def in_map(self, slam, state):
        return state.active

    def pose_error(self, slam, state, T_BC):
        """`T_true ⊟ T_est` of the pose that the frame holds, and its covariance."""
        frame = slam.frame
        estimate, covariance = linear.core_moments(slam.model.estimate, state)
        return difference(frame.estimate(frame.from_base_pose(T_BC)), estimate), covariance

    def unit_fixed(self, slam, state):
        del state
        return jnp.ones((), bool)


def compose_first(slam: AbstractSlam) -> bool:
    """Whether the motion is composed before the update: where landmarks stay where they are."""
    return not slam.frame.moves_landmarks


def composed(core: Core) -> Core:
    """The part of a core on which camera and landmarks depend once the motion is composed."""
    nothing = core.noise[:0]
    return replace(
        core, motion=None, noise=nothing, calibration=nothing, depth_error=None, base_motion=None
    )


def of_landmark(slam: AbstractSlam, function: OfLandmark) -> Landmark:
    """A function of a landmark's view as one of the core, as `composed` leaves it, and of the
    landmark."""

    def value(core: Core, landmark: Array) -> Float[Array, " k"]:
        seen = slam.model.metric_point(slam.model.view(core, COMPOSED), landmark)
        return function(LandmarkView(slam.model.camera_pose(core), *seen, core.log_scale))

    return value


def append_noise(slam: AbstractSlam, state: State) -> State:
    """Append this step's motion noise and calibration error (P10, P11, P15)."""
    start, sigma = state.core.part("noise").start, slam.model.noise_sigma
    state = linear.augmented(state, start, jnp.diag(sigma**2))
    return with_frames_calibration(slam, state)


def composed_first(slam: AbstractSlam, state: State, control: Control) -> State:
    """Move already, where the motion is composed before the update."""
    if not compose_first(slam):
        return state
    return linear.composed(slam.model, state, Context(control))


def context_of(slam: AbstractSlam, control: Control) -> Context:
    """The context of a predicted state's functions: the motion that is not yet composed."""
    return COMPOSED if compose_first(slam) else Context(control)


def correct(
    slam: AbstractSlam, state: State, control: Control, seen: Features
) -> tuple[State, Innovation]:
    """The update by features of slots (P16, P17), and its innovation."""
    context = context_of(slam, control)
    left = slice(0, 0) if slam.calibration.corrected else state.core.part("calibration")
    noise = noise_of(slam, seen)
    return slam.correction.update(slam.model, state, seen, noise, context, left)


def noise_of(slam: AbstractSlam, features: Features) -> Noise:
    """R of a measurement, for all features or for each: the sensor's times their own factors."""
    noise = noises(slam.sensor, features.measured)
    if features.noise_factor is None:
        return noise
    return noise * features.noise_factor[:, None, None]


def init_with_depths(
    slam: AbstractSlam, capacity: int | Capacity, first: Features, prior: Prior
) -> State:
    """`init` of landmarks each of which has a prior of its own: mean and σ of 1/z."""
    check_features(slam, first)
    state = with_frames_calibration(slam, slam.init(capacity))
    return forgotten(slam, insert(slam, state, first, prior))


def insert(slam: AbstractSlam, state: State, new: Features, prior: Prior | None = None) -> State:
    """Insert Gaussians into slots (P22–P26); 1/z has the filter's prior, or one for each slot."""
    context = COMPOSED
    prior = _depth_prior(slam, state) if prior is None else prior
    if slam.landmark.anchored:
        anchor = _free_anchor(state)
        state = linear.reparametrised(state, slam.model.anchoring(anchor))
        context = Context(None, anchor)
    state = linear.initialised(slam.model, state, new, noise_of(slam, new), prior, context)
    return slam.correction.remember(state, new.places(state.active.size))


def reanchored(slam: AbstractSlam, state: State) -> State:
    """The current camera as the keyframe: landmarks move to it, and T_KC is known."""
    return linear.reparametrised(state, slam.model.reanchoring())


def rebased(state: State) -> State:
    """The current camera as the one in which a submap begins: `T_BK ← T_BK T_KC`, T_KC is the
    identity, and the motion's variables are kept as they are now."""

    def core(core):
        return replace(core, pose=core.pose.reanchored(), base_motion=core.motion)

    return linear.reparametrised(state, Change(core=core, view=lambda core: (), landmark=None))


def each_gaussian(belief: Belief, function: Callable[[State], State]) -> Belief:
    """The belief with a function of every Gaussian in it, of which sums have batches."""

    def is_gaussian(node: PyTree) -> bool:
        return isinstance(node, State)

    def one(node: PyTree) -> PyTree:
        if not is_gaussian(node):
            return node
        return jax.vmap(function)(node) if node.covariance.ndim == 3 else function(node)

    return jax.tree.map(one, belief, is_leaf=is_gaussian)


def check_features(slam: AbstractSlam, features: Features, capacity: int | None = None) -> None:
    """Raise ValueError unless they are measurements of the filter's sensor, and, where a capacity
    is given, of as many landmarks in slots of it."""
    m, p = features.slots.shape[-1], slam.sensor.size
    wanted = {"slots": (m,), "measured": (m, p), "valid": (m,)}
    for name, shape in wanted.items():
        found = getattr(features, name).shape
        if found[-len(shape) :] != shape:
            raise ValueError(
                f"features.{name} has shape {found}; {type(slam.sensor).__name__} measures "
                f"{p} numbers of each of {m} landmarks: it needs {shape}"
            )
    if capacity is not None and is_known(features.valid):
        _check_slots("features", features.slots, features.valid, capacity)


def _empty(slam: AbstractSlam, capacity: int, dtype: DTypeLike) -> State:
    geometry = slam.motion.geometry
    slam = cast(slam, dtype)
    variables, log_scale, covariance = slam.scale.start(slam.motion)
    depth = slam.depth
    unit = None if log_scale is None else depth.unit
    if log_scale is not None and unit is not None:
        log_scale = jnp.append(log_scale, 0.0)
    pose = slam.frame.from_base_pose(identity(geometry, dtype))
    core = Core(
        pose=pose,
        motion=variables,
        log_scale=log_scale,
        noise=jnp.zeros(slam.model.noise_sigma.size, dtype),
        calibration=jnp.zeros(slam.calibration.sigma.shape, dtype),
        anchors=_no_anchors(slam, capacity, dtype),
        depth_error=None if depth.common is None else jnp.zeros(1, dtype),
        base_motion=variables if slam.frame.begins_submaps else None,
    )
    # An empty slot holds a point straight ahead: finite in every formula.
    ahead = jnp.zeros(geometry.point_dim, dtype).at[-1].set(1.0)
    empty = slam.landmark.initialise(ahead, depth.mean, jnp.asarray(slam.sensor.focal, dtype))
    state = linear.empty(core, jnp.tile(empty, (capacity, 1)))
    state = slam.correction.remember(state, jnp.arange(capacity))
    state = linear.augmented(state, core.part("motion").start, covariance)
    if unit is not None:
        variance = jnp.reshape(unit**2, (1, 1))
        state = linear.augmented(state, core.part("log_scale").start + 1, variance)
    if depth.common is not None:
        common = jnp.reshape(depth.common**2, (1, 1))
        state = linear.augmented(state, core.part("depth_error").start, common)
    if slam.frame.begins_submaps:
        state = rebased(state)
    return state if slam.calibration.each_frame else _with_calibration(slam, state)


def _check_slots(whose: str, slots: Int[AnyArray, " m"], valid: AnyArray, capacity: int) -> None:
    if not is_known(slots):
        return
    slots = np.asarray(slots)[np.asarray(valid)]
    inside = (slots >= 0) & (slots < capacity) & (slots % 1 == 0)
    if not np.all(inside) or len(np.unique(slots)) < slots.size:
        wanted = f"whole numbers from 0 to {capacity - 1}, each once"
        raise ValueError(f"the slots of {whose} are {wanted}, not {slots.tolist()}")


def _with_prior_map(slam: AbstractSlam, state: State, known: PriorMap) -> State:
    """The state with the landmarks of a prior map: `X ~ N(points, covariance)` in B, which is the
    camera. Their length is the metre: what is not known of the filter's own unit is in them."""
    m, n = known.slots.size, slam.motion.geometry.point_dim
    wanted = {"slots": (m,), "points": (m, n), "covariance": (m * n,) * 2}
    for name, shape in wanted.items():
        check_shape(f"a prior map's {name}", getattr(known, name), shape)
        check_numbers(f"a prior map's {name}", getattr(known, name))
    _check_slots("a prior map", known.slots, np.ones(m, bool), len(state.landmarks))
    if is_known(P := known.covariance):
        rounding = 1e-5 * np.max(np.abs(P), initial=0.0)
        if np.any(np.abs(P - P.T) > rounding) or np.any(np.diag(P) < 0):
            raise ValueError("a prior map's covariance is symmetric, with no variance below 0")
    one, focal = jnp.ones((), state.landmarks.dtype), jnp.asarray(slam.sensor.focal)

    def log_scale(core):
        return core.noise[:0] if core.log_scale is None else core.log_scale

    def landmark(log_scale, point):
        omega = one * jnp.exp(jnp.sum(log_scale))
        return slam.landmark.initialise(point, omega, focal), None

    points = jnp.asarray(known.points, one.dtype)
    values, _, J = linear.local_jacobians(log_scale, landmark, state.core, points)
    P = jnp.asarray(known.covariance, one.dtype).reshape(m, n, m, n)
    own = jnp.einsum("mdn,mnkl,kel->mdke", J.by_landmark, P, J.by_landmark)
    state = linear.with_landmarks(state, jnp.asarray(known.slots), values, J, own)
    return slam.correction.remember(state, jnp.asarray(known.slots))


def _no_anchors(slam: AbstractSlam, capacity: int, dtype: DTypeLike) -> SplitPose | None:
    if not slam.landmark.anchored:
        return None
    origin = SplitPose.of(identity(slam.motion.geometry, dtype))
    return jax.tree.map(lambda x: jnp.tile(x, (capacity, 1)), origin)


def _with_calibration(slam: AbstractSlam, state: State) -> State:
    covariance = jnp.diag(jnp.asarray(slam.calibration.sigma) ** 2)
    return linear.augmented(state, state.core.part("calibration").start, covariance)


def with_frames_calibration(slam: AbstractSlam, state: State) -> State:
    return _with_calibration(slam, state) if slam.calibration.each_frame else state


def forgotten(slam: AbstractSlam, state: State) -> State:
    """The state without the frame's calibration error, where the next frame draws another."""
    if not slam.calibration.each_frame:
        return state
    part = state.core.part("calibration")
    core = replace(state.core, calibration=jnp.zeros_like(state.core.calibration))
    return replace(linear.marginalised(state, part.start, part.stop - part.start), core=core)


def _depth_prior(slam: AbstractSlam, state: State) -> Prior:
    """Mean and σ of what a measurement hides of a landmark, its own part alone."""
    hidden, depth = slam.sensor.hidden, slam.depth
    mean, sigma = jnp.tile(depth.mean, hidden), jnp.tile(depth.sigma, hidden)
    variance = None
    if slam.scale.free:
        variance = linear.core_moments(lambda core: core.log_scale, state)[1][0, 0]
    return slam.scale.prior(mean, sigma, variance)


def _free_anchor(state: State) -> Int[Array, ""]:
    """One that no landmark refers to; there are as many anchors as landmarks."""
    number = jnp.where(state.active, state.landmarks[:, -1].astype(int), state.active.size)
    return jnp.argmin(jnp.zeros(state.active.size, bool).at[number].set(True, mode="drop"))
