"""What a right mean NEES may hide: tails, a mean error, and correlations that P does not have.

The whitened errors `z = L⁻¹ e` of a right filter, with `P = L Lᵀ`, are independent and standard
normal at every step. Runs are independent, steps are not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Float

from jaxslam.statistics.bands import Mask, PerAxis, PerStep, chi2_quantile
from jaxslam.statistics.one_run import effective_samples

SETS = (0.5, 0.9, 0.99)
"""The probabilities of the sets whose coverage is counted."""
FEW_RUNS = 3
"""Fewer runs do not show how they scatter."""
NOTICEABLE = 0.3
"""The least correlation that fewer runs show: parts of the errors of two axes that never change
along a run, of a share f of the variance, correlate by about f in it."""

_TINY = 1e-150
"""In place of zero below a fraction bar."""


class Bias(NamedTuple):
    """The mean error of every axis, in its σ."""

    mean: Float[np.ndarray, " n"]
    """The mean over the runs of their means over time."""
    p: Float[np.ndarray, " n"]
    """The probability of such a mean, or of a larger one, of a right filter."""


class Correlation(NamedTuple):
    """The correlations of whitened errors, which are zero for a right filter."""

    matrix: Float[np.ndarray, "n n"]
    axes: tuple[int, int]
    """The two axes whose correlation is the clearest."""
    p: float
    """The probability of one so clear of any two axes, for a right filter."""


def coverage(nees: PerStep, dof: int, logged: Mask) -> tuple[float, ...]:
    """The shares of all steps whose NEES is below the χ² quantiles of `SETS`.

    Of a right filter they are `SETS`. Errors with heavy tails, or with none, can have a mean NEES
    of n.
    """
    inside = (nees[logged] <= chi2_quantile(share, dof) for share in SETS)
    return tuple(float(np.mean(each)) for each in inside)


def bias(normalised: PerAxis, logged: Mask) -> Bias:
    """The mean of errors over their σ, and its p for each axis alone.

    From three runs on p is that of the scatter of their means (Student's t). The mean of fewer has
    at most the variance 1/runs, as if each run had one error all along: p is that of a Gaussian
    with this variance, and assumes that σ is right.
    """
    means = _of_runs(normalised, logged)
    mean = np.mean(means, axis=0)
    if len(means) < FEW_RUNS:
        return Bias(mean, scipy.special.erfc(np.abs(mean) * math.sqrt(len(means) / 2)))
    return Bias(mean, _p_of_zero(means))


def correlation(whitened: PerAxis, logged: Mask) -> Correlation:
    """The correlations over all steps, about a mean of zero, and whether the clearest is chance.

    From three runs on p is that of the scatter of their products; that of fewer is Fisher's, of the
    `effective_samples` of the axis that has fewer, and 1 below `NOTICEABLE`. It is corrected for
    the number of pairs of axes.
    """
    z = np.where(logged[..., None], whitened, 0.0)
    z = z / np.maximum(np.max(np.abs(z), axis=(0, 1)), _TINY)
    z = z / np.maximum(np.sqrt(np.sum(z**2, axis=(0, 1)) / np.sum(logged)), _TINY)
    matrix = np.einsum("rsi,rsj->ij", z, z) / np.sum(logged)
    first, second = np.triu_indices(len(matrix), 1)
    if not len(first):
        return Correlation(matrix, (0, 0), 1.0)
    r = np.clip(matrix[first, second], -1 + 1e-12, 1 - 1e-12)
    if len(z) < FEW_RUNS:
        left = np.where(logged[..., None], z, np.nan)
        samples = np.sum([[effective_samples(x[:, None]) for x in run.T] for run in left], axis=0)
        samples = np.maximum(np.minimum(samples[first], samples[second]) - 3, 0.0)
        away = np.abs(np.arctanh(r)) * np.sqrt(samples)
        p = np.where(np.abs(r) < NOTICEABLE, 1.0, scipy.special.erfc(away / math.sqrt(2)))
    else:
        p = _p_of_zero(_of_runs(z[..., first] * z[..., second], logged))
    best = int(np.lexsort((-np.abs(r), p))[0])
    axes = int(first[best]), int(second[best])
    return Correlation(matrix, axes, min(1.0, len(p) * float(p[best])))


def _of_runs(values: PerAxis, logged: Mask) -> Float[np.ndarray, "runs n"]:
    """The mean over the steps of every run."""
    return np.mean(values, axis=1, where=logged[..., None])


def _p_of_zero(values: Float[np.ndarray, "runs k"]) -> Float[np.ndarray, " k"]:
    """The two-sided p of Student's t for means of zero; 1 where all values are zero."""
    values = values / np.maximum(np.max(np.abs(values), axis=0), _TINY)
    error = np.std(values, axis=0, ddof=1) / math.sqrt(len(values))
    t = np.abs(np.mean(values, axis=0)) / np.maximum(error, _TINY)
    return 2 * scipy.special.stdtr(len(values) - 1, -t)
