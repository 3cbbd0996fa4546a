"""The verdict of NEES on a filter: the factor by which σ is wrong, in one study, over all steps."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.statistics.bands import (
    Mask,
    PerAxis,
    PerStep,
    PowerSums,
    lost_threshold,
    whiteness_p_value,
)
from jaxslam.statistics.looks import VERDICT_CONFIDENCE, Found, Look, Verdict
from jaxslam.statistics.one_run import FEWEST, one_run, one_run_of_nees

LOST_BOUND = 0.01
"""More lost runs than this share make a filter lost: 100 times what a consistent one loses."""
THIRDS = ("first third", "second third", "last third")
"""The names of the thirds of a run's steps."""


@dataclass(frozen=True)
class Tally:
    """The numbers of its runs that a study's verdict needs, which add up over chunks and seeds.

    The steps of a run are correlated, runs are not: each run gives one number, the average of
    its NEES over time; that of each third of its steps; and its NEES at the end.
    """

    dof: int
    """Degrees of freedom of one NEES."""
    runs: int
    diverged: int
    """Runs with a NEES that is not finite: they have no average, and a study with one no mean."""
    lost: int
    """Runs lost at any step (`lost_threshold` of so many steps), diverged ones too."""
    average: PowerSums
    """Time averages of the runs that did not diverge."""
    end: PowerSums
    """NEES at the last step of the runs that did not diverge."""
    never_lost: PowerSums
    """Time averages of the runs never lost."""
    fitted: float = 0.0
    """The degrees of freedom, from 0 to so many, that a fit to the run took from every NEES."""
    thirds: tuple[PowerSums, ...] = (PowerSums(), PowerSums(), PowerSums())
    """Averages over each third of the steps, of the runs that did not diverge and have three."""

    @staticmethod
    def of(nees: PerStep, dof: int, fitted: float = 0.0, logged: Mask | None = None) -> Tally:
        """Return the tally of the NEES of runs, with so many degrees of freedom.

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
        kept = np.ones(len(nees), bool)
        kept[lost_runs(nees, dof, there)] = False
        good, there, kept = nees[healthy], there[healthy], kept[healthy]
        average = good.mean(axis=1, where=True if there.all() else there)
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
            _thirds(good, there),
        )

    @staticmethod
    def from_dict(numbers: Found) -> Tally:
        """Return the tally that `asdict` wrote; one written without thirds has none."""
        counts = (numbers[name] for name in ("dof", "runs", "diverged", "lost"))
        sums = (PowerSums(**numbers[name]) for name in ("average", "end", "never_lost"))
        thirds = tuple(PowerSums(**x) for x in numbers.get("thirds", ({},) * 3))
        return Tally(*counts, *sums, numbers.get("fitted", 0.0), thirds)

    @staticmethod
    def of_numbers(numbers: Float[np.ndarray, " 27"], dof: int, fitted: float = 0.0) -> Tally:
        """Return the tally of what `numbers` gave of one, or of a sum of such."""
        runs, diverged, lost = (int(x) for x in numbers[:3])
        average, end, never_lost, *thirds = (
            PowerSums(int(n), *map(float, rest)) for n, *rest in numbers[3:].reshape(6, 4)
        )
        counts = dof, runs, diverged, lost
        return Tally(*counts, average, end, never_lost, fitted, tuple(thirds))

    def numbers(self) -> Float[np.ndarray, " 27"]:
        """Return all that adds up, for `of_numbers`."""
        each = (self.average, self.end, self.never_lost, *self.thirds)
        sums = (x for part in each for x in astuple(part))
        return np.array([self.runs, self.diverged, self.lost, *sums], np.float64)

    def asdict(self) -> dict[str, object]:
        """Return the numbers as JSON has them, for `from_dict`."""
        return asdict(self) | {"thirds": [asdict(third) for third in self.thirds]}

    def __add__(self, other: Tally) -> Tally:
        both = (self.dof, other.dof, ""), (self.fitted, other.fitted, "fitted ")
        for own, theirs, what in both:
            if own != theirs:
                told = f"runs with {own} and {theirs} {what}degrees of freedom"
                raise ValueError(f"{told} cannot be pooled")
        return Tally.of_numbers(self.numbers() + other.numbers(), self.dof, self.fitted)

    def looks(self) -> list[Look]:
        """The looks at all steps, the last one and each third, which hold together with 99 %.

        Half of what a right filter may fail is that of the mean over all steps, where a study has
        most to say, and the other half is shared by the parts (Bonferroni).
        """
        right = self.dof - self.fitted, float(self.dof)
        parts = {} if self.end == self.average else {"last step": self.end}
        parts |= {n: x for n, x in zip(THIRDS, self.thirds, strict=True) if x.count}
        total = 1 - VERDICT_CONFIDENCE
        share = total / 2 if parts else total
        return [
            Look("all steps", self.average, right, share),
            *(Look(n, x, right, (total - share) / len(parts)) for n, x in parts.items()),
        ]

    def decisive(self) -> Look:
        """The look at all steps; or, where only parts show that σ is wrong, at the clearest part.

        Raises ValueError where no run is left to look at.
        """
        if not self.average.count:
            raise ValueError("every run diverged, so there is no mean")
        looks = self.looks()
        wrong = [look for look in looks if look.disproved]
        if len(wrong) < 2 or wrong[0] is looks[0]:
            return (wrong or looks)[0]
        return min(wrong, key=lambda look: look.p)

    def verdict(self) -> Verdict:
        """The key `verdict` of `consistency.json`.

        `sigma_factor` is √(nees/dof), by which every σ should be larger, with an interval of 99 %;
        `p` that of a consistent filter. They are `of` the mean over all steps; or, where only that
        at the last step or of a third of the steps shows that σ is wrong, of that. So the word is
        over- or under-confident where the interval does not hold 1, and p < .01. Else it is
        consistent where the interval is within `TOLERANCE` of 1, and `cannot tell` where it is
        not: about `enough` runs would show it. `mean`, `end` and the `thirds` have their own, which
        hold together: p is corrected for the number of looks. With a diverged run no mean exists
        and the word is lost. `never_lost` is the verdict on the runs never lost: robust, and low
        by construction. `lost_runs` are their numbers, where they are known.

        With `fitted` a NEES above dof is compared with dof, one below dof − fitted with that. One
        between them is right: its σ factor is 1, and the interval is from √(low/dof) to
        √(high/(dof − fitted)), without an upper end where all may be fitted.
        """
        right = self.dof - self.fitted, float(self.dof)
        kept = Look("never lost", self.never_lost, right, 1 - VERDICT_CONFIDENCE)
        never_lost = kept.asdict() if kept.sums.count else _NONE
        return self._judged() | {
            "runs": self.runs,
            "lost": self.lost / self.runs,
            "lost_runs": None,
            "diverged": self.diverged,
            "never_lost": never_lost | {"runs": self.runs - self.lost},
        }

    def _judged(self) -> Verdict:
        """The look that decides, and all of them."""
        if self.diverged or not self.average.count:
            parts = {"mean": _NONE, "end": _NONE, "thirds": []}
            return _NONE | {"of": "all steps", "enough": None, **parts}
        looks, name = self.looks(), self.decisive().name
        told = {look.name: look.asdict() for look in looks}
        mean = told["all steps"]
        return told[name] | {
            "p": min(found["p"] for found in told.values()),
            "of": name,
            "enough": looks[0].enough() if told[name]["word"] == "cannot tell" else None,
            "mean": mean,
            "end": told.get("last step", mean),
            "thirds": [told[third] for third in THIRDS if third in told],
        }


_NONE = Verdict(nees=None, sigma_factor=None, interval99=[None, None], p=0.0, word="lost")
"""The verdict where there is no mean."""


def _logged(nees: PerStep, logged: Mask | None) -> Mask:
    """A mask of the steps that are there. Raises ValueError unless every run has one."""
    there = np.ones(nees.shape, bool) if logged is None else np.asarray(logged, bool)
    if there.shape != nees.shape or not there.any(axis=1).all():
        raise ValueError(f"logged must have the shape {nees.shape} and at least one step per run")
    return there


def lost_runs(nees: PerStep, dof: int, logged: Mask | None = None) -> list[int]:
    """The numbers of the runs lost at any of their steps; for `logged` see `Tally.of`.

    Of right runs one in 10 000 is lost, or fewer, however many steps they have. Raises ValueError
    for a run without steps.
    """
    there = _logged(nees, logged)
    steps, which = np.unique(there.sum(axis=1), return_inverse=True)
    limits = np.array([lost_threshold(dof, int(n)) for n in steps])[which]
    return [int(run) for run in np.flatnonzero((~(nees <= limits[:, None]) & there).any(axis=1))]


def _thirds(nees: PerStep, there: Mask) -> tuple[PowerSums, ...]:
    """The power sums of the averages over each third of the steps that are there."""
    steps = there.sum(axis=1)
    long, place = steps >= len(THIRDS), np.cumsum(there, axis=1) - 1
    which = np.where(there, len(THIRDS) * place // steps[:, None], -1)[long]
    each = (which == third for third in range(len(THIRDS)))
    return tuple(PowerSums.of(nees[long].mean(axis=1, where=those)) for those in each)


def run_verdict(
    nees: Float[np.ndarray, "runs steps"],
    dof: int,
    fitted: float = 0.0,
    logged: Bool[np.ndarray, "runs steps"] | None = None,
    whitened: Float[np.ndarray, "runs steps axes"] | None = None,
) -> Verdict:
    """The verdict on one study from the NEES of its independent runs, see `Tally.verdict`.

    For `fitted` and `logged` see `Tally.of`. Of one run the `whitened` errors `L⁻¹ e` say how many
    independent steps its steps are worth, `effective`; they may show that it is over-confident
    (`jaxslam.statistics.one_run`), and never anything else: `samples` is then `effective`. Without
    an axis they say only that NEES alone is known. Raises ValueError unless there are runs, steps
    and degrees of freedom.
    """
    nees = np.asarray(nees, np.float64)
    if nees.ndim != 2 or not nees.size or dof < 1:
        raise ValueError(f"NEES must be (runs, steps) with dof ≥ 1, not {nees.shape} and {dof}")
    found = Tally.of(nees, dof, fitted, logged).verdict()
    found |= {"lost_runs": lost_runs(nees, dof, logged)}
    if whitened is None or len(nees) > 1 or found["diverged"]:
        return found
    there = _logged(nees, logged)
    nees, whitened = np.where(there, nees, np.nan), np.where(there[..., None], whitened, np.nan)
    return _of_one_run(found, nees, whitened, dof)


def _of_one_run(found: Verdict, nees: PerStep, whitened: PerAxis, dof: int) -> Verdict:
    """A verdict on one run, or that it is over-confident by what its steps are worth."""
    one = one_run(whitened[0]) if whitened.shape[-1] else one_run_of_nees(nees[0], dof)
    found |= {"effective": one.samples}
    if not one.over_confident:
        # A part of the error that never changes may hide the rest of its variance.
        right = found["word"] in ("consistent", "under-confident")
        others = (part["word"] for part in (found["mean"], *found["thirds"]))
        lone = found["of"] == "last step" and "over-confident" not in others
        if lone and one.samples >= FEWEST:  # of so many one step may be of a heavy tail
            none = {"word": "cannot tell"}
            found |= found["mean"] | none | {"of": "all steps", "end": found["end"] | none}
        return found | {"word": "cannot tell"} if right else found
    return found | {
        "word": "over-confident",
        "nees": found["mean"]["nees"],
        "sigma_factor": one.sigma_factor,
        "interval99": list(one.interval99),
        "p": one.p,
        "of": "all steps",
        "enough": None,
        "samples": "effective",
    }


def not_disproved(found: Found) -> bool:
    """Whether a verdict lets a filter be consistent, be that shown or not."""
    return found["word"] in ("consistent", "cannot tell")


def sentences(found: Found, quantity: str = "NEES") -> list[str]:
    """A verdict in words, and that at the last step; of the runs never lost, where some were.

    Where more than a few were, the others are chosen by their NEES: no verdict is said of them.
    """
    told = [headline(found, quantity)]
    if found["nees"] is not None:
        if "effective" in found:
            told.append(_of_effective(found))
        if _part(found) != "all steps":
            told.append(f"over all steps: {_said(found['mean'], quantity)}")
        if _part(found) != "last step":
            told.append(f"at the last step: {_said(found['end'], quantity)}")
    if "white" in found and not found["diverged"]:
        told += _of_whiteness(found)
    if found["lost"]:
        told.append(_of_lost(found, quantity))
    return told


def _of_effective(found: Found) -> str:
    """A sentence on what the correlated steps of one run are worth."""
    number = max(round(found["effective"]), 1)
    said = f"its steps are worth {number} independent one{'s' if number > 1 else ''}"
    if found["word"] != "cannot tell":
        return said
    few = found["effective"] < FEWEST
    return f"{said}, {'too few to tell' if few else 'which do not show that σ is too small'}"


def _of_lost(found: Found, quantity: str) -> str:
    """A sentence on the runs that were lost, and on the others."""
    kept, runs = found["never_lost"], found["runs"]
    lost = runs - kept["runs"]
    word, others = "was lost" if lost == 1 else "were lost", "never lost"
    if quantity != "NEES":
        word, others = f"{'has' if lost == 1 else 'have'} an outlying {quantity}", "others"
    numbers = found.get("lost_runs")
    which = f" ({_listed(numbers)})" if numbers else ""
    if not kept["runs"]:
        return f"the only run {word}" if runs == 1 else f"all {runs} runs {word}"
    few = lost / runs <= LOST_BOUND
    said = _said(kept, quantity) if few else f"{quantity} {_digits(kept['nees'])}"
    return f"{lost} of {runs} runs {word}{which}, the {kept['runs']} {others}: {said}"


def _listed(numbers: list[int]) -> str:
    told = ", ".join(map(str, numbers[:_TOLD]))
    more = len(numbers) - _TOLD
    return f"run{'s' if len(numbers) > 1 else ''} {told}{f' and {more} more' if more > 0 else ''}"


_TOLD = 8
"""The most lost runs that are named."""


def _of_whiteness(found: Found) -> list[str]:
    if found["samples"] == "steps":
        return [f"innovations appear white (p = {found['white']:.2g}): each step is one sample"]
    if found["white"] is None:
        return ["too few steps to tell whether innovations are white: each run is one sample"]
    return [
        f"innovations are not white (p = {found['white']:.2g}), as those of a correct filter are: "
        "steps are not independent, so each run is one sample"
    ]


def headline(found: Found, quantity: str = "NEES") -> str:
    """The verdict on all runs: `NEES 4.72, σ too small by 1.25 [1.24, 1.27]: over-confident`."""
    if found["nees"] is None:
        word = found["word"]
        return f"{found['diverged']} of {found['runs']} runs diverged, no mean {quantity}: {word}"
    part = _part(found)
    where = {"all steps": "", "last step": "at the last step "}.get(part, f"in the {part} ")
    said = f"{where}{_said(found, quantity)}"
    if found.get("enough") is None:
        return said
    return f"{said}; about {found['enough']} {found.get('samples', 'runs')} would tell"


def brief(found: Found) -> str:
    """The word of a verdict with the factor of σ, for where there is little room."""
    if found["nees"] is None:
        return found["word"]
    factor, low, high = _factors(found["word"], found["sigma_factor"], *found["interval99"])
    return f"{found['word']}, σ × {factor} [{low}, {high}]"


def _part(found: Found) -> str:
    """The part that decided; older files, from before there were parts, have none."""
    return found.get("of", "all steps")


def _said(found: Found, quantity: str) -> str:
    factors, word = [found["sigma_factor"], *found["interval99"]], found["word"]
    told = "right up to a factor" if word == "consistent" else "should be ×"
    if word == "over-confident":
        told = "too small by"
    if word == "under-confident":
        told, factors = "too large by", [_inverse(factors[i]) for i in (0, 2, 1)]
    factor, low, high = _factors(word, *factors)
    p = f"p = {found['p']:.2g}" if found["p"] >= 1e-4 else "p < 0.0001"
    said = f"{quantity} {_digits(found['nees'])}, σ {told} {factor} [{low}, {high}]"
    return f"{said}: {word} ({p})"


def _factors(word: str, factor: float | None, *bounds: float | None) -> tuple[str, ...]:
    """A factor and its interval, in which a bound next to 1 is not 1 where σ is disproved."""
    wrong = word in ("over-confident", "under-confident")

    def bound(value: float | None) -> str:
        if value is None:
            return "∞"
        near = wrong and value != 1 and _digits(value) == "1.00"
        return f"{'>' if value > 1 else '<'}1" if near else _digits(value)

    return "–" if factor is None else _digits(factor), *map(bound, bounds)


def _inverse(factor: float | None) -> float | None:
    return 1 / factor if factor else None


def _digits(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.3g}"


def innovation_verdict(nis: PerStep, normalised: PerAxis, dof: int) -> Verdict:
    """The verdict on innovations, of every step where they seem white, else of every run.

    It is that of `run_verdict`; `samples` says whether steps or runs are counted. Innovations,
    which need no truth, are white if the filter is right, so that every step is a sample of its own
    (Bar-Shalom, Li, Kirubarajan 2001, §5.4.2).

    `normalised` are innovations over their σ; steps that a run lacks are NaN in `nis`. `white` is
    the p of `whiteness_p_value`, None where steps are too few or a NIS is not finite. A run that
    has a NIS above the quantile of lost runs is outlying: nothing is lost.
    """
    found = run_verdict(nis, dof, logged=~np.isnan(nis))
    p = None if found["diverged"] else whiteness_p_value(nis, normalised)
    white = p is not None and p >= 1 - VERDICT_CONFIDENCE
    if white:
        lost = found["lost_runs"]
        found |= _of_steps(nis, dof, lost).verdict() | {"lost_runs": lost}
    word = "outlying" if found["word"] == "lost" else found["word"]
    return found | {"word": word, "samples": "steps" if white else "runs", "white": p}


def _of_steps(nis: PerStep, dof: int, outlying: list[int]) -> Tally:
    """A tally to which every step is a run, but for the counts of runs."""
    there = ~np.isnan(nis)
    third = len(THIRDS) * (np.cumsum(there, axis=1) - 1) // there.sum(axis=1, keepdims=True)
    kept = np.ones(len(nis), bool)
    kept[outlying] = False
    at_end = nis[range(len(nis)), nis.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1)]
    return Tally(
        dof=dof,
        runs=len(nis),
        diverged=0,
        lost=len(outlying),
        average=PowerSums.of(nis[there]),
        end=PowerSums.of(at_end),
        never_lost=PowerSums.of(nis[there & kept[:, None]]),
        thirds=tuple(PowerSums.of(nis[there & (third == i)]) for i in range(len(THIRDS))),
    )
