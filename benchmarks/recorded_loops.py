"""Loops along recorded trajectories in full: is the whole path believable when they have closed?

    python benchmarks/recorded_loops.py --runs 8

Simulates a camera along whole trajectories of $JAXSLAM_DATA/trajectories (../shared/data by
default), from rest, through a filter with submaps. Landmarks that leave the view are gone for good.
Where the camera is again where it was, landmarks of the earlier submap are seen anew, with the
noise of a pixel: the tracker's own machinery then believes the loop or refuses it, and corrects all
submaps. Results are added to `recorded_loops.json`, their table to `docs/submaps.md`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from benchmark import RESULTS, OfRuns, data_folder, number, table
from submaps import Filtered, filtered, simulated

import jaxslam
from jaxslam.evaluation.alignment import similarity
from jaxslam.filters.protocol import LandmarkView
from jaxslam.filters.slam import Slam
from jaxslam.filters.submaps.handover import Frozen, SubmapsState
from jaxslam.geometry import difference
from jaxslam.io.calibration import Calibration
from jaxslam.models.frame import Submaps
from jaxslam.simulation import Room, Run, Scenario
from jaxslam.statistics import one_scale
from jaxslam.statistics.beyond_scale import beyond_scale
from jaxslam.tracking.places.closing import APART, GATE
from jaxslam.tracking.places.relocalisation import FEWEST, pose_of, well_known
from jaxslam.tracking.places.submaps import Graph, LoopClosure, Solved, Submap, loop_of
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance

MARK = "<!-- by recorded_loops.py -->"
RATES = {"kitti_00": 10.0, "tumvi_room1": 30.0}
"""Frames a second of recordings whose rate is not `RATE`, Hz."""
RATE = 20.0
LENSES: dict[str, dict[str, Any]] = {"tum_corridor1": {"focal": (250.0, 250.0)}}
"""Of recordings whose lens is wide: 104° in place of 52°."""
TURN = np.radians(30)
"""The greatest angle between two rays to a landmark from which it looks the same …"""
NEARER = 2.0
"""… and the greatest ratio of its distances."""


@dataclass(frozen=True, kw_only=True)
class RecordedLoops(OfRuns):
    """Loops along recorded trajectories."""

    trajectories: tuple[str, ...] = ("udel_gore", "tum_corridor1", "kitti_00")
    """Names of trajectories."""
    filter: str = "recommended"
    """The filter, with modifiers."""
    runs: int = 8
    steps: int = 0
    """Fewer than the whole trajectory has, if not 0."""
    chunk: int = 4
    seed: int = 11
    spare: int = 24
    """Slots for what is out of view."""
    history: int = 768
    """Submaps that are kept."""
    out: Path = RESULTS / "recorded_loops.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """Add what is not measured yet, one trajectory at a time."""
        worlds = {name: whole(name, self.steps) for name in self.trajectories}
        of = {"runs": self.runs, "seed": self.seed}
        yield from self.added(
            (
                (name,),
                of | {"steps": scenario.steps},
                lambda scenario=scenario: {"each": list(of_scenario(self, scenario))},
            )
            for name, scenario in worlds.items()
        )

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "submaps.md", MARK, page(results)


def page(results: dict[str, Any]) -> str:
    """The table of all trajectories: means of what is of one run, and sums of the loops."""
    header = (
        "trajectory", "runs", "length, m; frames; submaps", "NEES now: before, after",
        "NEES of old cameras: before, after", "ATE, m: before, after", "loops: closed, refused",
    )  # fmt: skip
    rows = []
    for name, found in results.items():
        each = {key: np.array([row[key] for row in found["each"]]) for key in found["each"][0]}
        mean = {key: values.mean() for key, values in each.items()}
        size = f"{mean['length']:.0f}; {found['steps']}; {mean['submaps']:.0f}"
        pairs = [
            ", ".join(number(mean[f"{what}_{when}"]) for when in ("before", "after"))
            for what in ("now", "old", "ate")
        ]
        loops = f"{each['loops'].sum()}, {each['refused'].sum()}"
        rows.append((name, found["runs"], size, *pairs, loops))
    return table(header, rows)


def whole(trajectory: str, steps: int) -> Scenario:
    """The scenario along a trajectory from its beginning to its end, or of fewer steps."""
    path, rate = data_folder() / "trajectories" / f"{trajectory}.txt", RATES.get(trajectory, RATE)
    times = np.loadtxt(path, usecols=0)
    every = int((times[-1] - times[0]) * rate + 1e-6)
    lens = LENSES.get(trajectory, {})
    return jaxslam.scenario(f"handheld-{trajectory}", rate=rate, steps=steps or every, **lens)


def of_scenario(options: RecordedLoops, scenario: Scenario) -> Iterator[dict[str, Any]]:
    """The numbers of every run."""
    (base,) = jaxslam.make_filters(scenario, [options.filter], ["inverse_scaling"]).values()
    assert isinstance(base, Slam)
    slam = replace(base, frame=jaxslam.Submaps(options.spare, options.history))
    for start in range(0, options.runs, options.chunk):
        indices = range(start, min(start + options.chunk, options.runs))
        runs = simulated(scenario, options.seed, indices)
        began = time.perf_counter()
        told, states = jax.device_get(filtered(slam, _room(runs), runs))
        seconds = (time.perf_counter() - began) / len(indices)
        for i, index in enumerate(indices):
            run, state, one = jax.tree.map(lambda x, i=i: x[i], (runs, states, told))
            closing = Closing(scenario, slam, run, state, one, np.random.default_rng(index))
            row = {**closing.numbers(), "seconds": round(seconds, 1)}
            print(scenario.name, index, {k: round(float(v), 3) for k, v in row.items()}, flush=True)
            yield row


def _room(runs: Run) -> Room:
    slots = runs.visible.shape[-1]
    assert runs.new is not None
    return Room(slots, slots, slots, int(runs.new[:, 1:].sum(axis=-1).max()))


class Closing:
    """One run whose loops are closed."""

    def __init__(
        self, scenario: Scenario, slam: Slam, run: Run, state: SubmapsState, told: Filtered,
        noise: np.random.Generator,
    ) -> None:  # fmt: skip
        assert isinstance(slam.frame, Submaps)
        history = slam.frame.history
        if int(state.count) > history:
            raise ValueError(f"{int(state.count)} submaps, and a history of {history}")
        self.scenario, self.slam, self.noise = scenario, slam, noise
        ended = np.flatnonzero(np.diff(np.r_[0, told.count])) + 1
        self.truth = np.asarray(run.poses.as_matrix())[np.r_[ended, scenario.steps]]
        self.points = _points_by_number(run, told)
        fx, fy, cx, cy = (float(x) for x in (*scenario.focal, *scenario.centre))
        width, height = (int(x) for x in scenario.image)
        self.camera = Calibration(width, height, fx, fy, cx, cy)
        _, newest = slam.inner.gaussian(state.inner, None)
        last = Frozen(newest, np.zeros_like(state.numbers, bool), state.numbers)
        place = np.arange(int(state.count)) % history
        frozen = jax.tree.map(lambda all, one: np.stack([*all[place], one]), state.frozen, last)
        points, covariances = jax.device_get(_points(slam, frozen.state))
        *self.submaps, self.present = (
            Submap(jax.tree.map(lambda x, k=k: x[k], frozen), X, P, PoseWithCovariance(), k)
            for k, (X, P) in enumerate(zip(points, covariances, strict=True))
        )

    def numbers(self) -> dict[str, Any]:
        """Of the path, before its loops and after them."""
        before = self.judged(self.graph([]).solved())
        loops, refused, seconds = self.closed()
        after = self.judged(self.graph(loops).solved())
        steps = np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=1)
        return {
            "length": float(steps.sum()),
            "submaps": len(self.submaps),
            "loops": len(loops),
            "refused": refused,
            "closing": seconds,
            **{f"{key}_before": value for key, value in before.items()},
            **{f"{key}_after": value for key, value in after.items()},
        }

    def graph(self, loops: list[LoopClosure]) -> Graph:
        most = self.scenario.landmarks
        return Graph(self.slam.one, self.submaps, self.present, loops, most)

    def closed(self) -> tuple[list[LoopClosure], int, float]:
        """The loops that are believed, the number of those refused, and the time of the last."""
        loops, refused, seconds = [], 0, 0.0
        for q in range(len(self.submaps)):
            apart = max(APART, q // 8)
            found = self.proposed(q) if not loops or q - loops[-1].submaps[1] >= apart else None
            if found is not None:
                began = time.perf_counter()
                compared = self.graph(loops).with_loop(found)
                seconds = time.perf_counter() - began
                if compared.nis < GATE:
                    loops.append(found)
                else:
                    refused += 1
        return loops, refused, seconds

    def proposed(self, q: int) -> LoopClosure | None:
        """The loop from the end of submap q to the earlier one of which it shows the most."""
        best = None
        for p in range(q - APART):
            slots, pixels = self.seen(p, q)
            if len(slots) >= FEWEST and (best is None or len(slots) > len(best[1])):
                best = p, slots, pixels
        if best is None:
            return None
        p, slots, pixels = best
        noisy = pixels + self.scenario.pixel_sigma * self.noise.normal(size=pixels.shape)
        posed = pose_of(self.submaps[p].points[slots], noisy, self.camera)
        if posed is None:
            return None
        T, which = posed
        sigma, most = self.scenario.pixel_sigma, self.scenario.landmarks
        return loop_of(self.slam.one, self.submaps, (p, q), slots[which], T, sigma, most)

    def seen(self, p: int, q: int) -> tuple[np.ndarray, np.ndarray]:
        """The slots of submap p whose landmarks the last camera of q shows so that they would be
        known again, and where; none where one of them never left the view."""
        submap, C_p, T_q = self.submaps[p], self.truth[p][:3, 3], self.truth[q]
        sure = well_known(submap.points, submap.covariances) & np.asarray(submap.frozen.carried)
        slots = np.flatnonzero(sure)
        if np.isin(submap.numbers[slots], self.submaps[q].numbers).any():
            return slots[:0], np.zeros((0, 2))
        points = self.points[submap.numbers[slots]]
        before, now = points - C_p, points - T_q[:3, 3]
        far = np.linalg.norm(before, axis=1), np.linalg.norm(now, axis=1)
        alike = np.sum(before * now, axis=1) > np.cos(TURN) * far[0] * far[1]
        alike &= np.abs(np.log(far[1] / far[0])) < np.log(NEARER)
        X = now @ T_q[:3, :3]
        ahead = X[:, 2] > self.scenario.visible_depth
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (X / X[:, 2:]) @ self.camera.matrix[:2].T
        inside = ahead & np.all((pixels >= 0) & (pixels < self.scenario.image), axis=1)
        return slots[inside & alike], pixels[inside & alike]

    def judged(self, solved: Solved) -> dict[str, float]:
        """NEES per degree of freedom at the one scale of the run, and the error of the path."""
        nees = one_scale(*jax.device_get(_judged(*solved[:2], self.truth))).nees / 6
        fit = similarity(solved.T_bc[:, :3, 3], self.truth[:, :3, 3], scaled=True)
        away = fit.moved(solved.T_bc)[:, :3, 3] - self.truth[:, :3, 3]
        ate = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
        return {"now": float(nees[-1]), "old": float(nees[:-1].mean()), "ate": ate}


def _points_by_number(run: Run, told: Filtered) -> np.ndarray:
    """The true points of all landmarks, by their numbers."""
    numbers, points = np.asarray(told.numbers), np.asarray(run.points_by_frame)[1:]
    known = np.zeros((numbers.max() + 1, points.shape[-1]))
    there = numbers >= 0
    known[numbers[there]] = points[there]
    return known


@jax.jit
def _judged(T: jax.Array, P: jax.Array, truth: jax.Array) -> Any:
    """The `BeyondScale` of every camera."""

    def one(T: jax.Array, P: jax.Array, truth: jax.Array) -> Any:
        pose = jaxlie.SE3.from_matrix(T)
        return beyond_scale(lambda true: (difference(true, pose), P), jaxlie.SE3.from_matrix(truth))

    return jax.vmap(one)(T, P, truth)


@eqx.filter_jit
def _points(slam: Slam, states: Any) -> tuple[jax.Array, jax.Array]:
    """The landmarks of all submaps in their last cameras, in the filter's unit."""

    def point(view: LandmarkView) -> jax.Array:
        metres = 0.0 if view.log_scale is None else jnp.sum(view.log_scale)
        return jnp.exp(-metres) * view.point / view.omega

    slots = jnp.arange(states.active.shape[1])
    return jax.vmap(lambda state: slam.one.landmark_marginal(state, point, slots))(states)


if __name__ == "__main__":
    RecordedLoops.run()
