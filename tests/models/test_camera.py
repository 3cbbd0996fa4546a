"""Tests of jaxslam.models.camera: projection against OpenCV, its inverse, scale and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import central, quick_jit

from jaxslam.models.camera import Camera, bearing, distort, project

IDEAL = Camera(jnp.array([525.0, 524.0]), jnp.array([308.6, 236.5]))
# The real camera of shared/data/costado.
WIDE = Camera(IDEAL.focal, IDEAL.centre, jnp.array([0.107, -0.181, 0.0, 0.0, 0.0]))
SKEWED = Camera(IDEAL.focal, IDEAL.centre, jnp.array([-0.21, 0.06, 0.002, -0.003, 0.01]))
LINE = Camera(jnp.array([650.0]), jnp.array([320.0]))
CAMERAS = {"ideal": IDEAL, "wide": WIDE, "skewed": SKEWED}

each_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


def points(count, seed=0):
    rng = np.random.default_rng(seed)
    bearings = rng.uniform([-0.55, -0.42], [0.55, 0.42], (count, 2))
    return np.column_stack([bearings, np.ones(count)]) * rng.uniform(0.5, 40, (count, 1))


@each_camera
def test_project_agrees_with_opencv(camera):
    cv2 = pytest.importorskip("cv2")
    matrix = np.diag([*camera.focal, 1.0])
    matrix[:2, 2] = camera.centre
    distortion = np.zeros(5) if camera.distortion is None else np.asarray(camera.distortion)
    X = points(200)
    theirs = cv2.projectPoints(X, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
    ours = jax.vmap(project, in_axes=(None, 0))(camera, X)
    # Rounding of numbers of a few hundred pixels.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


@each_camera
def test_bearing_is_the_inverse_of_project_over_the_whole_picture(camera):
    u, v = np.meshgrid(np.linspace(0, 640, 65), np.linspace(0, 480, 49))
    pixels = np.column_stack([u.ravel(), v.ravel()])

    def there_and_back(pixel):
        return project(camera, 3.0 * jnp.append(bearing(camera, pixel), 1.0))

    again = quick_jit(jax.vmap(there_and_back))(pixels)
    np.testing.assert_allclose(again, pixels, rtol=0, atol=1e-6)


@pytest.mark.parametrize("camera", [WIDE, pytest.param(SKEWED, marks=pytest.mark.slow)])
def test_the_derivatives_of_bearing_are_those_of_central_differences(camera):
    """By the pixel and by the lens, in both modes, and by the pixel twice."""
    pixel, lens = jnp.array([120.0, 400.0]), jnp.asarray(camera.distortion)

    def of_both(both):
        return bearing(Camera(camera.focal, camera.centre, both[2:]), both[:2])

    @quick_jit
    def derivatives(both):
        by_pixel = jax.jacfwd(lambda pixel: of_both(jnp.append(pixel, both[2:])))
        return of_both(both), by_pixel(both[:2]), jax.jacrev(of_both)(both)

    both = jnp.append(pixel, lens)
    differences = central(lambda x: derivatives(x)[0], both, 1e-5)
    twice = central(lambda x: derivatives(x)[1], both, 1e-5)[..., :2]
    _, forward, backward = derivatives(both)
    np.testing.assert_allclose(forward, differences[:, :2], atol=1e-11)
    np.testing.assert_allclose(backward[:, :2], differences[:, :2], atol=1e-11)
    np.testing.assert_allclose(backward[:, 2:], differences[:, 2:], atol=1e-9)
    second = quick_jit(jax.jacfwd(jax.jacfwd(lambda pixel: bearing(camera, pixel))))(pixel)
    np.testing.assert_allclose(second, twice, atol=1e-12)


def test_planar_camera_is_the_spatial_one_with_y_zero():
    camera = Camera(jnp.array([650.0, 600.0]), jnp.array([320.0, 240.0]))
    for x, z in [(0.3, 2.0), (-1.0, 1.5), (0.0, 7.0)]:
        u = project(LINE, jnp.array([x, z]))
        # Rounding of hundreds of pixels, and of numbers below 1.
        pixel = project(camera, jnp.array([x, 0.0, z]))
        np.testing.assert_allclose(pixel, [u[0], camera.centre[1]], rtol=0, atol=1e-12)
        ray = bearing(camera, jnp.array([u[0], camera.centre[1]]))
        np.testing.assert_allclose(ray, [bearing(LINE, u)[0], 0.0], rtol=0, atol=1e-15)


@pytest.mark.parametrize("scale", [1e-6, 7.3, 1e6])
@each_camera
def test_projection_does_not_depend_on_the_scale_of_the_point(camera, scale):
    X = jnp.asarray(points(1)[0])
    # 1e-10 px: rounding only.
    np.testing.assert_allclose(project(camera, scale * X), project(camera, X), rtol=0, atol=1e-10)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize(
    ("camera", "point"),
    [(LINE, [1.0, 0.0]), (WIDE, [1.0, 2.0, 0.0]), (IDEAL, [0.0, 0.0, 0.0])],
    ids=["line", "wide", "ideal"],
)
def test_derivative_at_zero_depth_is_finite(camera, point, mode):
    point = jnp.array(point)
    assert np.isfinite(project(camera, point)).all()
    assert np.isfinite(mode(project, argnums=1)(camera, point)).all()


def test_perturbed_moves_the_intrinsics_and_keeps_the_lens():
    delta = jnp.array([1.0, -2.0, 3.0, -4.0])
    moved = WIDE.perturbed(delta)
    np.testing.assert_array_equal(moved.intrinsics, WIDE.intrinsics + delta)
    np.testing.assert_array_equal(moved.distortion, WIDE.distortion)
    # u = f d(x/z) + c: by hand, what the shift of f and c does to a pixel.
    X = jnp.asarray(points(1)[0])
    d = distort(X[:2] / X[2], WIDE.distortion)
    np.testing.assert_allclose(
        project(moved, X) - project(WIDE, X), delta[:2] * d + delta[2:], rtol=0, atol=1e-10
    )


def test_an_empty_perturbation_means_a_known_camera():
    assert WIDE.perturbed(jnp.zeros(0)) is WIDE


def test_square_pixels_have_one_error_of_both_focal_lengths():
    moved = WIDE.perturbed(jnp.array([3.0, -1.0, 2.0]))
    np.testing.assert_array_equal(moved.focal, WIDE.focal + 3.0)
    np.testing.assert_array_equal(moved.centre, WIDE.centre + jnp.array([-1.0, 2.0]))
    with pytest.raises((TypeError, ValueError)):
        project(LINE.perturbed(jnp.array([3.0, -1.0, 2.0])), jnp.array([0.1, 1.0]))


@each_camera
def test_derivatives_agree_with_central_differences(camera):
    X = points(1, seed=1)[0]
    seen = jnp.asarray(X)
    pixel = np.asarray(project(camera, seen))
    delta = np.array([0.5, -0.5, 1.0, 2.0])
    functions = {
        "project": (lambda x: project(camera, x), X),
        "bearing": (lambda u: bearing(camera, u), pixel),
        "intrinsics": (lambda d: project(camera.perturbed(d), seen), delta),
    }
    for name, (function, at) in functions.items():
        # Rounding of a pixel (1e-13) over the step of 1e-6, relative to hundreds a metre.
        np.testing.assert_allclose(
            quick_jit(jax.jacfwd(function))(at),
            central(quick_jit(function), at),
            rtol=1e-6,
            atol=1e-6,
            err_msg=name,
        )
