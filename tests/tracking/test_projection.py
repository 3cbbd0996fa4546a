"""The map laid over a frame: pixels, their covariances, and the figure of both."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.pointcloud import Cloud, read_ply, seen_from, write_ply

LENS = Calibration(320, 240, 300.0, 310.0, 160.0, 118.0, (-0.2, 0.05, 1e-3, -2e-3))


def camera():
    T_wc = np.eye(4)
    T_wc[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    T_wc[:3, 3] = [0.3, -0.1, 0.2]
    return T_wc


def test_the_spread_in_the_picture_is_that_of_drawn_landmarks():
    T_wc, point = camera(), np.array([[0.2, 0.3, 4.0]])
    A = np.random.default_rng(0).normal(size=(3, 3)) / 100
    drawn = point + np.random.default_rng(1).normal(size=(20000, 3)) @ A.T
    pixels, covariances = seen_from(T_wc, point, (A @ A.T)[None], LENS)
    strided = np.column_stack([drawn, drawn])[:, :3]  # part of a table
    cloud, _ = seen_from(T_wc, strided, np.zeros((20000, 3, 3)), LENS)
    np.testing.assert_allclose(cloud.mean(axis=0), pixels[0], atol=0.05)
    np.testing.assert_allclose(np.cov(cloud.T), covariances[0], rtol=0.05, atol=0.01)


def test_a_lens_without_distortion_is_a_pinhole():
    ideal = Calibration(320, 240, 300.0, 310.0, 160.0, 118.0)
    pixels, _ = seen_from(np.eye(4), np.array([[0.5, -0.2, 4.0]]), np.zeros((1, 3, 3)), ideal)
    np.testing.assert_allclose(pixels, [[160 + 300 / 8, 118 - 310 / 20]])


@pytest.mark.parametrize("point", [[0.0, 0.0, -4.0], [9.0, 0.0, 4.0]])
def test_what_is_not_in_the_picture_has_no_pixel(point):
    for others in ([], [[0.0, 0.0, 4.0]]):
        points = np.array([point, *others])
        pixels, spread = seen_from(np.eye(4), points, np.zeros((len(points), 3, 3)), LENS)
        assert np.isnan(pixels[0]).all()
        assert np.isnan(spread[0]).all()
        assert np.isfinite(pixels[1:]).all()


def test_a_point_cloud_is_read_as_it_was_written(tmp_path):
    A = np.random.default_rng(0).normal(size=(5, 3, 3))
    there = Cloud(A[:, 0], A @ np.swapaxes(A, 1, 2), np.arange(3, 8), np.array([0, 0, 1, 1, 2]))
    write_ply(tmp_path / "map.ply", *there)
    for found, expected in zip(read_ply(tmp_path / "map.ply"), there, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7)
    write_ply(tmp_path / "map.ply", *(part[:0] for part in there))
    assert read_ply(tmp_path / "map.ply").covariances.shape == (0, 3, 3)
