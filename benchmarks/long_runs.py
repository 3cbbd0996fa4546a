"""Long runs among landmarks that come as others go: does a filter stay consistent to the end?

    python benchmarks/long_runs.py

What a filter takes for the depth of new landmarks is right in `laps-prior`, wrong in `laps-thrown`,
and becomes wrong half way in `laps-change`; the same of a camera with odometry, which is on a ring
in `laps`, too. Results are added to `long_runs.json` one filter at a
time; what it has, of as many runs, is not run again. `docs/long-runs.png` is drawn from it, by
`--page` alone from what is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, OfRuns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxslam
from jaxslam.plots.style import GREY, line_style, new_figure, save

WORLDS = {
    "laps-prior": "depths are as expected",
    "laps-thrown": "depths are not as expected",
    "laps-change": "depths change half way",
}
"""Scenarios, and what is drawn above them."""
ODOMETRY = {
    "motion": "odometry", "rate": 10.0, "odometry_sigma": [0.005, 0.005, 0.000873],
}  # fmt: skip
"""Settings of a camera with odometry: 5 mm and 0.05° over steps of 12 cm."""
WITH_ODOMETRY = " with odometry"
"""What stands behind the name of such a world in the results."""
FIRST, MOST = 10, 60
"""The first step of which numbers are kept, and how many steps, at even ratios."""
CUT = 1e5
"""NEES above which nothing is drawn."""
IDEAL = 3
"""NEES of a consistent filter in a plane."""


@dataclass(frozen=True, kw_only=True)
class LongRuns(OfRuns):
    """Filters in long runs."""

    scenarios: tuple[str, ...] = tuple(WORLDS)
    filters: tuple[str, ...] = ("robocentric", "world+oc", "scale_gauge+oc+scene50", "recommended")
    """Filters, with modifiers, of Inverse Scaling."""
    with_odometry: tuple[str, ...] = (*WORLDS, "laps")
    """Scenarios of a camera with odometry."""
    for_odometry: tuple[str, ...] = ("robocentric", "recommended")
    """Filters of it."""
    runs: int = 48
    steps: int = 3000
    seed: int = 20261128
    chunk: int = 24
    out: Path = RESULTS / "long_runs.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`[scenario][filter]`: mean and median NEES and the share of lost runs `at` some steps."""
        of_odometry = [world + WITH_ODOMETRY for world in self.with_odometry]
        for worlds, names in (
            (self.scenarios, self.filters),
            (of_odometry, self.for_odometry),
        ):
            yield from self.each(self._measured, worlds, names, steps=self.steps)

    def _measured(self, scenario: str, name: str) -> dict[str, Any]:
        settings = ODOMETRY if scenario.endswith(WITH_ODOMETRY) else {}
        settings = {**settings, "steps": self.steps}
        world = jaxslam.scenario(scenario.removesuffix(WITH_ODOMETRY), settings)
        _, found = self.study(world, name)
        at = np.unique(np.geomspace(FIRST, self.steps, MOST).round().astype(int)).tolist()
        kept = {key: [found[key][k - 1] for k in at] for key in ("nees", "nees_median", "lost")}
        seconds = found["seconds"]["run"]
        return {"at": at, **kept, "microseconds_per_step": 1e6 * seconds / self.runs / self.steps}

    def report(self, results: dict[str, Any]) -> None:
        save(drawn_of(results), self.docs / "long-runs.png")


def drawn_of(results: dict[str, Any]) -> Figure:
    """Mean NEES against the step, a panel for every scenario without odometry."""
    results = {name: row for name, row in results.items() if name in WORLDS}
    figure = new_figure(3.4 * len(results), 3.2)
    axes = np.atleast_1d(figure.subplots(1, len(results), sharey=True))
    for ax, (scenario, filters) in zip(axes, results.items(), strict=True):
        _draw(ax, filters)
        runs = {row["runs"] for row in filters.values()}
        ax.set_title(f"{scenario}: {WORLDS[scenario]}\n{max(runs)} runs", fontsize="medium")
    axes[0].set_ylabel("mean NEES of the pose")
    axes[0].legend(fontsize="small", loc="upper left")
    return figure


def _draw(ax: Axes, filters: dict[str, Any]) -> None:
    ax.axhline(IDEAL, color=GREY, linewidth=0.8, label="consistent")
    for index, (name, row) in enumerate(filters.items()):
        nees = np.array(row["nees"], float)
        ax.plot(row["at"], nees, **line_style(index), label=name)
    ends = FIRST, max(row["at"][-1] for row in filters.values())
    ax.set(xscale="log", yscale="log", xlabel="step", xlim=ends, ylim=(1, CUT))


if __name__ == "__main__":
    LongRuns.run()
