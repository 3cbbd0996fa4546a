"""Tests of jaxslam.landmarks: what every parametrization in the table owes its Euclidean point."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, each_geometry, each_landmark, named, pose, quick_jit

from jaxslam.geometry import joined
from jaxslam.landmarks import (
    Cartesian,
    InverseDepthToCartesian,
    InverseScaling,
    ParallaxAngle,
    SotNormal,
    UnifiedInverseDepth,
)
from jaxslam.landmarks.inverse_depth import angles_of

FOCAL = 650.0
INVERSE_DEPTHS = (0.02, 0.15, 1.3)

SECOND_CAMERA = np.array([0.5, -0.2, 0.3])


class Converted(InverseDepthToCartesian):
    """Inverse depth to Cartesian, after its conversion."""

    name = "inverse_depth_to_cartesian, converted"

    def initialise(self, point, omega, focal):
        position = point / omega
        return jnp.concatenate([position, jnp.zeros_like(position), jnp.ones(1)])


class Anchored(ParallaxAngle):
    """Parallax angle with a second anchor: the angle at X/ω between the rays to both."""

    name = "parallax_angle, with both anchors"

    def initialise(self, point, omega, focal):
        second = jnp.asarray(SECOND_CAMERA[: point.size])
        ray = point / jnp.linalg.norm(point)
        along, rho = ray @ second, omega / jnp.linalg.norm(point)
        across = jnp.sqrt(second @ second - along**2)
        alpha = jnp.arctan2(rho * across, 1 - rho * along)
        ends = jnp.stack([alpha, jnp.ones(())])
        return jnp.concatenate([jnp.zeros_like(point), second, angles_of(point), ends])


forms = [*each_landmark, Converted(), Anchored()]

with_geometry = pytest.mark.parametrize("geometry", each_geometry, ids=named)
every_landmark = pytest.mark.parametrize("landmark", forms, ids=named)
at_infinity = pytest.mark.parametrize(
    "landmark",
    [p for p in forms if not isinstance(p, Cartesian | Converted | SotNormal)],
    ids=named,
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


@with_geometry
@every_landmark
def test_it_is_a_point_wherever_its_anchor_is(landmark, geometry):
    """`check_landmark` has the rest, of a first sighting: here T U, and a length by a turn."""
    _, transform, _, euclidean = functions(landmark)
    parameters = generic(landmark, geometry)
    T, U = pose(geometry, 4, scale=1.0), pose(geometry, 5)
    moved = transform(T @ U, parameters)
    np.testing.assert_allclose(euclidean(moved), T @ U @ euclidean(parameters), rtol=1e-13)
    close(moved, transform(T, transform(U, parameters)), relative=1e-13)
    enlarged, turn = landmark.scale(1.7, parameters), joined(U.rotation(), 0 * U.translation())
    np.testing.assert_allclose(euclidean(enlarged), 1.7 * euclidean(parameters), rtol=1e-12)
    turned = landmark.scale(1.7, transform(turn, parameters))
    np.testing.assert_allclose(transform(turn, enlarged), turned, rtol=1e-12, atol=1e-14)


@with_geometry
@at_infinity
def test_infinity_and_beyond_are_nothing_special(landmark, geometry):
    """The pixel goes on as it came: no sign flips, nothing is clamped; and ω = 0 only turns."""
    initialise, transform, homogeneous, _ = functions(landmark)
    T = pose(geometry, 6)

    def bearing_after(inverse_depth):
        point, omega = homogeneous(transform(T, initialise(bearing_of(geometry), inverse_depth)))
        assert np.sign(omega) == np.sign(inverse_depth)
        assert point[-1] > 0
        return np.asarray(point[:-1] / point[-1])

    before, at, after = (bearing_after(w) for w in (1e-3, 0.0, -1e-3))
    ray = T.rotation() @ jnp.append(bearing_of(geometry), 1.0)
    np.testing.assert_allclose(at, ray[:-1] / ray[-1], rtol=1e-13)
    assert np.abs(after - before).max() > 1e-5
    # The second difference of a smooth function, O(1e-6); a flip would be of order 1.
    np.testing.assert_allclose(after - at, at - before, rtol=0, atol=1e-6)


@with_geometry
def test_parameters_are_the_published_ones(geometry):
    """P22–P26: (u − cx, v − cy, f, f/d). And an anchor, θ = atan2(nx, nz), φ = atan2(−ny, √(nx² +
    nz²)), and ρ along the ray, not along the axis."""
    bearing = bearing_of(geometry)
    scaling = functions(InverseScaling())[0](bearing, 0.2)
    np.testing.assert_allclose(scaling, [*(FOCAL * bearing), FOCAL, FOCAL * 0.2], rtol=1e-15)
    initialise, transform, *_ = functions(UnifiedInverseDepth())
    ray = np.append(bearing, 1.0)
    angles = [np.arctan2(ray[0], ray[-1])]
    if geometry.point_dim == 3:
        angles.append(np.arctan2(-ray[1], np.hypot(ray[0], ray[-1])))
    parameters, T = initialise(bearing, 0.2), pose(geometry, 8)
    expected = [*np.zeros(ray.size), *angles, 0.2 / np.linalg.norm(ray)]
    np.testing.assert_allclose(parameters, expected, rtol=1e-14)
    np.testing.assert_allclose(transform(T, parameters)[: ray.size], T.translation(), atol=1e-15)


@with_geometry
def test_a_correction_in_normal_coordinates_is_one_of_sot(geometry):
    """`e^l Exp(θ) p`, of which the equivariant filter's has |θ| = |δ| and this one `arctan |δ|`:
    δ across the ray turns it towards δ, and the range is exact."""
    parameters, euclidean = generic(SotNormal(), geometry), functions(SotNormal())[-1]
    point, ray = np.asarray(euclidean(parameters)), np.asarray(parameters[:-1])
    away = np.random.default_rng(0).normal(size=ray.size)
    away -= (away @ ray) * ray
    delta = 0.1 * away / np.linalg.norm(away)
    moved = np.asarray(euclidean(parameters + np.append(delta, 0.3)))
    np.testing.assert_allclose(np.linalg.norm(moved), np.exp(0.3) * np.linalg.norm(point))
    turned = np.cos(0.1) * ray + np.sin(0.1) * delta / 0.1
    np.testing.assert_allclose(angle_between(moved, turned), 0.1**3 / 3, rtol=0.01)
    np.testing.assert_allclose(angle_between(moved, ray), np.arctan(0.1), rtol=1e-12)


def angle_between(a, b):
    return np.arccos(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


@with_geometry
def test_parallax_angle_is_the_triangle_of_two_anchors_and_a_point(geometry):
    """Two sides and angles of a triangle by plain trigonometry: the law of sines."""
    rng = np.random.default_rng(0)
    main, associate = rng.uniform(-1, 1, (2, geometry.point_dim))
    point = rng.uniform(2, 6, geometry.point_dim)
    ray, baseline = point - main, associate - main
    alpha, psi = angle_between(main - point, associate - point), angle_between(ray, baseline)
    assert alpha > 0.02
    side = np.linalg.norm(baseline) * np.sin(np.pi - alpha - psi) / np.sin(alpha)
    np.testing.assert_allclose(np.linalg.norm(ray), side, rtol=1e-12)
    parameters = np.concatenate([main, associate, angles_of(jnp.asarray(ray)), [alpha, 1.0]])
    euclidean = functions(ParallaxAngle())[-1]
    np.testing.assert_allclose(euclidean(parameters), point, rtol=1e-12)


@pytest.mark.parametrize("moved", [0.0, 0.5, -0.5], ids=["not at all", "towards", "away"])
@with_geometry
def test_a_camera_that_moves_along_the_ray_has_no_parallax_and_finite_derivatives(geometry, moved):
    parameters = generic(ParallaxAngle(), geometry)
    main, ray = _main_and_ray(parameters, geometry)
    camera = jnp.asarray(main + moved * ray)
    size = ParallaxAngle().size(geometry.point_dim)
    value, J = value_and_jacobian(ParallaxAngle())(camera, parameters, jnp.eye(size))
    np.testing.assert_array_equal(value, parameters)
    assert all(np.isfinite(part).all() for part in J)
    # And with such a second anchor, where no point is told, the formula is still finite.
    flat = jnp.concatenate([main, camera, parameters[2 * main.size : -2], jnp.array([0.1, 1.0])])
    J = quick_jit(jax.jacfwd(ParallaxAngle().homogeneous))(flat)
    assert all(np.isfinite(part).all() for part in J)


def _main_and_ray(parameters, geometry):
    """The anchor, and the unit ray from there to the point."""
    main = np.asarray(parameters[: geometry.point_dim])
    point = np.asarray(functions(ParallaxAngle())[-1](parameters))
    return main, (point - main) / np.linalg.norm(point - main)


@cache
def value_and_jacobian(landmark):
    """`(camera, parameters, covariance) → converted`, and its derivatives by the first two."""
    return quick_jit(
        lambda *x: (landmark.convert(*x), jax.jacfwd(landmark.convert, argnums=(0, 1))(*x))
    )


def convert(landmark, *arguments):
    return np.asarray(value_and_jacobian(landmark)(*arguments)[0])


def linearity_index(anchor, point, camera, rho, sigma_rho):
    """Civera, Davison, Montiel, ICRA 2007: `L_d = 4 σ_d |cos α| / d₁`, `σ_d = σ_ρ/ρ²`."""
    parallax = angle_between(point - anchor, point - camera)
    return 4 * sigma_rho / rho**2 * abs(np.cos(parallax)) / np.linalg.norm(point - camera)


def with_last_sigma(size, sigma):
    """A covariance of which only the last parameter before the constant counts."""
    covariance = np.full((size, size), 7.0)
    covariance[-2, -2] = sigma**2
    return covariance


@pytest.mark.parametrize("seed", [0, 2])
@with_geometry
def test_inverse_depth_becomes_cartesian_exactly_where_it_is_linear(geometry, seed):
    landmark, n = InverseDepthToCartesian(), geometry.point_dim
    parameters = np.asarray(generic(landmark, geometry, INVERSE_DEPTHS[seed]))
    camera = np.random.default_rng(seed).uniform(-0.5, 0.5, n)
    point, rho = np.asarray(functions(landmark)[-1](parameters)), parameters[-2]
    # The index is proportional to σ_ρ: this one is at the threshold of 10 %.
    threshold = 0.1 / linearity_index(parameters[:n], point, camera, rho, 1.0)
    above = convert(landmark, camera, parameters, with_last_sigma(2 * n + 1, threshold * 1.0001))
    np.testing.assert_array_equal(above, parameters)
    below = convert(landmark, camera, parameters, with_last_sigma(2 * n + 1, threshold * 0.9999))
    np.testing.assert_allclose(below[:n], point, rtol=1e-13)
    np.testing.assert_array_equal(below[n:], [0.0] * n + [1.0])
    np.testing.assert_allclose(functions(landmark)[-1](below), point, rtol=1e-13)
    again = convert(landmark, camera + 0.1, below, with_last_sigma(2 * n + 1, 0.0))
    np.testing.assert_array_equal(again, below)


@pytest.mark.parametrize("rho", [0.0, -0.1])
@with_geometry
def test_a_point_at_or_beyond_infinity_does_not_become_cartesian(geometry, rho):
    n = geometry.point_dim
    parameters = generic(InverseDepthToCartesian(), geometry).at[-2].set(rho)
    arguments = jnp.zeros(n), parameters, with_last_sigma(2 * n + 1, 1e-9)
    value, J = value_and_jacobian(InverseDepthToCartesian())(*arguments)
    np.testing.assert_array_equal(value, parameters)
    assert all(np.isfinite(part).all() for part in J)


@pytest.mark.parametrize("seed", [0, 2])
@with_geometry
def test_a_camera_becomes_the_associate_anchor_exactly_at_the_least_parallax(geometry, seed):
    landmark, n = ParallaxAngle(), geometry.point_dim
    parameters = np.asarray(generic(landmark, geometry, INVERSE_DEPTHS[seed]))
    main, ray = _main_and_ray(parameters, geometry)
    point = np.asarray(functions(landmark)[-1](parameters))
    covariance = np.eye(3 * n + 1)
    # Across the ray and somewhat along it, as far as makes the parallax 0.02 ∓ 1e-7.
    step = np.random.default_rng(seed).normal(size=n)
    across = step - (step @ ray) * ray
    across /= np.linalg.norm(across)
    along = 0.2 * np.linalg.norm(point - main)

    def camera_at(parallax):
        left = np.linalg.norm(point - main) - along
        return main + along * ray + left * np.tan(parallax) * across

    early, late = camera_at(0.02 - 1e-7), camera_at(0.02 + 1e-7)
    np.testing.assert_allclose(angle_between(point - main, point - late), 0.02 + 1e-7, atol=1e-12)
    np.testing.assert_array_equal(convert(landmark, early, parameters, covariance), parameters)
    anchored = convert(landmark, late, parameters, covariance)
    expected = [*main, *late, *parameters[2 * n : -2], 0.02 + 1e-7, 1.0]
    np.testing.assert_allclose(anchored, expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(functions(landmark)[-1](anchored), point, rtol=1e-12)
    # Once only: the second anchor stays, however much larger another parallax is.
    again = convert(landmark, camera_at(0.3), anchored, covariance)
    np.testing.assert_array_equal(again, anchored)
