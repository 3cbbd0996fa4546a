"""Tests of what monocular SLAM cannot know: the rank of the stacked Jacobians of a short window.

Linearised at the truth, the unobservable directions are the choice of the base frame and, without
odometry, the scale of the whole: 3 + 1 planar, 6 + 1 in space. A parametrization that has more
numbers than a point adds its redundancy for every landmark.
"""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from cases import a_filter, crossed, each_geometry, few_landmarks, pose, quick_jit

from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.geometry import PLANAR, SPATIAL, difference, retract
from jaxslam.models.frame import Robocentric, WorldCentric

STEPS, DT, COUNT = 8, 0.4, 7
GAUGE = {PLANAR: 3, SPATIAL: 6}
REDUNDANCY = {
    "inverse_scaling": {PLANAR: 1, SPATIAL: 1},
    "inverse_depth": {PLANAR: 2, SPATIAL: 3},
    "cartesian": {PLANAR: 0, SPATIAL: 0},
}


def truth(model):
    """The state at the start: pose, velocity, and landmarks first seen from different places."""
    geometry, p = model.geometry, model.geometry.pixel_dim
    rng = np.random.default_rng(5)
    t, n = geometry.tangent_dim, geometry.point_dim
    velocity = np.concatenate([rng.uniform(0.3, 0.8, n), rng.uniform(0.1, 0.2, t - n)])
    held = model.frame.from_base_pose(pose(geometry, 1))
    core = Core(held, jnp.asarray(velocity), None, jnp.zeros(t), jnp.zeros(0))
    T_AC = model.view(core, COMPOSED).map_from_camera

    def landmark(bearing, depth, anchor):
        seen = model.landmark.initialise(jnp.append(bearing, 1.0), 1 / depth, jnp.asarray(1.0))
        return model.landmark.transform(T_AC @ geometry.group.exp(anchor), seen)

    landmarks = jax.vmap(landmark)(
        rng.uniform(-0.4, 0.4, (COUNT, p)),
        rng.uniform(8, 20, COUNT),
        rng.uniform(-0.3, 0.3, (COUNT, t)),
    )
    return core, landmarks


@cache
def linearised(geometry, landmark, frame):
    """`(core, landmarks) → H` of all pixels here, `Φ` of one step, and the state after it."""
    model = a_filter(geometry, landmark, frame).model
    motion = Context(jnp.asarray(DT))

    def moved(core, landmarks):
        view = model.view(core, motion)
        if model.moves_landmarks:
            landmarks = jax.vmap(lambda x: model.compose_landmark(view, x, motion))(landmarks)
        return model.compose_core(core, motion), landmarks

    def jacobians(core, landmarks):
        after, moved_landmarks = moved(core, landmarks)

        def function(delta):
            c = delta.size - landmarks.size
            x = retract(core, delta[:c]), landmarks + delta[c:].reshape(landmarks.shape)
            view = model.view(x[0], COMPOSED)
            pixels = jax.vmap(lambda landmark: model.observe(view, landmark, COMPOSED)[0])(x[1])
            y = moved(*x)
            return pixels.ravel(), jnp.append(difference(y[0], after), y[1])

        H, F = jax.jacfwd(function)(jnp.zeros(3 * geometry.tangent_dim + landmarks.size))
        return H, F, after, moved_landmarks

    return quick_jit(lambda: truth(model)), quick_jit(jacobians)


def window(geometry, landmark, frame, accelerations):
    """∂(all pixels)/∂(state at the start, then acceleration of every step)."""
    start, jacobians = linearised(geometry, landmark, frame)
    core, landmarks = start()
    t = geometry.tangent_dim
    n = 3 * t + landmarks.size
    state = np.delete(np.arange(n), range(2 * t, 3 * t))
    # Sensitivity of the state (without acceleration) to (start, a_1, …, a_K).
    G = np.eye(state.size, state.size + STEPS * t)
    rows = []
    for k in range(STEPS + 1):
        a = accelerations[k] if k < STEPS else np.zeros(t)
        core = replace(core, noise=jnp.asarray(a))
        H, F, core, landmarks = jacobians(core, landmarks)
        H, F = np.asarray(H), np.asarray(F)
        rows.append(H[:, state] @ G)
        if k < STEPS:
            G = F[np.ix_(state, state)] @ G
            here = state.size + k * t
            G[:, here : here + t] += F[np.ix_(state, np.arange(2 * t, 3 * t))]
    return np.vstack(rows), state.size


def nullity(M):
    """Columns less the rank, columns being scaled to one; the gap must leave no doubt."""
    length = np.linalg.norm(M, axis=0)
    zero = length < 1e-12 * length.max()
    values = np.linalg.svd(M[:, ~zero] / length[~zero], compute_uv=False)
    values = np.append(values, np.zeros(max(0, M.shape[1] - zero.sum() - len(values))))
    rank = int((values > 1e-10 * values[0]).sum())
    smallest, largest_null = values[rank - 1], values[rank] if rank < len(values) else 0.0
    # Rounding leaves 1e-15 where there is nothing; what can be seen at all is seen better.
    assert largest_null < 1e-12 * values[0]
    assert smallest > 1e-8 * values[0]
    return int(M.shape[1] - rank)


def accelerations(geometry, linear):
    a = np.random.default_rng(3).uniform(-0.3, 0.3, (STEPS, geometry.tangent_dim))
    a[:, : geometry.point_dim] *= linear
    # The velocity at the start and the first acceleration are seen only in their sum.
    a[0] = 0.0
    return a


pytestmark = crossed(
    ("geometry", "landmark", "frame"),
    each_geometry,
    few_landmarks,
    [Robocentric(), WorldCentric()],
    quick=[
        (PLANAR, few_landmarks[0], Robocentric()),
        (SPATIAL, few_landmarks[1], WorldCentric()),
        (PLANAR, few_landmarks[2], WorldCentric()),
    ],
)


def redundancy(geometry, landmark):
    return COUNT * REDUNDANCY[landmark.name][geometry]


def test_without_odometry_the_frame_and_the_scale_are_unobservable(geometry, landmark, frame):
    """Accelerations are unknown, as they are to the filter: 4 directions planar, 7 in space."""
    M, n = window(geometry, landmark, frame, accelerations(geometry, 1.0))
    M = np.delete(M, range(n, n + geometry.tangent_dim), axis=1)  # the first one is known to be 0
    assert nullity(M) == GAUGE[geometry] + 1 + redundancy(geometry, landmark)


def test_constant_linear_velocity_tells_no_scale_either(geometry, landmark, frame):
    """Known accelerations that only turn the camera hold no metre."""
    M, n = window(geometry, landmark, frame, accelerations(geometry, 0.0))
    assert nullity(M[:, :n]) == GAUGE[geometry] + 1 + redundancy(geometry, landmark)


def test_known_accelerations_are_metric_and_leave_only_the_frame(geometry, landmark, frame):
    """As odometry would: 3 directions planar, 6 in space."""
    M, n = window(geometry, landmark, frame, accelerations(geometry, 1.0))
    assert nullity(M[:, :n]) == GAUGE[geometry] + redundancy(geometry, landmark)
