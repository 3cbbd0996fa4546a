"""Corners of a picture, to start landmarks at. Pixels are (u, v), centres at whole numbers."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from jaxslam.tracking.patches import Picture
from jaxslam.tracking.pose_with_covariance import Pixels, Places
from jaxslam.tracking.settings import TrackerSettings

_CELLS = (8, 6)  # columns and rows of the grid that corners are spread over
_BLOCK = 5  # side of the window that a corner's strength is summed over, in pixels


Corners = Float32[np.ndarray, "_ 2"]
"""Pixels (u, v) as OpenCV has them."""


def bare_corners(
    image: Picture, settings: TrackerSettings, occupied: Pixels | None = None
) -> Places:
    """Corners where the picture is bare; for a whole map where nothing says what is `occupied`."""
    s, wanted = settings, settings.wanted
    if occupied is None:
        occupied = np.zeros((0, 2))
    else:
        wanted = min(s.new_per_frame, s.wanted - len(occupied))
    return detect_corners(
        image, wanted, occupied=occupied, min_distance=s.spacing, border=2 * s.border
    ).astype(float)


def detect_corners(
    image: Picture, count: int, *, occupied: Pixels, min_distance: float, border: int
) -> Corners:
    """Return up to `count` new Shi-Tomasi corners (n, 2), sub-pixel, spread over the image.

    Each one is the strongest of the cell of a grid that holds fewest points so far, `occupied`
    ones included. None is within `min_distance` pixels of another one or of an occupied point,
    or within `border` pixels of the image's edge.
    """
    candidates = _candidates(image, max(border, 1)) if count > 0 else np.empty((0, 2), np.float32)
    points = np.asarray(occupied, dtype=np.float32).reshape(-1, 2)
    free = _farther(candidates, points, min_distance)
    scale = np.array(_CELLS) / image.shape[::-1]
    cell = _cell(candidates, scale)
    held = np.bincount(_cell(points, scale), minlength=_CELLS[0] * _CELLS[1])
    chosen = np.empty((0, 2), np.float32)
    while len(chosen) < count and free.any():
        # The candidates are sorted, so the first of the emptiest cell is its strongest.
        best = int(np.argmin(np.where(free, held[cell], np.iinfo(held.dtype).max)))
        free[best] = False
        corner = _refined(image, candidates[best : best + 1], max(border, 1))
        if len(corner) and _farther(corner, np.concatenate([points, chosen]), min_distance).all():
            chosen = np.concatenate([chosen, corner])
            held[cell[best]] += 1
            free &= _farther(candidates, corner, min_distance)
    return chosen


def _candidates(image: Picture, border: int) -> Corners:
    """Whole pixels (n, 2) of corners at least `border` pixels inside, the strongest first."""
    strength = cv2.cornerMinEigenVal(image, _BLOCK)
    peaks = strength == cv2.dilate(strength, np.ones((5, 5), np.uint8))
    # Weakest corner, as a share of the strongest one's least eigenvalue
    # Weakest corner at all, where the strongest one is only noise
    peaks &= strength > max(0.01 * float(strength.max()), 2e-5)
    places = np.flatnonzero(peaks)
    order = np.argsort(-strength.ravel()[places], kind="stable")
    row, column = np.divmod(places[order], image.shape[1])
    corners = np.column_stack([column, row]).astype(np.float32)
    return corners[_within(corners, image.shape, border)]


def _refined(image: Picture, corners: Corners, border: int) -> Corners:
    """The corners sub-pixel, but for those that then are within `border` pixels of the edge."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 15, 0.01)
    refined = cv2.cornerSubPix(image, corners[:, None].copy(), (4, 4), (-1, -1), criteria)[:, 0]
    moved = np.abs(refined - corners).max(axis=1) > _BLOCK // 2 + 1
    refined[moved] = corners[moved]
    return refined[_within(refined, image.shape, border)]


def _within(points: Corners, shape: tuple[int, ...], border: int) -> np.ndarray:
    return np.all((points >= border) & (points <= np.array(shape[1::-1]) - 1 - border), axis=1)


def _farther(points: Corners, others: Corners, distance: float) -> np.ndarray:
    """Return whether each point is as far as that from all others."""
    x, y = (points[:, None, i] - others[:, i] for i in (0, 1))
    return np.all(x * x + y * y >= distance**2, axis=1)


def _cell(points: Corners, scale: Float[np.ndarray, " 2"]) -> np.ndarray:
    """The number of each point's cell; points outside the image count for the nearest cell."""
    column, row = np.clip((points * scale).astype(int), 0, np.array(_CELLS) - 1).T
    return row * _CELLS[0] + column
