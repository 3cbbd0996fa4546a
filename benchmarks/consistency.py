"""Consistency over scenarios, filters and seeds: by how much σ is wrong, lost runs, RMSE and time.

    python benchmarks/consistency.py --scenarios matched-loose --filters robocentric --seeds 0 1 2

Results are added to `consistency.json` one seed at a time, also by several such commands at once;
what it already has is not run again. `docs/consistency.md` pools all runs of a row. `--page` only
writes it from what is there.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from pages import END, write_table
from verdicts import BEGIN
from verdicts import table as table_of_verdicts

import jaxslam
from jaxslam._runtime.files import write_atomically
from jaxslam.consistency import tally
from jaxslam.statistics import Tally, mean_band

Seeds = dict[str, dict[str, Any]]
Results = dict[str, dict[str, Seeds]]
"""`results[scenario][filter/landmarks][seed]`: what `measure` returns."""
LAYOUT = 2
"""Of what `measure` returns; what has another is measured again."""
VERDICTS = Path("benchmarks/results/verdicts.json")
RESULTS = Path("docs/results.md")
README = Path("README.md")
"""Pages with a table of the paper's filter and the recommended one, behind `MARK`."""
MARK = "<!-- consistency.py -->"
IN_README = ("matched", "matched-loose", "matched-forward-loose")
STEPS = (5, 10)
"""Steps whose mean NEES the page shows, beside the last."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    scenarios: tuple[str, ...] = (
        "matched-tight", "matched", "matched-loose", "matched-very-loose", "matched-forward",
        "matched-forward-loose", "matched-turn-loose", "circle", "circle-loose",
        "matched-6dof-loose",
    )  # fmt: skip
    """Built-in scenarios."""
    filters: tuple[str, ...] = (
        "robocentric", "scale_gauge", "scale_gauge+lag20", "scale_gauge+mixture17",
    )  # fmt: skip
    """Filters."""
    landmarks: tuple[str, ...] = ("inverse_scaling",)
    """Landmark parametrizations."""
    runs: int = 1000
    """Runs of every seed."""
    seeds: tuple[int, ...] = tuple(range(20))
    """Seeds. What is measured already is not measured again."""
    chunk: int = 25
    """Runs in one batch."""
    out: Path = Path("benchmarks/results/consistency.json")
    """The results, added to."""
    docs: Path = Path("docs/consistency.md")
    """The page."""
    page: bool = False
    """Measure nothing; write the page, and the tables of the README and of docs/results.md."""


def measure(scenario: jaxslam.Scenario, name: str, seed: int, options: Options) -> dict[str, Any]:
    """One filter on one seed: numbers from which those of many seeds follow."""
    frame, landmarks = name.rsplit("/", 1)
    filters = jaxslam.make_filters(scenario, [frame], [landmarks])
    study = jaxslam.monte_carlo(
        scenario, filters, runs=options.runs, seed=seed, chunk=options.chunk
    )
    ((key, f),) = jaxslam.summarise(study)["filters"].items()
    nis = np.sum(np.array(f["nis"], float)) / np.sum(np.array(f["nis_dof"], float))
    return {
        "layout": LAYOUT,
        "runs": options.runs,
        "tally": tally(study, key).asdict(),
        "one_scale": tally(study, key, "beyond_scale").asdict(),
        "drift": tally(study, key, "drift").asdict(),
        "nees": _rounded(f["nees"]),
        "lost": round(f["lost"][-1] * options.runs),
        "nees_median": _rounded(f["nees_median"][-1:])[0],
        "nees_not_lost": f["nees_not_lost"][-1],
        "rmse": _rounded(f["rmse"]["position"][-1:])[0],
        "sigma": _rounded(f["sigma"]["position"][-1:])[0],
        "nis_per_dof": round(float(nis), 4),
        "microseconds_per_step": round(
            1e6 * f["seconds"]["run"] / options.runs / scenario.steps, 1
        ),
    }


def _rounded(values: list[float | None]) -> list[float | None]:
    return [None if value is None else float(f"{value:.5g}") for value in values]


def pooled(seeds: Seeds) -> dict[str, Any]:
    """All runs of all seeds as one study; the median is the mean of the seeds'.

    Of the runs that did not diverge, but for `lost` and the verdict: `band95` is of so many.
    """
    one = list(seeds.values())
    total = reduce(add, (Tally.from_dict(seed["tally"]) for seed in one))
    survivors = [seed["runs"] - seed["tally"]["diverged"] for seed in one]
    kept = [seed["runs"] - seed["lost"] for seed in one]
    squared = {key: np.square(_column(one, key)) for key in ("rmse", "sigma")}
    return {
        "seeds": named(seeds),
        "runs": total.runs,
        "verdict": total.verdict(),
        **_at_one_scale(one),
        "band95": mean_band(total.dof, max(sum(survivors), 1)),
        "nees": _weighed(np.array([seed["nees"] for seed in one], float), survivors),
        "lost": 1 - sum(kept) / total.runs,
        "nees_not_lost": float(_weighed(_column(one, "nees_not_lost"), kept)),
        "nees_median": float(np.mean(_column(one, "nees_median"))),
        "nis_per_dof": float(np.mean(_column(one, "nis_per_dof"))),
        **{key: float(np.sqrt(_weighed(square, survivors))) for key, square in squared.items()},
    }


def _at_one_scale(one: list[dict[str, Any]]) -> dict[str, Any]:
    """Verdicts on NEES at one scale a run and on the drift of scale, where seeds have both."""
    if any("drift" not in seed for seed in one):
        return {}
    return {
        key: reduce(add, (Tally.from_dict(seed[key]) for seed in one)).verdict()
        for key in ("one_scale", "drift")
    }


def _column(seeds: list[dict[str, Any]], key: str) -> np.ndarray:
    return np.array([seed[key] for seed in seeds], float)


def _weighed(values: np.ndarray, runs: list[int]) -> Any:
    """The mean over seeds of so many runs; a seed without any has no value, and no weight."""
    weights = np.array(runs, float).reshape(-1, *[1] * (values.ndim - 1))
    with np.errstate(invalid="ignore"):
        return np.where(weights > 0, values * weights, 0.0).sum(axis=0) / weights.sum()


def page(results: Results, verdicts: Path = VERDICTS) -> str:
    """The Markdown page, with the table of `verdicts.py` where that was run."""
    lines = [
        "# Consistency, filter by filter",
        "",
        "`python benchmarks/consistency.py`; every number is measured. Each row is one study of",
        "all runs of its seeds. NEES is of the camera's pose (ideal mean 3, 6 in 6-DoF). *All",
        "steps*: the mean of the runs' time averages; *σ should be ×*: √(it/ideal), with its",
        "interval; *verdict*: of all steps, the last one and each third of them together, and",
        "which part decided, if one did; *at one scale a run*: the verdict on NEES at the scale of",
        "each run that explains its poses best, and on the drift of scale along it, of which only",
        "over-confidence can be proven ([one unit a map](gauge.md)); *never lost*: the first two",
        "numbers of the runs lost at no step (this choice makes a consistent filter's NEES low by",
        "up to .4 %). *Steps*: the",
        "mean NEES of all runs, bold inside the exact 95 % band of so many; *lost*: runs above the",
        "99.99 % quantile of χ² at the last step, *ever*: at any step above the higher quantile",
        "for so many, so that it may be less; *others*: mean NEES of those not lost at the last",
        "step; median, RMSE and σ of the position there. –: a run diverged, and",
        "there is no mean; then the other numbers are of the runs that did not.",
        "",
        *_of_verdicts(verdicts),
    ]
    if any(_old(seeds) for filters in results.values() for seeds in filters.values()):
        lines += [
            "",
            "†: tallied before a verdict looked at thirds, *ever* by the quantile of one step, and",
            "without drift: such a verdict is of all steps and of the last one.",
        ]
    for name, filters in results.items():
        lines += [
            "",
            f"## `{name}`",
            "",
            "| filter | seeds × runs | NEES, all steps | σ should be × | verdict "
            "| at one scale a run; drift | never lost "
            f"| NEES at steps {', '.join(map(str, STEPS))}, last | lost | ever | others | median "
            "| RMSE m | σ m | NIS/dof |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
            *(_row(key, pooled(seeds), len(seeds)) for key, seeds in filters.items() if seeds),
        ]
    return "\n".join(lines) + "\n"


def _old(seeds: Seeds) -> bool:
    """Whether any of them was tallied without thirds and drift."""
    return any("drift" not in seed for seed in seeds.values())


def _of_verdicts(path: Path) -> list[str]:
    """How often a verdict is wrong."""
    if not path.exists():
        return []
    return [
        "## How often a verdict is wrong",
        "",
        "`python benchmarks/verdicts.py` draws studies as of a filter: of 1, 2, 3 and 6 degrees",
        "of freedom, of one step, and of 12 that are independent or correlated by .98. By the",
        "number of runs, the worst of all these, or their range: a right filter called",
        "inconsistent; one whose σ is wrong by 1.3, either way, called consistent; a wrong σ",
        "found; opposite faults found, NEES/dof from .7 at the beginning to 1.3 at the end; and",
        "where 1 % of the runs have twenty times the variance, how often the interval of σ over",
        "all steps holds the truth. Of what no run of a study shows, an interval allows for",
        "as much as three runs that are just lost.",
        "",
        BEGIN,
        "",
        table_of_verdicts(json.loads(path.read_text())),
        "",
        END,
    ]


def _row(name: str, p: dict[str, Any], seeds: int) -> str:
    verdict, mean = p["verdict"], p["verdict"]["mean"]
    decided = "" if verdict["of"] == "all steps" else f" ({verdict['of']})"
    low, high = p["band95"] if verdict["nees"] is not None else (np.inf, -np.inf)
    nees = [p["nees"][step] for step in (*(s - 1 for s in STEPS if s < len(p["nees"])), -1)]
    cells = [
        f"`{name}`{'' if 'drift' in p else ' †'}",
        f"{p['seeds']} × {p['runs'] / seeds:g}",
        _short(mean["nees"]),
        _factor(mean),
        f"{verdict['word']}{decided}",
        "; ".join(p[key]["word"] for key in ("one_scale", "drift") if key in p) or "–",
        f"{_short(verdict['never_lost']['nees'])}, {_factor(verdict['never_lost'])}",
        " ".join(f"**{_short(n)}**" if low <= n <= high else _short(n) for n in nees),
        f"{p['lost']:.2%}",
        f"{verdict['lost']:.2%}",
        _short(p["nees_not_lost"]),
        _short(p["nees_median"]),
        f"{p['rmse']:.3f}",
        f"{p['sigma']:.3f}",
        f"{p['nis_per_dof']:.2f}",
    ]
    return f"| {' | '.join(cells)} |"


def recommended(results: Results, scenarios: Iterable[str]) -> str:
    """The table of the paper's filter and the recommended one, by scenario."""
    rows = [
        "| scenario | filter | NEES: all; last | σ should be × | verdict | lost | RMSE, σ, m |",
        "|---|---|---|---|---|---|---|",
    ]
    for scenario in scenarios:
        for name, seeds in results[scenario].items():
            label = "recommended" if "+scene50" in name else name.split("/")[0]
            if label in ("robocentric", "recommended"):
                rows.append(f"| `{scenario}` | `{label}` {_cells(pooled(seeds))}")
    return "\n".join(rows)


def _cells(p: dict[str, Any]) -> str:
    verdict, mean = p["verdict"], p["verdict"]["mean"]
    decided = "" if verdict["of"] == "all steps" else f" ({verdict['of']})"
    return (
        f"| {_short(mean['nees'])}; {_short(p['nees'][-1])} | {_factor(mean, 2)} "
        f"| {verdict['word']}{decided} | {p['lost']:.1%} | {p['rmse']:.3f}, {p['sigma']:.3f} |"
    )


def _factor(found: dict[str, Any], digits: int = 3) -> str:
    factor, (low, high) = found["sigma_factor"], found["interval99"]
    if factor is None:
        return _short(factor)
    told = "–" if high is None else f"{high:.{digits}f}"
    return f"{factor:.{digits}f} [{low:.{digits}f}, {told}]"


def named(seeds: Seeds) -> str:
    """`0–9, 12`."""
    numbers = sorted(map(int, seeds))
    starts = [numbers[0], *(b for a, b in pairwise(numbers) if b > a + 1)]
    ends = [*(a for a, b in pairwise(numbers) if b > a + 1), numbers[-1]]
    ranges = zip(starts, ends, strict=True)
    return ", ".join(f"{a}–{b}" if b > a else str(a) for a, b in ranges)


def _short(value: float | None) -> str:
    if value is None or np.isnan(value):
        return "–"
    return f"{value:.2f}" if value < 100 else f"{value:.3g}"


def read(path: Path) -> Results:
    """The results of this layout that a file holds; none where there is no file."""
    found: Results = json.loads(path.read_text()) if path.exists() else {}
    return {
        scenario: {
            name: {n: seed for n, seed in seeds.items() if seed.get("layout") == LAYOUT}
            for name, seeds in filters.items()
        }
        for scenario, filters in found.items()
    }


def add_to(path: Path, scenario: str, name: str, seed: int, found: dict[str, Any]) -> Seeds:
    """Read the file anew, as others add to it, and write it with one seed more."""
    path.parent.mkdir(parents=True, exist_ok=True)
    results = read(path)
    seeds = results.setdefault(scenario, {}).setdefault(name, {})
    seeds[str(seed)] = found
    with write_atomically(path) as temporary:
        temporary.write_text(json.dumps(results, separators=(",", ":"), allow_nan=False) + "\n")
    return seeds


def main(options: Options) -> None:
    """Measure and write."""
    names = [f"{f}/{landmarks}" for f in options.filters for landmarks in options.landmarks]
    for scenario_name in () if options.page else options.scenarios:
        scenario = jaxslam.scenario(scenario_name)
        for name in names:
            for seed in options.seeds:
                done = read(options.out).get(scenario_name, {}).get(name, {})
                if done.get(str(seed), {}).get("runs") == options.runs:
                    continue
                found = measure(scenario, name, seed, options)
                add_to(options.out, scenario_name, name, seed, found)
                print(scenario_name, _row(name, pooled({str(seed): found}), 1), flush=True)
    results = read(options.out)
    with write_atomically(options.docs) as path:
        path.write_text(page(results))
    if options.page:
        write_table(README, MARK, recommended(results, IN_README))
        write_table(RESULTS, MARK, recommended(results, results))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
