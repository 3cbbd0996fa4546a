"""Consistency statistics: NEES and its exact χ² bounds (Bar-Shalom, Li, Kirubarajan 2001, §5.4).

It also has what holds for the mean of independent numbers of any distribution, from their power
sums.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray
from jaxslam.linalg import cholesky

PerStep = Float[np.ndarray, "runs steps"]
"""One number for every step of every run."""
Mask = Bool[np.ndarray, "runs steps"]
"""Which steps of the runs are there."""
PerAxis = Float[np.ndarray, "runs steps n"]
"""A number for every axis of every step."""


CONFIDENCE = 0.95
MOST_DOF = 100
"""More degrees of freedom than a pose, or a state that is tested as a whole, usually has."""


def normalised_squared(
    error: Float[AnyArray, " n"], covariance: Float[AnyArray, "n n"]
) -> Float[Array, ""]:
    """`eᵀ P⁻¹ e`: the NEES of an error, the NIS of an innovation; NaN unless P is positive."""
    whitened = cholesky(covariance).whitening @ error
    return whitened @ whitened


def chi2_quantile(probability: float, dof: float) -> float:
    """The χ² value with the given probability below it."""
    return 2 * float(scipy.special.gammaincinv(dof / 2, probability))


def mean_band(dof: int, runs: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The two-sided bounds of the mean NEES of `runs` independent runs at ONE time step.

    `N · mean ~ χ²(N n)` exactly. The steps of a run are correlated: never pool them. Raises
    ValueError without a run or a degree of freedom, for no confidence between 0 and 1, and where
    dof and runs seem to be the wrong way round.
    """
    if dof > MOST_DOF and dof > runs:
        raise ValueError(
            f"mean_band(dof, runs) of {dof} degrees of freedom and {runs} runs: mean_band(3, 300) "
            f"is the band of 3 degrees of freedom and 300 runs; for a NEES of more than {MOST_DOF} "
            "degrees of freedom jaxslam.evaluation.evaluate_nees(nees, dof) has the band"
        )
    return exact_band(dof, runs, confidence)


def exact_band(dof: int, runs: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The bounds of `mean_band`, for any degrees of freedom. Raises ValueError as that does."""
    if dof < 1 or runs < 1:
        raise ValueError(f"a band needs at least one run and one dof, not {runs} and {dof}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence}")
    tail = (1 - confidence) / 2
    low, high = (chi2_quantile(q, runs * dof) / runs for q in (tail, 1 - tail))
    return low, high


def lost_threshold(dof: float, steps: int = 1) -> float:
    """The NEES above which a run counts as lost; 21.1 for 3 degrees of freedom.

    With so many `steps` one run in 10 000 exceeds it at any step, fewer if they are correlated.
    """
    # A run whose NEES is above this quantile of χ² is lost: one in 10 000 of a consistent filter.
    return 2 * float(scipy.special.gammainccinv(dof / 2, (1 - 0.9999) / steps))


def shortfall_limit(dof: float, level: float, *, above: bool) -> float:
    """The upper or the lower limit of everything, but for a share of `level`, that spreads no more
    than χ².

    A sum of time averages of χ² does not, by Jensen `E f(Σ xₜ/T) ≤ E f(x)` for every convex f,
    however the steps are correlated. Half of `level` is at most on each side, beyond χ²'s expected
    shortfall `E[χ² | χ² in its tail]` (Meilijson and Nádas, Journal of Applied Probability 1979,
    *Convex majorization with an application to the length of critical paths*).
    """
    special, shape, tail = scipy.special, dof / 2, level / 2
    if above:
        share = special.gammaincc(shape + 1, special.gammainccinv(shape, tail))
    else:
        share = special.gammainc(shape + 1, special.gammaincinv(shape, tail))
    return dof * float(share) / tail


def shortfall_p_value(mean: float, dof: float, runs: int) -> float:
    """A bound of the two-sided p of a mean NEES over runs *and* steps, correlated in any way.

    It is the level at which the sum is a `shortfall_limit`.
    """
    total, above = runs * mean, bool(mean > dof)
    low, high = _LEAST, 0.0  # of log p
    for _ in range(60):
        middle = (low + high) / 2
        limit = shortfall_limit(runs * dof, math.exp(middle), above=above)
        within = total <= limit if above else total >= limit
        low, high = (middle, high) if within else (low, middle)
    return 0.0 if low == _LEAST else math.exp(high)


_LEAST = math.log(1e-290)
"""The least log p; anything below it counts as zero."""


@dataclass(frozen=True)
class PowerSums:
    """The count of independent numbers and the sums of their first three powers. They add up.

    `count` numbers x: `first` is Σ x, `second` Σ x², `third` Σ x³.
    """

    count: int = 0
    first: float = 0.0
    second: float = 0.0
    third: float = 0.0

    @staticmethod
    def of(values: Float[np.ndarray, " n"]) -> PowerSums:
        """Return the power sums of these numbers."""
        values = np.asarray(values, np.float64)
        with np.errstate(over="ignore"):  # of a lost run's: no interval then
            return PowerSums(values.size, *(float(np.sum(values**power)) for power in (1, 2, 3)))

    def __add__(self, other: PowerSums) -> PowerSums:
        return PowerSums(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def mean(self) -> float:
        return self.first / self.count if self.count else math.nan

    @property
    def deviation(self) -> float:
        """The standard deviation, with n − 1."""
        central = self.second - self.count * self.mean * self.mean
        return math.sqrt(max(central, 0.0) / (self.count - 1)) if self.count > 1 else math.nan

    @property
    def skewness(self) -> float:
        n, m = self.count, self.mean
        second = self.second / n - m * m
        third = self.third / n - 3 * m * self.second / n + 2 * m * m * m
        cubed = second * math.sqrt(max(second, 0.0))
        return third / cubed if second > 1e-12 * m * m and cubed > 0 else 0.0


def mean_p_value(sums: PowerSums, expected: float) -> float:
    """The two-sided p of `expected` as the mean of skewed numbers; NaN for fewer than two.

    Student's t with its skewness removed by a cubic (Hall, Annals of Statistics 1992,
    "On the removal of skewness by transformation"): the studentised bootstrap to second order,
    without resampling.
    """
    if sums.count < 2:
        return math.nan
    away, k = sums.mean - expected, sums.skewness / math.sqrt(sums.count)
    if sums.deviation == 0:
        return float(away == 0)
    t = away / (sums.deviation / math.sqrt(sums.count))
    return 2 * float(scipy.special.stdtr(sums.count - 1, -abs(_symmetric(t, k))))


_FAR = 1e50
"""The largest studentised mean: the powers of a larger one overflow."""


def skewed_limit(sums: PowerSums, t: float) -> float:
    """The standard errors by which a mean may be too high, `-g⁻¹(−t)` of `_symmetric`.

    It is t for numbers that are not skewed.
    """
    k = sums.skewness / math.sqrt(sums.count)
    return 3 / k * (1 - math.cbrt(1 - k * (t + k / 6))) if k else t


def _symmetric(t: float, k: float) -> float:
    """Hall's cubic `g(t) = t + k/6 + k t²/3 + k² t³/27`, with k = skewness/√n: monotone."""
    t = min(max(t, -_FAR), _FAR)
    return t + k / 6 + k * t**2 / 3 + k**2 * t**3 / 27


def whiteness_p_value(nis: PerStep, normalised: PerAxis) -> float | None:
    """The p of white innovations, by their autocorrelations and those of NIS; None of too few.

    Of each axis, and of NIS about its mean, `Q = Σₗ rₗ² Nₗ`, the Nₗ pairs of steps l apart having
    the correlation rₗ, is χ² (Ljung and Box, Biometrika 1978; of all runs); the least p of them by
    Bonferroni. The mean of innovations is not taken away: one with a bias is not white.
    """
    lags = min(10, nis.shape[1] // 4)
    there = ~np.isnan(nis)
    # The fewest pairs of steps from which a correlation is estimated.
    if not lags or np.sum(there[:, 1:] & there[:, :-1]) < 20:
        return None
    series = [*np.moveaxis(normalised, -1, 0), nis - np.mean(nis, where=there)]
    with np.errstate(over="ignore", invalid="ignore"):
        p = [_portmanteau(np.where(there, x, 0.0), there, lags) for x in series]
    known = [x for x in p if not math.isnan(x)]  # of an axis that is always zero it is not
    return min(1.0, len(p) * float(min(known))) if known else None


def _portmanteau(values: np.ndarray, there: np.ndarray, lags: int) -> float:
    total, power = 0.0, np.sum(values**2) / np.sum(there)
    for lag in range(1, lags + 1):
        pairs = max(np.sum(there[:, lag:] & there[:, :-lag]), 1)
        total += (np.sum(values[:, lag:] * values[:, :-lag]) / power) ** 2 / pairs
    return float(scipy.special.gammaincc(lags / 2, total / 2))
