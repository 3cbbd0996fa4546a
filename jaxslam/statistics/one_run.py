"""Is σ too small, from one run alone? By how many independent steps its correlated ones are worth.

The mean NEES of T independent steps is χ² of n T degrees of freedom, over T. That of correlated
ones scatters like the mean of fewer. The whitened errors `z = L⁻¹ e`, with `P = L Lᵀ`, say how
many: their mean is known, 0, and Gaussian ones with the correlations `R(k) = E zₜ zₜ₊ₖᵀ` have
`cov(NEESₜ, NEESₜ₊ₖ) = 2 |R(k)|²` (Isserlis), so that they are worth `T/τ` steps, with
`τ = Σₖ |R(k)|²/n` over all lags k, before and after.

One run proves over-confidence only. A part of the error that stays the same all along the run has
one sample, and hides from every statistic of that run by how much it would vary over others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Bool, Complex, Float

from jaxslam.statistics.bands import chi2_quantile
from jaxslam.statistics.looks import VERDICT_CONFIDENCE

FEWEST = 10
"""The fewest independent steps of which a run says anything: of fewer their number is unsure."""
WINDOW = 10
"""The lags that are summed, in units of the sum (Sokal, *Monte Carlo methods in statistical
mechanics*, 1997, takes 5): more make the number of independent steps too small, not too large."""
SELF_NORMALISED = 10.0173
"""The 99.5 % quantile of W(1)/√I, the root of `_self_normalised_p(t) = .01`. Its square is 100.3;
Lobato (Journal of the American Statistical Association 2001) simulates 99.8."""
EARLY = 0.25
"""The square of a correlation from which on it is, for what chance adds to squares, that of lags
which correlate."""
MOST_CHANCE = 0.05
"""The most that is taken for chance, as of the squared correlations of 20 independent steps."""
HIDDEN = 0.1
"""The share of the variance that may stay the same all along a run, where only NEES is known."""
_TAIL = (1 - VERDICT_CONFIDENCE) / 2
_LEAST = 1e-150
"""In place of zero below a fraction bar: errors that are all zero, or that never change."""


class OneRun(NamedTuple):
    """The NEES of one run beside that of a right filter, whose interval holds as a two-sided one.

    Only `over_confident` is proven. Its opposite is not: nor that σ is right.
    """

    over_confident: bool
    """Whether σ is certainly too small: p < .01, of `FEWEST` samples or more."""
    p: float
    """Twice the probability of so large a mean NEES, or a larger one, of a right filter."""
    sigma_factor: float
    """The factor √(NEES/n) by which every σ should be larger."""
    interval99: tuple[float, float]
    """The 99 % interval of that factor."""
    samples: float
    """The number of independent steps that the run is worth."""


def one_run(whitened: Float[np.ndarray, "steps n"]) -> OneRun:
    """The test of the mean NEES of one run, by its whitened errors `L⁻¹ e`; NaN is not logged.

    N·NEES is χ² of n N degrees of freedom, with N of `effective_samples`. Raises ValueError unless
    a step was logged.
    """
    n, there = whitened.shape[1], _logged(whitened)
    mean, samples = float(np.sum(whitened[there] ** 2) / np.sum(there)), effective_samples(whitened)
    dof = n * samples
    p = min(1.0, 2 * float(scipy.special.gammaincc(dof / 2, samples * mean / 2)))
    low, high = (math.sqrt(samples * mean / chi2_quantile(q, dof)) for q in (1 - _TAIL, _TAIL))
    proven = samples >= FEWEST and p < 2 * _TAIL
    return OneRun(proven, p, math.sqrt(mean / n), (low, high), samples)


def one_run_of_nees(nees: Float[np.ndarray, " steps"], dof: int) -> OneRun:
    """The test where only NEES is known, less powerful: self-normalised, of the log of the mean.

    `√T log(mean/n)` over the root of `Σₜ sₜ²/T²`, sₜ being the partial sums of `NEES/mean − 1`,
    is W(1)/√I of a Wiener process W, with I the integral of the square of its bridge (Shao, JRSS B
    2010), whatever the correlation. What never changes NEES does not show: n is enlarged to what it
    is, where `HIDDEN` of the variance does not, in one of 200 runs. A NEES that varies by less than
    half of what χ² does, `2 n` for a mean of n, has not shown its range yet: one sample. NaN is not
    logged. Raises ValueError unless a step was logged.
    """
    there = _logged(nees[:, None])
    mean = max(float(np.mean(nees, where=there)), _LEAST)
    relative = nees[there] / mean
    error = math.sqrt(float(np.sum(np.cumsum(relative - 1) ** 2)) / len(relative) ** 3)
    right = 1 - HIDDEN + HIDDEN * chi2_quantile(1 - _TAIL, dof) / dof
    p = _self_normalised_p(math.log(mean / dof / right) / max(error, _LEAST))
    samples = _samples_of_nees(nees, dof, there) if np.var(relative) > 1 / dof else 1.0
    low, high = (math.exp(side * SELF_NORMALISED * error) * mean / dof for side in (-1, 1))
    interval = math.sqrt(low / right), math.sqrt(high)
    return OneRun(samples >= FEWEST and p < 2 * _TAIL, p, math.sqrt(mean / dof), interval, samples)


def effective_samples(whitened: Float[np.ndarray, "steps n"]) -> float:
    """The number of independent steps whose mean NEES would scatter as that of this run does.

    It is the least of three: of every axis' own correlation, `τ = Σₖ rₖ²`; of those of all pairs of
    axes; and of the variance and correlation of NEES itself, which tails that are heavier than a
    Gaussian's enlarge. What chance adds to squares is taken away. A lag counts by the pairs of
    steps that were logged, so that a gap neither breaks a correlation nor adds to it. At least 1.
    Raises ValueError unless a step was logged.
    """
    there = _logged(whitened)
    kept, n = int(np.sum(there)), whitened.shape[1]
    z = np.where(there[:, None], whitened, 0.0)
    z /= max(float(np.sqrt(np.sum(z**2) / (kept * n))), _LEAST)
    pairs = np.maximum(np.round(_products(_transform(there.astype(float)))), 1)
    own = _products(_transform(z.T))
    own = np.mean((own / np.maximum(own[:, :1], _LEAST)) ** 2, axis=0) * kept / pairs
    early = own[: np.argmax(np.append(own, 0.0) < EARLY)]
    # The square of a correlation that is zero is that of its noise, τ/T; a part of the error that
    # never changes makes it larger too, and must not be taken for noise.
    chance = float(np.clip((2 * np.sum(early) - 1) / kept, 0.0, MOST_CHANCE))
    covariance = z.T @ z / kept + 1e-12 * np.eye(n)
    u = _transform(np.linalg.solve(np.linalg.cholesky(covariance), z.T))
    both = sum(np.sum(_products(x, u) ** 2, axis=0) for x in u) / (n * kept * pairs)
    time = max(_correlation_time(own, chance), _correlation_time(both, n * chance))
    return max(min(kept / time, _samples_of_nees(np.sum(z**2, axis=1), n, there)), 1.0)


def _samples_of_nees(
    nees: Float[np.ndarray, " steps"], n: int, there: Bool[np.ndarray, " steps"]
) -> float:
    """The number by the variance of NEES and its correlation, at most that of the steps."""
    steps, mean = float(np.sum(there)), max(float(np.mean(nees, where=there)), _LEAST)
    c = _products(_transform(np.where(there, nees / mean - 1, 0.0)))
    # The initial positive sequence of pairs, made monotone (Geyer, Statistical Science 1992).
    two = c[: len(c) // 2 * 2].reshape(-1, 2).sum(axis=1)
    two = np.minimum.accumulate(two[: np.argmax(np.append(two, 0) <= 0)])
    variance = max(2 * float(np.sum(two)) - float(c[0]), float(c[0])) / steps**2
    return min(2 / n / max(variance, _LEAST), steps)


def _correlation_time(squares: Float[np.ndarray, " lags"], chance: float) -> float:
    """`τ = Σₖ rₖ²` over all lags up to `WINDOW` τ, before and after, without what is of chance."""
    squares = squares - chance * (np.arange(len(squares)) > 0)
    times = np.maximum(2 * np.cumsum(squares) - squares[0], 1.0)
    enough = np.arange(len(times)) >= WINDOW * times
    return float(times[np.argmax(enough) if enough.any() else -1])


def _transform(x: Float[np.ndarray, "*n steps"]) -> Complex[np.ndarray, "*n frequencies"]:
    """The Fourier transform of what is followed by as many zeros."""
    return np.fft.rfft(x, 2 * x.shape[-1])


def _products(
    x: Complex[np.ndarray, "*n frequencies"],
    y: Complex[np.ndarray, "*m frequencies"] | None = None,
) -> Float[np.ndarray, "*m lags"]:
    """`Σₜ xₜ yₜ₊ₖ` for lags k below half the steps, from transforms; y is x where not given."""
    products = np.fft.irfft(x.conj() * (x if y is None else y))
    return products[..., : max(products.shape[-1] // 4, 1)]


def _self_normalised_p(t: float) -> float:
    """Twice the probability of W(1)/√I above t, at most 1.

    W(1) is Gaussian and independent of I, with `E exp(−s I) = √(u/sinh u)`, u = √(2 s) (Anderson
    and Darling, Annals of Mathematical Statistics 1952). With Craig's formula of the Gaussian's
    tail that is `1/π ∫ √(u/sinh u) dθ` over θ from 0 to π/2, with u = t/sin θ.
    """
    if t <= 0:
        return 1.0
    u = t / np.sin((np.arange(200) + 0.5) * np.pi / 400)
    return float(np.mean(np.sqrt(2 * u / -np.expm1(-2 * u)) * np.exp(-u / 2)))


def _logged(values: Float[np.ndarray, "steps n"]) -> Bool[np.ndarray, " steps"]:
    """A mask of the steps that are there. Raises ValueError where none is."""
    there = ~np.isnan(values).any(axis=1)
    if not there.any():
        raise ValueError("a run needs at least one step that was logged")
    return np.asarray(there)
