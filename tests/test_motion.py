"""Tests of jaxslam.motion: what an odometry's reading and its error make of a pose."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each_geometry, named, quick_jit
from scipy.spatial.transform import Rotation

from jaxslam.geometry import PLANAR
from jaxslam.motion import MOTIONS, ODOMETRY

READING = np.array([0.3, -0.1, 0.7, 0.2, -0.5, 0.4])
ERROR = np.array([0.02, 0.03, -0.01, -0.04, 0.05, 0.02])


def reading_of(geometry, numbers):
    """The numbers of (x, z, θ), or of (x, y, z) and a rotation vector."""
    return numbers[[0, 2, 4]] if geometry is PLANAR else numbers


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


def test_motions_are_known_by_their_names():
    assert {name: motion.name for name, motion in MOTIONS.items()} == {
        "velocity": "velocity",
        "odometry": "odometry",
    }
    assert MOTIONS["velocity"].has_velocity
    assert not MOTIONS["odometry"].has_velocity
