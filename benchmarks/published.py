"""Other people's published numbers out of this library, on their own settings.

    python benchmarks/published.py comparisons
    python benchmarks/published.py ukfm
    python benchmarks/published.py navlie runs.npz --generate
    python benchmarks/published.py navlie runs.npz

Ours are printed beside theirs.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from benchmark import RESULTS, Benchmark, run_one, table
from tyro.conf import Positional

import jaxslam
from jaxslam.consistency import draw, run_through
from jaxslam.evaluation.convention import Convention, converted, pose_errors

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
    """The scenarios `room` (slamtb, Solà's EKF-SLAM toolbox in MATLAB) and `positions` (2-D SLAM of
    Huang, Mourikis and Roumeliotis, IJRR 2010, in the settings of Barrau and Bonnabel).

    Theirs are means over few runs, so ours come with the interval in which 95 % of the means of
    that many of our runs lie.
    """

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


def interval95(rng: np.random.Generator, by_run: np.ndarray, runs: int) -> np.ndarray:
    """Where 95 % of the means of so many of these runs lie."""
    means = [rng.choice(by_run, runs).mean() for _ in range(20_000)]
    return np.quantile(means, [0.025, 0.975]).round(3)


def _compared(table: Published, nees: np.ndarray, theirs: tuple[float, ...] | None) -> dict:
    """Means of our runs by window, and where 95 % of the means of `table.runs` of them lie."""
    healthy = nees[np.isfinite(nees).all(axis=1)]
    rng = np.random.default_rng(0)
    windows = {}
    for i, (label, part) in enumerate(table.windows.items()):
        by_run = healthy[:, part].mean(axis=1)
        low, high = interval95(rng, by_run, table.runs)
        windows[label] = {
            "ours": round(by_run.mean(), 3),
            "interval95": [low, high],
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


SPEED, TURN = 0.25, math.radians(1.5)
UKFM_SETTING = {
    "steps": 2499,
    "velocity": (0.0, SPEED, TURN),
    # Wheels do not slip sideways; a tenth of a millimetre keeps the covariance positive definite.
    "odometry_sigma": (1e-4, 0.05 * SPEED / math.sqrt(2), 0.1 * SPEED * math.sqrt(2)),
    "landmarks": 20,
    "ring_radius": SPEED / TURN + 3.0,
    "range": (1.0, 5.0),
    "position_sigma": 0.1,
}
UKFM_NEES = {"world/cartesian": (2.88, 2.56), "invariant/cartesian": (1.01, 1.17)}
"""NEES/dof of orientation and position: their EKF and their invariant EKF, 100 runs."""
FIRST = 10
"""Steps that they leave out."""
RIGHT, MIXED = Convention("right"), Convention("split", "mixed")


@dataclass(frozen=True, kw_only=True)
class Ukfm(Benchmark):
    """The table of ukfm's 2-D SLAM (Brossard, Barrau, Bonnabel, ICRA 2020) out of our filters.

    Its setting is ten rounds on a circle of 2500 steps with 20 landmarks beside it; the NEES of
    orientation and position by their degrees of freedom are means over all steps and runs. Poses
    and covariances go through `jaxslam.evaluate`, orientation and position apart, as theirs do: the
    position along the world's axes, its covariance that of the error `p − p̂` whatever the filter's
    own error is.
    """

    runs: int = 100
    """Runs of each filter."""
    seed: int = 0
    chunk: int = 25
    """Runs in one batch."""
    out: Path = RESULTS / "ukfm.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        results = {}
        for name in UKFM_NEES:
            results[name] = _of_parts(name, self)
            yield {"runs": self.runs, "seed": self.seed, "filters": results, "ukfm": UKFM_NEES}

    def report(self, results: dict[str, Any]) -> None:
        rows = []
        for name, found in results["filters"].items():
            parts = zip((found["orientation"], found["position"]), UKFM_NEES[name], strict=True)
            rows.append((name, *(_cell(part, theirs) for part, theirs in parts)))
        header = "filter", "orientation, NEES/dof (theirs)", "position (theirs)"
        print(table(header, rows), flush=True)


def poses_of(name: str, options: Ukfm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimated poses (runs, steps, 3, 3), covariances of the right error, and the truth."""
    scenario = jaxslam.scenario("positions", UKFM_SETTING)
    slam = jaxslam.make_filters(scenario, [name.split("/")[0]], [name.split("/")[1]])[name]
    room, runs = draw(scenario, options.runs, seed=options.seed)

    def told(state, innovation, frame):
        estimate, covariance = jaxslam.camera_pose(slam, state)
        return estimate.as_matrix(), covariance, frame.pose.as_matrix()

    one = partial(run_through, slam, room, output=told)
    batch = jax.jit(jax.vmap(lambda run: one(run)[1]))
    parts = [
        jax.device_get(batch(jax.tree.map(lambda x, i=i: x[i : i + options.chunk], runs)))
        for i in range(0, options.runs, options.chunk)
    ]
    estimates, covariances, truths = (np.concatenate(x) for x in zip(*parts, strict=True))
    return estimates[:, FIRST:], covariances[:, FIRST:], truths[:, FIRST:]


def _of_parts(name: str, options: Ukfm) -> dict:
    """NEES/dof of orientation and of position, with the verdict on each."""
    T, P, truth = poses_of(name, options)
    P, errors = converted(P, T, RIGHT, MIXED), pose_errors(MIXED, T, truth)
    result = {}
    for part, axes in (("orientation", slice(2, 3)), ("position", slice(0, 2))):
        found = jaxslam.evaluate(errors[..., axes], P[..., axes, axes])
        nees = found.nees.mean(axis=1) / found.dof
        interval = interval95(np.random.default_rng(0), nees, 100)
        result[part] = {
            "nees": round(float(nees.mean()), 3),
            "interval95_of_100_runs": interval.tolist(),
            "verdict": found.verdict["word"],
            "sigma_factor": found.verdict["sigma_factor"],
        }
    whole = jaxslam.evaluate_poses(T, P, truth, MIXED)
    return result | {"identified": str(whole.identified and whole.identified.convention)}


def _cell(part: dict, theirs: float) -> str:
    low, high = part["interval95_of_100_runs"]
    return f"{part['nees']:.2f} [{low:.2f}, {high:.2f}] ({theirs})"


ANCHORS = ((1, 0, 0), (-1, 0, 0), (0, 2, 0), (0, 2, 2))
TAGS = ((0.17, 0.17, 0), (-0.17, 0.17, 0))


def generate(path: Path, runs: int) -> None:
    """Run navlie's filter; write T_wc, P, truth and NEES of every tenth of a second."""
    if importlib.util.find_spec("navlie") is None:
        sys.exit("skipped: navlie is not installed (pip install navlie)")
    navlie, lib = (importlib.import_module(name) for name in ("navlie", "navlie.lib"))
    start = np.diag([0.1**2] * 3 + [0.3**3, 0.3**2, 0.3**2])
    Q = np.diag([0.01**2] * 3 + [0.1] * 3)
    process = lib.BodyFrameVelocity(Q)
    ranges = [lib.RangePoseToAnchor(list(a), list(tag), 0.1**2) for a in ANCHORS for tag in TAGS]

    def velocity(t, x):
        return np.array([np.sin(0.1 * t), np.cos(0.1 * t), np.sin(0.1 * t), 1, 0, 0])

    data = navlie.DataGenerator(process, velocity, Q, 100, ranges, 10)
    true_start = lib.SE3State([0] * 6, stamp=0.0)

    def trial(number: int) -> list[tuple]:
        np.random.seed(number)  # noqa: NPY002, navlie draws from it
        truth, inputs, measured = data.generate(true_start, 0, 10, noise=True)
        guess = true_start.plus(navlie.randvec(start))
        ekf = navlie.ExtendedKalmanFilter(process)
        found = navlie.run_filter(ekf, guess, start, inputs, measured, True)
        results = navlie.GaussianResultList.from_estimates(found, truth)
        kept = range(0, len(results.stamp), 10)
        return [
            (results.state[i].value, results.state_true[i].value, results.covariance[i],
             results.nees[i], results.stamp[i])
            for i in kept
        ]  # fmt: skip

    columns = [[np.stack(c) for c in zip(*trial(i), strict=True)] for i in range(runs)]
    T, truth, P, nees, times = (np.stack(column) for column in zip(*columns, strict=True))
    np.savez(path, estimates=T, truths=truth, covariances=P, nees=nees, times=times[0])


@dataclass(frozen=True, kw_only=True)
class Navlie(Benchmark):
    """navlie's Monte Carlo example through `jaxslam.evaluate_poses`: its numbers against ours.

    The setting is that of its `examples/ex_monte_carlo.py`: a body on SE(3) that is told its
    velocity and measures ranges to four anchors from two tags, 10 s at 100 Hz, an EKF from a wrong
    start. What is written is by how much ours differ, the verdict, and which convention the data
    tell.
    """

    file: Positional[Path]
    """npz file of poses, covariances and navlie's own NEES."""
    generate: bool = False
    """Draw that file, where navlie is installed, and compare nothing."""
    runs: int = 50
    """Runs that are drawn."""
    out: Path = RESULTS / "navlie.json"

    def __call__(self) -> None:
        if self.generate:
            generate(self.file, self.runs)
        else:
            super().__call__()

    def measure(self) -> Iterator[dict[str, Any]]:
        with np.load(self.file) as file:
            data = dict(file)
        arrays = [data[name] for name in ("estimates", "covariances", "truths")]
        theirs = Convention("right", order="rotation-first")
        found = jaxslam.evaluate_poses(*arrays, theirs, times=data["times"])
        wrong = jaxslam.evaluate_poses(*arrays, Convention(), times=data["times"])
        yield {
            "runs": found.runs,
            "steps": found.steps,
            "mean_nees": {"navlie": float(data["nees"].mean()), "ours": float(found.nees.mean())},
            "largest_relative_difference": float(np.max(abs(found.nees / data["nees"] - 1))),
            "verdict": found.headline,
            "identified": str(found.identified and found.identified.convention),
            "stated_wrongly": str(wrong),
        }


if __name__ == "__main__":
    run_one(Comparisons, Ukfm, Navlie)
