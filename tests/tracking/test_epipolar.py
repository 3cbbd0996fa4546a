"""Matches of one rigid scene, whatever its depths."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.epipolar import of_one_motion

CAMERA = Calibration(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(-0.2, 0.05))
PLAIN = Calibration(640, 480, 500.0, 500.0, 319.5, 239.5)


def seen(points, camera):
    """Pixels of points in the camera."""
    x, y = (points[:, :2] / points[:, 2:]).T
    k1, k2 = (*camera.distortion, 0.0, 0.0)[:2]
    factor = 1 + k1 * (x * x + y * y) + k2 * (x * x + y * y) ** 2
    return np.stack([500 * factor * x + 319.5, 500 * factor * y + 239.5], axis=1)


def two_views(rng, count, camera):
    """Of a scene of all depths, by a camera that turned by 0.1 rad and moved forward."""
    z = rng.uniform(3, 40, count)
    points = np.stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.4, 0.4, count) * z, z], 1)
    c, s = np.cos(0.1), np.sin(0.1)
    turned = points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T - [0.1, 0.05, 1.0]
    views = seen(points, camera), seen(turned, camera)
    return [view + rng.normal(0, 0.3, view.shape) for view in views]


@pytest.mark.parametrize("camera", [PLAIN, CAMERA])
def test_what_is_elsewhere_is_put_out_and_the_rest_kept(camera):
    rng = np.random.default_rng(0)
    before, now = two_views(rng, 60, camera)
    wrong = np.arange(60) % 3 == 0
    now[wrong] += rng.choice([-1, 1], (20, 2)) * rng.uniform(10, 60, (20, 2))
    rigid = of_one_motion(before, now, camera, 0.45)
    assert rigid[~wrong].mean() > 0.9
    assert rigid[wrong].mean() < 0.2


def test_the_answer_is_the_same_every_time():
    before, now = two_views(np.random.default_rng(1), 40, PLAIN)
    now[:15] = np.random.default_rng(2).uniform(0, 480, (15, 2))
    one, other = (of_one_motion(before, now, PLAIN, 0.45) for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_five_matches_or_fewer_say_nothing():
    before, now = two_views(np.random.default_rng(3), 5, PLAIN)
    for count in (0, 3, 5):
        assert not of_one_motion(before[:count], now[:count], PLAIN, 0.45).any()
