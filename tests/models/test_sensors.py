"""Tests of jaxslam.models.sensors: what a measurement tells of a point, and what it hides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each_geometry, named, quick_jit

from jaxslam.geometry import PLANAR, SPATIAL
from jaxslam.models.camera import Camera
from jaxslam.models.sensors import Pinhole, Position, RangeBearing

POINT = np.array([0.4, -0.7, 3.0])


def pinhole(geometry):
    p = geometry.pixel_dim
    return Pinhole(Camera([650.0, 640.0][:p], [320.0, 240.0][:p]), 0.3)


def position(geometry):
    return Position(0.1, point_dim=geometry.point_dim)


def range_bearing(geometry):
    assert geometry is PLANAR
    return RangeBearing([0.1, 0.02])


EVERY_SENSOR = [
    *((geometry, make) for geometry in each_geometry for make in (pinhole, position)),
    (PLANAR, range_bearing),
]

with_geometry = pytest.mark.parametrize("geometry", each_geometry, ids=named)
with_sensor = pytest.mark.parametrize(
    ("geometry", "make"),
    EVERY_SENSOR,
    ids=[f"{geometry.name}-{make.__name__}" for geometry, make in EVERY_SENSOR],
)


def point_of(geometry):
    return jnp.asarray(POINT[-geometry.point_dim :])


@with_sensor
def test_locate_is_the_inverse_of_measure_at_any_scale_of_a_homogeneous_point(geometry, make):
    sensor, X, omega = make(geometry), point_of(geometry), jnp.asarray(0.4)
    measured = quick_jit(lambda *x: sensor.measure(*x))(X, omega)
    assert measured.shape == (sensor.size,)
    assert sensor.noise.shape == (sensor.size, sensor.size)
    assert sensor.size + sensor.hidden == geometry.point_dim == sensor.point_dim
    # What a camera does not tell is 1/z.
    hidden = (omega / X[-1:])[: sensor.hidden]
    located, scale = quick_jit(lambda *x: sensor.locate(*x))(measured, hidden)
    np.testing.assert_allclose(located / scale, X / omega, rtol=1e-14)
    for function in (sensor.measure, sensor.chart):
        np.testing.assert_allclose(function(3 * X, 3 * omega), function(X, omega), rtol=1e-14)
    assert sensor.possible(X)
    assert sensor.possible(-X) == (make is not pinhole)


@with_geometry
def test_charts_are_an_image_with_inverse_depth_and_the_point_itself(geometry):
    X, omega, camera = point_of(geometry), jnp.asarray(0.5), pinhole(geometry)
    point = np.asarray(X) / 0.5
    expected = [*(point[:-1] / point[-1]), 1 / point[-1]]
    np.testing.assert_allclose(camera.chart(X, omega), expected, rtol=1e-15)
    np.testing.assert_allclose(position(geometry).chart(X, omega), point, rtol=1e-15)
    # A point at infinity has a place in a camera's chart, with derivatives.
    J = jax.jacfwd(camera.chart, argnums=(0, 1))(X, jnp.zeros(()))
    assert all(np.isfinite(part).all() for part in J)


def test_range_and_bearing_are_polar_coordinates_whose_angle_is_the_shorter_way_round():
    sensor = RangeBearing([0.1, 0.02])
    for angle in (0.0, 2.0, -3.0):
        found = sensor.measure(2.5 * jnp.array([np.sin(angle), np.cos(angle)]), jnp.asarray(0.5))
        np.testing.assert_allclose(found, [5.0, angle], rtol=1e-14, atol=1e-14)
    found = sensor.residual(jnp.array([5.0, 3.1]), jnp.array([4.0, -3.1]))
    np.testing.assert_allclose(found, [1.0, 6.2 - 2 * np.pi], rtol=1e-14)


def test_noise_has_one_sigma_for_all_numbers_or_one_each():
    np.testing.assert_allclose(pinhole(SPATIAL).noise, 0.09 * np.eye(2), rtol=1e-15)
    each = Position([0.1, 0.2]).noise
    np.testing.assert_allclose(each, np.diag([0.01, 0.04]), rtol=1e-15, atol=1e-18)


@with_sensor
def test_only_a_camera_has_a_calibration_that_can_be_off(geometry, make):
    sensor = make(geometry)
    assert sensor.perturbed(jnp.zeros(0)).point_dim == geometry.point_dim
    delta = jnp.ones(2 * geometry.pixel_dim)
    if make is pinhole:
        moved = sensor.perturbed(delta).camera.intrinsics
        np.testing.assert_array_equal(moved, sensor.camera.intrinsics + 1.0)
    else:
        with pytest.raises(ValueError, match=f"{type(sensor).__name__} has no calibration"):
            sensor.perturbed(delta)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RangeBearing(0.1), "sigma of range and bearing has shape"),
        (lambda: Position([0.1, 0.2], point_dim=3), "a position's sigma has shape"),
        (lambda: Pinhole(Camera([650.0], [320.0]), [0.3, 0.3]), "a pixel's sigma has shape"),
        (lambda: Camera([-650.0], [320.0]), "the camera's focal must be positive, not -650.0"),
        (lambda: Camera(jnp.zeros(2), jnp.ones(2)), "the camera's focal must be positive, not 0"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
