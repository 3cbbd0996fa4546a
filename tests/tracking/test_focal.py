"""A focal length that is 20 % off is noticed, and a right one never called wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")

import cv2

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.focal import CLEAR, FACTOR, better_focal
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked

CAMERA = Calibration(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.3, 0.1, 1e-3, -1e-3, 0.0))


def video(seed=0, turn=0.15, move=1.0, frames=30, points=60):
    """Frames of a camera that moves and turns before points, seen with 0.2 pixels of noise."""
    draw = np.random.default_rng(seed)
    places = draw.uniform([-2, -1.5, 3], [2, 1.5, 9], (points, 3))
    t = np.linspace(0, 1, frames)
    path = move * np.stack([np.sin(2 * t), 0.3 * t, 0.5 * t**2], axis=1)
    turns = Rotation.from_rotvec(turn * np.stack([np.sin(3 * t), -t, 0.3 * t], axis=1))
    history = []
    for index, (centre, R) in enumerate(zip(path, turns.as_matrix(), strict=True)):
        T_wc = np.eye(4)
        T_wc[:3, :3], T_wc[:3, 3] = R, centre
        turned = cv2.Rodrigues(R.T)[0]
        seen, _ = cv2.projectPoints(
            places, turned, -R.T @ centre, CAMERA.matrix, np.array(CAMERA.distortion)
        )
        pixels = seen[:, 0] + draw.normal(0, 0.2, (points, 2))
        history.append(
            Tracked(index, t[index], PoseWithCovariance(T_wc), sights=dict(enumerate(pixels)))
        )
    nothing = np.zeros((points, 3, 3))
    return history, Points(
        np.arange(points), *[np.zeros(points, int)] * 2, places, nothing, nothing
    )


def times(factor):
    return replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)


@pytest.mark.parametrize("off", [FACTOR, 1 / FACTOR])
def test_the_focal_length_that_fits_is_found(off):
    factor, left = better_focal(*video(), times(off))
    assert factor == pytest.approx(1 / off)
    assert left < 0.5 * CLEAR


@pytest.mark.parametrize("seed", range(3))
def test_the_right_one_is_left_alone(seed):
    assert better_focal(*video(seed), CAMERA)[1] > 1


def test_where_nothing_tells_nothing_is_said():
    """Of a camera that does not turn before a few points, and of one picture."""
    history, points = video(turn=0.0, move=0.05)
    assert better_focal(history, points, times(FACTOR))[1] > CLEAR
    assert better_focal(history[:1], points, times(FACTOR))[1] == 1


def test_a_view_that_shares_nothing_is_left_out():
    history, points = video()
    history[-1].sights.clear()
    factor, left = better_focal(history, points, times(FACTOR))
    assert factor == 1 / FACTOR
    assert left < CLEAR


def test_landmarks_at_infinity_and_outliers_do_no_harm():
    history, points = video()
    points.points[:5] = np.inf
    points.points[5:9] = np.nan
    for result in history[::3]:
        result.sights[20] += 50
    factor, left = better_focal(history, points, times(FACTOR))
    assert factor == 1 / FACTOR
    assert left < CLEAR
    assert better_focal(history, points, CAMERA)[1] > 1
