"""Every landmark parametrization in every frame: NEES, RMSE, σ/RMSE and time per step.

`python benchmarks/comparison.py` runs them all, 1000 runs each, and writes `comparison.json`
and `docs/comparison.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from benchmark import RESULTS, OfRuns, at_end, number, table

import jaxslam

NUMBERS, PARAMETRIZATIONS = "<!-- comparison.py -->", "<!-- all parametrizations -->"


@dataclass(frozen=True, kw_only=True)
class Comparison(OfRuns):
    """Parametrizations in frames in worlds."""

    scenarios: tuple[str, ...] = ("matched", "matched-loose", "matched-forward", "circle")
    """Simulated worlds."""
    filters: tuple[str, ...] = ("robocentric", "world")
    landmarks: tuple[str, ...] = tuple(jaxslam.LANDMARKS)
    """Landmark parametrizations; all by default."""
    runs: int = 1000
    chunk: int = 100
    out: Path = RESULTS / "comparison.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`{"scenarios": {scenario: {"filter/landmarks": numbers at the end}}}` and what it is of,
        after every filter."""
        of = {"schema": 1, "version": jaxslam.__version__, "runs": self.runs, "seed": self.seed}
        of["device"] = jax.devices()[0].device_kind
        names = [f"{frame}/{x}" for x in self.landmarks for frame in self.filters]
        for results in self.each(self._measured, self.scenarios, names, ("scenarios",)):
            yield of | {"scenarios": results["scenarios"]}

    def _measured(self, name: str, slam: str) -> dict[str, Any]:
        scenario = jaxslam.scenario(name)
        _, found = self.study(scenario, slam)
        row = at_end(found)
        rmse, sigma = row["rmse"], row.pop("sigma")
        microseconds = 1e6 * found["seconds"]["run"] / self.runs / scenario.steps
        return row | {
            "sigma_over_rmse": sigma / rmse if rmse and sigma else None,
            "microseconds_per_step": round(microseconds, 1),
        }

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "comparison.md", NUMBERS, as_table(results["scenarios"], results["runs"])
        yield "comparison.md", PARAMETRIZATIONS, parametrizations()


def _cell(found: dict[str, Any] | None, runs: int) -> str:
    if found is None:
        return "–"
    diverged = f" ({found['diverged']} diverged)" if found["diverged"] else ""
    few = "" if found["runs"] == runs else " †"
    ratio = number(found["sigma_over_rmse"])
    return f"{number(found['nees'])}; {found['lost']:.0%}{diverged}; {ratio}{few}"


def parametrizations() -> str:
    """All of them, as a Markdown table."""
    header = "name", "parameters", "numbers, spatial (planar)", "point", "source"
    all_of_them = jaxslam.LANDMARKS.values()
    return table(
        header,
        (
            (f"`{p.name}`", p.parameters, f"{p.size(3)} ({p.size(2)})", p.point, p.source)
            for p in all_of_them
        ),
    )


def as_table(results: dict[str, dict[str, Any]], runs: int) -> str:
    """A row for each filter, a column for each scenario; fewer runs are marked."""
    rows, counts = [], {one["runs"] for filters in results.values() for one in filters.values()}
    for name in dict.fromkeys(name for filters in results.values() for name in filters):
        cells = (_cell(filters.get(name), runs) for filters in results.values())
        rows.append([name.replace("/", " "), *cells])
    few = ", ".join(str(n) for n in sorted(counts - {runs})) or "none"
    told = table(["frame, landmark", *(f"`{name}`" for name in results)], rows)
    return f"{told}\n\n†: fewer runs, {few} instead of {runs}."


if __name__ == "__main__":
    Comparison.run()
