"""Every filter on every landmark in every scenario, by the native backend and by XLA.

    python benchmarks/native.py --minutes 60

A few runs of a few steps. What is there already is not measured again, and the order is drawn, so
that a part tells of all.
"""

from __future__ import annotations

import itertools
import random
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from benchmark import RESULTS, Benchmark, data_folder

import jaxslam
from jaxslam._numerics.arrays import cast
from jaxslam._runtime import programs
from jaxslam.consistency import backends, draw
from jaxslam.filters.words import FILTERS
from jaxslam.landmarks import LANDMARKS
from jaxslam.native import difference
from jaxslam.native.batch import Batch
from jaxslam.simulation import BUILT_IN

ALONE = ("handheld", "room")
"""Scenarios that need a recording."""
LOST = 1e6
"""NEES beyond which nothing is compared: what is lost magnifies rounding."""
MODIFIED = (
    "robocentric+oc", "robocentric+fej", "scale_gauge+scene50", "scale_gauge+mixture3",
    "scale_gauge+checked", "robocentric+drift",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Native(Benchmark):
    """Differences, runs that XLA had to compute again, and what is refused."""

    filters: tuple[str, ...] = (*FILTERS, *MODIFIED)
    """Filters, with their modifiers."""
    landmarks: tuple[str, ...] = tuple(LANDMARKS)
    """Parametrizations."""
    scenarios: tuple[str, ...] = tuple(x for x in BUILT_IN if x not in ALONE)
    """Worlds, with so few landmarks and steps."""
    runs: int = 8
    """Runs of each."""
    steps: int = 3
    """Steps of each."""
    count: int = 4
    """Landmarks, where the scenario has a number of them; loops are written out up to this."""
    minutes: float = 60.0
    """When to begin no further one."""
    out: Path = RESULTS / "native.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        data_folder()
        found, began = self.found(), time.monotonic()
        cases = list(itertools.product(self.filters, self.landmarks, self.scenarios))
        random.Random(0).shuffle(cases)
        for case in cases:
            if time.monotonic() - began > 60 * self.minutes:
                return
            if " ".join(case) in found:
                continue
            found[" ".join(case)] = self.compared(*case)
            print(" ".join(case), found[" ".join(case)], flush=True)
            yield found

    def compared(self, name: str, landmark: str, scenario: str) -> dict[str, Any]:
        """The outcome of one case."""
        fields = {"steps": self.steps, "landmarks": self.count}
        try:
            world = jaxslam.scenario(scenario, fields)
            (slam,) = jaxslam.make_filters(world, [name], [landmark]).values()
            room, runs = draw(world, self.runs)
        except ValueError as error:
            return {"outcome": "no such filter", "why": str(error)[:200]}
        pieces = cast(slam, "float64"), room, cast(world.sensor, "float64"), runs
        with again() as counted:
            try:
                records, _ = backends.by_native(*pieces)(np.int32(self.runs))
            except ValueError as error:
                return {"outcome": "refused", "why": str(error)[:200]}
        wanted = jax.device_get(backends._first_runs(*pieces))
        sane = wanted["nees"] <= LOST
        told = difference(records, wanted, sane, backends.AGREEMENT["float64"])
        apart = largest(records, wanted, sane)
        self.free()
        return {
            "outcome": "another" if told else "same",
            **({"why": told} if told else {}),
            "difference": apart,
            "computed_again": sum(counted),
        }

    def free(self) -> None:
        """Give back what was compiled: a process has only so many memory maps."""
        if len(Path("/proc/self/maps").read_text().splitlines()) > 20_000:
            programs.forget()
            backends.native_programs().forget()
            jax.clear_caches()

    def report(self, results: Any) -> None:
        """Count the outcomes."""
        counts: dict[str, int] = {}
        for of in results.values():
            counts[of["outcome"]] = counts.get(of["outcome"], 0) + 1
        same = [of for of in results.values() if of["outcome"] == "same"]
        again = sum(of["computed_again"] for of in same)
        print(
            f"{counts}; largest difference {max((of['difference'] for of in same), default=0):.1e};"
            f" computed again by XLA: {again} of {self.runs * len(same)} runs",
            flush=True,
        )


def largest(found: Any, wanted: Any, which: Any) -> float:
    """The largest difference, of the largest number of its record."""
    apart = 0.0
    for key in wanted:
        x, y = (np.asarray(z[key], float)[which] for z in (wanted, found))
        finite = np.isfinite(x) & np.isfinite(y)
        size = np.max(np.abs(x[finite]), initial=1e-300)
        most = np.max(np.abs(x[finite] - y[finite]), initial=0.0)
        apart = max(apart, float(most / size))
    return apart


@contextmanager
def again() -> Generator[list[int]]:
    """The numbers of runs that the native programs leave to XLA."""
    counted: list[int] = []
    by_xla = Batch._by_xla

    def noted(batch, shared, runs, doubted, made):
        counted.append(len(doubted))
        by_xla(batch, shared, runs, doubted, made)

    Batch._by_xla = noted  # ty: ignore[invalid-assignment]
    try:
        yield counted
    finally:
        Batch._by_xla = by_xla


if __name__ == "__main__":
    Native.run()
