"""A whole study of a workload: simulation, filter, records of every step, statistics.

    python -m benchmarks.speed.study --runs 1000 --backend native

A process of its own measures one study, on as many processors as it is told, and prints JSON.
"""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
import tyro

import jaxslam
from benchmarks.speed.workload import WORKLOADS, Workload, filters_of, scenario_of


@dataclass(frozen=True)
class Options:
    """What to measure."""

    workload: str = "A"
    runs: int = 400
    steps: int = 50
    landmarks: int = 12
    chunk: int = 100
    backend: str = "xla"
    processors: int = 1
    repeats: int = 3
    """Studies after the first one, which compiles."""


def study_of(
    work: Workload, backend: str, chunk: int = jaxslam.consistency.CHUNK
) -> Callable[[], None]:
    """What computes a study of the workload and its summary, compiled when it is called first."""
    scenario = scenario_of(work)
    filters = filters_of(scenario)

    def call() -> None:
        study = jaxslam.monte_carlo(scenario, filters, runs=work.runs, chunk=chunk, backend=backend)
        summary = jaxslam.summarise(study)
        assert all(found["diverged"] == 0 for found in summary["filters"].values())

    return call


def measured(options: Options) -> dict[str, float]:
    """Seconds of a study, µs of a step of a run, seconds of compilation, MiB of the process."""
    jax.config.update("jax_enable_x64", True)
    sizes = {name: getattr(options, name) for name in ("runs", "steps", "landmarks")}
    work = dataclasses.replace(WORKLOADS[options.workload], **sizes)
    call = study_of(work, options.backend, options.chunk)
    seconds = []
    for _ in range(options.repeats + 1):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    median = float(np.median(seconds[1:]))
    return {
        "seconds": round(median, 4),
        "microseconds_per_step": round(1e6 * median / work.runs / work.steps, 3),
        "compile_seconds": round(seconds[0] - median, 2),
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


if __name__ == "__main__":
    # Before JAX starts its threads, which are as many as there are processors to use.
    given = tyro.cli(Options, description=__doc__)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: given.processors])
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    print(json.dumps(measured(given)))
