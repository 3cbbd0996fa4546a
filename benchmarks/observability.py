"""Filters that respect what cannot be observed, beside those that do not, with a single camera.

`python benchmarks/observability.py` runs every frame plain, observability-constrained (`+oc`), with
first-estimate Jacobians (`+fej`) and invariant, and writes `benchmarks/results/observability.json`.
Rows that the file has with as many runs are not run again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import write_json
from jaxslam.consistency import Study


@dataclass(frozen=True)
class Options:
    """What to measure."""

    filters: tuple[str, ...] = (
        "robocentric/inverse_scaling",
        "robocentric+oc/inverse_scaling",
        "world/inverse_scaling",
        "world+oc/inverse_scaling",
        "world+fej/inverse_scaling",
        "invariant/inverse_scaling",
        "robocentric/inverse_depth",
        "robocentric+oc/inverse_depth",
        "world/inverse_depth",
        "world+oc/inverse_depth",
    )
    """`filter/landmarks`."""
    scenarios: tuple[str, ...] = (
        "matched",
        "matched-loose",
        "matched-forward",
        "matched-forward-loose",
        "circle",
    )
    runs: int = 200
    """Runs of every filter."""
    seed: int = 0
    out: Path = Path("benchmarks/results/observability.json")


def measure(options: Options, rows: dict[str, dict[str, Any]]) -> Iterator[None]:
    """Add to `{scenario: {"filter/landmarks": numbers at the end}}`, and yield after every row."""
    # Filter by filter, so that scenarios of one shape share its compiled program.
    for name in options.filters:
        for scenario in options.scenarios:
            done = rows.setdefault(scenario, {})
            if done.get(name, {}).get("runs") == options.runs:
                continue
            done[name] = _measure(name, scenario, options)
            print(scenario, name, json.dumps(done[name]), flush=True)
            yield


def _measure(name: str, scenario_name: str, options: Options) -> dict[str, Any]:
    scenario = jaxslam.scenario(scenario_name)
    kind, landmarks = name.split("/")
    filters = jaxslam.make_filters(scenario, [kind], [landmarks])
    study = jaxslam.monte_carlo(scenario, filters, runs=options.runs, seed=options.seed)
    (f,) = jaxslam.summarise(study)["filters"].values()
    return {
        "runs": options.runs,
        "seed": options.seed,
        "band95": f["band95"],
        "nees": f["nees"][-1],
        "nees_median": f["nees_median"][-1],
        "nees_not_lost": f["nees_not_lost"][-1],
        "lost": f["lost"][-1],
        "diverged": f["diverged"],
        "inside": f["inside"],
        "rmse": f["rmse"]["position"][-1],
        "sigma": f["sigma"]["position"][-1],
        "along": _along(study, name),
        "seconds_per_run": round(f["seconds"]["run"] / options.runs, 4),
    }


def _along(study: Study, name: str) -> dict[str, float]:
    """Median over the runs of the last step's |error| and σ along the nominal direction of
    motion, m: with a single camera both are those of the scale."""
    axis = int(np.argmax(np.abs(study.scenario.velocity[: study.scenario.world.point_dim])))
    records = [study.store.load(name, chunk, ("error", "variance")) for chunk in study.chunks]
    error, variance = (
        np.concatenate([record[key][:, -1, axis] for record in records])
        for key in ("error", "variance")
    )
    return {
        "error": round(float(np.nanmedian(np.abs(error))), 4),
        "sigma": round(float(np.nanmedian(np.sqrt(variance))), 4),
    }


def table(rows: dict[str, dict[str, Any]]) -> str:
    """All scenarios as one Markdown table."""
    lines = [
        "| scenario | filter | NEES mean / median | lost | inside | RMSE / σ, m "
        "| along the path: median error / σ, m |",
        "|---|---|---|---|---|---|---|",
    ]
    for scenario, filters in rows.items():
        for i, (name, f) in enumerate(filters.items()):
            cells = (
                f"`{scenario}`" if i == 0 else "",
                name,
                f"{_number(f['nees'])} / {_number(f['nees_median'])}",
                f"{f['lost']:.1%}",
                f"{f['inside']:.0%}",
                f"{_number(f['rmse'], 3)} / {_number(f['sigma'], 3)}",
                f"{f['along']['error']:.3f} / {f['along']['sigma']:.3f}",
            )
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None, digits: int = 2) -> str:
    if value is None:
        return "–"
    return f"{value:.1e}" if value >= 1e4 else f"{value:.{digits}f}"


def main(options: Options) -> None:
    """Measure what is missing, write the file after every row, print the table."""
    rows = json.loads(options.out.read_text())["scenarios"] if options.out.exists() else {}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for _ in measure(options, rows):
        write_json(options.out, {"schema": 1, "scenarios": rows})
    print(table(rows))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
