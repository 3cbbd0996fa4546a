"""Is it the noise or the model? The six scenarios of Yan, Hsu, Sun, arXiv:2509.03311.

    python benchmarks/noise_or_model.py

A covariance is `credible`, `optimistic` or `pessimistic`: k times the right one, with k = 1, from
0.1 to 0.8, or from 1.25 to 10. Errors have no mean, or one of 1.6 to 2.4 in a random direction:
each is uniform in its range, as in the authors' code. In the filters the mean is in σ.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from benchmark import RESULTS, Benchmark, table

import jaxslam
from jaxslam.consistency import draw, of_simulation
from jaxslam.filters.run import MeasuredRun
from jaxslam.statistics import mean_band
from jaxslam.statistics.calibration import bias

MARK = "<!-- noise_or_model.py -->"
SCALES = {"credible": (1.0, 1.0), "optimistic": (0.1, 0.8), "pessimistic": (1.25, 10.0)}
"""k, by which the covariance is wrong."""
SIZE = (1.6, 2.4)
"""The length of a mean."""
ERRORS = 100
"""Independent errors of a trial."""
MOTION = jaxslam.Odometry([0.02, 0.03, 0.01])
SENSOR = jaxslam.RangeBearing([0.1, 0.02])


@dataclass(frozen=True, kw_only=True)
class NoiseOrModel(Benchmark):
    """Errors of two numbers with a covariance, as published, by their mean and NEES; and logs of a
    robot by `jaxslam.tune`, where the mean is that of the odometry or of the measurements.

    The answer on errors is one of six. That on logs is `noise` without a mean and `model` with one.
    """

    trials: int = 50
    """Of every scenario."""
    tunings: int = 10
    """Of every scenario."""
    logs: int = 3
    """Logs of a tuning, with one mean."""
    steps: int = 150
    out: Path = RESULTS / "noise_or_model.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`[of][scenario]`: trials, right answers, and all answers by their number."""
        rng, results = np.random.default_rng(0), {}
        for scale, mean in itertools.product(SCALES, ("", " + bias")):
            found = [judged(rng, SCALES[scale], mean) for _ in range(self.trials)]
            results.setdefault("errors", {})[scale + mean] = counted(found, scale + mean)
        posts = jaxslam.Ring(landmarks=6, radius=8.0)
        world = jaxslam.World(MOTION, SENSOR, posts, steps=self.steps, rate=10.0)
        room, runs = draw(world, self.tunings * self.logs)
        each = [
            of_simulation(room, jax.tree.map(lambda x, i=i: x[i], runs))
            for i in range(self.tunings * self.logs)
        ]
        trials = [each[i :: self.tunings] for i in range(self.tunings)]
        for of, scale in itertools.product(("", "odometry", "measurements"), SCALES):
            found = [tuned(rng, SCALES[scale], of, logs) for logs in trials]
            right = "model" if of else "noise"
            name = f"{scale} + bias of {of}" if of else scale
            results.setdefault("logs", {})[name] = counted(found, right)
            yield results

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        rows = [
            (of, name, row["trials"], f"{row['right'] / row['trials']:.0%}", told(row["answers"]))
            for of, found in results.items()
            for name, row in found.items()
        ]
        header = "judged", "scenario", "trials", "right", "answers"
        yield "own-data.md", MARK, table(header, rows)


def counted(found: list[str], right: str) -> dict[str, Any]:
    answers = {name: found.count(name) for name in sorted(set(found))}
    return {"trials": len(found), "right": found.count(right), "answers": answers}


def told(answers: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in answers.items())


def towards(rng: np.random.Generator, size: int) -> np.ndarray:
    """A mean in a random direction."""
    direction = rng.normal(size=size)
    return rng.uniform(*SIZE) * direction / np.linalg.norm(direction)


def judged(rng: np.random.Generator, scales: tuple[float, float], mean: str) -> str:
    """The answer on errors: whether they have a mean (Student's t of each axis, at 1 % in all), and
    the side of the 95 % band on which their mean NEES about it is."""
    turn, _ = np.linalg.qr(rng.normal(size=(2, 2)))
    covariance = turn @ np.diag(rng.uniform(0.5, 2.0, 2)) @ turn.T
    center = towards(rng, 2) if mean else np.zeros(2)
    errors = rng.multivariate_normal(center, covariance, ERRORS)
    claimed = np.linalg.cholesky(rng.uniform(*scales) * covariance)
    z = np.linalg.solve(claimed, errors.T).T
    biased = 2 * bias(z[:, None], np.ones((ERRORS, 1), bool)).p.min() < 0.01
    nees = np.sum((z - z.mean(axis=0)) ** 2) / (ERRORS - 1)
    low, high = mean_band(2, ERRORS - 1)
    word = "optimistic" if nees > high else "pessimistic" if nees < low else "credible"
    return word + (" + bias" if biased else "")


def tuned(
    rng: np.random.Generator, scales: tuple[float, float], of: str, logs: list[MeasuredRun]
) -> str:
    """The word of `tune` on logs, by a filter whose Q and R are k times the right ones."""
    factor = np.sqrt(rng.uniform(*scales))
    motion = jaxslam.Odometry(factor * np.asarray(MOTION.noise_sigma))
    sensor = jaxslam.RangeBearing(factor * np.asarray(SENSOR.sigma))
    moved = towards(rng, 3) * MOTION.noise_sigma if of == "odometry" else np.zeros(3)
    off = towards(rng, 2) * SENSOR.sigma if of == "measurements" else np.zeros(2)

    def biased(log: MeasuredRun) -> MeasuredRun:
        frames = log.frames
        assert log.first is not None
        first, seen, new = (
            replace(x, measured=x.measured + off) for x in (log.first, frames.seen, frames.new)
        )
        frames = frames._replace(control=frames.control + moved, seen=seen, new=new)
        return replace(log, first=first, frames=frames)

    slam = jaxslam.Slam(motion, sensor, jaxslam.Cartesian())
    return jaxslam.tune(slam, [biased(log) for log in logs]).word


if __name__ == "__main__":
    NoiseOrModel.run()
