"""Tests of what a camera with an inertial unit cannot know, beside its base frame.

The length of the direction of gravity, a variable of its own, means nothing. Motions that excite
less leave more (Martinelli, FnT Robotics 2014; Wu, Roumeliotis, 2016): it is counted by the rank of
the Jacobian of all pixels of a short window, at the truth.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit
from scipy.spatial.transform import Rotation

from jaxslam.geometry import SPATIAL, identity, retract
from jaxslam.models.imu import Imu, InertialState, increments

FRAMES, POINTS, T, M = 10, 8, 0.5, 20
LENGTH = 1
DOWN = np.array([0.1, 0.9, 0.2]) / np.linalg.norm([0.1, 0.9, 0.2])
LOCAL = np.array([0.3, -0.2, 0.4])
"""An acceleration that stays, m/s²."""


@cache
def jacobian_of_pixels():
    """`controls ↦ ∂(all pixels)/∂(variables at the start, points)`."""
    imu, none, noise = Imu((0.0, 0.0)), jnp.zeros(3), jnp.zeros(18)
    points = np.random.default_rng(5).uniform([-4, -4, 4], [4, 4, 12], (POINTS, 3))
    empty = jnp.zeros(0)
    start = InertialState(jnp.array([0.4, -0.2, 0.6]), none, none, jnp.asarray(DOWN), empty, empty)

    def pixels(unknown, controls):
        there = points + unknown[12:].reshape(POINTS, 3)

        def step(carry, control):
            pose, now = carry
            pose, now = pose @ imu.displacement(now, noise, control), imu.next(now, noise, control)
            return (pose, now), jax.vmap(pose.inverse().apply)(there)

        begun = identity(SPATIAL, jnp.float64), retract(start, unknown[:12])
        later = jax.lax.scan(step, begun, controls)[1]
        seen = jnp.concatenate([there[None], later])
        return (seen[..., :2] / seen[..., 2:]).ravel()

    by_all = quick_jit(jax.jacfwd(pixels))
    return lambda controls: np.asarray(by_all(jnp.zeros(12 + 3 * POINTS), controls))


def nullity(M):
    """Columns less the rank, columns being scaled to one; the gap must leave no doubt."""
    values = np.linalg.svd(M / np.linalg.norm(M, axis=0), compute_uv=False)
    rank = int((values > 1e-10 * values[0]).sum())
    # Rounding leaves 1e-15 where there is nothing; what can be seen at all is seen better.
    assert values[rank:].max(initial=0.0) < 1e-12 * values[0]
    assert values[rank - 1] > 1e-8 * values[0]
    return M.shape[1] - rank


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
    still = np.zeros_like(waves[0])
    return {
        "any motion": (waves[0], 2 * waves[1]),
        "constant velocity": (waves[0], still),
        "constant acceleration": (still, still + LOCAL),
        "constant local acceleration": (waves[0], None),
        "no rotation": (still, 2 * waves[1]),
        "turning about one axis": (waves[0][:, :1] * DOWN, 2 * waves[1]),
    }[kind]


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


@pytest.mark.parametrize(
    ("kind", "directions"),
    [
        ("any motion", 0),
        ("constant velocity", 1),
        ("constant local acceleration", 1),
        ("no rotation", 2),
        ("constant acceleration", 3),
        ("turning about one axis", 0),
    ],
)
def test_what_a_motion_leaves_unobservable(kind, directions):
    """The scale, where the acceleration is constant in the unit's axes; two of gravity against the
    accelerometer's bias, where nothing turns."""
    assert nullity(jacobian_of_pixels()(controls(kind))) == LENGTH + directions
