"""Time of one step of every filter, all on the same batch of runs, against the first one's.

    python benchmarks/cost.py

Compile time apart; the filters take turns, and the median of the turns counts.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from benchmark import RESULTS, Benchmark

import jaxslam
from jaxslam.consistency import draw, filter_run
from jaxslam.simulation import Room


@eqx.filter_jit
def _records(slam, room: Room, sensor, runs) -> dict[str, jax.Array]:
    return jax.vmap(lambda run: filter_run(slam, room, sensor, run)[0])(runs)


@dataclass(frozen=True, kw_only=True)
class Cost(Benchmark):
    """Times of a step."""

    scenario: str = "matched-loose"
    filters: tuple[str, ...] = (
        "robocentric",
        "scale_gauge",
        "robocentric+oc",
        "scale_gauge+directions9",
        "scale_gauge+mixture9",
        "scale_gauge+mixture17",
        "recommended",
    )
    """Filters; times are relative to the first."""
    landmarks: str = "inverse_scaling"
    batch: int = 25
    turns: int = 7
    """Timed calls of every filter."""
    out: Path = RESULTS / "cost.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        scenario = jaxslam.scenario(self.scenario)
        room, runs = draw(scenario, self.batch)
        sensor = scenario.sensor

        compiled, compile_seconds = {}, {}
        for name in self.filters:
            (slam,) = jaxslam.make_filters(scenario, [name], [self.landmarks]).values()
            start = time.perf_counter()
            batch = _records.lower(slam, room, sensor, runs).compile()  # ty: ignore[missing-attribute]
            compiled[name] = partial(batch, slam, room, sensor)
            compile_seconds[name] = time.perf_counter() - start
            jax.block_until_ready(compiled[name](runs))
        seconds = {name: [] for name in compiled}
        for _ in range(self.turns):
            for name, function in compiled.items():
                start = time.perf_counter()
                jax.block_until_ready(function(runs))
                seconds[name].append(time.perf_counter() - start)

        base = np.array(seconds[self.filters[0]])
        result = {
            name: {
                "microseconds_per_step": round(
                    1e6 * float(np.median(turns)) / self.batch / scenario.steps, 1
                ),
                "relative": round(float(np.median(np.array(turns) / base)), 2),
                "compile_seconds": round(compile_seconds[name], 1),
            }
            for name, turns in seconds.items()
        }
        yield {"scenario": scenario.name, "filters": result}


if __name__ == "__main__":
    Cost.run()
