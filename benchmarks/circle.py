"""The README's study on several seeds, and its figure `docs/consistency.png`, that of the first.

    python benchmarks/circle.py

The figure is that of `jaxslam consistency` with its own options. What it says is kept beside the
verdicts, so that a test finds a figure that is older than they are; so are the verdicts that the
README's command prints, which are of the first runs of that study.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmark import RESULTS, Benchmark

import jaxslam
from jaxslam.plots.style import drawn
from jaxslam.statistics import Tally
from jaxslam.statistics.verdict import headline


@dataclass(frozen=True, kw_only=True)
class Circle(Benchmark):
    """Inverse Scaling and Inverse Depth on a circle."""

    runs: int = 1000
    """Runs of every seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    printed: int = 500
    """Runs of the README's command."""
    steps: int = 200
    out: Path = RESULTS / "circle.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """After every seed the verdicts, `[filter][seed]`, what is drawn and what is printed."""
        scenario = jaxslam.scenario("circle", {"steps": self.steps})
        filters = jaxslam.make_filters(
            scenario, ["robocentric"], ["inverse_scaling", "inverse_depth"]
        )
        found: dict[str, Any] = {"runs": self.runs, "verdicts": {name: {} for name in filters}}
        for seed in self.seeds:
            study = jaxslam.monte_carlo(scenario, filters, runs=self.runs, seed=seed)
            if seed == self.seeds[0]:
                figure = study.plot(self.docs / "consistency.png")
                found["drawn"] = json.loads(drawn(figure))
                nees = {name: study.records(name)["nees"][: self.printed] for name in filters}
                told = {name: Tally.of(x, 3).verdict() for name, x in nees.items()}
                found["printed"] = {name: headline(x) for name, x in told.items()}
            for name, of in study.summary()["filters"].items():
                found["verdicts"][name][str(seed)] = of["verdict"]
            yield found


if __name__ == "__main__":
    Circle.run()
