"""Tests of jaxslam.filters.linear.covariance: dense filters, Jacobians, and invariances."""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    Case,
    central,
    close,
    crossed,
    each_geometry,
    few_landmarks,
    named,
    pose,
    quick_jit,
    run_filter,
)

from jaxslam._numerics.arrays import cast
from jaxslam.filters.linear import blocks
from jaxslam.filters.linear import covariance as linear
from jaxslam.filters.linear.blocks import Blocks, observed, placed
from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.filters.slam import Slam
from jaxslam.geometry import PLANAR, SPATIAL, difference, retract
from jaxslam.landmarks import LANDMARKS, InverseScaling
from jaxslam.models.calibration import Known, White
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import Robocentric, WorldCentric
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features, Status
from jaxslam.models.sensors import Pinhole

update = Kalman().update

# --- a linear Gaussian problem, where the EKF must be the Kalman filter -------------------------


class Robot(NamedTuple):
    position: jax.Array
    velocity: jax.Array
    acceleration: jax.Array


class Frame(NamedTuple):
    """Context: the seconds not yet composed, and how the third coordinate shows (this frame)."""

    dt: jax.Array
    slant: jax.Array


@dataclass(frozen=True)
class Linear:
    """Landmarks (x, y, e); seen are (x, y) from the robot, plus e times a slant that changes.

    A single sighting says nothing of e, as one picture says nothing of depth.
    """

    moves_landmarks: bool

    def given(self, core, context):
        return context

    def compose_core(self, core, context):
        velocity = core.velocity + core.acceleration * context.dt
        position = core.position + velocity * context.dt
        return Robot(position, velocity, jnp.zeros_like(core.acceleration))

    def view(self, core, context):
        step = (core.velocity + core.acceleration * context.dt) * context.dt
        return step if self.moves_landmarks else core.position + step

    def compose_landmark(self, view, landmark, context):
        return landmark.at[:2].add(-view)

    def observe(self, view, landmark, context):
        return landmark[:2] + context.slant * landmark[2] - view, jnp.array(True)

    def residual(self, measured, predicted):
        return measured - predicted

    def initialise(self, view, measured, hidden, context):
        return jnp.append(measured + view - context.slant * hidden, hidden)

    def convert(self, view, landmark, covariance, context):
        return landmark


DT, STEPS, CAPACITY = 0.1, 40, 4
ACCELERATION_SIGMA, NOISE, PRIOR = 0.7, 0.02 * np.array([[2.0, 0.5], [0.5, 1.0]]), (0.8, 0.6)
# Landmark: slot, frames in which it is seen, frame after which it is removed.
LIVES = {
    0: (1, range(0, 18), 20),
    1: (0, [0, 1, 2, 9, 10, 11, 30, 39], None),
    2: (3, range(4, 12), 12),
    3: (1, range(21, 40), None),
    4: (3, range(13, 40, 3), 35),
    5: (2, [7], 8),
}
START = np.array([0.0, 0.0, 1.0, -0.5]), np.diag([0.0, 0.0, 0.2, 0.3]) ** 2


def linear_world():
    """Measurements {frame: {landmark: pixel}} and slants, drawn from the model itself."""
    rng = np.random.default_rng(4)
    slants = rng.normal(size=(STEPS, 2))
    points = rng.normal([0, 0, PRIOR[0]], [5, 5, PRIOR[1]], (len(LIVES), 3))
    position, velocity = np.zeros(2), rng.normal(START[0][2:], [0.2, 0.3])
    pixels = []
    for k in range(STEPS):
        if k:
            velocity = velocity + DT * rng.normal(0, ACCELERATION_SIGMA, 2)
            position = position + DT * velocity
        ideal = points[:, :2] + points[:, 2:] * slants[k] - position
        noisy = ideal + rng.multivariate_normal([0, 0], NOISE, len(points))
        pixels.append({j: noisy[j] for j, (_, seen, _) in LIVES.items() if k in seen})
    return pixels, slants


def kalman(pixels, slants):
    """The textbook filter with full matrices, in world coordinates; yields (names, x, P)."""
    x, P = START
    order = []  # landmarks in the state, as they came
    for k in range(STEPS):
        n = len(x)
        if k:
            F, G = np.eye(n), np.zeros((n, 2))
            F[:2, 2:4] = DT * np.eye(2)
            G[:2], G[2:4] = DT**2 * np.eye(2), DT * np.eye(2)
            x, P = F @ x, F @ P @ F.T + ACCELERATION_SIGMA**2 * G @ G.T
        for j, z in pixels[k].items():
            if j not in order:
                continue
            H = np.zeros((2, n))
            at = 4 + 3 * order.index(j)
            H[:, :2], H[:, at : at + 2], H[:, at + 2] = -np.eye(2), np.eye(2), slants[k]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + NOISE)
            x, P = x + K @ (z - H @ x), (np.eye(n) - K @ H) @ P
        for j, z in pixels[k].items():
            if j in order:
                continue
            n = len(x)
            e, sigma = PRIOR
            J, U = np.zeros((n + 3, n)), np.zeros((n + 3, 3))
            J[:n] = np.eye(n)
            J[n : n + 2, :2], U[n : n + 2, :2] = np.eye(2), np.eye(2)
            U[n : n + 2, 2], U[n + 2, 2] = -slants[k], 1
            noise = np.block([[NOISE, np.zeros((2, 1))], [np.zeros((1, 2)), sigma**2]])
            x = np.concatenate([x, z + x[:2] - slants[k] * e, [e]])
            P = J @ P @ J.T + U @ noise @ U.T
            order.append(j)
        for j in [j for j in order if LIVES[j][2] == k]:
            at = 4 + 3 * order.index(j)
            kept = np.delete(np.arange(len(x)), range(at, at + 3))
            x, P = x[kept], P[np.ix_(kept, kept)]
            order.remove(j)
        yield list(order), x, P


def packed(seen):
    """Features of {landmark: pixel}, padded by features that are not valid and hold NaN."""
    slots, pixels = np.zeros(CAPACITY, int), np.full((CAPACITY, 2), np.nan)
    valid = np.arange(CAPACITY) < len(seen)
    for i, (j, z) in enumerate(seen.items()):
        slots[i], pixels[i] = LIVES[j][0], z
    return Features(jnp.asarray(slots), jnp.asarray(pixels), jnp.asarray(valid))


def linear_start():
    x, P = (jnp.asarray(a) for a in START)
    n = 6 + 3 * CAPACITY
    state = State(
        core=Robot(x[:2], x[2:], jnp.zeros(2)),
        landmarks=jnp.zeros((CAPACITY, 3)),
        active=jnp.zeros(CAPACITY, bool),
        covariance=jnp.zeros((n, n)),
    )
    return linear.augmented(state, 0, P)


@cache
def linear_step(moves_landmarks, first=False):
    """One frame of the filter: robocentric composes after the update, world before it."""
    model, noise = Linear(moves_landmarks), jnp.asarray(NOISE)

    def step(state, slant, known, new, gone):
        here, motion = Frame(jnp.zeros(()), slant), Frame(jnp.asarray(DT), slant)
        if not first:
            state = linear.augmented(state, 4, ACCELERATION_SIGMA**2 * jnp.eye(2))
            if moves_landmarks:
                state, _ = update(model, state, known, noise, motion)
                state = linear.composed(model, state, motion)
            else:
                state = linear.composed(model, state, motion)
                state, _ = update(model, state, known, noise, here)
        prior = jnp.array(PRIOR[:1]), jnp.array(PRIOR[1:])
        state = linear.initialised(model, state, new, noise, prior, here)
        return linear.removed(state, gone)

    return quick_jit(step)


def linear_run(moves_landmarks, steps=STEPS):
    """The filter's state after every frame."""
    state, in_map = linear_start(), set()
    pixels, slants = linear_world()
    for k in range(steps):
        known = {j: z for j, z in pixels[k].items() if j in in_map}
        new = {j: z for j, z in pixels[k].items() if j not in in_map}
        in_map |= set(new)
        ending = [j for j in in_map if LIVES[j][2] == k]
        in_map -= set(ending)
        gone = np.isin(np.arange(CAPACITY), [LIVES[j][0] for j in ending])
        step = linear_step(moves_landmarks, first=k == 0)
        state = step(state, slants[k], packed(known), packed(new), gone)
        yield state


def in_world(state, order, robocentric):
    """Mean and covariance of (position, velocity, landmarks of `order`) in world coordinates."""
    mean = np.concatenate([*state.core, state.landmarks.ravel()])
    picked = list(range(4))
    T = np.eye(len(mean))
    for j in order:
        at = 6 + 3 * LIVES[j][0]
        picked += range(at, at + 3)
        if robocentric:
            T[at : at + 2, :2] = np.eye(2)
    T = T[picked]
    return T @ mean, T @ state.covariance @ T.T


@pytest.mark.parametrize("robocentric", [True, False], ids=["robocentric", "world"])
def test_on_a_linear_problem_the_filter_is_the_kalman_filter(robocentric):
    pixels, slants = linear_world()
    largest = 0
    for state, (order, x, P) in zip(linear_run(robocentric), kalman(pixels, slants), strict=True):
        mean, covariance = in_world(state, order, robocentric)
        # Numbers of order 10 and 40 steps of rounding.
        np.testing.assert_allclose(mean, x, rtol=0, atol=1e-10)
        np.testing.assert_allclose(covariance, P, rtol=0, atol=1e-10)
        assert set(np.flatnonzero(state.active)) == {LIVES[j][0] for j in order}
        largest = max(largest, len(order))
    assert largest == CAPACITY  # the schedule fills the map, so that every slot is tried


def rows_of(c, order, d):
    """Places in the state of the core and of the slots in another order."""
    return np.concatenate([np.arange(c), (c + d * order[:, None] + np.arange(d)).ravel()])


# --- the real models, against dense Jacobians of the whole state --------------------------------


def pieces(geometry) -> dict[str, Any]:
    p, t = geometry.pixel_dim, geometry.tangent_dim
    return {
        "motion": ConstantVelocity(np.full(t, 0.1), np.zeros(t), np.full(t, 0.1)),
        "sensor": Pinhole(Camera([650.0, 640.0][:p], [320.0, 240.0][:p]), 0.3),
        "calibration": White([3.0, 3.0, 2.0, 2.0][: 2 * p]),
        "depth": InverseDepth(1 / 6, 1 / 12),
    }


def slam_model(geometry, landmark, frame):
    return Slam(landmark=landmark, frame=frame, **pieces(geometry)).model


def noise_of(geometry):
    """R of one measurement, of σ = 0.3 pixels."""
    return 0.09 * jnp.eye(geometry.pixel_dim)


BEARINGS = np.array([[0.3, -0.2], [-0.25, 0.1], [0.1, 0.25]])
DEPTHS = np.array([4.0, 7.0, 2.5])
STEP = 0.2


def generic_state(model, capacity=3):
    """Three landmarks ahead, first seen from elsewhere, everything correlated and nothing zero."""
    geometry, rng = model.geometry, np.random.default_rng(8)
    t, p = geometry.tangent_dim, geometry.pixel_dim
    core = Core(
        pose=model.frame.from_base_pose(pose(geometry, 11)),
        motion=jnp.asarray(rng.normal(0, 0.5, t)),
        log_scale=None,
        noise=jnp.asarray(rng.normal(0, 0.5, t)),
        calibration=jnp.asarray(rng.normal(0, 2, 2 * p)),
    )
    T_AC = model.view(core, Context(jnp.asarray(STEP))).map_from_camera
    elsewhere = pose(geometry, 12, scale=0.1)

    def landmark(bearing, depth):
        seen = model.landmark.initialise(jnp.append(bearing, 1.0), 1 / depth, jnp.asarray(650.0))
        return model.landmark.transform(T_AC @ elsewhere, seen)

    landmarks = jax.vmap(landmark)(BEARINGS[:, :p], DEPTHS)
    n = 3 * t + 2 * p + landmarks.size
    factor = rng.normal(0, 0.05, (n, n))
    return State(core, landmarks, jnp.ones(3, bool), jnp.asarray(factor @ factor.T))


def whole_state_function(model, state, context):
    """δ ↦ stacked measurements of every landmark, then the composed state ⊟ its mean."""
    c, shape = state.core_dim, state.landmarks.shape
    mean = model.compose_core(state.core, context)

    def function(delta):
        core = retract(state.core, delta[:c])
        landmarks = state.landmarks + delta[c:].reshape(shape)
        view = model.view(core, context)
        pixels = jax.vmap(lambda x: model.observe(view, x, context)[0])(landmarks)
        if model.moves_landmarks:
            landmarks = jax.vmap(lambda x: model.compose_landmark(view, x, context))(landmarks)
        composed = difference(model.compose_core(core, context), mean)
        return jnp.concatenate([pixels.ravel(), composed, landmarks.ravel()])

    return function


@cache
def slam_case(geometry, landmark, frame):
    """A generic state; compiled: update with composition, the dense function, its Jacobian."""
    model = slam_model(geometry, landmark, frame)
    context = Context(jnp.asarray(STEP))
    state = quick_jit(lambda: generic_state(model))()

    def block_wise(state, features):
        updated, innovation = update(model, state, features, noise_of(geometry), context)
        return updated, innovation, linear.composed(model, state, context)

    def dense(state, delta):
        return whole_state_function(model, state, context)(delta)

    jacobian = jax.jacfwd(dense, argnums=1)
    return state, quick_jit(block_wise), quick_jit(dense), quick_jit(jacobian)


@cache
def compiled_retract():
    return quick_jit(retract)


def middle_only(state, geometry, pixel):
    """Features of all three landmarks, of which only the middle one counts."""
    pixels = np.full((3, geometry.pixel_dim), np.nan)
    pixels[1] = pixel
    return Features(jnp.arange(3), jnp.asarray(pixels), jnp.array([False, True, False]))


@crossed(
    ("geometry", "frame", "landmark"),
    each_geometry,
    [Robocentric(), WorldCentric()],
    few_landmarks,
    quick=[
        (SPATIAL, Robocentric(), LANDMARKS["inverse_scaling"]),
        (PLANAR, WorldCentric(), LANDMARKS["inverse_depth"]),
        (PLANAR, Robocentric(), LANDMARKS["cartesian"]),
    ],
)
def test_blocks_are_the_dense_jacobians_with_only_the_middle_landmark_seen(
    geometry, frame, landmark
):
    state, block_wise, dense, jacobian = slam_case(geometry, landmark, frame)
    p, c, zero = geometry.pixel_dim, state.core_dim, np.zeros(len(state.covariance))
    pixels, composed = np.split(dense(state, zero), [3 * p])
    both = np.asarray(jacobian(state, zero))
    differences = central(lambda delta: np.asarray(dense(state, delta)), zero)
    for exact, approximate in zip(
        np.split(both, [3 * p]), np.split(differences, [3 * p]), strict=True
    ):
        # Rounding over the step: 1e-16/1e-6 of the largest numbers, pixels or parameters.
        close(approximate, exact, 1e-7)
    H, J = np.split(both, [3 * p])

    seen = pixels.reshape(3, p)[1] + np.array([0.7, -0.4])[:p]
    updated, innovation, moved = block_wise(state, middle_only(state, geometry, seen))
    P, R, H = np.asarray(state.covariance), 0.09 * np.eye(p), H[p : 2 * p]
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    # 1e-11: rounding, times the condition of S.
    middle = slice(p, 2 * p)
    close(innovation.covariance[middle, middle], S, 1e-11)
    close(updated.covariance, P - K @ S @ K.T, 1e-11)
    delta = K @ (seen - pixels.reshape(3, p)[1])
    for after, expected in zip(
        jax.tree.leaves(updated.core),
        jax.tree.leaves(compiled_retract()(state.core, delta[:c])),
        strict=True,
    ):
        np.testing.assert_allclose(after, expected, rtol=0, atol=1e-11)
    close(updated.landmarks, state.landmarks + delta[c:].reshape(state.landmarks.shape), 1e-12)
    nis = (seen - pixels[middle]) @ np.linalg.solve(S, seen - pixels[middle])
    np.testing.assert_allclose(innovation.nis, nis, rtol=1e-9)
    assert innovation.nis_dof == p
    np.testing.assert_allclose(innovation.log_det, np.linalg.slogdet(S)[1], rtol=1e-12)
    assert innovation.status == Status.OK

    np.testing.assert_array_equal(updated.covariance, updated.covariance.T)

    close(moved.covariance, J @ P @ J.T, 1e-12)
    close(moved.landmarks.ravel(), composed[c:], 1e-14)


def planar_case():
    return slam_case(PLANAR, InverseScaling(), Robocentric())


def planar_pixels(state):
    """A pixel for every landmark, half a pixel from where it is expected."""
    pixels = planar_case()[2](state, jnp.zeros(len(state.covariance)))[:3]
    return pixels.reshape(3, 1) + jnp.array([[0.5], [-0.3], [0.8]])


def test_the_order_of_the_slots_does_not_matter():
    state, block_wise, *_ = planar_case()
    pixels, order = planar_pixels(state), np.array([2, 0, 1])
    numbers = rows_of(state.core_dim, order, state.landmarks.shape[1])
    permuted = replace(
        state,
        landmarks=state.landmarks[order],
        covariance=state.covariance[np.ix_(numbers, numbers)],
    )
    seen = jnp.array([True, True, False])
    # Landmark i is in slot inverse[i] of the permuted state.
    inverse = np.argsort(order)
    plain = block_wise(state, Features(jnp.arange(3), pixels, seen))
    other = block_wise(permuted, Features(jnp.asarray(inverse), pixels, seen))
    np.testing.assert_allclose(other[1].nis, plain[1].nis, rtol=1e-12)
    close(other[1].covariance, plain[1].covariance, 1e-14)
    for before, after in ((plain[0], other[0]), (plain[2], other[2])):
        close(after.landmarks, before.landmarks[order], 1e-13)
        close(after.covariance, np.asarray(before.covariance)[np.ix_(numbers, numbers)], 1e-13)
        for a, b in zip(jax.tree.leaves(after.core), jax.tree.leaves(before.core), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def test_the_order_of_the_features_does_not_matter():
    state, block_wise, *_ = planar_case()
    pixels, order = planar_pixels(state), np.array([2, 0, 1])
    plain = block_wise(state, Features(jnp.arange(3), pixels, jnp.ones(3, bool)))[0]
    other = block_wise(state, Features(jnp.asarray(order), pixels[order], jnp.ones(3, bool)))[0]
    close(other.covariance, plain.covariance, 1e-12)
    close(other.landmarks, plain.landmarks, 1e-12)


def behind(state):
    """The state with landmark 0 behind the camera, by reflecting its homogeneous point."""
    return replace(state, landmarks=state.landmarks.at[0].multiply(jnp.array([-1, -1, 1])))


def removed(state):
    """The state without landmark 0."""
    return linear.removed(state, np.arange(3) == 0)


@pytest.mark.parametrize(
    ("change", "valid"),
    [(lambda state: state, False), (behind, True), (removed, True)],
    ids=["not valid", "behind the camera", "inactive slot"],
)
def test_a_feature_that_cannot_be_used_changes_nothing(change, valid):
    state, block_wise, *_ = planar_case()
    pixels = planar_pixels(state)
    state = change(state)
    alone = Features(jnp.arange(3), pixels, jnp.array([valid, False, False]))
    updated, innovation, _ = block_wise(state, alone)
    for after, before in zip(jax.tree.leaves(updated), jax.tree.leaves(state), strict=True):
        # The pose is multiplied by Exp(0).
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(updated.landmarks, state.landmarks)
    # P is symmetric to rounding, and made so exactly.
    close(updated.covariance, state.covariance, 1e-14)
    assert innovation.nis == 0
    assert innovation.nis_dof == 0

    # And beside one that is used, it makes no difference, whatever its pixel says.
    beside = Features(jnp.arange(3), pixels.at[0].set(1e9), jnp.array([valid, True, False]))
    without = Features(jnp.arange(3), pixels, jnp.array([False, True, False]))
    (a, a_innovation, _), (b, b_innovation, _) = (block_wise(state, f) for f in (beside, without))
    np.testing.assert_array_equal(a.covariance, b.covariance)
    np.testing.assert_array_equal(a.landmarks, b.landmarks)
    assert a_innovation.nis == b_innovation.nis > 0
    assert a_innovation.nis_dof == b_innovation.nis_dof == 1
    np.testing.assert_array_equal(a_innovation.used, [False, True, False])


def test_search_ellipses_are_the_diagonal_blocks_of_the_innovation_covariance():
    for geometry, landmark, frame in (
        (PLANAR, InverseScaling(), Robocentric()),
        (SPATIAL, LANDMARKS["inverse_depth"], WorldCentric()),
    ):
        state, block_wise, dense, _ = slam_case(geometry, landmark, frame)
        p, model = geometry.pixel_dim, slam_model(geometry, landmark, frame)
        slots = jnp.array([2, 0])
        pixels, covariances, in_front = quick_jit(
            lambda state, model=model, slots=slots: linear.expected(
                model, state, slots, Context(jnp.asarray(STEP))
            )
        )(state)
        expected = dense(state, np.zeros(len(state.covariance)))[: 3 * p].reshape(3, p)
        seen = Features(jnp.arange(3), expected, jnp.ones(3, bool))
        S = block_wise(state, seen)[1].covariance.reshape(3, p, 3, p)
        assert in_front.all()
        close(pixels, expected[slots], 1e-14)
        close(covariances + noise_of(geometry), np.stack([S[i, :, i] for i in (2, 0)]), 1e-12)


def test_considered_numbers_count_but_are_not_corrected():
    """Schmidt (1966): P_xx, P_xc and P_cc by the textbook's partitioned equations."""
    state, _, dense, jacobian = planar_case()
    model = slam_model(PLANAR, InverseScaling(), Robocentric())
    context = Context(jnp.asarray(STEP))
    c, n = state.core_dim, len(state.covariance)
    calibration = slice(c - 2, c)
    seen = Features(jnp.arange(3), planar_pixels(state), jnp.ones(3, bool))
    updated, innovation = quick_jit(
        lambda state: update(model, state, seen, noise_of(PLANAR), context, calibration)
    )(state)

    zero = np.zeros(n)
    H, P = np.asarray(jacobian(state, zero))[:3], np.asarray(state.covariance)
    residual = np.asarray(seen.measured).ravel() - np.asarray(dense(state, zero))[:3]
    k = np.arange(n)[calibration]  # considered
    x = np.delete(np.arange(n), k)  # estimated
    S = H @ P @ H.T + 0.09 * np.eye(3)
    K = (P[np.ix_(x, x)] @ H[:, x].T + P[np.ix_(x, k)] @ H[:, k].T) @ np.linalg.inv(S)
    P_xx = P[np.ix_(x, x)] - K @ S @ K.T
    P_xk = P[np.ix_(x, k)] - K @ (H[:, x] @ P[np.ix_(x, k)] + H[:, k] @ P[np.ix_(k, k)])
    after = np.asarray(updated.covariance)
    close(after[np.ix_(x, x)], P_xx, 1e-10)
    close(after[np.ix_(x, k)], P_xk, 1e-10)
    close(after[np.ix_(k, k)], P[np.ix_(k, k)], 1e-14)
    np.testing.assert_array_equal(after, after.T)
    assert np.abs(P_xk - P[np.ix_(x, k)]).max() > 1e-3

    np.testing.assert_array_equal(updated.core.calibration, state.core.calibration)
    delta = np.zeros(n)
    delta[x] = K @ residual
    close(updated.landmarks.ravel(), state.landmarks.ravel() + delta[c:], 1e-10)
    moved = compiled_retract()(state.core, delta[:c])
    for a, b in zip(jax.tree.leaves(updated.core), jax.tree.leaves(moved), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10)
    np.testing.assert_allclose(innovation.nis, residual @ np.linalg.solve(S, residual), rtol=1e-9)


# --- initialisation -----------------------------------------------------------------------------


@pytest.mark.parametrize("frame", [Robocentric(), WorldCentric()], ids=named)
def test_landmarks_of_one_frame_share_its_pose_and_its_calibration(frame):
    """P ← J diag(P, R, σ², R, σ²) Jᵀ for two landmarks at once, the paper's P22–P26."""
    model = slam_model(PLANAR, InverseScaling(), frame)
    depth = cast(model.depth, float)
    everyone = slam_case(PLANAR, InverseScaling(), frame)[0]
    state = linear.removed(everyone, jnp.array([True, False, True]))
    c, d = state.core_dim, state.landmarks.shape[1]
    pixels, w = jnp.array([[100.0], [500.0]]), depth.mean
    prior = (w[None], depth.sigma[None])
    new = Features(jnp.array([2, 0]), pixels, jnp.ones(2, bool))

    def block_wise(state):
        return linear.initialised(model, state, new, noise_of(PLANAR), prior, COMPOSED)

    def both(x):
        view = model.view(retract(state.core, x[:c]), COMPOSED)
        return jnp.concatenate(
            [
                model.initialise(view, pixels[0] + x[c], w[None] + x[c + 1], COMPOSED),
                model.initialise(view, pixels[1] + x[c + 2], w[None] + x[c + 3], COMPOSED),
            ]
        )

    after = quick_jit(block_wise)(state)
    J = np.asarray(quick_jit(jax.jacfwd(both))(jnp.zeros(c + 4)))
    P = np.asarray(state.covariance)
    full = np.zeros((c + 4, c + 4))
    full[:c, :c] = P[:c, :c]
    full[c:, c:] = np.diag([0.09, float(depth.sigma) ** 2] * 2)
    new_rows = np.r_[c + 2 * d : c + 3 * d, c : c + d]
    expected = J @ full @ J.T
    actual = np.asarray(after.covariance)[np.ix_(new_rows, new_rows)]
    close(actual, expected, 1e-13)
    # What would be missing if each landmark were initialised alone: z = f is one and the same.
    sigma = np.sqrt(np.diag(expected))
    assert np.abs(expected[:d, d:] / np.outer(sigma[:d], sigma[d:])).max() > 0.5
    # With the old state: J_core P.
    old = np.r_[0:c, c + d : c + 2 * d]
    close(after.covariance[np.ix_(new_rows, old)], J[:, :c] @ P[:c][:, old], 1e-13)
    np.testing.assert_array_equal(after.covariance[np.ix_(old, old)], P[np.ix_(old, old)])
    np.testing.assert_array_equal(after.active, [True, True, True])


def test_inverse_scaling_has_rank_three_when_the_focal_length_is_known():
    """Never invert a landmark block: (u − cx, v − cy, f, ω0) has a constant in it."""
    slam = replace(Slam(**pieces(SPATIAL)), calibration=Known())
    new = Features(jnp.array([0]), jnp.array([[100.0, 300.0]]), jnp.array([True]))
    block = np.asarray(quick_jit(lambda new: slam.init(1, new).covariance)(new))[-4:, -4:]
    values = np.linalg.eigvalsh(block)
    # Zero is found to 1e-15 of the largest, or so.
    assert values[0] <= 1e-13 * values[-1]
    assert values[1] >= 1e-6 * values[-1]


# --- many steps ---------------------------------------------------------------------------------


@crossed(
    ("kind", "dtype"),
    ["robocentric", "world", "scale_gauge"],
    [jnp.float32, jnp.float64],
    quick=[
        ("robocentric", jnp.float32), ("world", jnp.float64), ("scale_gauge", jnp.float32),
    ],
)  # fmt: skip
def test_covariance_stays_symmetric_and_positive_over_a_long_run(kind, dtype):
    """In any precision, with landmarks whose covariance is singular: see `ROUNDING`."""
    case = Case("matched-very-loose", steps=600)
    slam = cast(case.filter(kind), dtype)
    data = cast((case.controls(), *case.frames(0)), dtype)
    _, (_, _, covariances, nis) = quick_jit(partial(run_filter, case.capacity, slam))(*data)
    assert nis.dtype == dtype
    assert np.isfinite(nis).all()
    P = np.asarray(covariances, float)
    unit = np.finfo(dtype).eps
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    sigma = np.where(sigma > 0, sigma, 1.0)
    correlations = P / sigma[:, :, None] / sigma[:, None, :]
    # Composition and initialisation round the two halves differently; the update mends it.
    assert np.abs(correlations - correlations.transpose(0, 2, 1)).max() <= 100 * unit
    least = np.linalg.eigvalsh((correlations + correlations.transpose(0, 2, 1)) / 2)[:, 0]
    assert least.min() >= -P.shape[1] * unit


@pytest.mark.parametrize("dense", [0, 1000])
def test_products_with_blocks_leave_out_only_zeros(dense, monkeypatch):
    monkeypatch.setattr(blocks, "DENSE", dense)
    rng = np.random.default_rng(0)
    m, k, v, c, d, capacity = 3, 2, 4, 5, 3, 6
    J = Blocks(*(jnp.asarray(rng.normal(size=s)) for s in ((v, c), (m, k, v), (m, k, d))))
    slots, B = jnp.array([4, 0, 4]), jnp.asarray(rng.normal(size=(c + capacity * d, 7)))
    close(observed(J, slots, B), placed(J, slots, capacity) @ B, 1e-14)
