"""Filters side by side: NEES, RMSE, σ/RMSE and time per step at the end of the same runs.

    python benchmarks/comparison.py parametrizations
    python benchmarks/comparison.py observability

The first writes `comparison.json` and the tables of `docs/comparison.md`, the second
`observability.json`, whose numbers stand in `docs/rivals.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from benchmark import RESULTS, OfRuns, at_end, number, run_one, table

import jaxslam
from jaxslam.consistency import Study

NUMBERS, PARAMETRIZATIONS = "<!-- comparison.py -->", "<!-- all parametrizations -->"


@dataclass(frozen=True, kw_only=True)
class Parametrizations(OfRuns):
    """Every landmark parametrization in every frame."""

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


@dataclass(frozen=True, kw_only=True)
class Observability(OfRuns):
    """Do filters that respect what cannot be observed help a single camera?

    Every frame plain, observability-constrained (`+oc`), with first-estimate Jacobians (`+fej`) and
    invariant. Rows that the file has with as many runs are not run again.
    """

    filters: tuple[str, ...] = (
        "robocentric/inverse_scaling", "robocentric+oc/inverse_scaling",
        "world/inverse_scaling", "world+oc/inverse_scaling", "world+fej/inverse_scaling",
        "world+fej2/inverse_scaling", "world+decoupled/inverse_scaling",
        "invariant/inverse_scaling", "robocentric/inverse_depth", "robocentric+oc/inverse_depth",
        "world/inverse_depth", "world+oc/inverse_depth",
    )  # fmt: skip
    """`filter/landmarks`."""
    scenarios: tuple[str, ...] = (
        "matched", "matched-loose", "matched-forward", "matched-forward-loose", "circle",
    )  # fmt: skip
    chunk: int = 100
    out: Path = RESULTS / "observability.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """Add to `{scenario: {"filter/landmarks": numbers at the end}}`."""
        yield from self.each(self._measured, self.scenarios, self.filters, ("scenarios",))

    def _measured(self, scenario: str, name: str) -> dict[str, Any]:
        study, found = self.study(jaxslam.scenario(scenario), name)
        seconds = round(found["seconds"]["run"] / self.runs, 4)
        return at_end(found) | {"along": _along(study, name), "seconds_per_run": seconds}


def _along(study: Study, name: str) -> dict[str, float]:
    """Median over the runs of the last step's |error| and σ along the nominal direction of
    motion, m: with a single camera both are those of the scale."""
    axis = int(np.argmax(np.abs(study.scenario.velocity[: study.scenario.geometry.point_dim])))
    records = [study.store.load(name, chunk, ("error", "variance")) for chunk in study.chunks]
    error, variance = (
        np.concatenate([record[key][:, -1, axis] for record in records])
        for key in ("error", "variance")
    )
    return {
        "error": round(float(np.nanmedian(np.abs(error))), 4),
        "sigma": round(float(np.nanmedian(np.sqrt(variance))), 4),
    }


if __name__ == "__main__":
    run_one(Parametrizations, Observability)
