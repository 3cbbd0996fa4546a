"""The table of ukfm's 2-D SLAM (Brossard, Barrau, Bonnabel, ICRA 2020) out of our filters.

`python benchmarks/ukfm.py` simulates its setting, ten rounds on a circle of 2500 steps with 20
landmarks beside it, and prints the NEES of orientation and position by their degrees of freedom,
means over all steps and 100 runs, beside theirs. Poses and covariances go through
`jaxslam.evaluate`, orientation and position apart, as theirs do: the position along the world's
axes, its covariance that of the error `p − p̂` whatever the filter's own error is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from benchmark import RESULTS, Benchmark, table

import jaxslam
from jaxslam.consistency import draw, run_through
from jaxslam.evaluation.convention import Convention, converted, pose_errors

SPEED, TURN = 0.25, math.radians(1.5)
SETTING = {
    "steps": 2499,
    "velocity": (0.0, SPEED, TURN),
    # Wheels do not slip sideways; a tenth of a millimetre keeps the covariance positive definite.
    "odometry_sigma": (1e-4, 0.05 * SPEED / math.sqrt(2), 0.1 * SPEED * math.sqrt(2)),
    "landmarks": 20,
    "ring_radius": SPEED / TURN + 3.0,
    "range": (1.0, 5.0),
    "position_sigma": 0.1,
}
THEIRS = {"world/cartesian": (2.88, 2.56), "invariant/cartesian": (1.01, 1.17)}
"""NEES/dof of orientation and position: their EKF and their invariant EKF, 100 runs."""
FIRST = 10
"""Steps that they leave out."""
RIGHT, MIXED = Convention("right"), Convention("split", "mixed")


@dataclass(frozen=True, kw_only=True)
class Ukfm(Benchmark):
    """Both filters; ours is printed beside theirs."""

    runs: int = 100
    """Runs of each filter."""
    seed: int = 0
    chunk: int = 25
    """Runs in one batch."""
    out: Path = RESULTS / "ukfm.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        results = {}
        for name in THEIRS:
            results[name] = measured(name, self)
            yield {"runs": self.runs, "seed": self.seed, "filters": results, "ukfm": THEIRS}

    def report(self, results: dict[str, Any]) -> None:
        rows = []
        for name, found in results["filters"].items():
            parts = zip((found["orientation"], found["position"]), THEIRS[name], strict=True)
            rows.append((name, *(_cell(part, theirs) for part, theirs in parts)))
        header = "filter", "orientation, NEES/dof (theirs)", "position (theirs)"
        print(table(header, rows), flush=True)


def poses_of(name: str, options: Ukfm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimated poses (runs, steps, 3, 3), covariances of the right error, and the truth."""
    scenario = jaxslam.scenario("positions", SETTING)
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


def measured(name: str, options: Ukfm) -> dict:
    """NEES/dof of orientation and of position, with the verdict on each."""
    T, P, truth = poses_of(name, options)
    P, errors = converted(P, T, RIGHT, MIXED), pose_errors(MIXED, T, truth)
    result = {}
    for part, axes in (("orientation", slice(2, 3)), ("position", slice(0, 2))):
        found = jaxslam.evaluate(errors[..., axes], P[..., axes, axes])
        nees = found.nees.mean(axis=1) / found.dof
        rng = np.random.default_rng(0)
        means = [rng.choice(nees, 100).mean() for _ in range(20_000)]
        result[part] = {
            "nees": round(float(nees.mean()), 3),
            "interval95_of_100_runs": np.quantile(means, [0.025, 0.975]).round(3).tolist(),
            "verdict": found.verdict["word"],
            "sigma_factor": found.verdict["sigma_factor"],
        }
    whole = jaxslam.evaluate_poses(T, P, truth, MIXED)
    return result | {"identified": str(whole.identified and whole.identified.convention)}


def _cell(part: dict, theirs: float) -> str:
    low, high = part["interval95_of_100_runs"]
    return f"{part['nees']:.2f} [{low:.2f}, {high:.2f}] ({theirs})"


if __name__ == "__main__":
    Ukfm.run()
