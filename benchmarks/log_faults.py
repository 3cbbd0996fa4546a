"""What is between an estimate's log and a truth's: how often it is named, and how often wrongly.

    python benchmarks/log_faults.py

Logs of right filters, and of ones whose σ is too small by a factor, each with one fault between
the logs: their verdicts and the causes that are named. It writes a JSON file of its name.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmark import RESULTS, Benchmark
from scipy.spatial.transform import Rotation
from verdicts import correlated, displaced

from jaxslam.evaluation import Evaluation, evaluate_log, write_covariances
from jaxslam.evaluation.alignment import Similarity
from jaxslam.evaluation.convention import Convention, converted
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.io.tum import poses as poses_of
from jaxslam.io.tum import quaternions, write_tum

SEED = 2026
FACTORS = (1.0, 1.5, 3.0)
"""By which σ is too small."""
RUNS = (6, 30)
"""Fewest and most runs of a log."""
STEP, DENSE = 0.1, 10
"""Seconds from an estimate to the next, and the true poses to each."""
CONVENTIONS = (
    Convention("right"), Convention("left"), Convention("split", "world"),
    Convention("split", "mixed"), Convention("right", order="rotation-first"),
)  # fmt: skip


class Flight(NamedTuple):
    """The logs of a filter, whose errors are drawn from its covariances: runs, steps."""

    times: np.ndarray
    estimates: np.ndarray
    covariances: np.ndarray
    dense_times: np.ndarray
    dense: np.ndarray
    """The truth at its own, higher rate."""
    convention: Convention

    @property
    def truths(self) -> np.ndarray:
        return self.dense[:, ::DENSE]


class Fault(NamedTuple):
    """One fault between the logs, and a word of what names it."""

    put: Callable[[np.random.Generator, Flight], Flight]
    word: str
    written: bool = False
    """Whether it is one of files."""
    align: str = "none"


def paths(rng: np.random.Generator, runs: int, times: np.ndarray) -> np.ndarray:
    """Smooth true poses (runs, n, 4, 4): on wheels, on hills, or held in a hand."""
    tilt = rng.choice([0.02, 0.15, 0.6])
    count = 4
    frequency, phase = rng.uniform(0.5, 4, (2, runs, 1, 3, count))
    angles = np.sum(np.sin(frequency * times[:, None, None] + 7 * phase), axis=-1) / count
    angles *= np.array([tilt, tilt, 2.0])
    angles[..., 2] += rng.uniform(-3, 3, (runs, 1))
    turn = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_matrix().reshape(runs, -1, 3, 3)
    speed = rng.uniform(0.3, 2.0)
    steps = speed * np.gradient(times)[:, None] * turn[..., 0]
    T = np.tile(np.eye(4), (runs, len(times), 1, 1))
    T[..., :3, :3], T[..., :3, 3] = turn, np.cumsum(steps, axis=1)
    return T


def flight(rng: np.random.Generator, runs: int, steps: int, factor: float = 1.0) -> Flight:
    """A filter whose errors are `factor` times as large as it says, and correlated in time."""
    dense_times = np.arange(steps * DENSE) * STEP / DENSE
    dense, times = paths(rng, runs, dense_times), dense_times[::DENSE]
    size = np.repeat(np.exp(rng.uniform(np.log([0.01, 0.003]), np.log([0.15, 0.04]))), 3)
    spread = size * np.exp(rng.uniform(0, 1, 6))
    root = np.diag(spread) @ (np.eye(6) + 0.2 * rng.normal(size=(6, 6)))
    growth = np.linspace(rng.choice([0.1, 0.3, 1.0]), 1.0, steps)[:, None, None]
    P = np.broadcast_to(growth**2 * (root @ root.T), (runs, steps, 6, 6))
    noise = correlated(rng.normal(size=(steps + 1, runs, 6)), rng.choice([0.0, 0.9, 0.98]))[:-1]
    errors = factor * np.swapaxes(noise, 0, 1) @ np.swapaxes(root, 0, 1) * growth[..., 0]
    convention = CONVENTIONS[rng.integers(len(CONVENTIONS))]
    at_truth = dense[:, ::DENSE]
    # T̂ of T: displaced makes truths of estimates, so that P belongs to the estimate.
    own = Convention(convention.error, convention.axes)
    estimates = at_truth.copy()
    for _ in range(4):
        off = displaced(estimates, errors, own)
        estimates = estimates @ np.linalg.inv(off) @ at_truth
    if convention.order == "rotation-first":
        P = np.roll(P, 3, axis=(2, 3))
    return Flight(times, estimates, P, dense_times, dense, convention)


def rotation(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    """About a random axis, by degrees whose logs are uniform."""
    axis = rng.normal(size=3)
    angle = np.radians(np.exp(rng.uniform(np.log(low), np.log(high))))
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


def of_body(rng: np.random.Generator, log: Flight, turn: bool, arm: bool) -> Flight:
    X = np.eye(4)
    if turn:
        X[:3, :3] = rotation(rng, 3, 180)
    if arm:
        direction = rng.normal(size=3)
        X[:3, 3] = rng.uniform(0.3, 1.0) * direction / np.linalg.norm(direction)
    return log._replace(dense=log.dense @ X)


def w_first(_: np.random.Generator, log: Flight) -> Flight:
    T = log.estimates.reshape(-1, 4, 4)
    q = quaternions(T[:, :3, :3])[:, [3, 0, 1, 2]]
    return log._replace(estimates=poses_of(T[:, :3, 3], q).reshape(log.estimates.shape))


def another_world(rng: np.random.Generator, log: Flight, upright: bool = False) -> Flight:
    R = rotation(rng, 10, 180)
    if upright:
        R = Rotation.from_euler("z", rng.uniform(-3, 3)).as_matrix()
    S = Similarity(R, rng.uniform(-20, 20, 3), 1.0)
    T, split = S.moved(log.estimates), Convention("split")
    P = S.block @ converted(log.covariances, log.estimates, log.convention, split) @ S.block.T
    return log._replace(estimates=T, covariances=converted(P, T, split, log.convention))


def late(rng: np.random.Generator, log: Flight) -> Flight:
    return log._replace(times=log.times + rng.choice([-1, 1]) * rng.uniform(0.02, 0.2))


def half_angles(_: np.random.Generator, log: Flight) -> Flight:
    scale = np.where(np.arange(6) >= 3, 0.5, 1.0)
    if log.convention.order == "rotation-first":
        scale = scale[::-1]
    return log._replace(covariances=scale[:, None] * log.covariances * scale)


def of_angles(rng: np.random.Generator, log: Flight) -> Flight:
    """Covariances of roll, pitch and yaw, said to be of rotations along the world's axes."""
    P = converted(log.covariances, log.estimates, log.convention, Convention("split", "rpy"))
    stated = Convention("split", ("world", "mixed")[rng.integers(2)])
    return log._replace(covariances=P, convention=stated)


def misstated(rng: np.random.Generator, log: Flight) -> Flight:
    others = [x for x in CONVENTIONS if x != log.convention]
    return log._replace(convention=others[rng.integers(len(others))])


def unchanged(_: np.random.Generator, log: Flight) -> Flight:
    return log


CONVENTION, BODIES = "convention of the covariances is another", "two bodies"
FAULTS = {
    "none": Fault(unchanged, ""),
    "none, files": Fault(unchanged, "", written=True),
    "none, another world aligned by se3": Fault(another_world, "", align="se3"),
    "w first": Fault(w_first, "w first"),
    "body, turned": Fault(lambda r, x: of_body(r, x, True, False), BODIES),
    "body, lever arm": Fault(lambda r, x: of_body(r, x, False, True), BODIES),
    "body, both": Fault(lambda r, x: of_body(r, x, True, True), BODIES),
    "another world": Fault(another_world, "not in one world"),
    "another world, upright": Fault(lambda r, x: another_world(r, x, True), "not in one world"),
    "clock": Fault(late, "clocks", written=True),
    "half angles": Fault(half_angles, "half angles"),
    "roll, pitch, yaw": Fault(of_angles, CONVENTION),
    "wrong convention": Fault(misstated, CONVENTION),
    "column by column": Fault(unchanged, "column by column", written=True),
    "doubled stamps": Fault(unchanged, "doubled", written=True),
}


def judged(
    name: str, factor: float, number: int, of_runs: tuple[int, int] = RUNS
) -> tuple[str, Evaluation]:
    """What is said of a log of so many runs: `named`, another cause, `false`, or a word; and the
    evaluation."""
    fault = FAULTS[name]
    rng = np.random.default_rng([SEED, list(FAULTS).index(name), round(10 * factor), number])
    runs, steps = int(rng.integers(of_runs[0], of_runs[1] + 1)), int(rng.integers(25, 41))
    log = fault.put(rng, flight(rng, runs, steps, factor))
    if fault.written:
        with tempfile.TemporaryDirectory() as folder:
            written(Path(folder), log, name)
            found = evaluate_log(folder, align=fault.align)
    else:
        logs = log.estimates, log.covariances, log.truths
        found = evaluate_poses(*logs, log.convention, align=fault.align)
    said = [x.what for x in found.mistakes if x.certain]
    if fault.word in " ".join([*said, *found.notes]) and fault.word:
        return "named", found
    if said:
        return f"false: {said[0]}", found
    word = found.verdict["word"]
    return "over-confident" if word == "lost" else word, found


def written(folder: Path, log: Flight, name: str) -> None:
    """A sub-folder of files for every run."""
    for run, T in enumerate(log.estimates):
        own = folder / f"run{run:02}"
        own.mkdir()
        times, P = log.times, log.covariances[run]
        if name == "doubled stamps":  # of which the first is a prediction, somewhere else
            rows = np.repeat(np.arange(len(T)), 2)
            times, T, P = times[rows], T[rows].copy(), P[rows]
            T[::2, :3, 3] += 1.0
        write_tum(own / "estimate.txt", times, T)
        write_tum(own / "truth.txt", log.dense_times, log.dense[run])
        write_covariances(own / "covariance.txt", times, P, log.convention)
        if name == "column by column":
            lower = np.column_stack([times, P[:, *np.tril_indices(6)]])
            np.savetxt(own / "covariance.txt", lower, header=str(log.convention))


@dataclass(frozen=True, kw_only=True)
class LogFaults(Benchmark):
    """How often a fault between the logs is named, and how often something else is.

    Logs of 6 to 30 runs of 25 to 40 poses: on wheels, on hills or held in a hand, with errors that
    are drawn from covariances along any axes, growing or not, correlated from pose to pose or not.
    σ is right, or too small by 1.5 or 3.
    """

    logs: int = 20
    """Of every fault and factor."""
    factors: tuple[float, ...] = FACTORS
    """By which σ is too small."""
    runs: tuple[int, int] = RUNS
    """The fewest and the most runs of a log."""
    seconds: float = 600.0
    """After so many no further round of logs begins."""
    out: Path = RESULTS / "log_faults.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        start, counts = time.monotonic(), {}
        for number in range(self.logs):
            if time.monotonic() - start > self.seconds:
                return
            for name in FAULTS:
                for factor in self.factors:
                    said = judged(name, factor, number, self.runs)[0]
                    counts.setdefault((name, factor), Counter())[said] += 1
            rows = [
                {"fault": name, "factor": factor, "logs": count.total(), "said": dict(count)}
                for (name, factor), count in counts.items()
            ]
            yield {"rows": rows}


if __name__ == "__main__":
    LogFaults.run()
