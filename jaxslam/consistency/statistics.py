"""Consistency statistics: NEES and its exact χ² bounds (Bar-Shalom, Li, Kirubarajan 2001, §5.4)."""

from __future__ import annotations

from jaxtyping import Array, Float
from scipy.special import gammainc, gammaincinv

from jaxslam.linalg import cholesky

CONFIDENCE = 0.95
LOST_QUANTILE = 0.9999
"""A run whose NEES is above this quantile of χ² is lost: one in 10 000 of a consistent filter."""


def normalised_squared(
    error: Float[Array, " n"], covariance: Float[Array, "n n"]
) -> Float[Array, ""]:
    """`eᵀ P⁻¹ e`: the NEES of an error, the NIS of an innovation; NaN unless P is positive."""
    whitened = cholesky(covariance).whitening @ error
    return whitened @ whitened


def chi2_quantile(probability: float, dof: float) -> float:
    """The χ² value with the given probability below it."""
    return 2 * float(gammaincinv(dof / 2, probability))


def chi2_cdf(value: float, dof: float) -> float:
    """The probability that χ² is below `value`."""
    return float(gammainc(dof / 2, value / 2))


def mean_band(dof: int, runs: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided bounds of the mean NEES of `runs` independent runs at ONE time step.

    `N · mean ~ χ²(N n)` exactly. The steps of a run are correlated: never pool them.
    """
    if dof < 1 or runs < 1:
        raise ValueError(f"a band needs at least one run and one dof, not {runs} and {dof}")
    tail = (1 - confidence) / 2
    low, high = (chi2_quantile(q, runs * dof) / runs for q in (tail, 1 - tail))
    return low, high


def lost_threshold(dof: int) -> float:
    """NEES above which a run counts as lost; 21.1 for 3 degrees of freedom."""
    return chi2_quantile(LOST_QUANTILE, dof)
