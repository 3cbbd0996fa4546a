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

from jaxslam.io.logs.log import interpolated

FURTHEST = 0.5
"""The largest offset that is looked for, s."""
BEYOND = 3.0
"""An offset of so many σ is one."""
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


def clock_offset(
    times: Float[np.ndarray, " n"],
    estimates: Float[np.ndarray, "n d d"],
    true_times: Float[np.ndarray, " m"],
    truths: Float[np.ndarray, "m d d"],
) -> Offset | None:
    """The offset by least squares; None where rotations do not determine it.

    Of a grid as fine as the truth the best one, refined by a parabola through its neighbours; σ is
    that of least squares, of residuals that are independent.
    """
    known = ~np.isnan(truths[:, 0, 0])
    true_times, truths = true_times[known], truths[known]
    if len(true_times) < _LEAST or len(times) < _LEAST:
        return None
    step = float(np.median(np.diff(true_times)))
    own = _increments(estimates)

    def cost(late: float) -> tuple[float, int]:
        theirs = _increments(interpolated(true_times, truths, times - late))
        there = ~np.isnan(theirs).any(axis=1)
        if there.sum() < _LEAST:
            return np.inf, 0
        a, b = own[there], theirs[there]
        if a.shape[1] == 3:
            left, _, right = np.linalg.svd(a.T @ b)
            left[:, -1] *= np.sign(np.linalg.det(left @ right))
            b = b @ (left @ right).T
        return float(np.mean(np.sum((a - b) ** 2, axis=1))), a.size

    grid = np.arange(-FURTHEST, FURTHEST + step / 2, max(step, 2e-3))
    costs = np.array([cost(late)[0] for late in grid])
    if not np.isfinite(costs).any():
        return None
    best = float(grid[int(np.argmin(costs))])
    if abs(best) >= FURTHEST - 2 * step:
        return None
    width = max(step, 2e-3)
    for _ in range(6):
        (low, _), (middle, count), (high, _) = (cost(best + x) for x in (-width, 0.0, width))
        curvature = low - 2 * middle + high
        if not np.isfinite(curvature) or curvature <= 0:
            return None
        best += float(np.clip((low - high) / (2 * curvature), -1, 1)) * width
        width /= 2
    # Sum of squares S(δ) = S₀ + ½ S'' δ², each residual of variance S₀/count.
    dims = own.shape[1]
    variance = middle / dims
    second = curvature / (2 * width) ** 2 * count / dims
    return Offset(best, float(np.sqrt(2 * variance / second)))


def _increments(T: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "k r"]:
    """The rotation vectors from each pose to the next; NaN where one of both is."""
    from scipy.spatial.transform import Rotation  # slow to import

    n = T.shape[-1] - 1
    turn = np.swapaxes(T[:-1, :n, :n], 1, 2) @ T[1:, :n, :n]
    if n == 2:
        return np.arctan2(turn[:, 1, 0], turn[:, 0, 0])[:, None]
    there = ~np.isnan(turn).any(axis=(1, 2))
    result = np.full((len(turn), 3), np.nan)
    result[there] = Rotation.from_matrix(turn[there]).as_rotvec()
    return result
