"""Time of one step of every filter, all on the same batch of runs, against the first one's.

    python benchmarks/cost.py

Compile time apart; the filters take turns, and the median of the turns counts.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import write_json
from jaxslam.consistency.montecarlo import filter_run
from jaxslam.simulation import Room, sensor_of, sightings, simulate


@dataclass(frozen=True)
class Options:
    """What to measure."""

    scenario: str = "matched-loose"
    """Built-in scenario."""
    filters: tuple[str, ...] = (
        "robocentric",
        "scale_gauge",
        "robocentric+oc",
        "scale_gauge+lag10",
        "scale_gauge+lag20",
        "scale_gauge+directions9",
        "scale_gauge+mixture9",
        "scale_gauge+mixture17",
    )
    """Filters; times are relative to the first."""
    landmarks: str = "inverse_scaling"
    """Landmark parametrization."""
    batch: int = 25
    """Runs in one batch."""
    turns: int = 7
    """Timed calls of every filter."""
    out: Path = Path("benchmarks/results")
    """Folder of cost.json."""


@eqx.filter_jit
def _records(slam, room: Room, sensor, runs) -> dict[str, jax.Array]:
    return jax.vmap(lambda run: filter_run(slam, room, sensor, run)[0])(runs)


def main() -> None:
    """Measure and write."""
    options = tyro.cli(Options, description=__doc__)
    jax.config.update("jax_enable_x64", True)
    scenario = jaxslam.scenario(options.scenario)
    keys = jax.random.split(jax.random.key(0), options.batch)
    runs = jax.jit(jax.vmap(partial(simulate, scenario)))(keys)
    most = jax.tree.map(lambda x: int(np.max(x)), jax.vmap(sightings)(runs))
    room = Room(most.landmarks, most.first, most.known, max(1, most.new))
    sensor = sensor_of(scenario)

    compiled, compile_seconds = {}, {}
    for name in options.filters:
        (slam,) = jaxslam.make_filters(scenario, [name], [options.landmarks]).values()
        start = time.perf_counter()
        batch = _records.lower(slam, room, sensor, runs).compile()  # ty: ignore[missing-attribute]
        compiled[name] = partial(batch, slam, room, sensor)
        compile_seconds[name] = time.perf_counter() - start
        jax.block_until_ready(compiled[name](runs))
    seconds = {name: [] for name in compiled}
    for _ in range(options.turns):
        for name, function in compiled.items():
            start = time.perf_counter()
            jax.block_until_ready(function(runs))
            seconds[name].append(time.perf_counter() - start)

    base = np.array(seconds[options.filters[0]])
    result = {
        name: {
            "microseconds_per_step": round(
                1e6 * float(np.median(turns)) / options.batch / scenario.steps, 1
            ),
            "relative": round(float(np.median(np.array(turns) / base)), 2),
            "compile_seconds": round(compile_seconds[name], 1),
        }
        for name, turns in seconds.items()
    }
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "cost.json", {"scenario": scenario.name, "filters": result})
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
