"""Tests of jaxslam.landmarks: what every parametrization in the table owes its Euclidean point."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import central, close, each_geometry, each_landmark, named, pose, quick_jit

from jaxslam.camera import Camera, project
from jaxslam.landmarks import INVERSE_SCALING, LANDMARKS

FOCAL = 650.0
INVERSE_DEPTHS = (0.02, 0.15, 1.3)

pytestmark = [pytest.mark.parametrize("geometry", each_geometry, ids=named)]
every_landmark = pytest.mark.parametrize("landmark", each_landmark, ids=named)
at_infinity = pytest.mark.parametrize(
    "landmark", [p for p in each_landmark if p.name != "cartesian"], ids=named
)


def bearing_of(geometry):
    return jnp.array([0.31, -0.22])[: geometry.pixel_dim]


@cache
def functions(landmark):
    """The landmark's functions compiled, and `euclidean(parameters)`."""

    def euclidean(parameters):
        point, omega = landmark.homogeneous(parameters)
        return point / omega

    return (
        quick_jit(lambda b, w: landmark.initialise(jnp.append(b, 1.0), w, jnp.asarray(FOCAL))),
        quick_jit(landmark.transform),
        quick_jit(landmark.homogeneous),
        quick_jit(euclidean),
    )


def generic(landmark, geometry, inverse_depth=0.15):
    """A landmark first seen from elsewhere: an anchor, where there is one, is not the origin."""
    initialise, transform, *_ = functions(landmark)
    return transform(pose(geometry, 1), initialise(bearing_of(geometry), inverse_depth))


@every_landmark
def test_size_is_the_number_of_parameters(landmark, geometry):
    assert generic(landmark, geometry).shape == (landmark.size(geometry.point_dim),)


@every_landmark
@pytest.mark.parametrize("inverse_depth", INVERSE_DEPTHS)
def test_first_observation_puts_the_point_on_its_ray_at_its_depth(
    landmark, geometry, inverse_depth
):
    initialise, _, _, euclidean = functions(landmark)
    ray = jnp.append(bearing_of(geometry), 1.0)
    point = euclidean(initialise(bearing_of(geometry), inverse_depth))
    np.testing.assert_allclose(point, ray / inverse_depth, rtol=1e-14)


@every_landmark
def test_transform_moves_the_euclidean_point(landmark, geometry):
    _, transform, _, euclidean = functions(landmark)
    parameters, T = generic(landmark, geometry), pose(geometry, 2, scale=1.0)
    moved = euclidean(transform(T, parameters))
    np.testing.assert_allclose(moved, T @ euclidean(parameters), rtol=1e-13, atol=1e-13)


@every_landmark
def test_transform_there_and_back_is_the_identity_also_for_the_parameters(landmark, geometry):
    _, transform, *_ = functions(landmark)
    parameters, T = generic(landmark, geometry), pose(geometry, 3, scale=1.0)
    moved = transform(T, parameters)
    assert np.abs(moved - parameters).max() > 0.01
    close(transform(T.inverse(), moved), parameters, relative=1e-14)


@every_landmark
def test_transforms_compose(landmark, geometry):
    _, transform, *_ = functions(landmark)
    parameters = generic(landmark, geometry)
    T, U = pose(geometry, 4), pose(geometry, 5)
    close(transform(T @ U, parameters), transform(T, transform(U, parameters)), relative=1e-14)


@every_landmark
def test_derivatives_agree_with_central_differences(landmark, geometry):
    parameters, T = np.asarray(generic(landmark, geometry)), pose(geometry, 2)
    p = geometry.pixel_dim

    def first_seen(x):
        return landmark.initialise(jnp.append(x[:p], 1.0), x[p], jnp.asarray(FOCAL))

    def moved_by(delta):
        return landmark.transform(T @ geometry.group.exp(delta), parameters)

    def stacked(x):
        return jnp.append(*landmark.homogeneous(x))

    for name, function, at in (
        ("initialise", first_seen, np.append(bearing_of(geometry), 0.15)),
        ("transform by parameters", lambda x: landmark.transform(T, x), parameters),
        ("transform by pose", moved_by, np.zeros(geometry.tangent_dim)),
        ("homogeneous", stacked, parameters),
    ):
        exact = np.asarray(quick_jit(jax.jacfwd(function))(at))
        assert np.isfinite(exact).all(), name
        # Steps of 1e-6: rounding leaves about 1e-10 of the largest entry, curvature 1e-12.
        close(central(quick_jit(function), at), exact, relative=1e-8)


@at_infinity
def test_a_point_at_infinity_is_nothing_special(landmark, geometry):
    initialise, transform, homogeneous, _ = functions(landmark)
    camera = Camera(jnp.full(geometry.pixel_dim, FOCAL), jnp.full(geometry.pixel_dim, 320.0))
    T = pose(geometry, 6)
    parameters = initialise(bearing_of(geometry), 0.0)
    point, omega = homogeneous(transform(T, parameters))
    assert omega == 0.0
    # It turns with the rotation, and the translation does nothing.
    ray = T.rotation() @ jnp.append(bearing_of(geometry), 1.0)
    np.testing.assert_allclose(point / point[-1], ray / ray[-1], rtol=1e-13, atol=1e-15)

    def pixel(parameters):
        return project(camera, landmark.homogeneous(landmark.transform(T, parameters))[0])

    J = np.asarray(quick_jit(jax.jacfwd(pixel))(parameters))
    close(central(quick_jit(pixel), np.asarray(parameters)), J, relative=1e-7)


@at_infinity
def test_a_negative_inverse_depth_is_legal_and_continuous(landmark, geometry):
    """Beyond infinity the pixel goes on as it came: no sign flips, nothing is clamped."""
    initialise, transform, homogeneous, _ = functions(landmark)
    T = pose(geometry, 6)

    def bearing_after(inverse_depth):
        parameters = transform(T, initialise(bearing_of(geometry), inverse_depth))
        point, omega = homogeneous(parameters)
        # IS carries the focal length as its scale; the sign is what matters.
        np.testing.assert_allclose(np.sign(omega), np.sign(inverse_depth))
        assert point[-1] > 0
        return np.asarray(point[:-1] / point[-1])

    before, at, after = (bearing_after(w) for w in (1e-3, 0.0, -1e-3))
    assert np.abs(after - before).max() > 1e-5
    # The second difference of a smooth function, O(1e-6); a flip would be of order 1.
    np.testing.assert_allclose(after - at, at - before, rtol=0, atol=1e-6)


def test_inverse_scaling_is_linear_in_the_landmark(geometry):
    _, transform, *_ = functions(INVERSE_SCALING)
    T, n = pose(geometry, 7), geometry.point_dim
    a, b = np.random.default_rng(0).normal(size=(2, n + 1))
    close(transform(T, 2 * a - 3 * b), 2 * transform(T, a) - 3 * transform(T, b), relative=1e-14)


def test_inverse_scaling_starts_in_pixels(geometry):
    """P22–P26: (u − cx, v − cy, f, f/d)."""
    initialise, *_ = functions(INVERSE_SCALING)
    expected = [*(FOCAL * bearing_of(geometry)), FOCAL, FOCAL * 0.2]
    np.testing.assert_allclose(initialise(bearing_of(geometry), 0.2), expected, rtol=1e-15)


def test_inverse_depth_holds_anchor_angles_and_inverse_distance(geometry):
    """θ = atan2(nx, nz), φ = atan2(−ny, √(nx² + nz²)), ρ along the ray, not along the axis."""
    initialise, transform, *_ = functions(LANDMARKS["inverse_depth"])
    ray = np.append(bearing_of(geometry), 1.0)
    theta = np.arctan2(ray[0], ray[-1])
    phi = [np.arctan2(-ray[1], np.hypot(ray[0], ray[-1]))] if geometry.point_dim == 3 else []
    angles = [theta, *phi]
    parameters = initialise(bearing_of(geometry), 0.2)
    expected = [*np.zeros(ray.size), *angles, 0.2 / np.linalg.norm(ray)]
    np.testing.assert_allclose(parameters, expected, rtol=1e-14)
    T = pose(geometry, 8)
    np.testing.assert_allclose(transform(T, parameters)[: ray.size], T.translation(), atol=1e-15)
