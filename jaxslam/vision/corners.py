"""Corners of a picture, to start landmarks at. Pixels are (u, v), centres at whole numbers."""

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

_CELLS = (8, 6)  # columns and rows of the grid that corners are spread over
_BLOCK = 5  # side of the window that a corner's strength is summed over, in pixels
_QUALITY = 0.01  # weakest corner, as a share of the strongest one's least eigenvalue
_MIN_EIGENVALUE = 2e-5  # weakest corner at all, where the strongest one is only noise


def detect_corners(
    image: UInt8[np.ndarray, "h w"],
    count: int,
    *,
    occupied: Float[np.ndarray, "k 2"],
    min_distance: float,
    border: int,
) -> Float32[np.ndarray, "n 2"]:
    """Up to `count` new Shi-Tomasi corners (n, 2), sub-pixel, spread over the image.

    Each one is the strongest of the cell of a grid that holds fewest points so far, `occupied`
    ones included. None is within `min_distance` pixels of another one or of an occupied point,
    or within `border` pixels of the image's edge.
    """
    occupied = np.asarray(occupied, dtype=np.float32).reshape(-1, 2)
    candidates = _corner_candidates(image, border)
    if count <= 0 or not len(candidates):
        return np.empty((0, 2), np.float32)
    free = np.ones(len(candidates), bool)
    for point in occupied:
        free &= _farther(candidates, point, min_distance)
    scale = np.array(_CELLS) / image.shape[::-1]
    cell = _cell(candidates, scale)
    held = np.bincount(_cell(occupied, scale), minlength=_CELLS[0] * _CELLS[1])
    chosen = []
    while len(chosen) < count and free.any():
        # The candidates are sorted, so the first of the emptiest cell is its strongest.
        best = int(np.argmin(np.where(free, held[cell], np.iinfo(held.dtype).max)))
        chosen.append(best)
        held[cell[best]] += 1
        free &= _farther(candidates, candidates[best], min_distance)
    return candidates[chosen]


def _corner_candidates(image: UInt8[np.ndarray, "h w"], border: int) -> Float32[np.ndarray, "n 2"]:
    """Sub-pixel corners (n, 2) at least `border` pixels inside, the strongest first."""
    strength = cv2.cornerMinEigenVal(image, _BLOCK)
    peaks = (strength == cv2.dilate(strength, np.ones((5, 5), np.uint8))) & (
        strength > max(_QUALITY * float(strength.max()), _MIN_EIGENVALUE)
    )
    rows, columns = np.nonzero(peaks)
    order = np.argsort(-strength[rows, columns], kind="stable")[:600]
    corners = np.column_stack([columns, rows])[order].astype(np.float32)
    margin = max(border, 1)
    corners = corners[_within(corners, image.shape, margin)]
    if not len(corners):
        return corners
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 15, 0.01)
    refined = cv2.cornerSubPix(image, corners[:, None].copy(), (4, 4), (-1, -1), criteria)[:, 0]
    moved = np.abs(refined - corners).max(axis=1) > _BLOCK // 2 + 1
    refined[moved] = corners[moved]
    return refined[_within(refined, image.shape, margin)]


def _within(points: Float32[np.ndarray, "n 2"], shape: tuple[int, ...], border: int) -> np.ndarray:
    high = np.array(shape[1::-1]) - 1 - border
    return np.all((points >= border) & (points <= high), axis=1)


def _farther(
    points: Float32[np.ndarray, "n 2"], point: Float32[np.ndarray, " 2"], distance: float
) -> np.ndarray:
    return ((points - point) ** 2).sum(axis=1) >= distance**2


def _cell(points: Float32[np.ndarray, "n 2"], scale: Float[np.ndarray, " 2"]) -> np.ndarray:
    """The number of each point's cell; points outside the image count for the nearest cell."""
    column, row = np.clip((points * scale).astype(int), 0, np.array(_CELLS) - 1).T
    return row * _CELLS[0] + column
