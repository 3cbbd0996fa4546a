"""The offset of two clocks, from the rotations between stamps.

Where the stamps of an estimate are late by δ, its rotation between two of them is the truth's
between both δ earlier, whatever the worlds are and however the bodies are mounted: up to a constant
rotation C between the bodies, `φ̂_k = C φ(t_k − δ, t_{k+1} − δ)`. Rotation increments do not drift,
as positions do, by which an offset would be wrong where the trajectory drifts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.evaluation.alignment import nearest_rotation
from jaxslam.io.logs.log import Log, interpolated, turns

FURTHEST = 0.5
"""The largest offset that is looked for, s."""
BEYOND = 3.0
"""An offset of so many σ is one."""
LEAST_VARIANCE = 0.25
"""The least variance of an offset, of what it were without correlations."""
_LEAST = 20
"""The fewest rotations that determine one."""


class Offset(NamedTuple):
    """By how much the estimate's stamps are late."""

    seconds: float
    sigma: float

    @property
    def found(self) -> bool:
        """Whether it is larger than chance."""
        return abs(self.seconds) > max(BEYOND * self.sigma, 1e-4)


def clock_offset(estimate: Log, truth: Log) -> Offset | None:
    """The offset by least squares; None where rotations do not determine it.

    Of a grid as fine as the truth the best one, refined by a parabola through its neighbours.
    """
    (times, estimates), (true_times, truths) = (
        (x.times[there], x.poses[there])
        for x in (estimate, truth)
        for there in [~np.isnan(x.poses[:, 0, 0])]
    )
    if len(true_times) < _LEAST or len(times) < _LEAST:
        return None
    step = float(np.median(np.diff(true_times)))
    own = increments(estimates)

    def residuals(late: float) -> Float[np.ndarray, "k r"]:
        theirs = increments(interpolated(true_times, truths, times - late))
        there = ~np.isnan(theirs).any(axis=1)
        if there.sum() < _LEAST:
            return np.full_like(own, np.nan)
        if own.shape[1] == 3:
            theirs = theirs @ nearest_rotation(own[there].T @ theirs[there]).T
        return own - theirs

    def cost(late: float) -> float:
        found = np.sum(residuals(late) ** 2, axis=1)
        return float(np.nanmean(found)) if np.isfinite(found).any() else np.inf

    width = max(step, 2e-3)
    grid = np.arange(-FURTHEST, FURTHEST + step / 2, width)
    costs = np.array([cost(late) for late in grid])
    best = float(grid[int(np.argmin(costs))])
    if not np.isfinite(costs).any() or abs(best) >= FURTHEST - 2 * step:
        return None
    for _ in range(6):
        low, middle, high = (cost(best + x) for x in (-width, 0.0, width))
        curvature = low - 2 * middle + high
        if not np.isfinite(curvature) or curvature <= 0:  # flat, within what is rounded
            break
        best += float(np.clip((low - high) / (2 * curvature), -1, 1)) * width
        width /= 2
    return Offset(best, _sigma(*(residuals(best + x) for x in (-step, 0.0, step)), 2 * step))


def _sigma(before: np.ndarray, now: np.ndarray, after: np.ndarray, apart: float) -> float:
    """σ of a least squares, of residuals of which neighbours correlate: the error of an orientation
    is in two increments, with either sign."""
    slope = (after - before) / apart
    score = np.nan_to_num(np.sum(slope * now, axis=1))
    alone = float(score @ score)
    # What few neighbours tell is uncertain itself.
    variance = max(alone + 2 * float(score[1:] @ score[:-1]), LEAST_VARIANCE * alone)
    information = float(np.nansum(slope**2))
    return float(np.sqrt(variance)) / information if information > 0 else np.inf


def increments(T: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "k r"]:
    """The rotation vectors from each pose to the next; NaN where one of both is."""
    vectors = turns(T[:-1], T[1:])
    return vectors if T.shape[-1] == 4 else vectors[:, 2:]
