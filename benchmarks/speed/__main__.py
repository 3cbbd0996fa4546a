"""Microseconds of a run's step: ours, by XLA and native, beside NumPy, dynamax, and C++ with Eigen.

    python -m benchmarks.speed

The same pixels and controls for all, whose results are compared first; beside the filter alone
stand whole studies: drawing, every record, statistics. All in one process on one processor, in
turns; the median counts, and compilation is apart. C++ needs a compiler, and the headers of
`pip install cmeel-eigen` or of the system; dynamax is measured where it is installed.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.benchmark import RESULTS, Benchmark
from benchmarks.speed.dynamax_ekf import TOLERANCE, by_dynamax, missing
from benchmarks.speed.eigen import build, by_hand
from benchmarks.speed.loop import by_loop
from benchmarks.speed.study import study_of
from benchmarks.speed.workload import (
    WORKLOADS,
    Inputs,
    Records,
    Workload,
    by_native,
    ours,
    prepared,
)
from jaxslam.consistency import BACKENDS
from jaxslam.native.build import compiler

AGREEMENT = 1e-9
"""In double precision, of every NEES, and of the last covariance relative to its largest entry."""
SINGLE = "native_float32"
STUDIES = (*BACKENDS, "auto")
"""Backends of whole studies: what is built for the second is there for the default."""
OURS = ("jaxslam", "native", SINGLE, *(f"study_{name}" for name in STUDIES))
"""The filter alone, and whole studies of it: drawing, every record, statistics."""
LOOP_RUNS = 4
"""The loop of NumPy is slow, and its time is the same for every run."""


@dataclass(frozen=True, kw_only=True)
class Speed(Benchmark):
    """All who compute the same filter, in turns."""

    workloads: tuple[str, ...] = tuple(WORKLOADS)
    """A is planar with 12 landmarks, B has six degrees of freedom and 30 landmarks."""
    runs: int = 1024
    """At most so many."""
    steps: int = 100
    """At most so many."""
    repeats: int = 5
    """Turns; the median counts."""
    out: Path = RESULTS / "speed.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        with tempfile.TemporaryDirectory() as folder:
            library = build(Path(folder))
            if isinstance(library, str):
                print(f"without C++: {library}")
            result: dict[str, Any] = {"dgemm_gflops": round(dgemm(), 1)}
            for name in self.workloads:
                work = WORKLOADS[name].reduced(self.runs, self.steps)
                result[name] = measured(work, library, self.repeats, result["dgemm_gflops"])
                result["peak_memory_MiB"] = (
                    resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
                )
                result["load"] = os.getloadavg()
                yield result


def first(inputs: Inputs, runs: int) -> Inputs:
    start, pixels, poses = jax.tree.map(lambda x: x[:runs], tuple(inputs[2:]))
    return inputs._replace(start=start, pixels=pixels, poses=poses)


def difference(found, wanted) -> float:
    """The largest relative one, of so many runs as both have."""
    (nees, P), (nees_wanted, P_wanted) = found, wanted
    runs = min(len(nees), len(nees_wanted))
    nees, nees_wanted, P, P_wanted = (x[:runs] for x in (nees, nees_wanted, P, P_wanted))
    of_P = np.max(np.abs(P - P_wanted)) / np.max(np.abs(P_wanted))
    return float(max(np.max(np.abs(nees / nees_wanted - 1)), of_P))


def without_pose(records: Records) -> Records:
    """Of the velocity and the landmarks alone, planar: dynamax's pose is no element of a group."""
    nees, P = records
    return np.ones_like(nees), P[:, 3:, 3:]


def dgemm() -> float:
    """GFlop/s of the machine's own product of matrices."""
    A = np.random.default_rng(0).normal(size=(1000, 1000))
    seconds = []
    for _ in range(5):
        began = time.perf_counter()
        A @ A
        seconds.append(time.perf_counter() - began)
    return 2 * len(A) ** 3 / min(seconds) / 1e9


def flops(work: Workload) -> float:
    """Of one step, as the program in C++ multiplies: the update of rank m and the composition."""
    d, t, p = (4, 6, 2) if "6dof" in work.scenario else (3, 3, 1)
    n, m = 3 * t + work.landmarks * d, work.landmarks * p
    update = 2 * m * n * (t + d) + 2 * m * m * (t + d) + m**3 / 3 + m * m * n + m * n * n
    return update + 2 * 2 * n * (n - 3 * t) * (t + d)


def contestants(
    inputs: Inputs, library: Any
) -> tuple[dict[str, Callable[[], Records]], dict[str, float]]:
    """All who compute the same on these inputs, and the seconds that ours took to compile."""
    began = time.perf_counter()
    calls = {"jaxslam": ours(inputs)}
    compile_seconds = {"jaxslam": round(time.perf_counter() - began, 2)}
    if compiler() is not None:
        began = time.perf_counter()
        calls["native"] = by_native(inputs)
        compile_seconds["native"] = round(time.perf_counter() - began, 2)
        calls[SINGLE] = by_native(inputs, "float32")
    calls["numpy"] = by_loop(first(inputs, LOOP_RUNS))
    if why := missing(inputs):
        print(f"without dynamax: {why}")
    else:
        calls["dynamax"] = by_dynamax(inputs)
    if not isinstance(library, str):
        calls["eigen"] = by_hand(library, inputs)
        calls["eigen_fixed_sizes"] = by_hand(library, inputs, fixed=True)
    return calls, compile_seconds


def apart(results: dict[str, Records]) -> dict[str, float]:
    """By how much all differ from ours; asserts that it is little."""
    wanted = results["jaxslam"]
    found = {name: difference(of, wanted) for name, of in results.items()}
    if "dynamax" in results:
        found["dynamax"] = difference(*map(without_pose, (results["dynamax"], wanted)))
    bounds = {SINGLE: np.inf, "dynamax": TOLERANCE}
    wrong = {name: x for name, x in found.items() if not x < bounds.get(name, AGREEMENT)}
    assert not wrong, f"not the same results: {wrong}"
    return found


def in_turns(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median seconds of each."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - began)
    return {name: float(np.median(x)) for name, x in seconds.items()}


def measured(work: Workload, library: Any, repeats: int, product: float) -> dict[str, Any]:
    """Times of all on one workload; `product` is `dgemm`."""
    filters, compile_seconds = contestants(prepared(work), library)
    results = {name: call() for name, call in filters.items()}
    runs = {name: len(of[0]) for name, of in results.items()}
    studies = {f"study_{name}": name for name in STUDIES if name != "native" or name in filters}
    calls = {**filters, **{key: study_of(work, name) for key, name in studies.items()}}
    for key in studies:
        calls[key]()  # compiles
    seconds = in_turns(calls, repeats)
    each = {name: x / runs.get(name, work.runs) / work.steps for name, x in seconds.items()}
    return {
        "runs": work.runs,
        "steps": work.steps,
        "microseconds_per_step": {name: round(1e6 * x, 2) for name, x in each.items()},
        "speed_against": {
            ours: {name: round(x / each[ours], 3) for name, x in each.items() if name != ours}
            for ours in OURS
            if ours in each
        },
        "largest_difference": apart(results),
        "compile_seconds": compile_seconds,
        "share_of_dgemm": {
            name: round(flops(work) / each[name] / 1e9 / product, 3) for name in filters
        },
    }


if __name__ == "__main__":
    # Before JAX starts its threads, which are as many as there are processors to use.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    Speed.run()
