"""Tests of benchmarks/published_worlds.py: an inertial unit moves as its readings say."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from numpy.testing import assert_allclose
from published_worlds import HELD, Unit


def moved(unit, controls):
    """Poses of every step, and the orientations and velocities that the motion keeps."""

    def step(carry, control):
        pose, variables = carry
        pose = pose @ unit.displacement(variables, jnp.zeros(6), control)
        variables = unit.next(variables, jnp.zeros(6), control)
        return (pose, variables), (pose, unit.held.camera_pose(variables[1]))

    start = jaxlie.SE3.identity(), unit.start()[0]
    return jax.lax.scan(step, start, controls)[1]


def test_without_errors_a_unit_goes_around_the_circle():
    poses, kept = moved(Unit(), jnp.zeros((3000, 6)))
    angle = 2 * np.pi * np.arange(3000) / 2999
    circle = 5 * np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    assert_allclose(poses.translation(), circle, atol=0.02)
    speed = np.linalg.norm(kept.translation()[3:], axis=1)
    assert_allclose(speed, 2 * np.pi * 5 / 29.99, rtol=1e-5)


@pytest.mark.parametrize("held", HELD)
def test_how_attitude_and_velocity_are_held_does_not_matter_to_the_motion(held):
    controls = jax.random.normal(jax.random.key(0), (200, 6))
    expected, found = moved(Unit(), controls), moved(Unit(HELD[held]), controls)
    for pose, same in zip(expected, found, strict=True):
        assert_allclose(same.as_matrix(), pose.as_matrix(), atol=1e-12)
    poses, kept = found
    assert_allclose(kept.rotation().as_matrix(), poses.rotation().as_matrix(), atol=1e-12)
