"""One mean of independent runs beside that of a right filter: by how much σ may be wrong.

There are two intervals, each of which is narrow where the other is wide. That of χ² takes the
covariances of all runs to be wrong by one factor, however the steps of a run are correlated. That
of the scatter is as wide as the runs themselves scatter, whatever they are drawn from.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import scipy  # of which `special` is imported when it is first used

from jaxslam.statistics.bands import (
    PowerSums,
    lost_threshold,
    mean_p_value,
    shortfall_limit,
    shortfall_p_value,
    skewed_limit,
)

VERDICT_CONFIDENCE = 0.99
"""The confidence with which all intervals of a study hold together: a consistent filter is called
inconsistent in less than one of 100 studies."""
TOLERANCE = 1.3
"""A σ wrong by this factor would have been seen, where a filter is called consistent."""
UNSEEN = 3
"""The runs in N that may be of a kind that none among N is (the rule of three: Hanley,
Lippman-Hand, JAMA 1983)."""


class Verdict(dict[str, Any]):
    """A verdict: the dict that JSON has, whose keys are attributes too, as `Tally.verdict` says."""

    word: str
    """`consistent`, `over-confident`, `under-confident`, `cannot tell` or `lost`; of innovations
    `outlying` in place of `lost`."""
    nees: float | None
    """The mean NEES that decided; None where a run diverged."""
    sigma_factor: float | None
    """The factor by which every σ should be larger."""
    interval99: list[float | None]
    """The 99 % interval of that factor; None for an end that is not bounded."""
    p: float
    """The probability of such numbers, or more extreme ones, if the filter is consistent."""
    of: str
    """The steps that decided: `all steps`, `last step`, or a third of them (`first third`)."""
    enough: int | None
    """About how many runs would tell, where the word is `cannot tell`."""
    runs: int
    """The number of runs."""
    lost: float
    """The share of runs that are lost at any step, diverged ones too."""
    lost_runs: list[int] | None
    """The numbers of these runs, where all records are kept."""
    diverged: int
    """The number of runs with a NEES that is not finite, or with a P that is not positive."""
    mean: Verdict
    """The verdict on the mean over all steps alone."""
    end: Verdict
    """The verdict on the last step alone."""
    thirds: list[Verdict]
    """The verdicts on each third of the steps."""
    never_lost: Verdict
    """The verdict on the runs that are never lost."""
    effective: float
    """The number of independent steps that the steps of the only run are worth, where there is
    one run, whose errors are known."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            told = f"this verdict has no {name!r}; known: {', '.join(self)}"
            raise AttributeError(told) from None

    def __or__(self, other: Mapping[str, object]) -> Verdict:
        return Verdict({**self, **other})

    def __repr__(self) -> str:
        shown = ("word", "nees", "sigma_factor", "interval99", "p")
        told = (f"{name}={self[name]!r}" for name in shown if name in self)
        return f"Verdict({', '.join(told)})"


Found = Mapping[str, Any]
"""A verdict, or one as JSON has it."""


@dataclass(frozen=True)
class Look:
    """A test of the mean of one number a run; factors are of σ², 1 where it is right."""

    name: str
    """The steps that are looked at: `all steps`, `last step` or a third, such as `first third`."""
    sums: PowerSums
    right: tuple[float, float]
    """The mean of a right filter is anywhere from the one to the other."""
    level: float
    """The probability that a right filter is outside the interval."""

    @property
    def factor(self) -> float:
        """The factor by which σ² should be larger."""
        mean = self.sums.mean
        nearest = min(max(mean, self.right[0]), self.right[1])
        return 1.0 if mean == nearest else mean / nearest

    @cached_property
    def interval(self) -> tuple[float, float]:
        """The interval of the scatter where it proves that σ is wrong; else one that holds both.

        It excludes 1 where that of χ² proves it: a right filter is tested by each of them, while
        any other factor says less of how runs scatter, and only both together exclude it. Where
        neither does, it reaches up as if `UNSEEN` more runs had just been lost.
        """
        low, high = self._tested()
        if low <= 1 <= high:
            high += _unseen(self.sums.mean, self.right[1], self.sums.count)
        return low, high

    def _tested(self) -> tuple[float, float]:
        """An interval that holds both, or what is left of them where σ is proven to be wrong."""
        model = self._of_chi2()
        scatter = self._of_scatter()
        if scatter is None:
            return model
        if scatter[0] > 1 or scatter[1] < 1:
            return scatter
        low, high = min(model[0], scatter[0]), max(model[1], scatter[1])
        if model[0] > 1:
            low = math.nextafter(1.0, 2.0)
        if model[1] < 1:
            high = math.nextafter(1.0, 0.0)
        return low, high

    def _of_chi2(self) -> tuple[float, float]:
        """The range of factors with which the sum over N runs is not in a tail of χ²(N n)."""
        total, n = self.sums.first, self.sums.count
        most = _limit(n * self.right[1], self.level, above=True)
        least = _limit(n * self.right[0], self.level, above=False)
        return total / most, total / least if least else math.inf

    def _of_scatter(self) -> tuple[float, float] | None:
        """The interval of Student's t, by the relative scatter: `m (1 − δ)` to `m/(1 − δ)`.

        δ = t s/(m √N), s the scatter. Relative to the mean, few runs that are all small are not
        alike. Upwards to Hall's limit for skewed numbers, where that is further: few runs of many
        are the large ones.
        """
        relative = self._relative_error()
        if relative is None:
            return None
        t = float(scipy.special.stdtrit(self.sums.count - 1, 1 - self.level / 2))  # Student's
        delta = t * relative
        low, high = self.sums.mean * max(1 - delta, 0.0), math.inf
        if delta < 1 and self.right[0]:
            skewed = 1 + skewed_limit(self.sums, t) * relative
            high = self.sums.mean * max(1 / (1 - delta), skewed) / self.right[0]
        return low / self.right[1], high

    def _relative_error(self) -> float | None:
        """The relative standard error of the mean; None where the runs are too few."""
        # The fewest numbers whose scatter says anything.
        if self.sums.count < 3 or self.sums.mean <= 0:
            return None
        relative = self.sums.deviation / self.sums.mean / math.sqrt(self.sums.count)
        return relative if math.isfinite(relative) else None

    @property
    def p(self) -> float:
        """The p of a right filter, at 99 % confidence all together: below .01 if disproved."""
        mean, (low, high) = self.sums.mean, self.right
        nearest = min(max(mean, low), high)
        if mean == nearest:
            return 1.0
        p = shortfall_p_value(mean, nearest, self.sums.count)
        relative = self._relative_error()
        if relative is not None:
            apart = 1 - min(mean, nearest) / max(mean, nearest)
            t = apart / relative if relative else math.inf
            scattered = 2 * float(scipy.special.stdtr(self.sums.count - 1, -t))
            if mean < nearest:
                scattered = max(scattered, mean_p_value(self.sums, nearest))
            p = min(p, scattered)
        return min(1.0, p * (1 - VERDICT_CONFIDENCE) / self.level)

    @property
    def disproved(self) -> bool:
        """Whether σ is certainly wrong."""
        low, high = self.interval
        return low > 1 or high < 1

    @property
    def word(self) -> str:
        """The word for σ, right within `TOLERANCE` or wrong; `cannot tell` without proof."""
        low, high = self.interval
        if self.disproved:
            return "over-confident" if low > 1 else "under-confident"
        if not self.right[0]:  # only over-confidence can be proven, and only it is to be excluded
            low, high = 1.0, replace(self, right=(self.right[1], self.right[1])).interval[1]
        return "consistent" if low >= TOLERANCE**-2 and high <= TOLERANCE**2 else "cannot tell"

    def asdict(self) -> Verdict:
        """Return the numbers as a verdict has them, of σ."""
        low, high = self.interval
        return Verdict(
            nees=self.sums.mean,
            sigma_factor=math.sqrt(self.factor),
            interval99=[_root(low, upwards=low > 1), _root(high, upwards=high > 1)],
            p=self.p,
            word=self.word,
        )

    def enough(self) -> int:
        """Estimate how many runs would show whether σ is right within `TOLERANCE`."""
        runs = _enough(self.right[0] or self.right[1], self.right[1], self.level)
        low, high = self.interval
        if runs <= self.sums.count and low > 0 and math.isfinite(high):  # and they scatter more
            wide = max(-math.log(low), math.log(high)) / (2 * math.log(TOLERANCE))
            runs = max(runs, math.ceil(self.sums.count * max(wide, 1.0) ** 2))
        digits = max(len(str(runs)) - 2, 0)
        return math.ceil(runs / 10**digits) * 10**digits


def _root(factor: float, *, upwards: bool) -> float | None:
    """The root of a factor, on the same side of 1 as the factor however it is rounded."""
    if not math.isfinite(factor):
        return None
    root = math.sqrt(factor)
    if root == 1 != factor:
        return math.nextafter(1.0, 2.0 if upwards else 0.0)
    return root


@lru_cache(maxsize=1024)
def _limit(dof: float, level: float, *, above: bool) -> float:
    return shortfall_limit(dof, level, above=above) if dof else 0.0


def _unseen(mean: float, dof: float, runs: int) -> float:
    """The amount by which `UNSEEN` more runs that are just lost would enlarge the factor of σ²."""
    return UNSEEN * max(lost_threshold(dof) - mean, 0.0) / (runs + UNSEEN) / dof


@lru_cache(maxsize=256)
def _enough(least_dof: float, dof: float, level: float) -> int:
    """The number of runs whose χ² interval is within `TOLERANCE`, the mean off by its error."""

    def told(runs: int) -> bool:
        total = runs * least_dof
        error = math.sqrt(2 * total)
        least, most = (shortfall_limit(total, level, above=above) for above in (False, True))
        high = TOLERANCE**2 - _unseen(dof, dof, runs)
        return total + error <= least * high and most <= TOLERANCE**2 * (total - error)

    high = 1
    while not told(high):
        high *= 2
    return bisect_left(range(high), True, lo=high // 2 + 1, key=told)
