"""How the time and the memory of a whole study grow, one axis at a time.

    python -m benchmarks.speed.sweep

Every point is a process of its own (`benchmarks.speed.study`), which ends or is ended. The
exponent of an axis along which there is more to do is the slope of log seconds over log size by
least squares; `worst` is by how much the time for one more differs at most from that of the largest
size. JSON is written after every point, and what is there already is not measured again.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.benchmark import RESULTS, Benchmark

AXES: dict[str, tuple[tuple[int, ...], dict[str, int]]] = {
    "runs": ((128, 512, 2048, 8192), {"steps": 100, "chunk": 128}),
    "steps": ((10, 25, 50, 100, 200, 400), {"runs": 800}),
    "landmarks": ((4, 8, 16, 32, 64), {"runs": 200, "steps": 50}),
    "chunk": ((10, 25, 50, 100, 200, 500), {"runs": 1000, "steps": 50}),
    "processors": ((1, 2), {"runs": 1600, "steps": 100}),
}
"""Sizes, and what else is not as `study.Options` has it."""
GROWING = ("runs", "steps", "landmarks")
"""Axes along which a study is more work."""
LIMIT = 900.0
"""Seconds of a process."""


@dataclass(frozen=True, kw_only=True)
class Sweep(Benchmark):
    """Studies along every axis."""

    axes: tuple[str, ...] = tuple(AXES)
    backends: tuple[str, ...] = ("xla", "native")
    workload: str = "A"
    out: Path = RESULTS / "sweep.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        result = self.found()
        for axis, backend in itertools.product(self.axes, self.backends):
            sizes, others = AXES[axis]
            found = result.setdefault(axis, {}).setdefault(backend, {"points": {}})
            points = found["points"]
            for size in sizes:
                if "seconds" not in points.get(str(size), {}):
                    given = {"workload": self.workload, "backend": backend, **others, axis: size}
                    points[str(size)] = point(**given)
                    yield result
            known = [n for n in sizes if "seconds" in points[str(n)]]
            if axis in GROWING and len(known) > 1:
                found |= growth(known, [points[str(n)]["seconds"] for n in known])
            yield result


def point(**options: Any) -> dict[str, Any]:
    """What `study` prints for these options; or why there is nothing."""
    words = [f"--{name}={value}" for name, value in options.items()]
    command = [sys.executable, "-m", "benchmarks.speed.study", *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"not finished after {LIMIT:.0f} s"}
    if done.returncode:
        return {"error": " ".join(done.stderr.split())[-500:]}
    return {**json.loads(done.stdout.splitlines()[-1]), "load": round(os.getloadavg()[0], 1)}


def growth(sizes: list[int], seconds: list[float]) -> dict[str, float]:
    """The exponent, and the worst of the times for one more against that of the largest size."""
    exponent = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
    each = np.array(seconds) / sizes
    worst = np.max(np.abs(each / each[-1] - 1))
    return {"exponent": round(float(exponent), 3), "worst": round(float(worst), 3)}


if __name__ == "__main__":
    Sweep.run()
