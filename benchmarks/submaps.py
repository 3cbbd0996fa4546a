"""Submaps and loops, judged by truth: what does a filter believe of long ago, before and after?

    python benchmarks/submaps.py --scenarios laps laps-6dof --runs 100

Simulates runs that come back to where they were, through a filter with submaps. A landmark that
comes back is a new one to the filter, until loops say that it is not: at the end of every lap those
in view are paired with the landmarks that they were before, a share of them wrongly; joint
compatibility decides. Compared are the filter without submaps, the chain before the loops and after
them, and the batch solution of all measurements, which is told from the start which landmark is
which. Results are added to `submaps.json`, and their table to `docs/submaps.md`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, OfRuns, number, table
from submaps_batch import batch_positions

import jaxslam
from jaxslam.consistency import run_through
from jaxslam.filters import Chain, Loops, agreeing, base_poses, chain, close
from jaxslam.filters.slam import Slam
from jaxslam.filters.submaps.handover import SubmapsState
from jaxslam.geometry import difference, scaled
from jaxslam.simulation import Room, Run, Scenario, simulate
from jaxslam.statistics import lost_threshold, normalised_squared, one_scale
from jaxslam.statistics.beyond_scale import beyond_scale

MARK = "<!-- by submaps.py -->"
FILTER = "scale_gauge+oc+scene50"
COUNTS = ("pairs", "wrong", "true_believed", "wrong_believed")
LAPS = 5
"""Times that loops are looked for, evenly over a run."""


@dataclass(frozen=True, kw_only=True)
class Submaps(OfRuns):
    """Submaps and loops."""

    scenarios: tuple[str, ...] = ("laps", "laps-6dof")
    runs: int = 100
    steps: int = 0
    """Fewer than the scenario's, if not 0."""
    chunk: int = 20
    seed: int = 11
    spare: int = 24
    """Slots for what is out of view."""
    history: int = 128
    """Submaps that are kept."""
    wrong: float = 0.0
    """Share of the pairs that are wrong."""
    out: Path = RESULTS / "submaps.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """Add what is not measured yet, one scenario at a time."""
        of = {"runs": self.runs, "seed": self.seed, "wrong": self.wrong, "steps": self.steps}
        yield from self.added(
            ((f"{name}, {100 * self.wrong:.0f} % wrong",), of, partial(measured, self, name))
            for name in self.scenarios
        )

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "submaps.md", MARK, page(results)


def page(results: dict[str, Any]) -> str:
    """The table of all scenarios."""
    header = (
        "scenario", "runs", "NEES now: one filter, submaps, after loops", "NEES of old cameras: "
        "before, after", "RMSE, m: before, after, batch", "lost", "loops: found, wrong",
    )  # fmt: skip
    rows = []
    for name, r in results.items():
        parts = (
            [number(r[key]) for key in keys]
            for keys in (
                ("nees_filter", "nees_submaps", "nees_closed"),
                ("old_before", "old_closed"),
                ("rmse_before", "rmse_closed", "rmse_batch"),
            )
        )
        believed = f"{100 * r['recall']:.0f} %, {r['wrong_believed']}"
        rows.append((name, r["used"], *map(", ".join, parts), f"{100 * r['lost']:.1f} %", believed))
    return table(header, rows)


def measured(options: Submaps, name: str) -> dict[str, Any]:
    """The numbers of one scenario."""
    scenario = jaxslam.scenario(name, {"steps": options.steps} if options.steps else {})
    word = "robocentric+oc" if scenario.reads else FILTER
    (slam,) = jaxslam.make_filters(scenario, [word], ["inverse_scaling"]).values()
    found, size = [], min(options.chunk, options.runs)
    for start in range(0, options.runs, size):
        found += of_chunk(options, scenario, slam, range(start, min(start + size, options.runs)))
    return {"filter": word, **averages(found, scenario.geometry.tangent_dim)}


def averages(found: list[dict[str, Any]], t: int) -> dict[str, Any]:
    """Over runs that the filter without submaps has not lost."""
    all_of = {key: np.array([one[key] for one in found]) for key in found[0]}
    lost = all_of["nees_filter"] * t > lost_threshold(t)
    good = ~lost & np.isfinite(all_of["rmse_closed"])
    count = {key: int(all_of.pop(key).sum()) for key in COUNTS}
    return {
        "used": int(good.sum()),
        "lost": float(lost.mean()),
        "recall": count["true_believed"] / max(1, count["pairs"] - count["wrong"]),
        "wrong_believed": count["wrong_believed"],
        "wrong_pairs": count["wrong"],
        **{
            key: float(np.sqrt(np.mean(x[good] ** 2)) if "rmse" in key else np.mean(x[good]))
            for key, x in all_of.items()
        },
    }


def merged(run: Run, told: Filtered, loops: Loops, believed, chained: Chain) -> np.ndarray:
    """Which landmark every slot has in every frame; those of a loop are one."""
    numbers = np.array(told.numbers)
    left = np.asarray(run.new)[1]  # what frame 0 saw is seen in frame 1, but for these
    first = np.where(left, numbers.max() + 1 + np.arange(left.size), numbers[0])
    numbers = np.concatenate([first[None], numbers])
    of_link = np.asarray(chained.links.numbers)
    for pair, slots in zip(
        np.asarray(loops.submaps)[believed], np.asarray(loops.slots)[believed], strict=True
    ):
        old, new = of_link[pair, slots]
        numbers[numbers == new] = numbers[numbers == old].min(initial=old)
    return numbers


class Filtered(NamedTuple):
    """What a filter says after every step of a run."""

    nees: Any
    count: Any
    numbers: Any
    """Of the landmark in every slot; −1 where there is none."""


def of_chunk(options, scenario: Scenario, slam, indices: range) -> list[dict[str, Any]]:
    """The numbers of some runs."""
    runs = simulated(scenario, options.seed, indices)
    slots = scenario.in_view
    room = Room(slots, slots, slots, slots)
    around = replace(slam, frame=jaxslam.Submaps(options.spare, options.history))
    plain, _ = filtered(slam, room, runs)
    ours, states = filtered(around, room, runs)
    rows = []
    for i in range(len(indices)):
        run, state, told = jax.tree.map(lambda x, i=i: x[i], (runs, states, ours))
        row = of_run(options, scenario, around, run, state, told, indices[i])
        rows.append({"nees_filter": float(plain.nees[i, -1]), **row})
        print(indices[i], {k: round(float(v), 3) for k, v in rows[-1].items()}, flush=True)
    return rows


def simulated(scenario: Scenario, seed: int, indices: range) -> Run:
    """Runs of these numbers, a batch."""
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(jnp.asarray(indices))
    return jax.jit(jax.vmap(lambda key: simulate(scenario, key)))(keys)


@eqx.filter_jit
def filtered(slam: Slam, room: Room, runs: Run) -> tuple[Filtered, Any]:
    """What is said of every step, and the last state."""

    def output(state, innovation, frame):
        error, P = slam.pose_error(state, frame.pose)
        nees = normalised_squared(error, P) / error.size
        if not isinstance(state, SubmapsState):
            return Filtered(nees, jnp.zeros((), int), jnp.zeros(0, int))
        return Filtered(nees, state.count, jnp.append(state.numbers, -1)[state.slots])

    return jax.vmap(lambda run: run_through(slam, room, run, output)[::-1])(runs)


def of_run(options, scenario, slam, run: Run, state, told: Filtered, index: int) -> dict[str, Any]:
    """The numbers of one run: of its chain before and after its loops."""
    count, frames = int(state.count), np.flatnonzero(np.diff(np.r_[0, told.count])) + 1
    if count > options.history:
        raise ValueError(f"{count} submaps, and a history of {options.history}")
    kept = min(options.history, 8 * -(-count // 8))  # runs of nearly one length share programs
    chained = _chain(slam, state, kept)
    ended = np.r_[frames, scenario.steps]
    truth = jax.tree.map(lambda x: x[ended], run.poses)
    truth = _padded(truth, kept + 1)
    laps, wrong = paired(options, scenario, chained, run, told, index)
    loops = jax.tree.map(lambda *all: jnp.concatenate(all), *laps)
    there, trusted = np.asarray(loops.valid), np.zeros(len(loops.valid), bool)
    nothing = closed = _close(chained, replace(loops, valid=jnp.asarray(trusted)))
    for i, lap in enumerate(laps):  # one after the other, as a camera comes to them
        agree = np.asarray(_agreeing(closed, lap).valid)
        trusted[i * len(agree) : (i + 1) * len(agree)] = agree
        start = time.perf_counter()
        closed = jax.block_until_ready(_close(chained, replace(loops, valid=jnp.asarray(trusted))))
        seconds = time.perf_counter() - start
    mine = slice(chained.shape[0] - 1 - count, None)
    row = {
        "pairs": int(there.sum()),
        "wrong": int(wrong.sum()),
        "true_believed": int((trusted & ~wrong).sum()),
        "wrong_believed": int((trusted & wrong).sum()),
        "submaps": count,
        "seconds": seconds,
        "nees_submaps": float(told.nees[-1]),
        "converged": float(closed.converged),
        "unit_variance": float(closed.unit_variance()),
    }
    positions = np.asarray(truth.translation())[mine]
    for name, of in (("before", nothing), ("closed", closed)):
        poses, *scales = jax.tree.map(lambda x: np.asarray(x)[mine], _judged(of, truth))
        nees = one_scale(*scales).nees / scenario.geometry.tangent_dim
        row[f"nees_{name}"] = float(nees[-1])
        row[f"old_{name}"] = float(nees[:-1].mean())
        row[f"rmse_{name}"] = _rmse(poses, positions)
    who = merged(run, told, loops, trusted & ~wrong, chained)
    best = batch_positions(slam.one, replace(run, identity=who), 1 / scenario.rate)[ended]
    row["rmse_batch"] = _rmse(best, positions)
    return row


def _rmse(positions, truth) -> float:
    return float(np.sqrt(np.mean(np.sum((positions - truth) ** 2, axis=1))))


def _padded(poses, count: int):
    """Poses with others in front of them."""

    def one(x):
        return jnp.concatenate([jnp.tile(x[:1], (count - len(x), 1)), x])

    return jax.tree.map(one, poses)


@eqx.filter_jit
def _chain(slam, state, count: int) -> Chain:
    return chain(slam, state, count)


_agreeing, _close = jax.jit(agreeing), jax.jit(close)


@jax.jit
def _judged(of, truth):
    """The last cameras' positions, m, and of each the `BeyondScale`."""

    def metric(states):
        poses = base_poses(of.chain, states)
        return jax.vmap(lambda T, unit: scaled(T, unit))(poses, _units(states))

    poses, P = of.marginal(metric)
    t = poses.tangent_dim
    N = len(P) // t
    P = P.reshape(N, t, N, t)[jnp.arange(N), :, jnp.arange(N)]

    def one(pose, P, truth):
        return beyond_scale(lambda T: (difference(T, pose), P), truth)

    return poses.translation(), *jax.vmap(one)(poses, P, truth)


def _units(states):
    """The unit of each submap, m."""
    log_scale = states.core.log_scale
    if log_scale is None:
        return jnp.ones(states.landmarks.shape[0])
    return jnp.exp(jnp.sum(log_scale, axis=1))


def paired(
    options, scenario, chained: Chain, run: Run, told: Filtered, index: int
) -> tuple[list[Loops], np.ndarray]:
    """Pairs of landmarks in view with the first that the same point was: a `Loops` each time, all
    of one size, and which of them all are wrong."""
    rng = np.random.default_rng(index)
    numbers, identity = np.asarray(told.numbers), np.asarray(run.identity)[1:]
    there = numbers >= 0
    point_of = dict(zip(numbers[there].tolist(), identity[there].tolist(), strict=True))
    first: dict[int, int] = {}
    for landmark, point in sorted(point_of.items()):
        first.setdefault(point, landmark)
    places: dict[int, tuple[int, int]] = {}  # the last submap that has a landmark, and its slot
    for submap, slots in enumerate(np.asarray(chained.links.numbers)):
        places.update((n, (submap, slot)) for slot, n in enumerate(slots.tolist()) if n >= 0)
    laps, all_wrong, done = [], [], set()
    every = len(numbers) // LAPS
    for frame in range(every - 1, len(numbers), every):
        both = np.zeros((scenario.in_view, 2, 2), int)
        valid, wrong = np.zeros((2, scenario.in_view), bool)
        for i, new in enumerate(numbers[frame][there[frame]].tolist()):
            old = first[point_of[new]]
            if new in done or places[old][0] >= places[new][0] or old == new:
                continue
            done.add(new)
            if rng.random() < options.wrong:
                others = [n for n in first.values() if n != old and places[n][0] < places[new][0]]
                old, wrong[i] = int(rng.choice(others)), True
            both[i], valid[i] = (places[old], places[new]), True
        laps.append(Loops(*map(jnp.asarray, (both[:, :, 0], both[:, :, 1], valid))))
        all_wrong.append(wrong)
    return laps, np.concatenate(all_wrong)


if __name__ == "__main__":
    Submaps.run()
