"""What a delayed initialisation costs: consistency, bias of depth, information, frames of delay.

    python benchmarks/initialisation.py --runs 200

Runs undelayed and delayed filters on the same worlds, prints a table, and writes one JSON file;
scenarios that are in the file and are not measured again stay there.
`near` is the world of `matched` with points 0.5–5 m away, the range of MonoSLAM's particles, and
a camera at 0.4 m/s; in the others points lie beyond it.
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
from benchmark import RESULTS, Benchmark, by_batch, number, table
from jaxtyping import Array, Bool

import jaxslam
from jaxslam.consistency.montecarlo import draw
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera
from jaxslam.filters.rivals.depth_particles import DepthParticles
from jaxslam.filters.rivals.rays import RaySum
from jaxslam.linalg import cholesky
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import Room, Run, features
from jaxslam.statistics.bands import lost_threshold, normalised_squared

NEAR = {"inverse_depth": (1.1, 0.45), "least_inverse_depth": 0.225, "velocity": (0.4, 0.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class Initialisation(Benchmark):
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
    """Filters with their landmarks. Information is compared with the first one's."""
    runs: int = 200
    """Runs of every filter."""
    seed: int = 0
    """Run i draws from this seed and i alone."""
    steps: int | None = None
    """Filter steps; the scenario's by default."""
    chunk: int = 50
    """Runs in one batch."""
    out: Path = RESULTS / "initialisation.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        results = self.found()
        for name in self.scenarios:
            filters: dict[str, dict] = {}
            results[name] = {"runs": self.runs, "seed": self.seed, "filters": filters}
            for pair, numbers in measured(name, self):
                filters[pair] = numbers
                yield results

    def report(self, results: dict[str, Any]) -> None:
        rows = [
            (name, pair, *_cells(f))
            for name, of in results.items()
            for pair, f in of["filters"].items()
        ]
        print(table(HEADER, rows), flush=True)


def measured(world: str, options: Initialisation) -> Iterator[tuple[str, dict]]:
    """All filters of one scenario."""
    fields = {} if options.steps is None else {"steps": options.steps}
    base, fields = ("matched", {**NEAR, **fields}) if world == "near" else (world, fields)
    scenario = jaxslam.scenario(base, fields)
    room, runs = draw(scenario, options.runs, seed=options.seed)
    sensor, reference = scenario.sensor, None
    for pair in options.filters:
        name, landmark = pair.split("/")
        slam = jaxslam.make_filters(scenario, [name], [landmark])[pair]
        run = jax.jit(jax.vmap(partial(filter_run, slam, room, sensor)))
        records = by_batch(run, runs, options.chunk)
        if reference is None:
            reference = records["information"]
        yield pair, summarise(records, reference)


def filter_run(slam: AbstractFilter, room: Room, sensor: AbstractSensor, run: Run) -> dict:
    """One filter on one run: records of every step, and its landmarks at the last."""
    first, seen, new = features(run, room)
    state = slam.init(room.capacity, first)
    settled = partial(initialised, slam)

    def step(state, frame):
        seen, new, control, T_BC = frame
        state, _ = slam.step(state, control, seen, new)
        estimate, covariance = camera_pose(slam, state)
        missed = estimate.translation() - T_BC.translation()
        return state, {
            "nees": normalised_squared(*slam.pose_error(state, T_BC)),
            "squared_error": missed @ missed,
            "variance": jnp.trace(covariance[: missed.size, : missed.size]),
            "information": -cholesky(covariance).log_det(),
            "settled": settled(state),
        }

    later = jax.tree.map(lambda x: x[1:], run.poses)
    last, records = jax.lax.scan(step, state, (seen, new, run.controls, later))
    records["settled"] = jnp.concatenate([settled(state)[None], records["settled"]])
    return records | _landmarks(slam, room.landmarks, sensor, run, last)


def initialised(slam: AbstractFilter, state: Any) -> Bool[Array, " landmarks"]:
    """Which landmarks are in the map as points, no longer as alternatives."""
    if isinstance(slam, DepthParticles):  # the last number of a ray is 0, that of a point 1
        return state.gaussian.active & (state.gaussian.landmarks[:, -1] > 0.5)
    if isinstance(slam, RaySum):
        return jnp.sum(state.gaussian.active.reshape(-1, slam.slots_each), axis=1) == 1
    return slam.in_map(state)


def _landmarks(slam, count, sensor, run, state) -> dict:
    """Of every landmark: when and how far away it was first seen, and what became of it."""
    visible = run.visible[:, :count]
    first = jnp.argmax(visible, axis=0)
    positions = run.poses.translation()
    T_CB = jax.tree.map(lambda x: x[-1], run.poses).inverse()
    points = run.points[:count]
    slots = jnp.arange(count)
    chart, covariance = landmarks_in_camera(slam, state, slots, sensor)
    truth = 1 / jax.vmap(T_CB.apply)(points)[:, -1]
    return {
        "begun": jnp.any(visible, axis=0),
        "first": first,
        "distance": jnp.linalg.norm(points - positions[first], axis=1),
        "in_map": slam.in_map(state),
        "seen_last": visible[-1] & (first < visible.shape[0] - 1),
        "normalised": (chart[:, -1] - truth) / jnp.sqrt(covariance[:, -1, -1]),
    }


def summarise(records: dict, reference: np.ndarray) -> dict:
    """Numbers of one filter: over all runs but those whose NEES is not finite, which are lost."""
    healthy = np.isfinite(records["nees"]).all(axis=1)
    good = {key: value[healthy] for key, value in records.items()}
    nees, dof = good["nees"][:, -1], 3
    settled, begun = good["settled"], good["begun"]
    ever = settled.any(axis=1) & begun
    delays = (np.argmax(settled, axis=1) - good["first"])[ever]
    known = settled[:, -1] & good["in_map"] & good["seen_last"]
    steps = good["information"].shape[1]
    # Half of log det P a dimension: how much larger σ is than the reference's.
    ratio = np.exp((reference[healthy] - good["information"]).mean(axis=0) / (2 * dof))
    return {
        "nees": float(nees.mean()),
        "nees_median": float(np.median(nees)),
        "lost": float(1 - np.sum(nees <= lost_threshold(dof)) / healthy.size),
        "diverged": int(np.sum(~healthy)),
        "rmse": float(np.sqrt(good["squared_error"][:, -1].mean())),
        "sigma": float(np.sqrt(good["variance"][:, -1].mean())),
        "sigma_ratio_third": float(ratio[steps // 3 - 1]),
        "sigma_ratio_end": float(ratio[-1]),
        "delay_mean": float(delays.mean()) if delays.size else None,
        "delay_median": float(np.median(delays)) if delays.size else None,
        "landmarks": {
            name: _landmark_numbers(good, known, ever, begun & which)
            for name, which in _by_distance(good["distance"]).items()
        },
    }


def _by_distance(distance: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "all": np.ones_like(distance, bool),
        "within 5 m": distance <= 5,
        "5-30 m": (distance > 5) & (distance <= 30),
        "beyond 30 m": distance > 30,
    }


def _landmark_numbers(good: dict, known, ever, which) -> dict | None:
    """Shares of the landmarks begun; error of 1/z over σ of those settled and seen at the end."""
    count = int(which.sum())
    if not count:
        return None
    errors = good["normalised"][known & which]
    return {
        "count": count,
        "settled": float(ever[which].mean()),
        "dropped": float((~good["in_map"])[which].mean()),
        "compared": int(errors.size),
        "bias": float(errors.mean()) if errors.size else None,
        "bias_median": float(np.median(errors)) if errors.size else None,
        "spread": float(np.sqrt((errors**2).mean())) if errors.size else None,
    }


HEADER = (
    "scenario", "filter/landmarks", "NEES", "median", "lost", "RMSE m", "σ m", "σ/σ₀ ⅓", "end",
    "delay", "settled", "dropped", "bias/σ", "rms/σ",
)  # fmt: skip


def _cells(f: dict[str, Any]) -> tuple[str, ...]:
    landmarks = f["landmarks"]["all"]
    return (
        number(f["nees"], ".3g"),
        number(f["nees_median"]),
        f"{f['lost']:.1%}",
        *(number(f[key], ".3f") for key in ("rmse", "sigma")),
        *(number(f[key]) for key in ("sigma_ratio_third", "sigma_ratio_end")),
        number(f["delay_mean"], ".1f"),
        *(f"{landmarks[key]:.1%}" for key in ("settled", "dropped")),
        *(number(landmarks[key]) for key in ("bias", "spread")),
    )


if __name__ == "__main__":
    Initialisation.run()
