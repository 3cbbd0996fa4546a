"""Rays, pixels and slopes of any lens, and what the tracker makes of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")

import cv2

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.epipolar import of_one_motion
from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.observations import Prediction
from jaxslam.tracking.optics import LEAST, on_pinhole, rays, sighted
from jaxslam.tracking.patches import Patch
from jaxslam.tracking.pointcloud import seen_from
from jaxslam.tracking.search import changes_of_view

FISHEYE = Calibration(
    512, 512, 163.0, 163.0, 255.5, 255.5, (0.0035, 0.0007, -0.002, 0.0002), model="fisheye"
)
WIDE = Calibration(640, 480, 400.0, 401.0, 319.5, 239.5, (-0.28, 0.09, 1e-3, -2e-3))
RATIONAL = Calibration(
    640, 480, 300.0, 300.0, 319.5, 239.5, (1.2, 0.1, 0, 0, 0.004, 1.5, 0.35, 0.02), model="rational"
)

each_lens = pytest.mark.parametrize("lens", [FISHEYE, WIDE, RATIONAL], ids=lambda x: x.model)


def pixels_of(lens, count=40, seed=0):
    draw = np.random.default_rng(seed)
    return draw.uniform([20, 20], [lens.width - 20, lens.height - 20], (count, 2))


def moved(points):
    """The points in a camera that turned by .1 rad and moved."""
    R = Rotation.from_rotvec([0.03, 0.1, -0.02]).as_matrix()
    return (points - [0.3, 0.05, 0.2]) @ R, R


@each_lens
@pytest.mark.parametrize("count", [0, 1, LEAST, LEAST + 3])
def test_rays_of_pixels_are_seen_there_in_any_number(lens, count):
    pixels = pixels_of(lens, count)
    seen = sighted(lens, 3 * rays(lens, pixels))
    np.testing.assert_allclose(seen.pixels, pixels, rtol=0, atol=1e-6)
    assert seen.seen.all()
    assert seen.slopes.shape == (count, 3, 3)


@each_lens
def test_a_pinhole_picture_is_what_opencv_distorts(lens):
    pixels = pixels_of(lens)
    flat, within = on_pinhole(lens, pixels)
    X = np.column_stack([flat, np.ones(len(flat))]) @ np.linalg.inv(lens.matrix).T
    project = cv2.fisheye.projectPoints if lens is FISHEYE else cv2.projectPoints
    numbers, still = np.array(lens.distortion), np.zeros(3)
    theirs = project(X[within, None], still, still, lens.matrix, numbers)[0][:, 0]
    np.testing.assert_allclose(theirs, pixels[within], rtol=0, atol=1e-6)
    assert 0.3 < within.mean() < (0.9 if lens is FISHEYE else 1.1)


@each_lens
def test_matches_of_one_motion_agree_by_any_lens(lens):
    """The same every time; of five matches or fewer nothing is said."""
    draw = np.random.default_rng(1)
    before = pixels_of(lens, 60)
    X, _ = moved(rays(lens, before) * draw.uniform(1, 9, (60, 1)))
    now = sighted(lens, X).pixels + draw.normal(0, 0.2, (60, 2))
    now[::4] += draw.choice([-1, 1], (15, 2)) * draw.uniform(5, 12, (15, 2))
    agree = of_one_motion(before, now, lens, 0.45)
    near = on_pinhole(lens, before)[1] & on_pinhole(lens, now)[1]
    right = np.arange(60) % 4 > 0
    assert agree[right & near].mean() > 0.85
    assert agree[~right].mean() < 0.25
    assert not agree[~near].any()
    np.testing.assert_array_equal(of_one_motion(before, now, lens, 0.45), agree)
    for count in (0, 3, 5):
        assert not of_one_motion(before[:count], now[:count], lens, 0.45).any()


@each_lens
def test_a_patch_changes_as_the_pixels_around_it_do(lens):
    """Of a surface that faces the first camera: a plane z of a pinhole, a sphere of a fisheye."""
    first = pixels_of(lens, 25)
    depth = np.random.default_rng(3).uniform(2, 9, (25, 1))

    def now(offset):
        return sighted(lens, moved(rays(lens, first + offset) * depth)[0]).pixels

    steps = [(now(h) - now(-h)) / 0.02 for h in np.eye(2) / 100]
    X, R = moved(rays(lens, first) * depth)
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = R, [0.3, 0.05, 0.2]
    landmarks = {
        i: Landmark(i, Patch.take(np.zeros((64, 64), np.uint8), p), np.eye(4), p)
        for i, p in enumerate(first)
    }
    prediction = Prediction(
        now(0.0), np.zeros((25, 2, 2)), np.ones(25, bool), T_wc, X / depth, 1 / depth[:, 0]
    )
    affine = changes_of_view(landmarks, prediction, np.arange(25), lens)
    np.testing.assert_allclose(affine, np.stack(steps, 2), rtol=0, atol=1e-4)


# --- the map laid over a picture ------------------------------------------------------------------

LENS = Calibration(320, 240, 300.0, 310.0, 160.0, 118.0, (-0.2, 0.05, 1e-3, -2e-3))


def test_the_spread_in_the_picture_is_that_of_drawn_landmarks():
    T_wc, point = np.eye(4), np.array([[0.2, 0.3, 4.0]])
    T_wc[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    T_wc[:3, 3] = [0.3, -0.1, 0.2]
    A = np.random.default_rng(0).normal(size=(3, 3)) / 100
    drawn = point + np.random.default_rng(1).normal(size=(20000, 3)) @ A.T
    pixels, covariances = seen_from(T_wc, point, (A @ A.T)[None], LENS)
    strided = np.column_stack([drawn, drawn])[:, :3]  # part of a table
    cloud, _ = seen_from(T_wc, strided, np.zeros((20000, 3, 3)), LENS)
    np.testing.assert_allclose(cloud.mean(axis=0), pixels[0], atol=0.05)
    np.testing.assert_allclose(np.cov(cloud.T), covariances[0], rtol=0.05, atol=0.01)


@pytest.mark.parametrize("point", [[0.0, 0.0, -4.0], [9.0, 0.0, 4.0]])
def test_what_is_not_in_the_picture_has_no_pixel(point):
    for others in ([], [[0.0, 0.0, 4.0]]):
        points = np.array([point, *others])
        pixels, spread = seen_from(np.eye(4), points, np.zeros((len(points), 3, 3)), LENS)
        assert np.isnan(pixels[0]).all()
        assert np.isnan(spread[0]).all()
        assert np.isfinite(pixels[1:]).all()


def test_a_fisheye_lays_a_map_over_its_picture_beyond_a_right_angle():
    points = np.array([[1.5, 1.5, -0.3], [0.1, 0.2, 3.0], [0.0, 0.01, -3.0]])
    pixels, spread = seen_from(np.eye(4), points, np.tile(np.eye(3) / 1e4, (3, 1, 1)), FISHEYE)
    assert np.hypot(*(pixels[0] - 255.5)) > 163 * np.pi / 2
    assert (np.linalg.eigvalsh(spread[:2]) > 0).all()
    assert np.isnan(pixels[2]).all()
    # A lens without distortion is a pinhole.
    ideal = replace(LENS, distortion=())
    pixels, _ = seen_from(np.eye(4), np.array([[0.5, -0.2, 4.0]]), np.zeros((1, 3, 3)), ideal)
    np.testing.assert_allclose(pixels, [[160 + 300 / 8, 118 - 310 / 20]])
