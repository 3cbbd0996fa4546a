"""Consistency over scenarios, filters and seeds: by how much σ is wrong, lost runs, RMSE and time.

    python benchmarks/consistency.py --scenarios matched-loose --filters robocentric --seeds 0 1 2

Results are added to `consistency.json` one seed at a time; seeds that a row already has are not run
again. A row is one study of all runs of its seeds, which are as many of each; to measure it with
more, remove it first. `--page` only writes
`docs/consistency.md`, from what is there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, OfRuns, at_end, table

import jaxslam
from jaxslam._runtime.files import json_numbers
from jaxslam.consistency import tally
from jaxslam.statistics import Tally, mean_band

Row = dict[str, Any]
Results = dict[str, dict[str, Row]]
"""`results[scenario][filter/landmarks]`: what `measure` returns of one seed, `together` of more."""
TALLIES = ("tally", "one_scale", "drift")
MARK, SAID = "<!-- consistency.py -->", "<!-- consistency.py, in words -->"
IN_README = ("matched", "matched-loose", "matched-forward-loose")
STEPS = (5, 10)
"""Steps whose mean NEES the page shows, beside the last."""


@dataclass(frozen=True, kw_only=True)
class Consistency(OfRuns):
    """Filters in scenarios on seeds."""

    scenarios: tuple[str, ...] = (
        "matched-tight", "matched", "matched-loose", "matched-very-loose", "matched-forward",
        "matched-forward-loose", "matched-turn-loose", "circle", "circle-loose",
        "matched-6dof-loose",
    )  # fmt: skip
    filters: tuple[str, ...] = (
        "robocentric", "scale_gauge", "scale_gauge+mixture17",
    )  # fmt: skip
    runs: int = 1000
    seeds: tuple[int, ...] = tuple(range(20))
    """Seeds. What is measured already is not measured again."""
    out: Path = RESULTS / "consistency.json"

    def measure(self) -> Iterator[Results]:
        results: Results = self.found()
        for scenario, frame in itertools.product(self.scenarios, self.filters):
            name, rows = f"{frame}/inverse_scaling", results.setdefault(scenario, {})
            for seed in missing(rows.get(name), self):
                found = measure(jaxslam.scenario(scenario), name, seed, self)
                rows[name] = together(rows[name], found) if name in rows else found
                print(scenario, *_row(name, found), flush=True)
                yield results

    def tables(self, results: Results) -> Iterator[tuple[str, str, str]]:
        yield "consistency.md", SAID, in_words(results)
        yield "consistency.md", MARK, as_table(results)
        if self.page:
            yield "../README.md", MARK, recommended(results, IN_README)
            yield "results.md", MARK, beside(results)


def measure(scenario: jaxslam.Scenario, name: str, seed: int, options: Consistency) -> Row:
    """One filter on one seed: numbers from which those of many seeds follow."""
    study, f = options.study(scenario, name, seed)
    (key,) = study.filters
    nis = np.sum(np.array(f["nis"], float)) / np.sum(np.array(f["nis_dof"], float))
    last = at_end(f)
    return {
        "seeds": [seed],
        "runs": options.runs,
        "tally": tally(study, key).asdict(),
        "one_scale": tally(study, key, "beyond_scale").asdict(),
        "drift": tally(study, key, "drift").asdict(),
        "nees": f["nees"],
        "lost": round(last["lost"] * options.runs),
        **{of: last[of] for of in ("nees_median", "nees_not_lost", "rmse", "sigma")},
        "nis_per_dof": float(nis),
        "microseconds_per_step": 1e6 * f["seconds"]["run"] / options.runs / scenario.steps,
    }


def together(one: Row, other: Row) -> Row:
    """Rows of different seeds as one study; of medians, NIS and times the mean of the seeds'.

    NEES, RMSE and σ are of the runs that did not diverge.
    """
    both = one, other
    seeds = [len(row["seeds"]) for row in both]
    survivors = [row["runs"] - row["tally"]["diverged"] for row in both]
    kept = [row["runs"] - row["lost"] for row in both]

    def mean(key: str, weights: list[int]) -> np.ndarray:
        return _weighed(np.array([row[key] for row in both], float), weights)

    def root(key: str) -> np.ndarray:
        return np.sqrt(_weighed(np.array([row[key] for row in both], float) ** 2, survivors))

    of_seeds = "nees_median", "nis_per_dof", "microseconds_per_step"
    numbers = {
        "nees_not_lost": mean("nees_not_lost", kept),
        **{key: mean(key, seeds) for key in of_seeds},
        **{key: root(key) for key in ("rmse", "sigma")},
    }
    return {
        "seeds": sorted(one["seeds"] + other["seeds"]),
        "runs": one["runs"] + other["runs"],
        "lost": one["lost"] + other["lost"],
        **{
            key: (Tally.from_dict(one[key]) + Tally.from_dict(other[key])).asdict()
            for key in TALLIES
            if key in one and key in other
        },
        "nees": json_numbers(mean("nees", survivors)),
        **dict(zip(numbers, json_numbers(np.array(list(numbers.values()))), strict=True)),
    }


def _weighed(values: np.ndarray, weights: list[int]) -> np.ndarray:
    """The mean over rows of such weights; one without any has no value."""
    w = np.array(weights, float).reshape(-1, *[1] * (values.ndim - 1))
    with np.errstate(invalid="ignore"):
        return np.where(w > 0, values * w, 0.0).sum(axis=0) / w.sum()


def verdicts_of(row: Row) -> dict[str, dict[str, Any]]:
    """Of all steps, at one scale a run, and of the drift of scale, where a row has them."""
    return {key: Tally.from_dict(row[key]).verdict() for key in TALLIES if key in row}


def as_table(results: Results) -> str:
    """All rows, by scenario."""
    steps = ", ".join(map(str, STEPS))
    header = [
        "scenario, filter", "NEES, all steps", "σ should be ×", "verdict", "at one scale; drift",
        f"NEES at steps {steps}, last", "lost; ever", "RMSE; σ, m",
    ]  # fmt: skip
    rows: list[list[str]] = []
    for name, filters in results.items():
        rows.append([f"**`{name}`**", *[""] * (len(header) - 1)])
        rows += [_row(key, row) for key, row in filters.items()]
    return table(header, rows)


def in_words(results: Results) -> str:
    """In how many scenarios each filter is consistent, by how much σ is wrong elsewhere, and of how
    many runs that is."""
    lines = []
    for name in ("robocentric", "scale_gauge", "recommended"):
        found = [
            verdicts_of(row)["tally"]
            for filters in results.values()
            for key, row in filters.items()
            if label(key) == name
        ]
        if factors := [v["mean"]["sigma_factor"] for v in found if v["mean"]["sigma_factor"]]:
            right = sum(v["word"] == "consistent" for v in found)
            lines.append(
                f"- `{name}` is consistent in {right} of {len(found)} scenarios. Over all steps "
                f"its σ should be multiplied by {min(factors):.3g} to {max(factors):.3g}."
            )
    rows = [row for filters in results.values() for row in filters.values()]
    runs, seeds = [row["runs"] for row in rows], {seed for row in rows for seed in row["seeds"]}
    told = f"A row is one study of {min(runs)} to {max(runs)} runs of seeds {named(seeds)}."
    return "\n".join([*lines, "", told])


def label(name: str) -> str:
    """A filter as tables call it."""
    slam, _, landmarks = name.rpartition("/")
    if landmarks != "inverse_scaling":
        return name
    if "+scene50" in slam:
        return "recommended"
    return slam.replace("scale_gauge+", "+")


BRIEF = {"consistent": "yes", "over-confident": "over", "under-confident": "under"}


def _row(name: str, row: Row) -> list[str]:
    told = verdicts_of(row)
    verdict, mean = told["tally"], told["tally"]["mean"]
    survivors = row["runs"] - row["tally"]["diverged"]
    low, high = mean_band(row["tally"]["dof"], max(survivors, 1))
    if verdict["nees"] is None:
        low, high = np.inf, -np.inf
    steps = (*(s - 1 for s in STEPS if s < len(row["nees"])), -1)
    nees = [np.nan if row["nees"][step] is None else row["nees"][step] for step in steps]
    brief = (BRIEF.get(told[key]["word"], "?") for key in TALLIES[1:] if key in told)
    return [
        f"`{label(name)}`{'' if 'drift' in row else ' †'}",
        _short(mean["nees"]),
        _factor(mean),
        _decided(verdict),
        "; ".join(brief) or "–",
        " ".join(f"**{_short(n)}**" if low <= n <= high else _short(n) for n in nees),
        f"{row['lost'] / row['runs']:.2%}; {verdict['lost']:.2%}",
        f"{row['rmse']:.3f}; {row['sigma']:.3f}",
    ]


def _decided(verdict: dict[str, Any]) -> str:
    """The word, and the part that decided."""
    part = "" if verdict["of"] == "all steps" else f" ({verdict['of']})"
    return f"{verdict['word']}{part}"


def recommended(results: Results, scenarios: Iterable[str]) -> str:
    """The table of the paper's filter and the recommended one, by scenario."""
    header = (
        "scenario", "filter", "NEES: all; last", "σ should be ×", "verdict", "lost", "RMSE, σ, m"
    )  # fmt: skip
    rows = []
    for scenario, (name, row) in ((of, item) for of in scenarios for item in results[of].items()):
        if label(name) in ("robocentric", "recommended"):
            verdict = verdicts_of(row)["tally"]
            rows.append(
                (
                    *(f"`{scenario}`", f"`{label(name)}`"),
                    f"{_short(verdict['mean']['nees'])}; {_short(row['nees'][-1])}",
                    *(_factor(verdict["mean"]), _decided(verdict)),
                    f"{row['lost'] / row['runs']:.1%}",
                    f"{row['rmse']:.3f}, {row['sigma']:.3f}",
                )
            )
    return table(header, rows)


def beside(results: Results) -> str:
    """The same numbers in short, a row for each scenario."""
    rows = []
    for scenario, filters in results.items():
        of = {label(name): row for name, row in filters.items()}
        told = {name: verdicts_of(of[name])["tally"] for name in ("robocentric", "recommended")}
        cells = [
            f"{_factor(verdict['mean'])}; {of[name]['lost'] / of[name]['runs']:.1%}"
            for name, verdict in told.items()
        ]
        cells[-1] += f"; {_decided(told['recommended'])}"
        rows.append((f"`{scenario}`", *cells))
    columns = "`robocentric`: σ should be ×; lost", "`recommended`: σ should be ×; lost; verdict"
    return table(("scenario", *columns), rows)


def _factor(found: dict[str, Any]) -> str:
    factor, (low, high) = found["sigma_factor"], found["interval99"]
    if factor is None:
        return _short(factor)
    return f"{factor:.2f} [{low:.2f}, {'–' if high is None else f'{high:.2f}'}]"


def named(seeds: Iterable[int]) -> str:
    """Seeds in short: `0–9, 12`."""
    numbers = sorted(seeds)
    starts = [numbers[0], *(b for a, b in pairwise(numbers) if b > a + 1)]
    ends = [*(a for a, b in pairwise(numbers) if b > a + 1), numbers[-1]]
    ranges = zip(starts, ends, strict=True)
    return ", ".join(f"{a}–{b}" if b > a else str(a) for a, b in ranges)


def _short(value: float | None) -> str:
    if value is None or np.isnan(value):
        return "–"
    return f"{value:.2f}" if value < 100 else f"{value:.3g}"


def missing(row: Row | None, options: Consistency) -> list[int]:
    """Seeds that a row does not have yet. Raises ValueError where it has other numbers of runs."""
    if row is None:
        return list(options.seeds)
    each = row["runs"] / len(row["seeds"])
    if each != options.runs:
        raise ValueError(
            f"there is a row with {each:g} runs of every seed, not {options.runs}: remove it from "
            f"{options.out}, or write to another file (--out)"
        )
    return [seed for seed in options.seeds if seed not in row["seeds"]]


if __name__ == "__main__":
    Consistency.run()
