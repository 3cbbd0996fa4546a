"""Every landmark parametrization in every frame: NEES, RMSE, σ/RMSE and time per step.

`python benchmarks/comparison.py` runs them all, 1000 runs each, and writes `comparison.json`
and `docs/comparison.md`.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from benchmark import RESULTS, Benchmark, number, table, write_page

import jaxslam
from jaxslam.landmarks import table as landmark_table


@dataclass(frozen=True, kw_only=True)
class Comparison(Benchmark):
    """Parametrizations in frames in worlds."""

    scenarios: tuple[str, ...] = ("matched", "matched-loose", "matched-forward", "circle")
    """Simulated worlds."""
    filters: tuple[str, ...] = ("robocentric", "world")
    """Frames."""
    landmarks: tuple[str, ...] = tuple(jaxslam.LANDMARKS)
    """Landmark parametrizations; all by default."""
    runs: int = 1000
    """Runs of every filter."""
    seed: int = 0
    out: Path = RESULTS / "comparison.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`{"scenarios": {scenario: {"filter/landmarks": numbers at the end}}}` and what it is of,
        after every filter."""
        results: dict[str, dict[str, Any]] = {name: {} for name in self.scenarios}
        of = {"schema": 1, "version": jaxslam.__version__, "runs": self.runs, "seed": self.seed}
        of["device"] = jax.devices()[0].device_kind
        # Filter by filter, so that scenarios of one shape share its compiled program.
        for landmarks, frame in itertools.product(self.landmarks, self.filters):
            for name in self.scenarios:
                numbers = _measure(name, frame, landmarks, self)
                results[name][f"{frame}/{landmarks}"] = numbers
                print(name, f"{frame}/{landmarks}", json.dumps(numbers), flush=True)
            yield {**of, "scenarios": results}

    def report(self, results: dict[str, Any]) -> None:
        write_page(self.docs / "comparison.md", page(results))


def _measure(name: str, frame: str, landmarks: str, options: Comparison) -> dict[str, Any]:
    scenario = jaxslam.scenario(name)
    filters = jaxslam.make_filters(scenario, [frame], [landmarks])
    study = jaxslam.monte_carlo(scenario, filters, runs=options.runs, seed=options.seed)
    (f,) = jaxslam.summarise(study)["filters"].values()
    rmse, sigma = f["rmse"]["position"][-1], f["sigma"]["position"][-1]
    microseconds = 1e6 * f["seconds"]["run"] / options.runs / scenario.steps
    return {
        "runs": options.runs,
        "dof": f["dof"],
        "band95": f["band95"],
        "nees": f["nees"][-1],
        "nees_median": f["nees_median"][-1],
        "inside": f["inside"],
        "lost": f["lost"][-1],
        "diverged": f["diverged"],
        "rmse": rmse,
        "sigma_over_rmse": sigma / rmse if rmse and sigma else None,
        "microseconds_per_step": round(microseconds, 1),
    }


def page(summary: dict[str, Any]) -> str:
    """The Markdown page."""
    parts = [
        "# Parametrization × frame × scenario",
        "Made by `python benchmarks/comparison.py`; do not edit. "
        f"{summary['runs']} runs of every filter (fewer where a row says so) on the same worlds, "
        f"seed {summary['seed']}, {summary['device']}, float64. A consistent filter has a mean "
        "NEES in the 95 % band; "
        "*inside* is the share of steps at which it is there; a run is *lost* when its NEES is "
        "above the 99.99 % quantile of χ². NEES, lost, RMSE and σ are those of the last step; the "
        "time is that of one step of one run in a batch, on a machine that other programs share.",
        "## The parametrizations",
        landmark_table(jaxslam.LANDMARKS.values()),
    ]
    names = list(dict.fromkeys(name for r in summary["scenarios"].values() for name in r))
    for scenario, results in summary["scenarios"].items():
        low, high = next(iter(results.values()))["band95"]
        parts += [
            f"## `{scenario}` (95 % band {low:.3f}–{high:.3f})",
            _rows(results, names, summary["runs"]),
        ]
    return "\n\n".join(parts) + "\n"


def _rows(results: dict[str, Any], names: list[str], runs: int) -> str:
    header = "filter", "NEES mean", "median", "inside", "lost", "RMSE m", "σ/RMSE", "µs a step"
    rows = []
    for name in names:
        if name not in results:
            rows.append([name, "not measured", *["–"] * 6])
            continue
        f = results[name]
        few = "" if f["runs"] == runs else f" ({f['runs']} runs)"
        diverged = f" ({f['diverged']} diverged)" if f["diverged"] else ""
        rows.append(
            [
                f"{name}{few}",
                *(number(f[key]) for key in ("nees", "nees_median")),
                f"{f['inside']:.0%}",
                f"{f['lost']:.1%}{diverged}",
                number(f["rmse"], ".3f"),
                number(f["sigma_over_rmse"]),
                f"{f['microseconds_per_step']:.0f}",
            ]
        )
    return table(header, rows)


if __name__ == "__main__":
    Comparison.run()
