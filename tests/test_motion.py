"""Tests of jaxslam.motion: what velocities, readings and their noise make of a pose."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each_geometry, named, quick_jit
from scipy.spatial.transform import Rotation

from jaxslam.geometry import PLANAR, exp, identity
from jaxslam.motion import BODY_RATES, CONSTANT_VELOCITY, MOTIONS, ODOMETRY, BodyRates

READING = np.array([0.3, -0.1, 0.7, 0.2, -0.5, 0.4])
ERROR = np.array([0.02, 0.03, -0.01, -0.04, 0.05, 0.02])


def reading_of(geometry, numbers):
    """The numbers of (x, z, θ), or of (x, y, z) and a rotation vector."""
    return numbers[[0, 2, 4]] if geometry is PLANAR else numbers


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_step_is_made_with_the_velocity_after_the_acceleration(geometry):
    """`v' = v + a Δt`, `T = Exp(v' Δt)` (P8, P9): by jaxlie's exponential, not ours."""
    velocity, acceleration = (jnp.asarray(reading_of(geometry, x)) for x in (READING, 50 * ERROR))
    after = velocity + 0.2 * acceleration
    step, found = quick_jit(
        lambda v, a, dt: (
            CONSTANT_VELOCITY.displacement(geometry, v, a, dt),
            CONSTANT_VELOCITY.next_velocity(v, a, dt),
        )
    )(velocity, acceleration, jnp.asarray(0.2))
    np.testing.assert_allclose(found, after, rtol=0, atol=1e-14)
    expected = geometry.group.exp(0.2 * after)
    np.testing.assert_allclose(step.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-14)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_odometry_goes_straight_and_then_turns_by_its_reading_and_error(geometry):
    reading, error = (reading_of(geometry, x) for x in (READING, ERROR))
    n = geometry.point_dim
    velocity = jnp.full(geometry.tangent_dim, jnp.nan)  # not used
    displacement = quick_jit(lambda *x: ODOMETRY.displacement(geometry, *x))
    step = displacement(velocity, error, reading)
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
def test_rates_of_a_vehicle_are_the_odometry_of_a_camera_at_its_centre(geometry):
    rates, error = (reading_of(geometry, x) for x in (READING, ERROR))
    still = jnp.zeros(geometry.tangent_dim)
    seconds = jnp.asarray(0.2)
    control = BodyRates(jnp.asarray(rates), seconds, identity(geometry, jnp.dtype(float)))
    step = quick_jit(lambda *x: BODY_RATES.displacement(geometry, still, *x))(error, control)
    expected = quick_jit(lambda *x: ODOMETRY.displacement(geometry, still, *x))(
        0.2 * error, 0.2 * rates
    )
    np.testing.assert_allclose(step.as_matrix(), expected.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_vehicle_that_turns_moves_the_camera_by_its_lever_arm(geometry):
    """T_WC after the step, by way of the vehicle, is that by way of the camera."""
    rates = jnp.asarray(reading_of(geometry, READING))
    T_VC = exp(geometry.group, jnp.asarray(reading_of(geometry, 3 * ERROR + 0.2)))
    still = jnp.zeros(geometry.tangent_dim)
    control = BodyRates(rates, jnp.asarray(0.5), T_VC)
    step = quick_jit(lambda c: BODY_RATES.displacement(geometry, still, still, c))(control)
    vehicle = quick_jit(lambda u: ODOMETRY.displacement(geometry, still, still, u))(0.5 * rates)
    np.testing.assert_allclose((T_VC @ step).as_matrix(), (vehicle @ T_VC).as_matrix(), atol=1e-14)
    # A vehicle that only turns moves a camera off its centre.
    turning = rates.at[: geometry.point_dim].set(0.0)
    control = BodyRates(turning, jnp.asarray(0.5), T_VC)
    step = quick_jit(lambda c: BODY_RATES.displacement(geometry, still, still, c))(control)
    assert np.linalg.norm(step.translation()) > 0.01


def test_motions_are_known_by_their_names():
    assert {name: motion.name for name, motion in MOTIONS.items()} == {
        "velocity": "velocity",
        "odometry": "odometry",
    }
    assert MOTIONS["velocity"].has_velocity
    assert not MOTIONS["odometry"].has_velocity
