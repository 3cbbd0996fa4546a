"""A lens that is wrong is noticed, and a right one never called so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")

import cv2

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.focal import CLEAR, better_lens
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked

CAMERA = Calibration(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.3, 0.1, 1e-3, -1e-3, 0.0))


def video(seed=0, turn=0.15, move=1.0, frames=16, points=40):
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


def given(factor=1.0, k1=0.0):
    """A calibration that is wrong by so much."""
    distortion = (CAMERA.distortion[0] + k1, *CAMERA.distortion[1:])
    return replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor, distortion=distortion)


@pytest.mark.parametrize(("factor", "k1"), [(1.0, 0.0), (1.0, -0.08), (1.2, 0.08)])
def test_the_lens_that_fits_is_found(factor, k1):
    found = better_lens(*video(turn=0.3), given(factor, k1))
    assert (found.left < 0.6 * CLEAR) == ((factor, k1) != (1.0, 0.0))
    assert (found.left > 0.9) == ((factor, k1) == (1.0, 0.0))
    off = np.array([np.log(found.focal * factor), found.k1 + k1])
    assert (np.abs(off) < 4 * found.sigma).all()
    assert (found.sigma < [0.02, 0.02]).all()


def test_where_nothing_tells_nothing_is_said():
    """Of a camera that does not turn before a few points, and of one picture."""
    history, points = video(turn=0.0, move=0.05)
    assert better_lens(history, points, given(1.2)).left > CLEAR
    assert better_lens(history[:1], points, given(1.2)).left == 1


def test_landmarks_at_infinity_and_outliers_do_no_harm():
    history, points = video(turn=0.3)
    points.points[:5] = np.inf
    points.points[5:9] = np.nan
    for result in history[::3]:
        result.sights[20] += 50
    history[-1].sights.clear()  # a view that shares nothing is left out
    found = better_lens(history, points, given(1.2))
    assert found.focal == pytest.approx(1 / 1.2, rel=0.05)
    assert found.left < CLEAR
