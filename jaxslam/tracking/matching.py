"""Active search: where in a picture the patches are, each within the ellipse of its prediction.

Positions are pixels (u, v) = (column, row), with pixel centres at whole numbers.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxslam.tracking.observations import Slots, joined, only
from jaxslam.tracking.patches import Picture, Window
from jaxslam.tracking.pose_with_covariance import Pixels, Places

Windows = Float32[np.ndarray, "n window window"]
"""Pictures of n landmarks as they should look now."""
Grey = Float32[np.ndarray, "h w"]
"""A picture in which windows are compared."""


GATE = 9.21
"""The 99 % quantile of χ² with two degrees of freedom."""
THRESHOLD = 0.8
"""Least correlation of a match."""
AMBIGUITY = 0.05
"""By how much more than a second place of a narrow ellipse a match correlates at least."""
_MAP_SIGMA = 0.2  # of a map's elements: a patch does not face its first camera
_PRECISION = 2.4e-4 / _MAP_SIGMA**2  # by s² of ρ = .98
_MOST_MAPPED = 0.5  # by which elements of a map differ from the identity's
_MAX_SHIFT = 1.5  # pixels: a refinement that moves further than this has left its peak
_NARROW = 91**2  # pixels: boxes of more are searched in the picture of half the size first
_NEARBY = 3  # pixels around such a peak
PEAKS = 3
"""The most places in a wide ellipse that may be a patch's."""
_APART = 2  # pixels: nearer peaks are one place


class Matches(NamedTuple):
    """m places that look like patches, in order of these, and the best first."""

    owner: Int[np.ndarray, " m"]
    """Which patch each looks like."""
    pixels: Float[np.ndarray, "m 2"]
    """(u, v), sub-pixel."""
    scores: Float32[np.ndarray, " m"]
    """Correlations, up to 1."""
    variances: Float[np.ndarray, " m"]
    """The variance of each pixel's u and v, pixels², as the difference of the two windows tells
    (`refine`)."""

    def first_of_each(
        self, count: int
    ) -> tuple[Float[np.ndarray, "count 2"], Float[np.ndarray, " count"]]:
        """The first pixel of each of so many patches, and its variance; NaN and zero of those that
        have none."""
        first, variances = np.full((count, 2), np.nan), np.zeros(count)
        first[self.owner[::-1]] = self.pixels[::-1]
        variances[self.owner[::-1]] = self.variances[::-1]
        return first, variances


def match_patches(
    image: Picture,
    templates: Windows,
    centres: Places,
    covariances: Float[np.ndarray, "n 2 2"],
    *,
    several: bool = True,
) -> Matches:
    """Active search: the places most like each template within the ellipse of its prediction.

    The ellipse is (x - centre)' covariance^-1 (x - centre) <= `GATE` (a quantile of chi2 with two
    degrees of freedom), cut at a quarter of the image's width from the centre along each axis.
    Peaks of the zero-mean normalised cross-correlation in it are refined to sub-pixel accuracy. In
    a narrow ellipse that is the best peak; none where it does not reach `THRESHOLD`, or where a
    second one comes within `AMBIGUITY` of its score. A wide ellipse is searched in the image of
    half the size, and around the highest peaks there again in the whole one. As the best of many
    peaks often is another place, `several` are given, up to `PEAKS`, best first, for who knows what
    else was found to choose from. None where the ellipse is outside the image.
    """
    if not len(templates):
        return Matches(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros(0))
    whole, half = image.astype(np.float32), templates.shape[1] // 2
    ellipses = _Ellipses.of(centres, covariances)
    boxes = _boxes_around(ellipses, half, image.shape)
    least = THRESHOLD - AMBIGUITY
    wide = boxes.owner[boxes.large()]
    boxes = _narrowed(image, templates, ellipses, boxes, least)
    peaks = _peaks(whole, templates, boxes, least)
    peaks = only(peaks, ellipses.hold(peaks.owner, peaks.pixels))
    peaks = only(peaks, np.lexsort((-peaks.scores, peaks.owner)))
    in_wide = several & np.isin(peaks.owner, wide)
    both = _alone(only(peaks, ~in_wide)), _several(only(peaks, in_wide))
    chosen = joined(both)
    chosen = only(chosen, np.argsort(chosen.owner, kind="stable"))
    pixels = chosen.pixels + _quadratic_peaks(chosen.around)
    variances = np.zeros(len(pixels))
    if len(pixels):
        pixels, variances = refine(whole, templates[chosen.owner], pixels)
    return Matches(chosen.owner, pixels, chosen.scores, variances)


def refine(
    image: Grey, templates: Windows, pixels: Places
) -> tuple[Places, Float[np.ndarray, " n"]]:
    """The places near `pixels` to which affine maps fit templates best, by Gauss-Newton, and the
    variance of each pixel's u and v, pixels².

    Minimises the squared difference of the two windows, each made zero-mean with unit norm (so
    gain and offset do not matter), with a prior on the map: the identity, with a σ of `_MAP_SIGMA`.
    It is inverse compositional (Baker & Matthews 2004), so the gradient J is the template's. One
    that does not converge stays where it is. A patch that was warped as if it faced its first
    camera is nevertheless found where it is.

    Of windows of m pixels with a correlation ρ, the residual has the variance `s² = 2 (1 − ρ)/m` a
    pixel and least squares the covariance `s² (Jᵀ J + Λ)⁻¹`, whatever the map; half the trace of
    the place's is returned. What is left of a patch with two depths is not white: its errors are
    larger (`settings.FIT`).
    """
    known = _Templates.of(templates)
    places, maps, identity = pixels, np.tile(np.eye(2), (len(pixels), 1, 1)), np.eye(2)
    for _ in range(3):
        windows, _ = known.compared(image, places, maps)
        slope = np.einsum("nkm,nm->nk", known.jacobian, windows)
        slope[:, 2:] += _PRECISION * (maps - identity).reshape(-1, 4)
        step = np.einsum("nkl,nl->nk", known.inverse, slope)
        maps = maps @ np.linalg.inv(identity + step[:, 2:].reshape(-1, 2, 2))
        maps = np.clip(maps, identity - _MOST_MAPPED, identity + _MOST_MAPPED)
        places = places - np.einsum("nij,nj->ni", maps, step[:, :2])
        places = np.clip(places, pixels - 2 * _MAX_SHIFT, pixels + 2 * _MAX_SHIFT)
    gone = np.abs(places - pixels).max(axis=1) > _MAX_SHIFT
    places = np.where(gone[:, None], pixels, places)
    maps = np.where(gone[:, None, None], identity, maps)
    windows, likeness = known.compared(image, places, maps)
    s2 = 2 * np.maximum(1 - likeness, 0.0) / windows.shape[1]
    return places, s2 * np.trace(known.inverse[:, :2, :2], axis1=1, axis2=2) / 2


class _Templates(NamedTuple):
    """The insides of n templates, as windows of m pixels with unit norm and mean zero."""

    inside: Float32[np.ndarray, "n m"]
    jacobian: Float32[np.ndarray, "n 6 m"]
    """How they change with a shift, (u, v), and a map, row by row. Orthogonal to constants and to
    the inside, so that it sees a residual without its mean and gain."""
    inverse: Float[np.ndarray, "n 6 6"]
    """Of the square of it with the prior. Zero of a template without texture in two directions."""

    @classmethod
    def of(cls, templates: Windows) -> "_Templates":
        n, side = len(templates), templates.shape[1] - 2
        inside = templates[:, 1:-1, 1:-1].reshape(n, 1, -1)
        inside = inside - inside.mean(axis=2, keepdims=True)
        norm = np.sqrt(np.sum(inside**2, axis=2, keepdims=True) + 1e-6)
        inside /= norm
        across = templates[:, 1:-1, 2:] - templates[:, 1:-1, :-2]
        down = templates[:, 2:, 1:-1] - templates[:, :-2, 1:-1]
        gradient = np.stack([across, down], axis=1).reshape(n, 2, -1) * (0.5 / norm)
        of_map = gradient[:, :, None] * _offsets(side).astype(np.float32)
        jacobian = np.concatenate([gradient, of_map.reshape(n, 4, -1)], axis=1)
        jacobian -= jacobian.mean(axis=2, keepdims=True)
        jacobian -= (jacobian @ inside.transpose(0, 2, 1)) * inside
        square = (jacobian @ jacobian.transpose(0, 2, 1)).astype(float)
        textured = np.linalg.det(square[:, :2, :2]) > 1e-8
        square += np.diag([1e-9] * 2 + [_PRECISION] * 4)
        return cls(inside[:, 0], jacobian, np.linalg.inv(square) * textured[:, None, None])

    def compared(
        self, image: Grey, pixels: Places, maps: Float[np.ndarray, "n 2 2"]
    ) -> tuple[Float32[np.ndarray, "n m"], Float32[np.ndarray, " n"]]:
        """Return the picture's windows at these places, and their correlations ρ."""
        windows = _windows(image, pixels, maps, math.isqrt(self.inside.shape[1]))
        windows -= windows.mean(axis=1, keepdims=True)
        windows /= np.sqrt(np.einsum("ni,ni->n", windows, windows) + 1e-6)[:, None]
        return windows, np.einsum("ni,ni->n", windows, self.inside)


def _windows(
    image: Grey, pixels: Places, maps: Float[np.ndarray, "n 2 2"], side: int
) -> Float32[np.ndarray, "n m"]:
    """The squares of `side` pixels, mapped, around sub-pixel places, row by row (m = side²)."""
    u, v = (pixels.T[:, :, None] + np.moveaxis(maps @ _offsets(side), 1, 0)).astype(np.float32)
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _offsets(side: int) -> Int[np.ndarray, "2 m"]:
    """Of the pixels of a window from its middle."""
    line = np.arange(side) - side // 2
    return np.stack([np.tile(line, side), np.repeat(line, side)])


class _Ellipses(NamedTuple):
    """n ellipses (x - centre)' covariance^-1 (x - centre) <= GATE; NaN for one that is none."""

    centres: Places
    uu: Float[np.ndarray, " n"]
    uv: Float[np.ndarray, " n"]
    vv: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, centres: Places, covariances: Float[np.ndarray, "n 2 2"]) -> "_Ellipses":
        # Half a pixel's diagonal wider, else a tiny ellipse could hold no whole pixel.
        uu, vv = covariances[:, 0, 0] + 0.5 / GATE, covariances[:, 1, 1] + 0.5 / GATE
        uv = covariances[:, 0, 1]
        some = (uu > 0) & (vv > 0) & (uu * vv > uv * uv)
        centres = np.where((some & np.isfinite(centres).all(axis=1))[:, None], centres, np.nan)
        return cls(centres, uu, uv, vv)

    def reach(self) -> Places:
        """Return how far each goes from its centre along u and v, pixels."""
        return np.sqrt(GATE * np.maximum(np.stack([self.uu, self.vv], axis=1), 0.0))

    def hold(
        self, which: Int[np.ndarray, " m"], pixels: Int[np.ndarray, "m 2"]
    ) -> Bool[np.ndarray, " m"]:
        """Return whether each pixel lies within the ellipse that `which` says."""
        x, y = (pixels - self.centres[which]).T
        uu, uv, vv = self.uu[which], self.uv[which], self.vv[which]
        return (vv * x - 2 * uv * y) * x + uu * y * y <= GATE * (uu * vv - uv * uv)


class _Boxes(NamedTuple):
    """m rectangles of whole pixels, from `low` to `high` inclusive, for patches `owner`."""

    owner: Int[np.ndarray, " m"]
    low: Int[np.ndarray, "m 2"]
    high: Int[np.ndarray, "m 2"]

    @property
    def sizes(self) -> Int[np.ndarray, "m 2"]:
        """Columns and rows."""
        return self.high - self.low + 1

    def large(self) -> Bool[np.ndarray, " m"]:
        """The patches that are first searched in the picture of half the size."""
        return self.sizes.prod(axis=1) > _NARROW

    def large_enough(self) -> "_Boxes":
        """Return those of three pixels each way: a peak needs a neighbour on either side."""
        return only(self, np.all(self.sizes >= 3, axis=1))


def _boxes_around(ellipses: _Ellipses, half: int, shape: tuple[int, ...]) -> _Boxes:
    """Return what to score for each ellipse: all of it, and one pixel more all around to tell a
    peak on the rim by; as far as windows of `half` pixels to each side are within the picture."""
    some = np.flatnonzero(np.isfinite(ellipses.centres + ellipses.reach()).all(axis=1))
    middle, reach = ellipses.centres[some], np.minimum(ellipses.reach()[some], 0.25 * shape[1])
    last = np.array(shape[::-1]) - 1 - half
    # Clipped as numbers, which have no greatest one, before they are whole.
    low = np.clip(np.floor(middle - reach) - 1, half, last + 1).astype(int)
    high = np.clip(np.ceil(middle + reach) + 1, half - 1, last).astype(int)
    return _Boxes(some, low, high).large_enough()


class _Peaks(NamedTuple):
    """k local maxima of the score of patches `owner`, each with its neighbourhood of 3x3."""

    owner: Slots
    pixels: Int[np.ndarray, "k 2"]
    scores: Float32[np.ndarray, " k"]
    around: Float32[np.ndarray, "k 9"]


def _peaks(image: Grey, templates: Windows, boxes: _Boxes, least: float) -> _Peaks:
    """The local maxima within each box, its rim excluded, that reach `least`."""
    (width, _), half = boxes.sizes.max(axis=0, initial=3), templates.shape[1] // 2
    tops = np.concatenate([[0], np.cumsum(boxes.sizes[:, 1])])
    # One below another, so that peaks are looked for in all of them at once.
    sheet = np.full((tops[-1], width), -1, np.float32)
    for owner, (u, v), (end_u, end_v), top in zip(*boxes, tops[:-1], strict=True):
        region = image[v - half : end_v + half + 1, u - half : end_u + half + 1]
        scores = cv2.matchTemplate(region, templates[owner], cv2.TM_CCOEFF_NORMED)
        sheet[top : top + scores.shape[0], : scores.shape[1]] = scores
    row, column = np.divmod(np.flatnonzero(sheet >= least), width)
    box = np.searchsorted(tops, row, side="right") - 1
    at = np.stack([column, row - tops[box]], axis=1)
    inner = ((at > 0) & (at < boxes.sizes[box] - 1)).all(axis=1)
    row, column, box, at = row[inner], column[inner], box[inner], at[inner]
    around = sheet[row[:, None] + _DOWN, column[:, None] + _RIGHT]
    found = _Peaks(boxes.owner[box], boxes.low[box] + at, around[:, 4], around)
    return only(found, found.scores == around.max(axis=1))


def _alone(peaks: _Peaks) -> _Peaks:
    """The best peak of each patch, of those that have one which is high enough and alone; of peaks
    in order of patches, best first."""
    _, first, of = np.unique(peaks.owner, return_index=True, return_inverse=True)
    best = only(peaks, first)
    apart = (np.abs(peaks.pixels - best.pixels[of]) > _APART).any(axis=1)
    rivals = peaks.owner[apart & (peaks.scores > best.scores[of] - AMBIGUITY)]
    return only(best, (best.scores >= THRESHOLD) & ~np.isin(best.owner, rivals))


def _several(peaks: _Peaks) -> _Peaks:
    """Return up to `PEAKS` peaks of each patch, apart from one another; of peaks in the same
    order."""
    kept: list[int] = []
    for i, (owner, pixel, score) in enumerate(zip(*peaks[:3], strict=True)):
        better = [j for j in kept[-PEAKS:] if peaks.owner[j] == owner]
        # … with scores so far below the best one's
        if not better or (
            len(better) < PEAKS
            and score >= peaks.scores[better[0]] - 0.12
            and np.abs(peaks.pixels[better] - pixel).max(axis=1).min() > _APART
        ):
            kept.append(i)
    return only(peaks, np.array(kept, int))


def _narrowed(
    image: Picture, templates: Windows, ellipses: _Ellipses, boxes: _Boxes, least: float
) -> _Boxes:
    """The boxes, in place of each large one those around its peaks in the picture's half."""
    large = boxes.large()
    if not large.any():
        return boxes
    halved = _Halved.of(image, (templates.shape[1] + 1) // 2)
    # Of score: what a match loses at half the size, where pixels fall otherwise
    small = [
        halved.places(templates[box.owner[0]], box, ellipses, least - 0.1)
        for box in (only(boxes, index) for index in np.flatnonzero(large)[:, None])
    ]
    return joined([only(boxes, ~large), *small])


class _Halved(NamedTuple):
    """A picture of half the size, in which windows of `side` pixels are compared."""

    image: Float32[np.ndarray, "r c"]
    spread: Float32[np.ndarray, "r c"]
    """The norm of each window without its mean."""
    side: int

    @classmethod
    def of(cls, image: Picture, side: int) -> "_Halved":
        half, size = cv2.pyrDown(image).astype(np.float32), (side, side)
        squares = cv2.sqrBoxFilter(half, cv2.CV_32F, size) - cv2.boxFilter(half, -1, size) ** 2
        # One grey level at the least, so that a bare wall is like nothing.
        return cls(half, side * np.sqrt(np.maximum(squares, 1.0)), side)

    def places(self, template: Window, box: _Boxes, ellipses: _Ellipses, least: float) -> _Boxes:
        """Boxes of the whole picture around the highest peaks within one box and its ellipse."""
        # The window at x covers the whole picture's pixels about 2 x + offset.
        offset = template.shape[0] // 2 - 2 * (self.side // 2)
        first, last = -((offset - box.low[0]) // 2), (box.high[0] - offset) // 2
        scores = self._scores(template, first, last)
        highest = cv2.dilate(scores, np.ones((3, 3), np.uint8))
        places = np.flatnonzero((scores == highest) & (scores >= least))
        row, column = np.divmod(places, scores.shape[1])
        pixels = 2 * (np.stack([column, row], axis=1) + first) + offset
        owner, around = np.full(len(pixels), box.owner[0]), 2 * np.stack([_RIGHT, _DOWN], axis=1)
        near = (pixels[:, None] + around).reshape(-1, 2)
        inside = ellipses.hold(np.repeat(owner, 9), near).reshape(-1, 9).any(axis=1)
        height = np.where(inside, scores.ravel()[places], -1)
        # Peaks of half the size that are looked at in full, for each patch
        best = np.argsort(-height)[:6]
        # Of score: peaks so far below the highest are not
        best = best[height[best] >= np.maximum(height[best[:1]] - 0.25, least)]
        low = np.maximum(pixels[best] - _NEARBY - 1, box.low)
        high = np.minimum(pixels[best] + _NEARBY + 1, box.high)
        return _Boxes(owner[best], low, high).large_enough()

    def _scores(
        self, template: Window, first: Int[np.ndarray, " 2"], last: Int[np.ndarray, " 2"]
    ) -> Float32[np.ndarray, "r c"]:
        """Normalised cross-correlations of the windows at the pixels from `first` to `last`."""
        before, after = self.side // 2, (self.side - 1) // 2
        (left, top), (right, bottom) = first, last + 1
        region = self.image[top - before : bottom + after, left - before : right + after]
        kernel = cv2.pyrDown(template)
        kernel -= kernel.mean()
        scores = cv2.filter2D(region, -1, kernel / (np.sqrt(np.sum(kernel**2)) + 1e-6))
        scores = scores[before : scores.shape[0] - after, before : scores.shape[1] - after]
        return scores / self.spread[top:bottom, left:right]


_RIGHT = np.tile([-1, 0, 1], 3)
_DOWN = np.repeat([-1, 0, 1], 3)
# Least squares of 1, x, y, x^2, xy, y^2 on a 3x3 neighbourhood.
_QUADRATIC = np.linalg.pinv(
    np.stack([np.ones(9), _RIGHT, _DOWN, _RIGHT**2, _RIGHT * _DOWN, _DOWN**2], axis=1)
)


def _quadratic_peaks(around: Float32[np.ndarray, "k 9"]) -> Pixels:
    """Return where paraboloids fitted to 3x3 scores peak, from the middle one, within one pixel."""
    _, bx, by, cxx, cxy, cyy = _QUADRATIC @ around.T
    determinant = 4 * cxx * cyy - cxy**2
    shift = np.stack([cxy * by - 2 * cyy * bx, cxy * bx - 2 * cxx * by], axis=1)
    shift /= np.where((cxx < 0) & (determinant > 0), determinant, np.inf)[:, None]
    return np.clip(shift, -1.0, 1.0)
