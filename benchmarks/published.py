"""Other people's published numbers out of this library's filters, on their own settings.

`python benchmarks/published.py` runs the scenarios `room` (slamtb, Solà's EKF-SLAM toolbox in
MATLAB) and `positions` (2-D SLAM of Huang, Mourikis and Roumeliotis, IJRR 2010, in the settings of
Barrau and Bonnabel) and prints ours beside theirs. Theirs are means over few runs, so ours come
with the interval in which 95 % of the means of that many of our runs lie.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, Benchmark, table

import jaxslam

ROOM_WINDOWS = {"1–50": slice(0, 50), "51–100": slice(50, 100), "101–200": slice(100, 200)}
# Their step 1 is our step 1; both leave out the start, which has no error.
POSITION_WINDOWS = {"all": slice(0, 400), "last 50": slice(350, 400)}


@dataclass(frozen=True)
class Published:
    """A table of somebody else's: mean pose NEES by window of steps, and RMSE at the end, m."""

    scenario: str
    runs: int
    windows: dict[str, slice]
    nees: dict[str, tuple[float, ...] | None]
    """By filter; None where only ours exists."""
    rmse: dict[str, float]


TABLES = (
    Published(
        scenario="room",
        runs=25,
        windows=ROOM_WINDOWS,
        nees={
            "world/inverse_depth": (6.99, 6.57, 6.88),
            "world/anchored_homogeneous": (7.00, 6.54, 6.83),
            "world/inverse_depth_to_cartesian": (7.01, 6.45, 6.95),
            "world/unit_homogeneous": (15.4, 56.2, 151.0),
            "robocentric/unit_homogeneous": None,
            "robocentric/inverse_scaling": None,
        },
        rmse={
            "world/inverse_depth": 0.082,
            "world/anchored_homogeneous": 0.082,
            "world/inverse_depth_to_cartesian": 0.078,
            "world/unit_homogeneous": 0.113,
        },
    ),
    Published(
        scenario="positions",
        runs=100,
        windows=POSITION_WINDOWS,
        nees={
            "world/cartesian": (4.77, 6.35),
            "robocentric/cartesian": (3.09, 3.37),
            "world+oc/cartesian": (3.10, 3.35),
            "world+fej/cartesian": None,
            "invariant/cartesian": (3.10, 3.33),
        },
        rmse={},
    ),
    Published(
        scenario="positions-loose",
        runs=100,
        windows=POSITION_WINDOWS,
        nees={
            "world/cartesian": (19.1, 29.9),
            "robocentric/cartesian": (5.11, 6.91),
            "world+oc/cartesian": (5.21, 7.02),
            "world+fej/cartesian": None,
            "invariant/cartesian": (5.01, 6.62),
        },
        rmse={},
    ),
)


@dataclass(frozen=True, kw_only=True)
class Comparisons(Benchmark):
    """Ours beside theirs."""

    scenarios: tuple[str, ...] = ("room", "positions", "positions-loose")
    """Which of the tables."""
    filters: tuple[str, ...] = ()
    """Only these rows, `filter/landmarks`; the file keeps its others. All by default."""
    runs: int = 1000
    """Runs of every filter."""
    seed: int = 0
    chunk: int = 10
    """Runs in one batch: few, since a map of 72 points is large."""
    out: Path = RESULTS / "published.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`{scenario: {"filters": {"filter/landmarks": numbers}, …}}`, after every filter."""
        results = self.found()
        for theirs in (t for t in TABLES if t.scenario in self.scenarios):
            dof = jaxslam.scenario(theirs.scenario).geometry.tangent_dim
            kept = results.get(theirs.scenario, {}).get("filters", {}) if self.filters else {}
            results[theirs.scenario] = {
                "seed": self.seed,
                "published_runs": theirs.runs,
                "band95_of_published_runs": jaxslam.mean_band(dof, theirs.runs),
                "filters": kept,
            }
            for name in self.filters or theirs.nees:
                if name in theirs.nees:
                    kept[name] = _measure(theirs, name, self)
                    yield results

    def report(self, results: dict[str, Any]) -> None:
        for theirs in (t for t in TABLES if t.scenario in results):
            header = ["filter", *(f"NEES, steps {label}" for label in theirs.windows), "RMSE m"]
            rows = [_line(*row) for row in results[theirs.scenario]["filters"].items()]
            print(
                f"\n{theirs.scenario}: ours [95 % of the means of {theirs.runs} runs] (published)"
            )
            print(table(header, rows), flush=True)


def _measure(theirs: Published, name: str, options: Comparisons) -> dict[str, Any]:
    """One filter, beside theirs."""
    scenario = jaxslam.scenario(theirs.scenario)
    frame, landmarks = name.split("/")
    filters = jaxslam.make_filters(scenario, [frame], [landmarks])
    study = jaxslam.monte_carlo(
        scenario, filters, runs=options.runs, seed=options.seed, chunk=options.chunk
    )
    records = [study.store.load(name, chunk, ("nees", "error")) for chunk in study.chunks]
    nees = np.concatenate([record["nees"] for record in records])
    error = np.concatenate([record["error"] for record in records])
    return _compared(theirs, nees, theirs.nees[name]) | {
        "runs": options.runs,
        "rmse": _rmse(error, scenario.geometry.point_dim),
        "published_rmse": theirs.rmse.get(name),
        "diverged": int(np.sum(~np.isfinite(nees).all(axis=1))),
        "seconds_per_run": round(study.seconds[name].run / options.runs, 4),
    }


def _compared(table: Published, nees: np.ndarray, theirs: tuple[float, ...] | None) -> dict:
    """Means of our runs by window, and where 95 % of the means of `table.runs` of them lie."""
    healthy = nees[np.isfinite(nees).all(axis=1)]
    rng = np.random.default_rng(0)
    windows = {}
    for i, (label, part) in enumerate(table.windows.items()):
        by_run = healthy[:, part].mean(axis=1)
        means = [rng.choice(by_run, table.runs).mean() for _ in range(20_000)]
        low, high = np.quantile(means, [0.025, 0.975])
        windows[label] = {
            "ours": round(by_run.mean(), 3),
            "interval95": [low.round(3), high.round(3)],
        }
        if theirs is not None:
            windows[label] |= {"published": theirs[i], "within": bool(low <= theirs[i] <= high)}
    return {"nees": windows}


def _rmse(error: np.ndarray, n: int) -> float:
    """Of the position at the last step."""
    return round(float(np.sqrt((error[:, -1, :n] ** 2).sum(axis=-1).mean())), 4)


def _line(name: str, row: dict[str, Any]) -> list[str]:
    cells = [name]
    for window in row["nees"].values():
        low, high = window["interval95"]
        theirs = f" ({window['published']})" if "published" in window else ""
        cells.append(f"{window['ours']:.2f} [{low:.2f}, {high:.2f}]{theirs}")
    theirs = f" ({row['published_rmse']})" if row["published_rmse"] else ""
    return [*cells, f"{row['rmse']:.3f}{theirs}"]


if __name__ == "__main__":
    Comparisons.run()
