"""A camera with an inertial unit along recorded trajectories, as OpenVINS simulates it.

    JAXSLAM_DATA=data python benchmarks/inertial.py

The recipe (Geneva et al., ICRA 2020): 10 Hz camera, pixels of σ 1, 400 Hz unit of the ADIS16448's
noise, points thrown at 5 to 7 m, a start that is known to 1 cm/s and 1°. The trajectories are
`trajectories/udel_gore.txt` and `tum_corridor1.txt` of the folder. Results are added one filter at
a time; what is there, of as many runs, is not run again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from benchmark import RESULTS, OfRuns

import jaxslam
from jaxslam.consistency import run_through
from jaxslam.consistency.simulator import Simulator
from jaxslam.geometry import log
from jaxslam.statistics.bands import chi2_quantile, normalised_squared

RECIPE = {"depth_range": [5.0, 7.0], "inverse_depth": [0.1682, 0.0164], "landmarks": 30}
"""With the mean and σ of 1/z of points that are uniform between 5 and 7 m."""
PARTS = {"orientation": slice(3, 6), "position": slice(0, 3)}


@dataclass(frozen=True, kw_only=True)
class Inertial(OfRuns):
    """Filters along recorded trajectories."""

    trajectories: tuple[str, ...] = ("udel_gore", "tum_corridor1")
    """Names of trajectories in `$JAXSLAM_DATA/trajectories`."""
    filters: tuple[str, ...] = (
        "robocentric", "recommended", "invariant", "world+oc", "world", "world+fej",
    )  # fmt: skip
    """Filters, with modifiers, of Inverse Scaling."""
    runs: int = 100
    steps: int = 1600
    seed: int = 20261128
    out: Path = RESULTS / "inertial.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`[trajectory][filter]`: NEES per degree of freedom of orientation and position, of every
        third and of the last second, and the share of lost runs."""
        yield from self.each(self._measured, self.trajectories, self.filters, steps=self.steps)

    def _measured(self, trajectory: str, name: str) -> dict[str, Any]:
        world = jaxslam.scenario("imu", RECIPE, trajectory=trajectory, sway=[], steps=self.steps)
        (slam,) = jaxslam.make_filters(world, [name]).values()
        nees, errors = _of_runs(slam, world, self)
        nees = np.where(np.isfinite(nees), nees, np.inf)
        found: dict[str, Any] = {}
        for index, part in enumerate(PARTS):
            third = self.steps // 3
            spans = {
                "first": slice(third), "second": slice(third, 2 * third),
                "last": slice(2 * third, None), "end": slice(-10, None),
            }  # fmt: skip
            means = {of: nees[:, span, index].mean(axis=1) / 3 for of, span in spans.items()}
            found[part] = {of: [float(x.mean()), *_interval95(x)] for of, x in means.items()}
            found[part]["rmse"] = float(np.sqrt(np.mean(errors[:, -1, index])))
        lost = np.any(nees[:, -1] > chi2_quantile(0.9999, 3), axis=1)
        return found | {"lost": float(np.mean(lost))}


def _interval95(by_run: np.ndarray) -> list[float]:
    """Where 95 % of the means of as many runs lie."""
    means = np.random.default_rng(0).choice(by_run, (20_000, len(by_run))).mean(axis=1)
    return np.quantile(means, [0.025, 0.975]).round(3).tolist()


def _of_runs(slam, world, options: Inertial) -> tuple[np.ndarray, np.ndarray]:
    """NEES and squared errors of orientation and position (runs, steps, 2)."""

    def told(state, innovation, frame):
        estimate, covariance = jaxslam.camera_pose(slam, state)
        back = estimate.rotation().inverse()
        position = back @ (frame.pose.translation() - estimate.translation())
        orientation = log(back @ frame.pose.rotation())
        errors = zip((orientation, position), PARTS.values(), strict=True)
        return [(normalised_squared(e, covariance[part, part]), e @ e) for e, part in errors]

    # Batch by batch, as the readings of all runs together need many gigabytes.
    simulator = Simulator(world, options.seed, "float64", options.chunk)
    starts = range(0, options.runs, options.chunk)
    chunks = tuple(range(start, start + options.chunk) for start in starts)
    room = simulator.room(chunks, lambda of, parts: ((part, of(part)) for part in parts))
    batch = jax.jit(jax.vmap(lambda run: run_through(slam, room, run, told)[1]))
    found = [np.array(batch(simulator(chunk)[0])) for chunk in chunks]
    # Of two parts, each NEES and error: runs, steps, part.
    whole = np.moveaxis(np.concatenate(found, axis=2), (0, 1), (-2, -1))[: options.runs]
    return whole[..., 0], whole[..., 1]


if __name__ == "__main__":
    Inertial.run()
