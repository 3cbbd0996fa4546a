"""Filters along real trajectories and on recorded tracks: what is right beyond the scale?

    python benchmarks/handheld.py --filters robocentric scale_gauge+scene50+mixture9 --runs 200

Simulates runs along every trajectory in $JAXSLAM_DATA/trajectories (../shared/data by default), as
`jaxslam consistency --scenario handheld-NAME` does, and runs the same filters on the tracks of real
drives in $JAXSLAM_DATA/kitti_tracks. Results are added to `handheld.json` one filter at a time;
what it already has, of as many runs, is not run again. The table of `docs/handheld.md` is written
from it, by `--page` alone from what is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import tracks
from benchmark import RESULTS, Case, OfRuns, data_folder, table

import jaxslam
from jaxslam._numerics.arrays import cast
from jaxslam.consistency import SimulatedFrame, run_through, scale_records
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import camera_pose
from jaxslam.simulation import Room, Run, Scenario, sightings
from jaxslam.statistics import lost_threshold
from jaxslam.statistics.beyond_scale import SCALE, one_scale_of, reversal

DOF = 6
"""Of a pose in space; one scale a run takes from one of all its poses together to one of each."""
STEPS = (10, 30, 60, 100, 150)
"""Of which numbers are shown, where a run has them; and the last."""
TRACKS_PIXEL_SIGMA = 1.0
"""Of a tracked point, pixels.

Tracks drift smoothly and drag the motion with them, so what is left over says little: it is 0.15
pixels where bundle adjustment of 10 frames, told 0.5, is three times as wrong as it claims in
squares (2011_09_30_0020).
"""
STREET_NEAREST_DEPTH = 17.0
"""Whose prior on 1/z, N(0.029, 0.015²) 1/m, is that of the points of 2011_09_30_0020."""
TRUTH_SIGMA = np.array([0.1] * 3 + [np.radians(0.1)] * 3)
"""Of the true poses of the drives, m and rad."""
MARK = "<!-- by handheld.py -->"
"""Where the table stands in `docs/handheld.md`."""
RECORDS = ("log_scale", "log_scale_sigma", *SCALE, "reversed", "nis", "nis_dof")


@dataclass(frozen=True, kw_only=True)
class Handheld(OfRuns):
    """Filters along trajectories and drives."""

    filters: tuple[str, ...] = ("world", "robocentric", "scale_gauge+scene50+mixture9")
    """Filters, with modifiers."""
    landmarks: str = "inverse_scaling"
    """Landmark parametrization."""
    trajectories: tuple[str, ...] = ()
    """Names of trajectories; all of the data folder by default."""
    drives: tuple[str, ...] = ()
    """Names of drives with tracks; all of the data folder by default."""
    steps: int = 150
    starts: int = 20
    """Windows of every drive."""
    frames: int = 100
    """Steps of a window of a drive."""
    out: Path = RESULTS / "handheld.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """Add what is not measured yet, one filter at a time."""
        yield from self.added(_studies(self))

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "handheld.md", MARK, as_table(results)


def _studies(options: Handheld) -> Iterator[Case]:
    """Along every trajectory and on every drive, each filter."""
    simulated = {"runs": options.runs, "steps": options.steps, "seed": options.seed}
    recorded = {"runs": options.starts, "steps": options.frames}
    data = data_folder()  # where scenarios find them too
    for trajectory in options.trajectories or _known("trajectories/*.txt", "kitti_format"):
        world = jaxslam.scenario(f"handheld-{trajectory}", steps=options.steps)
        for name, slam in _filters(world, options).items():
            yield (world.name, name), simulated, partial(_simulated, world, name, slam, options)
    for drive in options.drives or _known("kitti_tracks/*/tracks.npz"):
        drove = tracks.read(data / "kitti_tracks" / drive)
        for name, slam in _filters(on_the_road(drove), options).items():
            yield (f"tracks-{drive}", name), recorded, partial(_recorded, drove, slam, options)


def _known(pattern: str, without: str = " ") -> list[str]:
    """Names in the data folder: of files, or of the folders that hold them."""
    paths = sorted(data_folder().glob(pattern))
    return [p.parent.name if p.suffix == ".npz" else p.stem for p in paths if without not in p.stem]


def _filters(scenario: Scenario, options: Handheld) -> dict[str, AbstractFilter]:
    return jaxslam.make_filters(scenario, list(options.filters), [options.landmarks])


def on_the_road(data: tracks.Tracks) -> Scenario:
    """What the filters are told of a drive: its camera, and the priors of a car."""
    (fx, fy), (cx, cy) = np.asarray(data.camera.focal), np.asarray(data.camera.centre)
    return jaxslam.scenario(
        "handheld",
        rate=10.0,
        image=[float(n) for n in data.image],
        focal=[float(fx), float(fy)],
        centre=[float(cx), float(cy)],
        pixel_sigma=TRACKS_PIXEL_SIGMA,
        nearest_depth=STREET_NEAREST_DEPTH,
        velocity_sigma=[10.0] * 3 + [1.0] * 3,
    )


def _simulated(
    scenario: Scenario, name: str, slam: AbstractFilter, options: Handheld
) -> dict[str, Any]:
    study = jaxslam.monte_carlo(
        scenario, {name: slam}, runs=options.runs, seed=options.seed, chunk=options.chunk
    )
    parts = [study.store.load(name, chunk, RECORDS) for chunk in study.chunks]
    return numbers({key: np.concatenate([part[key] for part in parts]) for key in RECORDS})


def _recorded(data: tracks.Tracks, slam: AbstractFilter, options: Handheld) -> dict[str, Any]:
    with jax.enable_x64(True):
        runs = tracks.windows(data, options.frames, options.starts)
        most = jax.tree.map(lambda x: max(1, int(x.max())), jax.vmap(sightings)(runs))
        room = Room(most.landmarks, most.first, most.known, most.new)
        return numbers(jax.device_get(_through(cast(slam, "float64"), room, runs)))


@eqx.filter_jit
def _through(slam: AbstractFilter, room: Room, runs: Run) -> dict[str, jax.Array]:
    """Records of a batch of windows, against a truth that is itself uncertain."""

    def told(state: Any, innovation: Any, frame: SimulatedFrame) -> dict[str, jax.Array]:
        estimate, _ = camera_pose(slam, state)
        return {
            **scale_records(slam, state, frame.pose, TRUTH_SIGMA),
            "reversed": reversal(estimate, frame.pose),
            "nis": innovation.nis,
            "nis_dof": innovation.nis_dof,
        }

    return jax.vmap(lambda run: run_through(slam, room, run, told)[1])(runs)


def numbers(records: dict[str, np.ndarray]) -> dict[str, Any]:
    """What `handheld.json` keeps of records (runs, steps): lists over the steps in `at`.

    Means are of the runs that are finite there; the others count as lost.
    """
    count = records["beyond_scale"].shape[1]
    at = [step for step in STEPS if step < count] + [count]
    one = one_scale_of(records)
    whole = {**records, "nees": one.nees, "drift": one.drift, "normalised": one.normalised}
    part = {key: np.asarray(values)[:, np.array(at) - 1] for key, values in whole.items()}
    nees, finite = part["nees"], np.isfinite(part["nees"])

    def mean(values: np.ndarray) -> list[float | None]:
        counted = finite & np.isfinite(values)
        sums = np.where(counted, values, 0.0).sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return _for_json(sums / counted.sum(axis=0))

    def root(values: np.ndarray) -> list[float | None]:
        return [None if x is None else float(np.sqrt(x)) for x in mean(values)]

    with np.errstate(invalid="ignore"):
        lost = ~(nees <= lost_threshold(DOF))
        normalised = (part["log_scale"] / part["log_scale_sigma"]) ** 2
        nis = np.nansum(records["nis"]) / np.nansum(records["nis_dof"])
    return {
        "at": at,
        "one_scale": mean(nees / DOF),
        "one_scale_median": _for_json(np.median(np.where(finite, nees, np.inf), axis=0) / DOF),
        "drift_rms": root(part["drift"] ** 2),
        "drift_normalised": root(part["normalised"]),
        "lost": lost.mean(axis=0).tolist(),
        "log_scale_normalised": root(normalised),
        "reversed": mean(part["reversed"]),
        "nis": _for_json(np.array([nis]))[0],
    }


def _for_json(values: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


COLUMNS = (
    "path", "NEES/dof: mean; median", "median at earlier steps", "lost", "drift",
    "log-scale error", "reversed", "NIS",
)  # fmt: skip


def _row(where: str, found: dict[str, Any]) -> list[str]:
    """One path: the numbers of the last step, and how NEES came there."""

    def shown(key: str, form: str, unit: str = "", i: int = -1) -> str:
        value = found[key][i]
        return "–" if value is None else f"{format(value, form if value < 1e3 else '.1e')}{unit}"

    before = range(len(found["at"]) - 1)
    return [
        where.removeprefix("handheld-"),
        f"{shown('one_scale', '.2f')}; {shown('one_scale_median', '.2f')}",
        " ".join(shown("one_scale_median", ".2f", i=i) for i in before) or "–",
        shown("lost", ".0%"),
        shown("drift_normalised", ".1f", " σ"),
        shown("log_scale_normalised", ".1f", " σ"),
        shown("reversed", ".0%"),
        "–" if found["nis"] is None else f"{found['nis']:.2f}",
    ]


def as_table(results: dict[str, Any]) -> str:
    """A table for each filter: a row for each path, simulated ones first."""
    names = sorted({name for filters in results.values() for name in filters})
    parts = []
    for name in names:
        those = {where: f[name] for where, f in sorted(results.items()) if name in f}
        rows = (_row(where, found) for where, found in those.items())
        counts = {
            f"{found['runs']} runs of {found['steps']} steps ({_kind(where)})"
            for where, found in those.items()
        }
        parts += [f"`{name}`, {', '.join(sorted(counts))}:", table(COLUMNS, rows)]
    return "\n\n".join(parts)


def _kind(where: str) -> str:
    return "tracks" if where.startswith("tracks-") else "simulated"


if __name__ == "__main__":
    Handheld.run()
