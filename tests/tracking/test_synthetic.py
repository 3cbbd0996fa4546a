"""The synthetic video: that pictures show what the exact trajectory says."""

import cv2
import numpy as np
import pytest

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.synthetic import (
    NOISE,
    Quad,
    add_noise,
    handheld_trajectory,
    render,
    room,
    synthetic_source,
)

SMALL = Calibration(160, 120, 131.2, 131.2, 79.5, 59.5)


def chessboard(squares, side, size, distance, yaw):
    """A chessboard of `size` metres before the first camera, turned about the vertical."""
    pattern = np.kron(np.indices((squares, squares)).sum(0) % 2, np.ones((side, side)))
    right = size * np.array([np.cos(yaw), 0.0, np.sin(yaw)])
    down = np.array([0.0, size, 0.0])
    corner = np.array([0.0, 0.0, distance]) - right / 2 - down / 2
    return Quad(corner, right, down, (25 + 200 * pattern).astype(np.uint8))


def project(points, T_wc, calibration):
    rays = (points - T_wc[:3, 3]) @ T_wc[:3, :3] @ calibration.matrix.T
    return rays[:, :2] / rays[:, 2:]


@pytest.mark.parametrize(("distance", "yaw"), [(2.5, 0.6), (4.0, -0.3)])
def test_points_are_rendered_where_the_camera_model_puts_them(distance, yaw):
    calibration = Calibration(640, 480, 525.0, 525.0, 319.5, 239.5)
    board = chessboard(12, 24, 0.48 * distance, distance, yaw)
    inner = np.arange(1, 12) * 24 - 0.5  # between two pixels of the texture
    points = board.point(np.stack(np.meshgrid(inner, inner), -1).reshape(-1, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    for T_wc in handheld_trajectory(np.array([1.0, 2.2, 3.1])):
        expected = project(points, T_wc, calibration)
        # Smoothed, since the corner finder itself is biased by the aliasing of sharp edges.
        image = cv2.GaussianBlur(render([board], T_wc, calibration), (0, 0), 1.0)
        start = expected[:, None].astype(np.float32)
        found = cv2.cornerSubPix(image, start, (6, 6), (-1, -1), criteria)[:, 0]
        assert np.abs((found - expected).mean(axis=0)).max() < 0.02
        assert np.linalg.norm(found - expected, axis=1).max() < 0.1


def test_nearer_quads_hide_farther_ones_and_backs_are_not_drawn():
    white = np.full((50, 50), 255, np.uint8)
    black = np.zeros((50, 50), np.uint8)
    square = np.array([-1.0, -1.0, 3.0]), np.array([2.0, 0, 0]), np.array([0, 2.0, 0])
    near = np.array([-0.5, -0.5, 2.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    quads = [Quad(*square, white), Quad(*near, black)]
    image = render(quads, np.eye(4), SMALL)
    assert image[60, 80] == 0
    assert image[60, 80 + 40] == 255
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 6.0
    assert np.all(render(quads, behind, SMALL) == render([], behind, SMALL))


def test_room_fills_the_view_for_long():
    quads = [
        Quad(quad.corner, quad.right, quad.down, np.full((600, 600), 255, np.uint8))
        for quad in room(0, 131.2)
    ]
    for T_wc in handheld_trajectory(np.arange(0.0, 100.0, 9.3), 4):
        assert render(quads, T_wc, SMALL).min() == 255


def test_a_source_is_reproducible_and_well_exposed():
    first, again = (list(synthetic_source(4, seed=2, width=160, height=120)) for _ in range(2))
    assert len(first) == 4
    for one, other in zip(first, again, strict=True):
        # The same operations on the same numbers, on one machine: exact.
        np.testing.assert_array_equal(one.image, other.image)
    assert first[0].image.shape == (120, 160)
    assert np.mean((first[0].image < 5) | (first[0].image > 250)) < 0.02  # well exposed
    assert np.mean(first[0].image != next(iter(synthetic_source(4, 3, 160, 120))).image) > 0.9


def test_noise_has_its_standard_deviation():
    image = np.full((200, 200), 100, np.uint8)
    noise = add_noise(image, np.random.default_rng(0)).astype(float) - 100
    assert noise.std() == pytest.approx(np.sqrt(NOISE**2 + 1 / 12), rel=0.02)
    assert abs(noise.mean()) < 0.05
