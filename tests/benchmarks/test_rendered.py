"""Tests of benchmarks/rendered_videos.py: the truth is that of the pixels."""

import cv2
import numpy as np
import pytest
import rendered_videos as benchmark
from numpy.testing import assert_allclose
from rendered_videos import Body, Paint, render
from scipy.spatial.transform import Rotation

CAMERA = benchmark.CALIBRATION


def pose(*rotation, position=(0.0, 0.0, 0.0)):
    T_wc = np.eye(4)
    T_wc[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T_wc[:3, 3] = position
    return T_wc


def truth(source):
    assert source.reference is not None
    return source.reference


def projected(points, T_wc):
    x, y, z = ((points - T_wc[:3, 3]) @ T_wc[:3, :3]).T
    return np.stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy], 1)


def test_a_box_is_seen_where_its_corners_are_projected():
    yaw, T_wc = 0.7, pose(0.1, -0.15, 0.3, position=(0.2, -0.1, 0.3))
    box = Body((0.1, 0.2, 2.5), (0.3, 0.2, 1e-4), Paint(base=0.0, contrast=0.0), yaw)
    dark = 100 - render([box], T_wc, CAMERA, sky=100.0, samples=3)
    (v, u), mass = np.mgrid[: CAMERA.height, : CAMERA.width], dark.sum()
    found = np.array([(u * dark).sum(), (v * dark).sum()]) / mass
    across = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.asarray(box.centre) + signs[:, :1] * 0.3 * across + signs[:, 1:] * [0, 0.2, 0]
    outline = projected(corners, T_wc).astype(np.float32)
    moments = cv2.moments(outline)
    middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    assert_allclose(found, middle, atol=0.02)
    assert_allclose(mass / 100, moments["m00"], rtol=2e-3)


def test_textures_stay_where_they_are_on_a_wall():
    wall = Body((0, 0, 4), (6, 6, 1), Paint(1, 130.0, 90.0, 110.0))
    first, second = np.eye(4), pose(0.02, 0.05, 0.03, position=(0.25, -0.1, 0.2))
    corners = np.array([[-1, -1, 3], [1, -1, 3], [1, 1, 3], [-1, 1, 3]], float)
    to_second, _ = cv2.findHomography(projected(corners, first), projected(corners, second))
    a, b = (render([wall], T_wc, CAMERA, samples=3) for T_wc in (first, second))
    size = CAMERA.width, CAMERA.height
    warped = cv2.warpPerspective(a, to_second, size, flags=cv2.INTER_CUBIC)
    window = np.s_[60:-60, 80:-80]
    (dx, dy), response = cv2.phaseCorrelate(warped[window], b[window])
    assert response > 0.5
    assert np.hypot(dx, dy) < 0.05


def test_a_sphere_and_a_room_from_inside_hide_what_is_behind():
    bodies = [
        Body((0, 0, 0), (5, 5, 5), Paint(0, 50.0, 0.0)),
        Body((0, 0, 3), (0.5, 0.5, 0.5), Paint(0, 200.0, 0.0), sphere=True),
        Body((0, 0, 4), (0.2, 0.2, 0.2), Paint(0, 120.0, 0.0)),
    ]
    picture = render(bodies, np.eye(4), CAMERA)
    assert_allclose([picture[180, 240], picture[180, 20], picture[10, 240]], [200, 50, 50])
    # The cone that touches the sphere has the half angle of which the sine is r by the distance.
    radius = CAMERA.fx * np.tan(np.arcsin(0.5 / 3))
    assert_allclose(np.sum(picture > 75), np.pi * radius**2, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["turn+blur+exposure", "orbit"])
def test_a_video_is_the_same_again_and_from_its_pictures(name, tmp_path):
    """Pictures that are kept under another seed, or drawn by another."""
    source = benchmark.rendered_source(name, 3, 2)
    fresh, written, read = (
        [frame.image for frame in of]
        for of in (source, *2 * (benchmark.rendered_source(name, 3, 2, tmp_path),))
    )
    assert len(list(tmp_path.glob(f"{name}-3/*.png"))) == 2
    assert_allclose(written, fresh)
    assert_allclose(read, fresh)


def test_the_truth_of_a_video_is_that_of_its_pictures():
    source = benchmark.rendered_source("boxes", 0, 1)
    bodies = benchmark.KINDS["boxes"].scene(np.random.default_rng([0, 0]))
    difference = next(iter(source)).image - render(bodies, truth(source).T_wc[0], CAMERA, 110.0)
    assert 1.9 < difference.std() < 2.15  # the sensor's and of the rounding


def test_cameras_move_as_their_kinds_say():
    for kind, most in {"turn": 61, "spin": 31, "street": 42, "orbit": 19, "look-round": 92}.items():
        source = benchmark.rendered_source(kind, 1)
        times, T_wc = truth(source)
        step = Rotation.from_matrix(T_wc[:-1, :3, :3]).inv() * Rotation.from_matrix(
            T_wc[1:, :3, :3]
        )
        rate = np.degrees(step.magnitude()) / np.diff(times)
        assert most - 5 < rate.max() < most


def test_unknown_kinds_and_modifiers_are_refused():
    with pytest.raises(ValueError, match=r"boxes, orbit, .* are accepted"):
        benchmark.rendered_source("orbit+fog", 0)
