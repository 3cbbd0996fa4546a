"""Tests of jaxslam.models.motion: what velocities, readings and their noise make of a pose."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each_geometry, named, quick_jit
from scipy.spatial.transform import Rotation

from jaxslam.geometry import PLANAR
from jaxslam.models.motion import ConstantVelocity, Odometry, check_control

READING = np.array([0.3, -0.1, 0.7, 0.2, -0.5, 0.4])
ERROR = np.array([0.02, 0.03, -0.01, -0.04, 0.05, 0.02])


def sigmas(geometry):
    """Of a noise that no test draws: of what geometry the model is."""
    return np.ones(geometry.tangent_dim)


def reading_of(geometry, numbers):
    """The numbers of (x, z, θ), or of (x, y, z) and a rotation vector."""
    return numbers[[0, 2, 4]] if geometry is PLANAR else numbers


def displacement(motion):
    """Of (variables, noise, control), compiled."""
    return quick_jit(lambda *x: motion.displacement(*x))


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_step_is_made_with_the_velocity_after_the_acceleration(geometry):
    """`v' = v + a Δt`, `T = Exp(v' Δt)` (P8, P9): by jaxlie's exponential, not ours."""
    velocity, acceleration = (jnp.asarray(reading_of(geometry, x)) for x in (READING, 50 * ERROR))
    after = velocity + 0.2 * acceleration
    motion = ConstantVelocity(*(sigmas(geometry),) * 3)
    step, found = quick_jit(
        lambda v, a, dt: (motion.displacement(v, a, dt), motion.next(v, a, dt))
    )(velocity, acceleration, jnp.asarray(0.2))
    np.testing.assert_allclose(found, after, rtol=0, atol=1e-14)
    expected = geometry.group.exp(0.2 * after)
    np.testing.assert_allclose(step.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-14)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_odometry_goes_straight_and_then_turns_by_its_reading_and_error(geometry):
    reading, error = (reading_of(geometry, x) for x in (READING, ERROR))
    n = geometry.point_dim
    step = displacement(Odometry(sigmas(geometry)))((), error, reading)
    turned = reading[n:] + error[n:]
    if geometry is PLANAR:
        c, s = np.cos(turned[0]), np.sin(turned[0])
        rotation = [[c, -s], [s, c]]
    else:
        rotation = Rotation.from_rotvec(turned).as_matrix()
    np.testing.assert_allclose(step.rotation().as_matrix(), rotation, atol=1e-15)
    # The straight way is along the axes before the turn.
    np.testing.assert_allclose(step.translation(), reading[:n] + error[:n], rtol=1e-15)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_of_the_control_that_is_still_nothing_moves_and_another_models_is_refused(geometry):
    sigma = sigmas(geometry)
    motions: list[Any] = [ConstantVelocity(sigma, sigma, sigma), Odometry(sigma)]
    for motion, other in (motions, motions[::-1]):
        variables, noise = motion.start()[0], jnp.zeros(geometry.tangent_dim)
        assert motion.geometry is geometry
        check_control(motion, motion.still())
        step = motion.displacement(variables, noise, motion.still())
        np.testing.assert_array_equal(step.as_matrix(), np.eye(geometry.point_dim + 1))
        np.testing.assert_array_equal(motion.next(variables, noise, motion.still()), variables)
        with pytest.raises(ValueError, match=f"the control of {type(motion).__name__} is"):
            check_control(motion, other.still())
