"""Consistency over many seeds: which share of (seed, step) pairs has its mean NEES in the band.

    python benchmarks/consistency.py --scenarios matched-tight --seeds 10 --runs 1000

Writes one JSON file a scenario, with the mean NEES of every seed and step.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import jaxslam
from jaxslam.files import write_atomically


@dataclass(frozen=True)
class Options:
    """What to measure."""

    scenarios: tuple[str, ...] = ("matched-tight", "matched-6dof-tight")
    """Built-in scenarios."""
    landmarks: tuple[str, ...] = ("inverse_scaling", "inverse_depth")
    """Landmark parametrizations."""
    filters: tuple[str, ...] = ("robocentric",)
    """Filters."""
    runs: int = 1000
    """Runs of every seed."""
    seeds: int = 10
    """How many seeds."""
    first_seed: int = 0
    """Seeds are first_seed, first_seed + 1, …"""
    steps: int | None = None
    """Filter steps; the scenario's by default."""
    out: Path = Path("benchmarks/results")
    """Folder of the JSON files."""


def measure(name: str, options: Options) -> dict:
    """All seeds of one scenario."""
    fields = {} if options.steps is None else {"steps": options.steps}
    scenario = jaxslam.scenario(name, **fields)
    filters = jaxslam.make_filters(
        scenario.rig, options.filters, options.landmarks, scenario.calibration
    )
    seeds = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        study = jaxslam.monte_carlo(scenario, filters, runs=options.runs, seed=seed)
        summary = jaxslam.summarise(study)["filters"]
        seeds.append(summary)
        print(name, "seed", seed, {k: f"{f['inside']:.0%}" for k, f in summary.items()}, flush=True)
    return {
        "scenario": name,
        "runs": options.runs,
        "seeds": [options.first_seed, options.first_seed + options.seeds - 1],
        "filters": {key: _pooled([summary[key] for summary in seeds]) for key in filters},
    }


def _pooled(seeds: list[dict]) -> dict:
    nees = np.array([seed["nees"] for seed in seeds], float)
    band = np.array([seed["band95"] for seed in seeds])
    inside = (nees >= band[:, :1]) & (nees <= band[:, 1:])
    return {
        "inside": float(inside.mean()),
        "nees": nees.mean(axis=0).round(4).tolist(),
        "nees_by_seed_at_the_end": nees[:, -1].round(4).tolist(),
        "median_at_the_end": float(np.mean([seed["nees_median"][-1] for seed in seeds])),
        "not_lost_at_the_end": float(np.mean([seed["nees_not_lost"][-1] for seed in seeds])),
        "lost_at_the_end": float(np.mean([seed["lost"][-1] for seed in seeds])),
        "diverged": sum(seed["diverged"] for seed in seeds),
        "position_rmse_at_the_end": float(
            np.sqrt(np.mean([seed["rmse"]["position"][-1] ** 2 for seed in seeds]))
        ),
        "position_sigma_at_the_end": float(
            np.sqrt(np.mean([seed["sigma"]["position"][-1] ** 2 for seed in seeds]))
        ),
        "nis_per_dof": float(
            np.sum([seed["nis"] for seed in seeds]) / np.sum([seed["nis_dof"] for seed in seeds])
        ),
    }


def main() -> None:
    """Measure and write."""
    options = tyro.cli(Options, description=__doc__)
    for name in options.scenarios:
        result = measure(name, options)
        options.out.mkdir(parents=True, exist_ok=True)
        with write_atomically(options.out / f"{name}.json") as path:
            path.write_text(json.dumps(result, indent=1) + "\n")
        for key, pooled in result["filters"].items():
            print(
                f"{name} {key}: {pooled['inside']:.1%} of (seed, step) pairs in the band, mean "
                f"NEES at the end {pooled['nees'][-1]:.3f}, lost {pooled['lost_at_the_end']:.2%}"
            )


if __name__ == "__main__":
    main()
