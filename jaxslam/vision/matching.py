"""Active search: where in a picture the patches are, each within the ellipse of its prediction.

Positions are pixels (u, v) = (column, row), with pixel centres at whole numbers.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

_ITERATIONS = 3
_MAX_SHIFT = 1.5  # pixels: a refinement that moves further than this has left its peak


@dataclass(frozen=True)
class Match:
    """Where a patch was found: pixel (u, v), sub-pixel, and its correlation score up to 1."""

    pixel: Float[np.ndarray, " 2"]
    score: float


def match_patch(
    image: UInt8[np.ndarray, "h w"],
    template: Float32[np.ndarray, "window window"],
    centre: Float[np.ndarray, " 2"],
    covariance: Float[np.ndarray, "2 2"],
    *,
    gate: float = 9.21,
    threshold: float = 0.8,
    max_radius: float = 40.0,
    ambiguity: float = 0.05,
) -> Match | None:
    """Active search: the place most like `template` within the ellipse of the prediction.

    Looks where (x - centre)' covariance^-1 (x - centre) <= `gate` (a quantile of chi2 with two
    degrees of freedom), at most `max_radius` pixels from the centre along each axis, for the
    best zero-mean normalised cross-correlation, then refines it to sub-pixel. None where no
    peak reaches `threshold`, or where a second peak comes within `ambiguity` of the best
    one's score (0: never ambiguous), or where the ellipse is outside the image.
    """
    return match_patches(
        image,
        template[None],
        np.asarray(centre, dtype=float)[None],
        np.asarray(covariance, dtype=float)[None],
        gate=gate,
        threshold=threshold,
        max_radius=max_radius,
        ambiguity=ambiguity,
    )[0]


def match_patches(
    image: UInt8[np.ndarray, "h w"],
    templates: Float32[np.ndarray, "n window window"],
    centres: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    *,
    gate: float = 9.21,
    threshold: float = 0.8,
    max_radius: float = 40.0,
    ambiguity: float = 0.05,
) -> list[Match | None]:
    """`match_patch` for n patches; faster than one by one, as all are refined together."""
    found: dict[int, tuple[Float[np.ndarray, " 2"], float]] = {}
    for index, (template, centre, covariance) in enumerate(
        zip(templates, centres, covariances, strict=True)
    ):
        area = _search(image, template, centre, covariance, gate, max_radius)
        peak = None if area is None else _best_peak(area.scores, area.inside, threshold, ambiguity)
        if area is not None and peak is not None:
            row, column = peak
            around = area.scores[row - 1 : row + 2, column - 1 : column + 2]
            start = np.array([area.left + column, area.top + row]) + _quadratic_peak(around)
            found[index] = start, float(area.scores[row, column])
    matches: list[Match | None] = [None] * len(templates)
    if found:
        starts = np.array([start for start, _ in found.values()])
        refined = refine(image, templates[list(found)], starts)
        for index, pixel in zip(found, refined, strict=True):
            matches[index] = Match(pixel, found[index][1])
    return matches


def refine(
    image: UInt8[np.ndarray, "h w"],
    templates: Float32[np.ndarray, "n window window"],
    pixels: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    """The positions near `pixels` that fit the templates best, by Gauss-Newton.

    Minimises the squared difference of the two windows, each made zero-mean with unit norm (so
    gain and offset do not matter); inverse compositional, so that the gradient is the
    template's. One that does not converge stays where it is.
    """
    steps = _gauss_newton_steps(templates)
    size = (templates.shape[2] - 2, templates.shape[1] - 2)
    positions = pixels
    for _ in range(_ITERATIONS):
        windows = np.stack(
            [
                cv2.getRectSubPix(image, size, (u, v), patchType=cv2.CV_32F).ravel()
                for u, v in positions.tolist()
            ]
        )
        windows -= windows.mean(axis=1, keepdims=True)
        norms = np.sqrt(np.einsum("ni,ni->n", windows, windows) + 1e-6)
        # The steps ignore what of a window is like its template, so there is nothing to subtract.
        shifts = (steps @ windows[:, :, None])[:, :, 0] / norms[:, None]
        positions = np.clip(positions - shifts, pixels - 2 * _MAX_SHIFT, pixels + 2 * _MAX_SHIFT)
    gone = np.abs(positions - pixels).max(axis=1) > _MAX_SHIFT
    return np.where(gone[:, None], pixels, positions)


def _gauss_newton_steps(
    templates: Float32[np.ndarray, "n window window"],
) -> Float32[np.ndarray, "n 2 m"]:
    """What takes each window of unit norm to the shift (2,) it shows against its template.

    The rows are orthogonal to constants and to the template's inside (m values), so they see
    the residual without its mean and gain. Zero for a template without texture in two
    directions.
    """
    inside = templates[:, 1:-1, 1:-1]
    target = inside.reshape(len(templates), 1, -1)
    target = target - target.mean(axis=2, keepdims=True)
    norm = np.sqrt(np.sum(target**2, axis=2, keepdims=True) + 1e-6)
    target /= norm
    across = templates[:, 1:-1, 2:] - templates[:, 1:-1, :-2]
    down = templates[:, 2:, 1:-1] - templates[:, :-2, 1:-1]
    gradient = np.stack([across, down], axis=1).reshape(len(templates), 2, -1) * (0.5 / norm)
    gradient -= gradient.mean(axis=2, keepdims=True)
    gradient -= (gradient @ target.transpose(0, 2, 1)) * target
    hessian = gradient @ gradient.transpose(0, 2, 1)
    flat = np.linalg.det(hessian) < 1e-8
    hessian[flat] = np.eye(2)
    gradient[flat] = 0.0
    return np.linalg.solve(hessian, gradient)


class _Area(NamedTuple):
    """Scores of the whole pixels around an ellipse, and which of them lie inside it."""

    scores: Float32[np.ndarray, "r c"]
    inside: Bool[np.ndarray, "r c"]
    left: int  # the pixel of the first score
    top: int


def _search(
    image: UInt8[np.ndarray, "h w"],
    template: Float32[np.ndarray, "window window"],
    centre: Float[np.ndarray, " 2"],
    covariance: Float[np.ndarray, "2 2"],
    gate: float,
    max_radius: float,
) -> _Area | None:
    """The area to search, with one pixel more all around to tell a peak on the rim by."""
    # Half a pixel's diagonal wider, else a tiny ellipse could hold no whole pixel.
    a, b, d = (float(covariance[i, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    a, d = a + 0.5 / gate, d + 0.5 / gate
    u, v = float(centre[0]), float(centre[1])
    determinant = a * d - b * b
    if not (math.isfinite(u + v + determinant) and a > 0 and determinant > 0):
        return None
    half = template.shape[0] // 2
    left, right = _span(u, min(math.sqrt(gate * a), max_radius), half, image.shape[1])
    top, bottom = _span(v, min(math.sqrt(gate * d), max_radius), half, image.shape[0])
    if right - left < 2 or bottom - top < 2:  # a peak needs a neighbour on either side
        return None
    region = image[top - half : bottom + half + 1, left - half : right + half + 1]
    scores = cv2.matchTemplate(region.astype(np.float32), template, cv2.TM_CCOEFF_NORMED)
    x = np.arange(left - u, right - u + 0.5)
    y = np.arange(top - v, bottom - v + 0.5)[:, None]
    inside = (d * x - (2 * b) * y) * x + (a * y) * y <= gate * determinant
    return _Area(scores, inside, left, top)


def _span(middle: float, reach: float, half: int, length: int) -> tuple[int, int]:
    """First and last pixel to score along one axis: all within reach, and one more."""
    low, high = math.floor(middle - reach) - 1, math.ceil(middle + reach) + 1
    return max(low, half), min(high, length - 1 - half)


def _best_peak(
    scores: Float32[np.ndarray, "r c"],
    inside: Bool[np.ndarray, "r c"],
    threshold: float,
    ambiguity: float,
) -> tuple[int, int] | None:
    """Row and column of the best local maximum inside; None if too low or not alone."""
    # The rim of the array cannot be judged: without a neighbour it may be a mere slope.
    core, highest = scores[1:-1, 1:-1], cv2.dilate(scores, _NEIGHBOURS)[1:-1, 1:-1]
    peaks = inside[1:-1, 1:-1] & (core == highest) & (core >= threshold - ambiguity)
    rows, columns = np.nonzero(peaks)
    if not len(rows):
        return None
    values = core[rows, columns]
    best = int(values.argmax())
    if values[best] < threshold:
        return None
    row, column = int(rows[best]), int(columns[best])
    if ambiguity > 0 and len(rows) > 1:
        apart = (abs(rows - row) > 2) | (abs(columns - column) > 2)
        if (values[apart] > values[best] - ambiguity).any():
            return None
    return row + 1, column + 1


_NEIGHBOURS = np.ones((3, 3), np.uint8)
_OFFSETS = np.array([[x, y] for y in (-1, 0, 1) for x in (-1, 0, 1)], dtype=float)
# Least squares of 1, x, y, x^2, xy, y^2 on a 3x3 neighbourhood.
_QUADRATIC = np.linalg.pinv(
    np.column_stack(
        [np.ones(9), _OFFSETS, _OFFSETS[:, :1] ** 2, _OFFSETS.prod(1), _OFFSETS[:, 1] ** 2]
    )
)


def _quadratic_peak(scores: Float32[np.ndarray, "3 3"]) -> Float[np.ndarray, " 2"]:
    """Where a paraboloid fitted to 3x3 scores peaks, from the middle one, within one pixel."""
    _, bx, by, cxx, cxy, cyy = _QUADRATIC @ scores.ravel()
    determinant = 4 * cxx * cyy - cxy**2
    if cxx >= 0 or determinant <= 0:
        return np.zeros(2)
    shift = np.array([cxy * by - 2 * cyy * bx, cxy * bx - 2 * cxx * by]) / determinant
    return np.clip(shift, -1.0, 1.0)
