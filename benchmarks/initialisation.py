"""What a delayed initialisation costs: consistency, bias of depth, frames of delay.

    python benchmarks/initialisation.py --runs 200

Runs undelayed and delayed filters on the same worlds; scenarios that are in the file and are not
measured again stay there. `near` is the world of `matched` with points 0.5–5 m away, the range of
MonoSLAM's particles, and a camera at 0.4 m/s; in the others points lie beyond it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, OfRuns, by_batch
from jaxtyping import Array, Bool

import jaxslam
from jaxslam.consistency import draw, run_through
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera
from jaxslam.filters.rivals.depth_particles import DepthParticles
from jaxslam.filters.rivals.rays import RaySum
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import Room, Run, features
from jaxslam.statistics.bands import lost_threshold, normalised_squared

NEAR = {"inverse_depth": (1.1, 0.45), "least_inverse_depth": 0.225, "velocity": (0.4, 0.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class Initialisation(OfRuns):
    """Undelayed and delayed filters in the same worlds."""

    scenarios: tuple[str, ...] = ("near", "matched", "circle")
    """Built-in scenarios, or `near`."""
    filters: tuple[str, ...] = (
        "robocentric/inverse_scaling",
        "world/inverse_depth",
        "robocentric/cartesian",
        "world+particles/cartesian",
        "robocentric+particles/cartesian",
        "robocentric+particles30/cartesian",
        "robocentric+rays/cartesian",
    )
    """Filters with their landmarks."""
    steps: int | None = None
    """Filter steps; the scenario's by default."""
    chunk: int = 50
    out: Path = RESULTS / "initialisation.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        results = self.found()
        for name in self.scenarios:
            filters: dict[str, dict] = {}
            results[name] = {"runs": self.runs, "seed": self.seed, "filters": filters}
            for pair, numbers in measured(name, self):
                filters[pair] = numbers
                yield results


def measured(world: str, options: Initialisation) -> Iterator[tuple[str, dict]]:
    """All filters of one scenario."""
    fields = {} if options.steps is None else {"steps": options.steps}
    base, fields = ("matched", {**NEAR, **fields}) if world == "near" else (world, fields)
    scenario = jaxslam.scenario(base, fields)
    room, runs = draw(scenario, options.runs, seed=options.seed)
    for pair in options.filters:
        name, landmark = pair.split("/")
        slam = jaxslam.make_filters(scenario, [name], [landmark])[pair]
        run = jax.jit(jax.vmap(partial(filter_run, slam, room, scenario.sensor)))
        yield pair, summarise(by_batch(run, runs, options.chunk))


def filter_run(slam: AbstractFilter, room: Room, sensor: AbstractSensor, run: Run) -> dict:
    """One filter on one run: records of every step, and its landmarks at the last."""

    def told(state, innovation, frame):
        estimate, covariance = camera_pose(slam, state)
        missed = estimate.translation() - frame.pose.translation()
        return {
            "nees": normalised_squared(*slam.pose_error(state, frame.pose)),
            "squared_error": missed @ missed,
            "variance": jnp.trace(covariance[: missed.size, : missed.size]),
            "settled": initialised(slam, state),
        }

    last, records = run_through(slam, room, run, told)
    begun = initialised(slam, slam.init(room.capacity, features(run, room)[0]))
    records["settled"] = jnp.concatenate([begun[None], records["settled"]])
    return records | _landmarks(slam, room.landmarks, sensor, run, last)


def initialised(slam: AbstractFilter, state: Any) -> Bool[Array, " landmarks"]:
    """Which landmarks are in the map as points, no longer as alternatives."""
    if isinstance(slam, DepthParticles):  # the last number of a ray is 0, that of a point 1
        return state.gaussian.active & (state.gaussian.landmarks[:, -1] > 0.5)
    if isinstance(slam, RaySum):
        return jnp.sum(state.gaussian.active.reshape(-1, slam.slots_each), axis=1) == 1
    return slam.in_map(state)


def _landmarks(slam, count, sensor, run, state) -> dict:
    """Of every landmark: when it was first seen, and what became of it."""
    visible = run.visible[:, :count]
    first = jnp.argmax(visible, axis=0)
    T_CB = jax.tree.map(lambda x: x[-1], run.poses).inverse()
    chart, covariance = landmarks_in_camera(slam, state, jnp.arange(count), sensor)
    truth = 1 / jax.vmap(T_CB.apply)(run.points[:count])[:, -1]
    return {
        "begun": jnp.any(visible, axis=0),
        "first": first,
        "in_map": slam.in_map(state),
        "seen_last": visible[-1] & (first < visible.shape[0] - 1),
        "normalised": (chart[:, -1] - truth) / jnp.sqrt(covariance[:, -1, -1]),
    }


def summarise(records: dict) -> dict:
    """Numbers of one filter: over all runs but those whose NEES is not finite, which are lost.

    Of landmarks the shares of those begun, and the error of 1/z over σ of those that are settled
    and seen at the end.
    """
    healthy = np.isfinite(records["nees"]).all(axis=1)
    good = {key: value[healthy] for key, value in records.items()}
    nees, settled, begun = good["nees"][:, -1], good["settled"], good["begun"]
    ever = settled.any(axis=1) & begun
    delays = (np.argmax(settled, axis=1) - good["first"])[ever]
    known = settled[:, -1] & good["in_map"] & good["seen_last"] & begun
    errors = good["normalised"][known]
    return {
        "nees": float(nees.mean()),
        "nees_median": float(np.median(nees)),
        "lost": float(1 - np.sum(nees <= lost_threshold(3)) / healthy.size),
        "diverged": int(np.sum(~healthy)),
        "rmse": float(np.sqrt(good["squared_error"][:, -1].mean())),
        "sigma": float(np.sqrt(good["variance"][:, -1].mean())),
        "delay_mean": float(delays.mean()) if delays.size else None,
        "landmarks": {
            "all": {
                "settled": float(ever[begun].mean()),
                "dropped": float((~good["in_map"])[begun].mean()),
                "bias": float(errors.mean()) if errors.size else None,
            }
        },
    }


if __name__ == "__main__":
    Initialisation.run()
