"""How often a verdict is wrong, and how often it finds what is: NEES drawn as a filter's are.

    python benchmarks/verdicts.py

Studies of runs of 12 steps whose errors are independent (`white`), correlated by .98 from step to
step, or of one step. Writes `verdicts.json` and the table in `docs/consistency.md`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, Benchmark, table, write_table

from jaxslam.statistics import PowerSums, Tally, not_disproved
from jaxslam.statistics.verdict import THIRDS

BEGIN = "<!-- how often a verdict is wrong -->"
STEPS = 12
SERIES = {"white": (STEPS, 0.0), "correlated": (STEPS, 0.98), "one step": (1, 0.0)}
"""Steps, and the correlation of errors from one to the next."""
WRONG = (1.1, 1.3, 2.0)
"""Factors that σ is too small by; too large by the same ones."""
SHARE, TIMES = 0.01, 20.0
"""Of heavy tails: so many runs have so many times the variance."""


@dataclass(frozen=True, kw_only=True)
class Verdicts(Benchmark):
    """Studies that are drawn, and what is said of them."""

    runs: tuple[int, ...] = (1, 2, 3, 5, 10, 30, 100, 200, 300, 1000)
    """Runs of a study."""
    dof: tuple[int, ...] = (1, 2, 3, 6)
    """Degrees of freedom of a NEES."""
    studies: int = 20000
    """Of a right filter; a fifth of them of one that is wrong, a tenth of those of 1000 runs."""
    out: Path = RESULTS / "verdicts.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        rng = np.random.default_rng(0)
        yield {
            "by_factor": by_factor(self, rng),
            "ramps": ramps(self, rng),
            "heavy": heavy(self, rng),
        }

    def report(self, results: dict[str, Any]) -> None:
        write_table(self.docs / "consistency.md", BEGIN, as_table(results))


def series(
    rng: np.random.Generator, runs: int, dof: int, steps: int, correlation: float
) -> np.ndarray:
    """NEES of a right filter, (runs, steps): χ² at every step, its errors correlated so."""
    if not correlation:
        return rng.chisquare(dof, (runs, steps))
    error, nees = rng.normal(size=(runs, dof)), np.empty((runs, steps))
    for step in range(steps):
        nees[:, step] = np.sum(error**2, axis=1)
        error *= correlation
        error += math.sqrt(1 - correlation**2) * rng.normal(size=error.shape)
    return nees


def drawn(
    rng: np.random.Generator,
    dof: int,
    steps: int,
    correlation: float,
    scale: float | np.ndarray,
    runs: int,
) -> np.ndarray:
    """The NEES of so many runs, so many times as large as a right filter's at every step."""
    return scale * series(rng, runs, dof, steps, correlation)


def tallies(nees: np.ndarray, dof: int) -> Iterator[Tally]:
    """`Tally.of` each study of NEES (studies, runs, steps), but for its lost runs; all at once."""
    count, runs, steps = nees.shape
    third = len(THIRDS) * np.arange(steps) // steps
    parts = [nees.mean(axis=2), nees[..., -1]]
    if steps >= len(THIRDS):
        parts += [nees[..., third == i].mean(axis=2) for i in range(len(THIRDS))]
    powers = np.array([[np.sum(x**k, axis=1) for k in (1, 2, 3)] for x in parts])
    for study in range(count):
        average, end, *rest = (PowerSums(runs, *map(float, x)) for x in powers[..., study])
        first, second, last = rest or (PowerSums(),) * 3
        yield Tally(dof, runs, 0, 0, average, end, average, thirds=(first, second, last))


def words(draw: Callable[[int], np.ndarray], dof: int, runs: int, studies: int) -> dict[str, float]:
    """Shares of the words of so many studies; `draw` makes NEES of so many runs."""
    found: Counter[str] = Counter()
    at_once = max(1, 100000 // runs)
    for start in range(0, studies, at_once):
        count = min(at_once, studies - start)
        for tally in tallies(draw(count * runs).reshape(count, runs, -1), dof):
            found[tally.decisive().word] += 1
    return {word: number / studies for word, number in sorted(found.items())}


def wrong_share(found: dict[str, float]) -> float:
    """Studies that are called inconsistent."""
    return sum(share for word, share in found.items() if not not_disproved({"word": word}))


def by_factor(options: Verdicts, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Words where σ is right, and where all of it is wrong by a factor."""
    rows = []
    for dof in options.dof:
        for runs in options.runs:
            for name, (steps, correlation) in SERIES.items():
                studies = options.studies // (10 if runs >= 1000 else 1)
                found = {}
                for factor in (1.0, *WRONG, *(1 / x for x in WRONG)):
                    draw = partial(drawn, rng, dof, steps, correlation, factor**2)
                    count = studies if factor == 1 else max(studies // 5, 1)
                    found[f"{factor:.3g}"] = words(draw, dof, runs, count)
                row = {"dof": dof, "runs": runs, "series": name, "studies": studies}
                rows.append(row | {"words": found})
                print(dof, runs, name, f"{wrong_share(found['1']):.4f}", flush=True)
    return rows


def ramps(options: Verdicts, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Opposite faults: NEES/dof from .7 at the beginning to 1.3 at the end, of 3 dof."""
    rows = []
    for runs in options.runs:
        for name in ("white", "correlated"):
            steps, correlation = SERIES[name]
            draw = partial(drawn, rng, 3, steps, correlation, np.linspace(0.7, 1.3, steps))
            studies = max(options.studies // (50 if runs >= 1000 else 5), 1)
            rows.append({"runs": runs, "series": name, "words": words(draw, 3, runs, studies)})
    return rows


def heavy(options: Verdicts, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Heavy tails: how often the interval of the mean holds the truth, of 3 dof.

    `covered`: it does; `covered_or_not_told`: it does, or the word is `cannot tell`.
    """
    truth, rows = 1 - SHARE + SHARE * TIMES, []
    for runs in options.runs:
        for name, (steps, correlation) in SERIES.items():
            studies, covered, told = max(options.studies // 10, 1), 0, 0
            for _ in range(studies):
                nees = series(rng, runs, 3, steps, correlation)
                nees[rng.random(runs) < SHARE] *= TIMES
                tally = Tally.of(nees, 3)
                low, high = tally.looks()[0].interval
                covered += low <= truth <= high
                told += low <= truth <= high or tally.decisive().word == "cannot tell"
            shares = {"covered": covered / studies, "covered_or_not_told": told / studies}
            rows.append({"runs": runs, "series": name, "studies": studies} | shares)
    return rows


def as_table(results: dict[str, Any]) -> str:
    """The worst of all degrees of freedom and series, by the number of runs."""
    header = (
        "runs",
        "consistent filter called inconsistent",
        "σ wrong by 1.3 called consistent",
        "σ wrong by 1.1 found",
        "by 1.3",
        "by 2",
        "opposite faults found",
        "heavy tails, truth in interval",
    )
    lines = []
    for runs in sorted({row["runs"] for row in results["by_factor"]}):
        cells = [row["words"] for row in results["by_factor"] if row["runs"] == runs]
        missed = [w[f].get("consistent", 0.0) for w in cells for f in ("1.3", "0.769")]
        found = [
            _range([wrong_share(w[f"{f:.3g}"]) for w in cells for f in (x, 1 / x)]) for x in WRONG
        ]
        ramp = [wrong_share(row["words"]) for row in results["ramps"] if row["runs"] == runs]
        held = [row["covered"] for row in results["heavy"] if row["runs"] == runs]
        right = f"{max(wrong_share(w['1']) for w in cells):.2%}"
        lines.append((runs, right, f"{max(missed):.2%}", *found, _range(ramp), _range(held)))
    return table(header, lines)


def _range(shares: list[float]) -> str:
    low, high = f"{min(shares):.0%}", f"{max(shares):.0%}"
    return low if low == high else f"{low.removesuffix('%')}–{high}"


if __name__ == "__main__":
    Verdicts.run()
