"""Tests of jaxslam.models.camera: projection against OpenCV, its inverse, scale and derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import central, quick_jit

from jaxslam import cast
from jaxslam.models.camera import Camera, project, ray
from jaxslam.models.lens import Fisheye, RadialTangential, Rational

IDEAL = Camera(jnp.array([525.0, 524.0]), jnp.array([308.6, 236.5]))
# The real camera of shared/data/costado.
WIDE = Camera(IDEAL.focal, IDEAL.centre, RadialTangential(0.107, -0.181))
SKEWED = Camera(IDEAL.focal, IDEAL.centre, RadialTangential(-0.21, 0.06, 0.002, -0.003, 0.01))
RATIONAL = Camera(
    jnp.array([400.0, 401.0]), IDEAL.centre,
    Rational(1.2, 0.1, 2e-4, -1e-4, 0.004, 1.5, 0.35, 0.02),
)  # fmt: skip
# TUM-VI's, 195° across the corners, and one that sees farther back.
FISHEYE = Camera(jnp.array([238.3, 238.3]), IDEAL.centre, Fisheye(0.0034, 0.0007, -0.002, 0.0002))
EQUIDISTANT = Camera(jnp.array([180.0, 181.0]), IDEAL.centre, Fisheye())
LINE = Camera(jnp.array([650.0]), jnp.array([320.0]))
CAMERAS = {
    "ideal": IDEAL, "wide": WIDE, "skewed": SKEWED, "rational": RATIONAL, "fisheye": FISHEYE,
    "equidistant": EQUIDISTANT,
}  # fmt: skip

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
    numbers = np.array(jax.tree.leaves(camera.lens) or np.zeros(4))
    X, still = points(200), np.zeros(3)
    if isinstance(camera.lens, Fisheye):
        X[:, :2] *= 20  # up to 85° from the axis; OpenCV goes no farther than 90°
        theirs = cv2.fisheye.projectPoints(X[:, None], still, still, matrix, numbers)[0][:, 0]
    else:
        theirs = cv2.projectPoints(X, still, still, matrix, numbers)[0][:, 0]
    ours = quick_jit(jax.vmap(project, in_axes=(None, 0)))(camera, X)
    # Rounding of numbers of a few hundred pixels.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


@each_camera
def test_ray_is_the_inverse_of_project_over_the_whole_picture(camera):
    u, v = np.meshgrid(np.linspace(0, 640, 65), np.linspace(0, 480, 49))
    pixels = np.column_stack([u.ravel(), v.ravel()])

    def there_and_back(pixel):
        X = ray(camera, pixel)
        return project(camera, 3.0 * X), camera.lens.depth(X), camera.lens.sees(X), X[-1]

    again, depth, seen, z = quick_jit(jax.vmap(there_and_back))(pixels)
    np.testing.assert_allclose(again, pixels, rtol=0, atol=1e-6)
    np.testing.assert_allclose(depth, 1, rtol=1e-12)
    assert seen.all()
    # 90° is 283 pixels from the centre of the equidistant one.
    assert (z.min() < -0.4) == (camera is EQUIDISTANT)


@each_camera
def test_a_camera_in_single_precision_stays_in_it_and_is_nearly_as_exact(camera):
    single, pixel = cast(camera, "float32"), jnp.array([500.0, 50.0], jnp.float32)
    X = quick_jit(partial(ray, single))(pixel)
    again = quick_jit(partial(project, single))(X)
    assert X.dtype == again.dtype == jnp.float32
    np.testing.assert_allclose(X, ray(camera, pixel), rtol=0, atol=1e-5)
    np.testing.assert_allclose(again, pixel, rtol=0, atol=2e-3)


def test_a_lens_does_not_see_what_its_model_would_fold_back_into_the_picture():
    """`r (1 − .3 r²)` is largest at r = 1.054, and small again at 1.8."""
    lens = RadialTangential(-0.3)
    for r, seen in ((0.9, True), (1.0, True), (1.1, False), (1.8, False)):
        assert lens.sees(jnp.array([0.6 * r, 0.8 * r, 1.0])) == seen
    assert not lens.sees(jnp.array([0.1, 0.1, -1.0]))
    # `θ (1 − .2 θ²)` at 1.291 rad.
    folded = Fisheye(-0.2)
    for angle, seen in ((0.0, True), (1.28, True), (1.3, False), (2.0, False)):
        assert folded.sees(jnp.array([jnp.sin(angle), 0.0, jnp.cos(angle)])) == seen
        assert Fisheye().sees(jnp.array([jnp.sin(angle), 0.0, jnp.cos(angle)]))
    assert not Fisheye().sees(jnp.array([0.0, 0.0, -1.0]))


@quick_jit
def bent(X):
    """What the fisheye makes of a ray, with two derivatives; and back, with one."""
    lens, slope = FISHEYE.lens, jax.jacfwd(FISHEYE.lens.distort)
    there = lens.distort(X), slope(X), jax.jacfwd(slope)(X)
    back = lens.undistort(there[0]), jax.jacfwd(lens.undistort)(there[0])
    return lens.flat(7 * X), there, back


@pytest.mark.parametrize("angle", [0.0, 1e-9, 3e-5, 2.4])
def test_a_fisheye_and_its_derivatives_are_right_at_the_axis_and_beyond_a_right_angle(angle):
    X = np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), np.cos(angle)])
    flat, (_, J, twice), (ray, back) = bent(X)
    np.testing.assert_allclose(flat, angle * np.array([0.6, 0.8]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(ray, X, rtol=0, atol=1e-12)
    steps = central(lambda X: np.asarray(bent(X)[1][0]), X, 1e-6)
    np.testing.assert_allclose(J, steps, rtol=0, atol=1e-8)
    np.testing.assert_allclose(J @ back, np.eye(2), rtol=0, atol=1e-9)
    steps = central(lambda X: np.asarray(bent(X)[1][1]), X, 1e-5)
    np.testing.assert_allclose(twice, steps, rtol=0, atol=3e-5)


@pytest.mark.parametrize(
    "camera", [SKEWED, RATIONAL, FISHEYE], ids=["skewed", "rational", "fisheye"]
)
def test_the_derivatives_of_ray_are_those_of_central_differences(camera):
    """By the pixel and by the lens, in both modes, and by the pixel twice."""
    pixel, lens = jnp.array([120.0, 400.0]), jnp.stack(jax.tree.leaves(camera.lens))

    def of_both(both):
        return ray(Camera(camera.focal, camera.centre, type(camera.lens)(*both[2:])), both[:2])

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
    second = quick_jit(jax.jacfwd(jax.jacfwd(lambda pixel: ray(camera, pixel))))(pixel)
    np.testing.assert_allclose(second, twice, atol=1e-11)


def test_planar_camera_is_the_spatial_one_with_y_zero():
    camera = Camera(jnp.array([650.0, 600.0]), jnp.array([320.0, 240.0]))
    for x, z in [(0.3, 2.0), (-1.0, 1.5), (0.0, 7.0)]:
        u = project(LINE, jnp.array([x, z]))
        # Rounding of hundreds of pixels, and of numbers below 1.
        pixel = project(camera, jnp.array([x, 0.0, z]))
        np.testing.assert_allclose(pixel, [u[0], camera.centre[1]], rtol=0, atol=1e-12)
        there = ray(camera, jnp.array([u[0], camera.centre[1]]))
        np.testing.assert_allclose(there, [ray(LINE, u)[0], 0.0, 1.0], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("camera", "point"),
    [
        (LINE, [1.0, 0.0]),
        (WIDE, [1.0, 2.0, 0.0]),
        (IDEAL, [0.0, 0.0, 0.0]),
        (FISHEYE, [0.0, 0.0, 0.0]),
        (FISHEYE, [0.0, 0.0, -1.0]),
    ],
    ids=["line", "wide", "ideal", "nowhere", "behind"],
)
def test_derivative_where_nothing_is_seen_is_finite(camera, point):
    of_point = partial(project, camera)
    both = quick_jit(lambda X: (of_point(X), jax.jacfwd(of_point)(X), jax.jacrev(of_point)(X)))
    assert all(np.isfinite(x).all() for x in both(np.array(point)))


@pytest.mark.parametrize("camera", [WIDE, RATIONAL, FISHEYE], ids=["wide", "rational", "fisheye"])
@pytest.mark.parametrize("delta", [[3.0, -1, 2, 0.05, -0.02], [3.0, 3, -1, 2, 0.05, -0.02]])
def test_perturbed_moves_k1_and_k2_of_a_lens_that_is_not_known(camera, delta):
    moved = camera.perturbed(jnp.array(delta))
    change = np.array([3.0, 3, -1, 2, 0.05, -0.02])
    np.testing.assert_allclose(moved.intrinsics, camera.intrinsics + change, rtol=1e-15)
    assert jax.tree.leaves(moved.lens)[2:] == jax.tree.leaves(camera.lens)[2:]
    # By hand: u = f (d + Δ(k1 r² + k2 r⁴) x) + c of a lens without another denominator.
    if camera is not RATIONAL:
        X = jnp.array([0.3, -0.2, 1.0])
        x = camera.lens.flat(X)
        bent = camera.lens.distort(X) + x * (0.05 * x @ x - 0.02 * (x @ x) ** 2)
        expected = moved.focal * bent + moved.centre
        np.testing.assert_allclose(project(moved, X), expected, rtol=1e-13)


def test_other_errors_are_of_focal_lengths_and_centre_and_leave_the_lens():
    assert WIDE.perturbed(jnp.zeros(0)) is WIDE
    for delta, by in (([3.0, -1, 2], [3.0, 3, -1, 2]), ([1.0, -2, 3, -4], [1.0, -2, 3, -4])):
        moved = WIDE.perturbed(jnp.array(delta))
        np.testing.assert_array_equal(moved.intrinsics[:4], WIDE.intrinsics[:4] + np.array(by))
        assert moved.lens == WIDE.lens
    for camera, count in ((IDEAL, 5), (IDEAL, 6), (WIDE, 7)):
        with pytest.raises(ValueError, match=r"Ideal has no coefficients|too many values"):
            camera.perturbed(jnp.ones(count))
