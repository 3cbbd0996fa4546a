"""Every landmark parametrization in every frame: NEES, RMSE, σ/RMSE and time per step.

`python benchmarks/comparison.py` runs them all, 1000 runs each, and writes
`benchmarks/results/comparison.json`, `docs/comparison.png` and `docs/comparison.md`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

import jaxslam
from jaxslam._runtime.files import write_atomically, write_json
from jaxslam.landmarks import table as landmark_table
from jaxslam.plots.comparison import plot_comparison


@dataclass(frozen=True)
class Options:
    """What to measure."""

    scenarios: tuple[str, ...] = ("matched", "matched-loose", "matched-forward", "circle")
    """Simulated worlds."""
    filters: tuple[str, ...] = ("robocentric", "world")
    """Frames."""
    landmarks: tuple[str, ...] = tuple(jaxslam.LANDMARKS)
    """Landmark parametrizations; all by default."""
    runs: int = 1000
    """Runs of every filter."""
    seed: int = 0
    out: Path = Path("benchmarks/results")
    """Folder of comparison.json."""
    docs: Path = Path("docs")
    """Folder of comparison.md and comparison.png."""
    page_only: bool = False
    """Only write page and figure again."""


def measure(options: Options) -> Iterator[dict[str, dict[str, Any]]]:
    """`{scenario: {"filter/landmarks": numbers at the end}}`, yielded after every filter."""
    results: dict[str, dict[str, Any]] = {name: {} for name in options.scenarios}
    # Filter by filter, so that scenarios of one shape share its compiled program.
    for landmarks in options.landmarks:
        for frame in options.filters:
            for name in options.scenarios:
                numbers = _measure(name, frame, landmarks, options)
                results[name][f"{frame}/{landmarks}"] = numbers
                print(name, f"{frame}/{landmarks}", json.dumps(numbers), flush=True)
            yield results


def _measure(name: str, frame: str, landmarks: str, options: Options) -> dict[str, Any]:
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
        "![Mean NEES and σ/RMSE of every parametrization in both frames](comparison.png)",
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
    lines = [
        "| filter | NEES mean | median | inside | lost | RMSE m | σ/RMSE | µs a step |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        if name not in results:
            lines.append(f"| {name} | not measured |" + " – |" * 6)
            continue
        f = results[name]
        cells = (
            _number(f["nees"], "{:.2f}"),
            _number(f["nees_median"], "{:.2f}"),
            f"{f['inside']:.0%}",
            f"{f['lost']:.1%}" + (f" ({f['diverged']} diverged)" if f["diverged"] else ""),
            _number(f["rmse"], "{:.3f}"),
            _number(f["sigma_over_rmse"], "{:.2f}"),
            f"{f['microseconds_per_step']:.0f}",
        )
        few = "" if f["runs"] == runs else f" ({f['runs']} runs)"
        lines.append(f"| {name}{few} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None, form: str) -> str:
    if value is None:
        return "–"
    return f"{value:.1e}" if abs(value) >= 1e4 else form.format(value)


def main(options: Options) -> None:
    """Measure, and write the three files after every filter."""
    if options.page_only:
        write(json.loads((options.out / "comparison.json").read_text()), options)
        return
    import jax

    for folder in (options.out, options.docs):
        folder.mkdir(parents=True, exist_ok=True)
    for results in measure(options):
        summary = {
            "schema": 1,
            "version": jaxslam.__version__,
            "runs": options.runs,
            "seed": options.seed,
            "device": jax.devices()[0].device_kind,
            "scenarios": results,
        }
        write(summary, options)


def write(summary: dict[str, Any], options: Options) -> None:
    """The JSON file, the figure and the page."""
    write_json(options.out / "comparison.json", summary)
    plot_comparison(summary["scenarios"], options.docs / "comparison.png")
    with write_atomically(options.docs / "comparison.md") as path:
        path.write_text(page(summary))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
