"""Tests of jaxslam.sensors: what a measurement tells of a point, and what it hides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each_geometry, named, quick_jit

from jaxslam.camera import Camera
from jaxslam.sensors import CAMERA, POSITION, SENSORS

POINT = np.array([0.4, -0.7, 3.0])

with_geometry = pytest.mark.parametrize("geometry", each_geometry, ids=named)
with_sensor = pytest.mark.parametrize("sensor", list(SENSORS.values()), ids=named)


def camera_of(geometry):
    p = geometry.pixel_dim
    return Camera(jnp.array([650.0, 640.0])[:p], jnp.array([320.0, 240.0])[:p])


def point_of(geometry):
    return jnp.asarray(POINT[-geometry.point_dim :])


@with_sensor
@with_geometry
def test_locate_is_the_inverse_of_measure(geometry, sensor):
    camera, X, omega = camera_of(geometry), point_of(geometry), jnp.asarray(0.4)
    measured = quick_jit(sensor.measure)(camera, X, omega)
    assert measured.shape == (sensor.size(geometry),)
    assert sensor.size(geometry) + sensor.hidden == geometry.point_dim
    # What a camera does not tell is 1/z.
    hidden = (omega / X[-1:])[: sensor.hidden]
    located, scale = quick_jit(sensor.locate)(camera, measured, hidden)
    np.testing.assert_allclose(located / scale, X / omega, rtol=1e-14)


@with_sensor
@with_geometry
def test_a_measurement_does_not_depend_on_the_scale_of_a_homogeneous_point(geometry, sensor):
    camera, X, omega = camera_of(geometry), point_of(geometry), jnp.asarray(0.4)
    for function in (lambda X, w: sensor.measure(camera, X, w), sensor.chart):
        np.testing.assert_allclose(function(3 * X, 3 * omega), function(X, omega), rtol=1e-14)


@with_geometry
def test_a_position_is_measured_all_around_and_a_pixel_only_ahead(geometry):
    X = point_of(geometry)
    assert CAMERA.possible(X)
    assert not CAMERA.possible(-X)
    assert POSITION.possible(X)
    assert POSITION.possible(-X)
    np.testing.assert_array_equal(POSITION.measure(camera_of(geometry), -X, jnp.ones(())), -X)


@with_geometry
def test_charts_are_an_image_with_inverse_depth_and_the_point_itself(geometry):
    X, omega = point_of(geometry), jnp.asarray(0.5)
    point = np.asarray(X) / 0.5
    expected = [*(point[:-1] / point[-1]), 1 / point[-1]]
    np.testing.assert_allclose(CAMERA.chart(X, omega), expected, rtol=1e-15)
    np.testing.assert_allclose(POSITION.chart(X, omega), point, rtol=1e-15)
    # A point at infinity has a place in a camera's chart, with derivatives.
    J = jax.jacfwd(CAMERA.chart, argnums=(0, 1))(X, jnp.zeros(()))
    assert all(np.isfinite(part).all() for part in J)
