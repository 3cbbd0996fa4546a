"""Tests of what a camera with an inertial unit cannot know, of filters and of the model.

Position and heading have no origin: 6 directions of the base frame, as the direction of gravity is
a variable of its own in the unit's axes; its length, which means nothing, is one more. Motions that
excite less leave more (Martinelli, FnT Robotics 2014; Wu, Roumeliotis, 2016). They are counted by
the rank of the stacked Jacobians of a short window, at the truth.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, a_filter, pose, quick_jit, quick_rows
from scipy.spatial.transform import Rotation
from test_remedies import difference_of_runs

from jaxslam.filters.linear.blocks import plus
from jaxslam.filters.linear.covariance import empty
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.geometry import SPATIAL, difference
from jaxslam.landmarks import Cartesian
from jaxslam.models.frame import Robocentric, WorldCentric
from jaxslam.models.imu import Imu, InertialState, increments


def jacobians(model):
    """`(state, context) → H` of all pixels, `Φ` of one step, and the state after it, compiled."""

    def moved(state, context):
        view = model.view(state.core, context)
        landmarks = state.landmarks
        if model.moves_landmarks:
            landmarks = jax.vmap(lambda x: model.compose_landmark(view, x, context))(landmarks)
        return model.compose_core(state.core, context), landmarks

    def both(state, context):
        core, landmarks = moved(state, context)

        def function(delta):
            x = plus(state, delta)
            view = model.view(x.core, COMPOSED)
            pixels = jax.vmap(lambda landmark: model.observe(view, landmark, COMPOSED)[0])
            y = moved(x, context)
            return pixels(x.landmarks).ravel(), jnp.append(difference(y[0], core), y[1])

        H, F = jax.jacfwd(function)(jnp.zeros(state.core_dim + landmarks.size))
        return H, F, empty(core, landmarks)

    return quick_jit(both)


def stacked(step, state, contexts):
    """∂(all pixels)/∂(state at the start), where what drives the motion is known."""
    noise = state.core.part("noise")
    size = state.core_dim + state.landmarks.size
    kept = np.delete(np.arange(size), range(noise.start, noise.stop))
    G, rows = np.eye(kept.size), []
    for context in contexts:
        H, F, state = step(state, context)
        rows.append(np.asarray(H)[:, kept] @ G)
        G = np.asarray(F)[np.ix_(kept, kept)] @ G
    return np.vstack(rows)


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


FRAMES, POINTS, T, M = 10, 8, 0.5, 20
BASE, LENGTH = 6, 1
DOWN = np.array([0.1, 0.9, 0.2]) / np.linalg.norm([0.1, 0.9, 0.2])
"""In the camera of the first frame."""
LOCAL = np.array([0.3, -0.2, 0.4])
"""An acceleration that stays, m/s²."""


def some(rng, size):
    return rng.uniform(-size, size, 3)


def course(kind):
    """Angular velocities in the camera's axes and accelerations in the first one's, in time."""
    rng = np.random.default_rng(7)
    times = np.arange(FRAMES * M) * T / M
    waves = [
        sum(some(rng, 0.5) * np.sin(f * times[:, None] + some(rng, 3)) for f in (0.7, 1.3, 2.9))
        for _ in range(2)
    ]
    still, axis = np.zeros_like(waves[0]), DOWN
    return {
        "any motion": (waves[0], 2 * waves[1]),
        "constant velocity": (waves[0], still),
        "constant acceleration": (still, still + LOCAL),
        "constant local acceleration": (waves[0], None),
        "no rotation": (still, 2 * waves[1]),
        "turning about one axis": (waves[0][:, :1] * axis, 2 * waves[1]),
    }[kind]


EXPECTED = {
    "any motion": 0,
    "constant velocity": 1,
    "constant local acceleration": 1,
    "no rotation": 2,
    "constant acceleration": 3,
    "turning about one axis": 0,
}
"""Directions beside the base frame: the scale, where the acceleration is constant in the unit's
axes; two of gravity against the accelerometer's bias, where nothing turns."""


def controls(kind):
    rates, accelerations = course(kind)
    R, forces = Rotation.identity(), []
    for k, rate in enumerate(rates):
        half = R * Rotation.from_rotvec(rate * T / M / 2)
        local = LOCAL if accelerations is None else half.inv().apply(accelerations[k])
        forces.append(local - half.inv().apply(9.81 * DOWN))
        R = R * Rotation.from_rotvec(rate * T / M)
    parts = (x.reshape(FRAMES, M, 3) for x in (rates, np.array(forces)))
    return quick_jit(jax.vmap(lambda w, f: increments(jnp.full(M, T / M), w, f)))(*parts)


@cache
def inertial_start(frame):
    model, rng = a_filter(SPATIAL, Cartesian(), frame, motion=Imu((0.0, 0.0))).model, np.random
    held = model.frame.from_base_pose(pose(SPATIAL, 1))
    velocity, none = jnp.array([0.4, -0.2, 0.6]), jnp.zeros(3)
    start = InertialState(velocity, none, none, jnp.asarray(DOWN), jnp.zeros(0))
    core = Core(held, start, None, jnp.zeros(18), jnp.zeros(0))
    T_AC = model.view(core, COMPOSED).map_from_camera
    points = rng.default_rng(5).uniform([-4, -4, 4], [4, 4, 12], (POINTS, 3))
    return empty(core, jax.vmap(T_AC.apply)(jnp.asarray(points))), jacobians(model)


@pytest.mark.parametrize("kind", EXPECTED)
@pytest.mark.parametrize("frame", [Robocentric(), WorldCentric()], ids=lambda frame: frame.name)
def test_what_a_motion_leaves_unobservable(kind, frame):
    start, step = inertial_start(frame)
    of = controls(kind)
    contexts = [Context(jax.tree.map(lambda x, k=k: x[k], of)) for k in range(FRAMES)]
    assert nullity(stacked(step, start, contexts)) == BASE + LENGTH + EXPECTED[kind]


@cache
def inertial():
    return Case("imu-loose", steps=6, placement="prior", landmarks=5)


@pytest.mark.parametrize(
    "name", quick_rows(1, ["world+oc", "robocentric", "robocentric+oc", "world+fej", "invariant"])
)
def test_an_unknown_base_frame_changes_no_estimate(name):
    slam = inertial().filter(name, "anchored_homogeneous" if name == "invariant" else "cartesian")
    moved, forgotten = difference_of_runs(slam, inertial(), BASE)
    assert moved < 1e-8
    assert forgotten < 1e-7


@pytest.mark.slow
def test_a_world_centric_filter_learns_its_heading_from_nothing():
    moved, forgotten = difference_of_runs(inertial().filter("world", "cartesian"), inertial(), BASE)
    assert moved > 1e-5
    assert forgotten > 1e-3
