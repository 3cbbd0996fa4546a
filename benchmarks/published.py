"""Other people's published numbers out of this library, on their own settings.

    python benchmarks/published.py tables
    python benchmarks/published.py tables --studies zhang-1 zhang-5
    python benchmarks/published.py navlie runs.npz --generate
    python benchmarks/published.py navlie runs.npz

A row of the results is a published number beside ours.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, Benchmark, run_one, table
from published_worlds import inertial, localisation, make, zhang
from tyro.conf import Positional

import jaxslam
from jaxslam.consistency import draw, run_through
from jaxslam.evaluation.convention import Convention
from jaxslam.geometry import log
from jaxslam.simulation import World, scenario
from jaxslam.statistics.bands import normalised_squared

MARK = "<!-- published.py -->"
RESAMPLED = 4000
"""Samples of runs of which an interval is made."""


Published = tuple[float | None, ...] | None


class Quantity(NamedTuple):
    """A number of a published table: a mean over runs and steps."""

    told: str
    of: str
    """Which of `errors` it is."""
    steps: slice = slice(None)
    factor: float = 1.0
    mean: str = "plain"
    """`plain`; `rms` over runs, then plain over steps; `quadratic`: rms over both."""

    def value(self, records: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """It, for so many samples of runs, each of which counts by its weight."""
        by_step = weights @ records[:, self.steps]
        by_step = np.sqrt(by_step) if self.mean == "rms" else by_step
        found = by_step.mean(axis=-1)
        return self.factor * (np.sqrt(found) if self.mean == "quadratic" else found)


@dataclass(frozen=True)
class Study:
    """Published tables of one world."""

    source: str
    world: Callable[[], World]
    their_runs: int
    runs: int
    """Ours."""
    quantities: tuple[Quantity, ...]
    theirs: dict[str, Published]
    """By filter the value of every quantity; None where only ours exists."""
    every: int = 1
    """Measurements are in one frame of so many, the first of which is the start."""
    batch: int | None = 25
    """Runs in one batch; None where a map is so large that one after another is faster."""


UKFM = {
    "steps": 2499,
    "velocity": (0.0, 0.25, math.radians(1.5)),
    # Wheels do not slip sideways; a tenth of a millimetre keeps the covariance positive definite.
    "odometry_sigma": (1e-4, 0.05 * 0.25 / math.sqrt(2), 0.1 * 0.25 * math.sqrt(2)),
    "landmarks": 20,
    "ring_radius": 0.25 / math.radians(1.5) + 3.0,
    "range": (1.0, 5.0),
    "position_sigma": 0.1,
}
AFFINE = {
    "geometry": "spatial",
    "motion": "odometry",
    "sensor": "position",
    "odometry_sigma": (0.01,) * 3 + (0.003,) * 3,
    "position_sigma": 0.1,
    "steps": 2000,
    "rate": 1.0,
    "velocity": (0.0, 0.0, 0.2356, 0.0, -2 * math.pi / 400, 0.0),
    "placement": "ring",
    "ring_radius": 16.5,
    "landmarks": 50,
    "range": (0.0, 5.0),
}
ROOM = (
    Quantity("NEES, steps 1–50", "pose", slice(0, 50), 6),
    Quantity("NEES, steps 51–100", "pose", slice(50, 100), 6),
    Quantity("NEES, steps 101–200", "pose", slice(100, 200), 6),
    Quantity("RMSE at the end, m", "distance", slice(-1, None), mean="quadratic"),
)
POSITIONS = (
    Quantity("NEES, all steps", "pose", factor=3),
    Quantity("NEES, last 50 steps", "pose", slice(350, 400), 3),
)


def of_parts(first: int) -> tuple[Quantity, ...]:
    """ukfm's quantities, from a step on."""
    steps = slice(first, None)
    return (
        Quantity("NEES of orientation", "orientation", steps),
        Quantity("NEES of position", "position", steps),
        Quantity("RMSE, °", "turn", slice(None), 180 / math.pi, "quadratic"),
        Quantity("RMSE, m", "distance", slice(None), mean="quadratic"),
    )


ZHANG = (
    Quantity("RMS of position, m", "distance", mean="rms"),
    Quantity("RMS of orientation, rad", "turn", mean="rms"),
    Quantity("NEES of orientation", "orientation"),
    Quantity("NEES of pose", "pose"),
)
SOT: dict[str, Published] = {"robocentric/sot_normal": None}
"""The equivariant filter, which no table has."""
SLAMTB, HUANG = "slamtb (Solà)", "Barrau, Bonnabel 2015; Huang et al. 2010"
RAL, SONG = "Zhang et al. 2017", "Song et al. 2024"


SPELT = {
    "oc": "world+oc", "fej": "world+fej", "fej2": "world+fej2", "decoupled": "world+decoupled",
    "left": "left-invariant", "turned": "world, about its axes",
    "composed": "robocentric, composed first",
}  # fmt: skip


def cartesian(**theirs: Published) -> dict[str, Published]:
    """Rows of filters of Cartesian points, by names that `SPELT` makes those of filters."""
    return {f"{SPELT.get(name, name)}/cartesian": values for name, values in theirs.items()}


def positions(of: str, /, **theirs: Published) -> Study:
    """A table of Barrau and Bonnabel, and filters that it has not."""
    beside = cartesian(fej=None, fej2=None, decoupled=None) | SOT
    return Study(HUANG, partial(scenario, of), 100, 300, POSITIONS, cartesian(**theirs) | beside)


def zhang_of(share: float, /, **theirs: Published) -> Study:
    """A table of Zhang et al., and filters that it has not."""
    beside = cartesian(robocentric=None, oc=None, fej2=None, decoupled=None) | SOT
    world = partial(zhang, share)
    return Study(RAL, world, 100, 8, ZHANG, cartesian(**theirs) | beside, batch=None)


def affine() -> Study:
    """The circle of Song et al."""
    names = ("world", "fej", "fej2", "oc", "invariant", "decoupled", "robocentric")
    filters = cartesian(**dict.fromkeys(names))
    return Study(SONG, partial(scenario, "positions", AFFINE), 50, 50, ZHANG[2:], filters)


STUDIES = {
    "room": Study(
        SLAMTB, partial(scenario, "room"), 25, 100, ROOM,
        {
            "world/inverse_depth": (6.99, 6.57, 6.88, 0.082),
            "world/anchored_homogeneous": (7.00, 6.54, 6.83, 0.082),
            "world/inverse_depth_to_cartesian": (7.01, 6.45, 6.95, 0.078),
            "world/unit_homogeneous": (15.4, 56.2, 151.0, 0.113),
            "robocentric/unit_homogeneous": None,
            "robocentric/inverse_scaling": None,
        },
    ),
    "positions": positions(
        "positions", world=(4.77, 6.35), robocentric=(3.09, 3.37), oc=(3.10, 3.35),
        invariant=(3.10, 3.33),
    ),
    "positions-loose": positions(
        "positions-loose", world=(19.1, 29.9), robocentric=(5.11, 6.91), oc=(5.21, 7.02),
        invariant=(5.01, 6.62),
    ),
    "ukfm-slam2d": Study(
        "ukfm (Brossard)", partial(scenario, "positions", UKFM), 100, 200, of_parts(10),
        cartesian(world=(2.88, 2.56, 3.02, 0.67), invariant=(1.01, 1.17, 2.51, 0.55)),
    ),
    "ukfm-localisation": Study(
        "ukfm (Brossard)", localisation, 100, 400, of_parts(2000),
        cartesian(world=(4.91, 275.28, 12.00, 0.76), left=(1.00, 2.02, 11.35, 0.45)), every=100,
    ),
    "ukfm-inertial": Study(
        "ukfm (Brossard)", inertial, 100, 400, of_parts(1),
        cartesian(
            turned=(11.35, 276.29, 3.20, 0.82), world=None, invariant=(1.14, 1.37, 2.83, 0.24),
            left=None,
        ),
        every=100,
    ),
    "zhang-1": zhang_of(
        0.01, invariant=(0.25, 0.0058, 1.02, 1.01), fej=(0.29, 0.0071, 1.12, 1.14),
        world=(0.32, 0.0065, 1.34, 1.35), composed=(0.31, 0.0060, 1.04, 1.15),
    ),
    "zhang-5": zhang_of(
        0.05, invariant=(1.16, 0.027, 1.0, 1.01), fej=(1.24, 0.029, 1.05, 1.13),
        world=(2.0, 0.043, 3.7, 3.1), composed=(2.4, 0.041, 3.0, 7.5),
    ),
    "affine": affine(),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Tables(Benchmark):
    """Every published number that this library can give, beside its own.

    Theirs are means over few runs, so ours come with the interval in which 95 % of the means of
    that many runs are expected, by what our runs know: resampled twice, as many as ours, and of
    these as many as theirs.
    """

    studies: tuple[str, ...] = tuple(STUDIES)
    """Which of them; the file keeps the others."""
    filters: tuple[str, ...] = ()
    """Only these rows, `filter/landmarks`; all by default."""
    runs: int | None = None
    """Runs of every filter; by default, what the study says."""
    seed: int = 1
    out: Path = RESULTS / "published.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`{"rows": [{study, filter, quantity, ours, theirs, …}]}`, after every filter."""
        found = self.found().get("rows", []) if self.out.exists() else []
        for name in self.studies:
            study = STUDIES[name]
            study = study if self.runs is None else replace(study, runs=self.runs)
            batch = draw(study.world(), study.runs, seed=self.seed)
            for filter_name in (x for x in study.theirs if x in (self.filters or study.theirs)):
                start = time.perf_counter()
                records = errors(filter_name, study, batch)
                seconds = (time.perf_counter() - start) / study.runs
                found = [x for x in found if (x["study"], x["filter"]) != (name, filter_name)]
                rows = compared(study, filter_name, records)
                beside = {"study": name, "seed": self.seed, "seconds_per_run": round(seconds, 3)}
                found += [beside | row for row in rows]
                yield {"rows": sorted(found, key=_place)}

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "rivals.md", MARK, table_of(results["rows"])


def _place(row: dict[str, Any]) -> tuple[int, int]:
    study = STUDIES[row["study"]]
    return list(STUDIES).index(row["study"]), list(study.theirs).index(row["filter"])


def errors(name: str, study: Study, batch: tuple) -> dict[str, np.ndarray]:
    """Of every run and step NEES by its degrees of freedom, and the squares of the errors."""
    slam = make(name, study.world())
    room, runs = batch
    frames = np.arange(runs.visible.shape[1])
    seen = (study.every == 1) | ((frames > 1) & ((frames - 1) % study.every == 0))
    runs = replace(runs, visible=runs.visible & seen[None, :, None])

    def told(state, innovation, frame):
        estimate, P = jaxslam.camera_pose(slam, state)
        n, R = estimate.translation().shape[-1], estimate.rotation().as_matrix()
        moved = frame.pose.translation() - estimate.translation()
        turned = log(estimate.rotation().inverse() @ frame.pose.rotation())
        error, covariance = slam.pose_error(state, frame.pose)
        parts = (error, covariance), (turned, P[n:, n:]), (moved, R @ P[:n, :n] @ R.T)
        nees = (normalised_squared(*part) / part[0].size for part in parts)
        found = dict(zip(("pose", "orientation", "position"), nees, strict=True))
        return found | {"turn": jnp.sum(turned**2), "distance": jnp.sum(moved**2)}

    def one(run):
        return run_through(slam, room, run, told)[1]

    program = jax.jit(lambda runs: jax.lax.map(one, runs, batch_size=study.batch))
    return jax.device_get(program(runs))


def compared(study: Study, name: str, records: dict[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """The rows of a filter. What is not finite in a run leaves the run out, and is counted."""
    judged = [records[quantity.of][:, quantity.steps] for quantity in study.quantities]
    healthy = np.all([np.isfinite(of).all(axis=1) for of in judged], axis=0)
    count, rng = int(healthy.sum()), np.random.default_rng(0)
    ours = rng.multinomial(count, np.full(count, 1 / count), RESAMPLED)
    as_theirs = rng.multinomial(study.their_runs, ours / count) / study.their_runs
    theirs = study.theirs[name] or (None,) * len(study.quantities)
    for quantity, published in zip(study.quantities, theirs, strict=True):
        of = records[quantity.of][healthy]
        low, high = map(_rounded, np.quantile(quantity.value(of, as_theirs), [0.025, 0.975]))
        yield {
            "source": study.source,
            "filter": name,
            "quantity": quantity.told,
            "theirs": published,
            "their_runs": study.their_runs,
            "ours": _rounded(quantity.value(of, np.full((1, count), 1 / count))[0]),
            "our_runs": study.runs,
            "diverged": study.runs - count,
            "interval95": [low, high],
            "within": None if published is None else bool(low <= published <= high),
        }


def _rounded(value: float) -> float:
    """Four digits."""
    return float(f"{value:.4g}")


def table_of(rows: list[dict[str, Any]]) -> str:
    """The published values and ours."""
    lines = []
    for row in rows:
        low, high = row["interval95"]
        theirs = "–" if row["theirs"] is None else f"{row['theirs']:g}"
        theirs = theirs if row["within"] in (None, True) else f"**{theirs}**"
        ours = f"{row['ours']:.3g} [{low:.3g}, {high:.3g}]"
        lines.append((row["study"], row["filter"], row["quantity"], theirs, ours, row["our_runs"]))
    return table(("study", "filter", "quantity", "theirs", "ours [95 %]", "runs"), lines)


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
    run_one(Tables, Navlie)
