"""Corners, against positions known exactly."""

import cv2
import numpy as np
import pytest

from jaxslam.tracking.corners import bare_corners, detect_corners
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source

NOWHERE = np.empty((0, 2))


@pytest.fixture(scope="module")
def frame():
    return next(iter(synthetic_source(1, seed=3))).image


def test_corners_keep_their_distances_and_cover_the_image(frame):
    occupied = np.array([[100.0, 100.0], [500.0, 300.0]])
    corners = detect_corners(frame, 48, occupied=occupied, min_distance=15, border=20)
    assert len(corners) == 48
    points = np.concatenate([corners, occupied])
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert distances[np.triu_indices(len(points), 1)].min() >= 15
    assert np.all((corners >= 20) & (corners <= np.array([639, 479]) - 20))
    quarters = np.bincount((corners[:, 0] > 320) * 2 + (corners[:, 1] > 240), minlength=4)
    assert quarters.min() >= 8


def test_new_corners_go_where_there_are_none(frame):
    left = np.stack(np.meshgrid(np.arange(40, 320, 40), np.arange(40, 480, 40)), -1)
    corners = detect_corners(
        frame, 10, occupied=left.reshape(-1, 2).astype(float), min_distance=10, border=20
    )
    assert len(corners) == 10
    assert np.all(corners[:, 0] > 300)


@pytest.mark.parametrize(
    ("seen", "corners"), [(None, 20), (0, 5), (15, 5), (17, 3), (20, 0), (24, 0)]
)
def test_a_map_is_filled_up_by_a_few_corners_a_frame_to_as_many_as_are_wanted(frame, seen, corners):
    settings = TrackerSettings(wanted=20, new_per_frame=5)
    occupied = None if seen is None else np.full((seen, 2), 100.0)
    assert len(bare_corners(frame, settings, occupied)) == corners


def test_corner_of_a_square_is_found_with_its_fraction():
    big = np.full((8 * 80, 8 * 80), 60, np.uint8)
    big[8 * 30 + 3 :, 8 * 40 + 6 :] = 200
    image = cv2.resize(big, (80, 80), interpolation=cv2.INTER_AREA)
    corners = detect_corners(image, 5, occupied=NOWHERE, min_distance=10, border=10)
    assert len(corners) == 1
    # The edge lies between pixels: position 8 k + j of the large image is k + (j - 3.5) / 8.
    np.testing.assert_allclose(corners[0], [40 + 2 / 8, 30 - 1 / 8], atol=0.25)


def test_flat_and_full_images_give_no_corners(frame):
    flat = np.full((100, 100), 90, np.uint8)
    assert detect_corners(flat, 5, occupied=NOWHERE, min_distance=5, border=5).shape == (0, 2)
    assert len(detect_corners(frame, 0, occupied=NOWHERE, min_distance=5, border=5)) == 0
    grid = np.stack(np.meshgrid(np.arange(0.0, 640, 8), np.arange(0.0, 480, 8)), -1).reshape(-1, 2)
    assert len(detect_corners(frame, 9, occupied=grid, min_distance=20, border=5)) == 0
