"""What NEES says of a filter: by how much its covariance is wrong, in one study and on a map.

A `Tally` is the verdict on one study, over all its steps; `verdict` is that on one mean at one
step, alone and as one of many comparisons.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.consistency.statistics import (
    CONFIDENCE,
    PowerSums,
    chernoff_p_value,
    chi2_p_value,
    lost_threshold,
    mean_band,
    mean_interval,
    mean_p_value,
)

VERDICTS = ("consistent", "under-confident", "over-confident", "lost")
LOST_BOUND = 0.01
"""More lost runs than this share make a filter lost: 100 times what a consistent one loses."""
VERDICT_CONFIDENCE = 0.99
"""Of the interval of a study; a consistent filter is called inconsistent once in 100 studies."""


@dataclass(frozen=True)
class Tally:
    """What a study's verdict needs of its runs: numbers that add up, over chunks and over seeds.

    The steps of a run are correlated, runs are not: each run gives one number, the average of
    its NEES over time, and its NEES at the end.
    """

    dof: int
    """Degrees of freedom of one NEES."""
    runs: int
    diverged: int
    """Runs with a NEES that is not finite: they have no average, and a study with one no mean."""
    lost: int
    """Runs lost at any step, diverged ones too."""
    average: PowerSums
    """Time averages of the runs that did not diverge."""
    end: PowerSums
    """NEES at the last step of the runs that did not diverge."""
    never_lost: PowerSums
    """Time averages of the runs never lost."""
    fitted: float = 0.0
    """Of every NEES between 0 and so many degrees of freedom were taken by a fit to the run."""

    @staticmethod
    def of(
        nees: Float[np.ndarray, "runs steps"],
        dof: int,
        fitted: float = 0.0,
        logged: Bool[np.ndarray, "runs steps"] | None = None,
    ) -> Tally:
        """Of the NEES of runs, with so many degrees of freedom.

        Where runs are not equally long, or have gaps, `logged` says which steps of each are there:
        its average is over those, and its end is the last of them.

        What one fit to a whole run takes from each of its NEES depends on how its errors are
        correlated: of an unknown scale of K poses between 1/K and 1. With `fitted` the filter is
        right where the mean is anywhere between `dof - fitted` and `dof`. Raises ValueError
        unless `fitted` is from 0 to `dof`, and every run has a step.
        """
        if not 0 <= fitted <= dof:
            raise ValueError(f"fitted must be from 0 to the {dof} degrees of freedom, not {fitted}")
        nees = np.asarray(nees, np.float64)
        there = _logged(nees, logged)
        healthy = (np.isfinite(nees) | ~there).all(axis=1)
        good, there = nees[healthy], there[healthy]
        average = good.mean(axis=1, where=True if there.all() else there)
        kept = ((good <= lost_threshold(dof)) | ~there).all(axis=1)
        last = there.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1)
        return Tally(
            dof,
            len(nees),
            int(np.sum(~healthy)),
            int(len(nees) - np.sum(kept)),
            PowerSums.of(average),
            PowerSums.of(good[range(len(good)), last]),
            PowerSums.of(average[kept]),
            float(fitted),
        )

    @staticmethod
    def from_dict(numbers: dict[str, Any]) -> Tally:
        """Of what `asdict` made of it."""
        counts = (numbers[name] for name in ("dof", "runs", "diverged", "lost"))
        sums = (PowerSums(**numbers[name]) for name in ("average", "end", "never_lost"))
        return Tally(*counts, *sums, numbers.get("fitted", 0.0))

    @staticmethod
    def of_numbers(numbers: Float[np.ndarray, " 15"], dof: int, fitted: float = 0.0) -> Tally:
        """Of what `numbers` made of one tally, or of a sum of such."""
        runs, diverged, lost = (int(x) for x in numbers[:3])
        sums = (PowerSums(int(n), *map(float, rest)) for n, *rest in numbers[3:].reshape(3, 4))
        return Tally(dof, runs, diverged, lost, *sums, fitted)

    def numbers(self) -> Float[np.ndarray, " 15"]:
        """All that adds up, for `of_numbers`."""
        sums = (x for each in (self.average, self.end, self.never_lost) for x in astuple(each))
        return np.array([self.runs, self.diverged, self.lost, *sums], np.float64)

    def asdict(self) -> dict[str, Any]:
        """Numbers as JSON has them, for `from_dict`."""
        return asdict(self)

    def __add__(self, other: Tally) -> Tally:
        if self.dof != other.dof:
            raise ValueError(f"runs of {self.dof} and of {other.dof} dof are not one study")
        if self.fitted != other.fitted:
            raise ValueError(
                f"runs with {self.fitted} and {other.fitted} dof fitted are not one study"
            )
        names = ("runs", "diverged", "lost", "average", "end", "never_lost")
        sums = (getattr(self, name) + getattr(other, name) for name in names)
        return Tally(self.dof, *sums, self.fitted)

    def verdict(self) -> dict[str, Any]:
        """The key `verdict` of `consistency.json`.

        `nees` is the mean of the runs' time averages, `sigma_factor` is √(nees/dof): every σ
        should be so many times as large, with its 99 % interval (`mean_interval`). `p` is of a
        consistent filter: the smaller of Hall's, for what the runs themselves scatter, and of
        Chernoff's bound for χ², as a few lost runs scatter so much that they hide themselves.
        `end` is the same at the last step, where p is exact. With a diverged run no mean exists
        and the word is lost. `never_lost` is the verdict on the runs never lost: robust, and low
        by construction, by .1–.4 % of NEES for a consistent filter over 60 steps.

        With `fitted` a NEES above dof is compared with dof, one below dof − fitted with that, and
        one between them is right: its σ factor is 1, and the interval is from √(low/dof) to
        √(high/(dof − fitted)), without an upper end where all may be fitted.
        """
        never_lost, right = self.never_lost, (self.dof - self.fitted, self.dof)
        return {
            **_judged(self.average, right, _of_averages, self.diverged),
            "runs": self.runs,
            "lost": self.lost / self.runs,
            "diverged": self.diverged,
            "end": _judged(self.end, right, _at_one_step, self.diverged),
            "never_lost": {
                **_judged(never_lost, right, _of_averages),
                "runs": never_lost.count,
            },
        }


def _logged(
    nees: Float[np.ndarray, "runs steps"], logged: Bool[np.ndarray, "runs steps"] | None
) -> Bool[np.ndarray, "runs steps"]:
    """Which steps are there. Raises ValueError unless every run has one."""
    there = np.ones(nees.shape, bool) if logged is None else np.asarray(logged, bool)
    if there.shape != nees.shape or not there.any(axis=1).all():
        raise ValueError(f"logged must be {nees.shape}, with a step of every run")
    return there


def _judged(
    sums: PowerSums,
    right: tuple[float, float],
    p_value: Callable[[PowerSums, float], float],
    diverged: int = 0,
) -> dict[str, Any]:
    """Of a mean, that of a right filter being anywhere from the one bound to the other."""
    factor = _factor(sums, right, diverged)
    if diverged or not sums.count:
        return {**factor, "p": 0.0, "word": "lost"}
    nearest = _nearest(sums.mean, right)
    p = 1.0 if sums.mean == nearest else p_value(sums, nearest)
    return {**factor, "p": p, "word": _word(p, sums.mean > nearest)}


def _nearest(mean: float, right: tuple[float, float]) -> float:
    return min(max(mean, right[0]), right[1])


def _of_averages(sums: PowerSums, expected: float) -> float:
    bounds = mean_p_value(sums, expected), chernoff_p_value(sums.mean, expected, sums.count)
    return float(np.nanmin(bounds))


def _at_one_step(sums: PowerSums, expected: float) -> float:
    return chi2_p_value(sums.mean, expected, sums.count)


def _factor(sums: PowerSums, right: tuple[float, float], diverged: int) -> dict[str, Any]:
    if diverged or not sums.count:
        return {"nees": None, "sigma_factor": None, "interval99": [None, None]}
    nearest, (low, high) = _nearest(sums.mean, right), mean_interval(sums, VERDICT_CONFIDENCE)
    return {
        "nees": sums.mean,
        "sigma_factor": 1.0 if sums.mean == nearest else math.sqrt(sums.mean / nearest),
        "interval99": [_root(low, right[1]), _root(high, right[0])],
    }


def _root(mean: float, expected: float) -> float | None:
    """None where the mean is not known, and where none is too small."""
    return math.sqrt(mean / expected) if expected and math.isfinite(mean) else None


def _word(p: float, above: bool) -> str:
    if p >= 1 - VERDICT_CONFIDENCE:
        return "consistent"
    return "over-confident" if above else "under-confident"


def run_verdict(
    nees: Float[np.ndarray, "runs steps"],
    dof: int,
    fitted: float = 0.0,
    logged: Bool[np.ndarray, "runs steps"] | None = None,
) -> dict[str, Any]:
    """The verdict on one study from the NEES of its independent runs, see `Tally.verdict`; what is
    `fitted` and `logged`, see `Tally.of`.

    Raises ValueError unless there are runs, steps and degrees of freedom.
    """
    nees = np.asarray(nees)
    if nees.ndim != 2 or not nees.size or dof < 1:
        raise ValueError(f"NEES must be (runs, steps) with dof ≥ 1, not {nees.shape} and {dof}")
    return Tally.of(nees, dof, fitted, logged).verdict()


def lost_runs(
    nees: Float[np.ndarray, "runs steps"],
    dof: int,
    logged: Bool[np.ndarray, "runs steps"] | None = None,
) -> list[int]:
    """Which runs are lost at any of their steps; what is `logged`, see `Tally.of`."""
    lost = (~(nees <= lost_threshold(dof)) & _logged(nees, logged)).any(axis=1)
    return [int(run) for run in np.flatnonzero(lost)]


def not_disproved(found: dict[str, Any]) -> bool:
    """Whether a verdict lets a filter be consistent, be that shown or not."""
    return found["word"] in ("consistent", "cannot tell")


def sentences(found: dict[str, Any]) -> list[str]:
    """A verdict in words, and that at the last step; of the runs never lost, where some were.

    Where more than a few were, the others are chosen by their NEES: no verdict is said of them.
    """
    end, kept, runs = found["end"], found["never_lost"], found["runs"]
    told = [headline(found)]
    if end["nees"] is not None:
        told.append(f"at the last step: {_said(end)}")
    if lost := runs - kept["runs"]:
        told.append(f"{lost} of {runs} runs were lost, {_others(kept, lost / runs)}")
    return told


def _others(kept: dict[str, Any], lost: float) -> str:
    if not kept["runs"]:
        return "all of them"
    said = _said(kept) if lost <= LOST_BOUND else f"NEES {_digits(kept['nees'])}"
    return f"the {kept['runs']} never lost: {said}"


def headline(found: dict[str, Any]) -> str:
    """The verdict on all runs: `NEES 4.72, σ too small by 1.25 [1.24, 1.27]: over-confident`."""
    if found["nees"] is None:
        return f"{found['diverged']} of {found['runs']} runs diverged, no mean NEES: lost"
    return _said(found)


def _said(found: dict[str, Any]) -> str:
    factors = [found["sigma_factor"], *found["interval99"]]
    told = "right up to a factor"
    if found["word"] != "consistent":
        told = "too small by"
        if factors[0] < 1:
            told, factors = "too large by", [_inverse(factors[i]) for i in (0, 2, 1)]
    factor, low, high = ("–" if f is None else _digits(f) for f in factors)
    p = f"p = {found['p']:.2g}" if found["p"] >= 1e-4 else "p < 0.0001"
    said = f"NEES {_digits(found['nees'])}, σ {told} {factor} [{low}, {high}]"
    return f"{said}: {found['word']} ({p})"


def _inverse(factor: float | None) -> float | None:
    return 1 / factor if factor else None


def _digits(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.3g}"


def verdict(
    nees: float | None,
    lost: float,
    *,
    dof: int,
    runs: int,
    diverged: int = 0,
    comparisons: int = 1,
    lost_bound: float = LOST_BOUND,
) -> str:
    """One of `VERDICTS` for a mean NEES over `runs` independent runs, `lost` a share of runs.

    `lost` comes first; then a mean NEES below the 95 % band is under-confident (σ too large), one
    above it over-confident. With m comparisons the band is Bonferroni's, at 1 − 0.05/m: it holds
    all means of m consistent filters together in 95 % of cases, however they are correlated. A
    mean that does not exist (None or NaN, or of runs of which one diverged) is lost.

    Raises ValueError for numbers that make no sense.
    """
    if comparisons < 1:
        raise ValueError(f"comparisons must be at least 1, not {comparisons}")
    for name, share in (("lost", lost), ("lost_bound", lost_bound)):
        if not 0 <= share <= 1:
            raise ValueError(f"{name} must be a share from 0 to 1, not {share}")
    if lost > lost_bound or diverged or nees is None or math.isnan(nees):
        return "lost"
    low, high = mean_band(dof, runs, together(comparisons))
    if nees < low:
        return "under-confident"
    return "over-confident" if nees > high else "consistent"


def together(comparisons: int) -> float:
    """Confidence of each of m bands that hold together with 95 %, by Bonferroni."""
    return 1 - (1 - CONFIDENCE) / comparisons
