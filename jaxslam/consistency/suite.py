"""A suite of simulated runs in plain files, for filters of any program, and what draws them."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import read_json, write_atomically, write_json
from jaxslam._runtime.lookup import lookup
from jaxslam.consistency.montecarlo import check_sizes, draw
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import World, as_scenario, scenario

SUITE = ("matched", "matched-loose", "matched-forward-loose", "circle", "matched-6dof")
"""Little noise, where any right EKF is consistent, in the plane and in space; much, where few are;
and landmarks that come and go, with depths that are not the prior's."""

AXES = {
    "planar": ("x", "z", "rotation"),
    "spatial": ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z"),
}
"""The camera's position in its axes, m; orientation, rad."""


@dataclasses.dataclass(frozen=True)
class SuiteScenario:
    """A scenario of a suite, and what draws its runs."""

    scenario: World
    runs: int
    seed: int

    @cached_property
    def tables(self) -> dict[str, tuple[tuple[str, ...], Float[np.ndarray, "rows columns"]]]:
        """The names of columns and the rows of every file, by its name; drawn once.

        Raises ValueError for another sensor than a camera, and for landmarks that share slots, and
        so have no numbers.
        """
        s, axes = self.scenario, AXES[self.scenario.geometry.name]
        if s.inertial:
            raise ValueError(f"{s.name}: --suite has no table of inertial readings")
        if not isinstance(s.sensor, Pinhole) or s.beacons:
            has = "beacons" if s.beacons else f"a {type(s.sensor).__name__} sensor"
            raise ValueError(f"{s.name} has {has}; --suite supports cameras only, without beacons")
        with jax.enable_x64(True):
            batch = jax.device_get(draw(s, self.runs, seed=self.seed)[1])
            turns = batch.poses.rotation().log()
        if batch.new is not None:
            raise ValueError(
                f"{s.name}: its landmarks share slots, so they have no numbers of their own; "
                "--suite needs in_view=0 and a placement other than rays"
            )
        seen, (run, step) = np.nonzero(batch.visible), np.indices(batch.visible.shape[:2])
        pose = np.dstack([run, step, step / s.rate, batch.poses.translation(), turns])
        pixel = ("run", "step", "landmark", "u", "v")[: 3 + s.geometry.pixel_dim]
        tables = {
            "measurements.csv": (pixel, np.column_stack([*seen, batch.measured[seen]])),
            "truth.csv": (("run", "step", "time", *axes), pose.reshape(-1, pose.shape[-1])),
        }
        if s.reads:
            rows = np.dstack([run[:, 1:], step[:, 1:], batch.controls]).reshape(-1, 2 + len(axes))
            tables["controls.csv"] = ("run", "step", *axes), rows
        return tables


def write_suite(
    folder: str | Path,
    scenarios: Iterable[str | World] = SUITE,
    *,
    runs: int = 100,
    seed: int = 0,
    truth: bool = True,
) -> None:
    """Write a folder with a sub-folder of plain files for every scenario, whole or not at all.

    Without the `truth` the seed is left out too. Raises ValueError for a folder that is there, and
    without a scenario.
    """
    check_sizes(runs, seed, "float64", runs)
    folder, chosen = Path(folder), [as_scenario(name) for name in scenarios]
    if not chosen:
        raise ValueError(
            f"a suite needs at least one scenario; by default it has {', '.join(SUITE)}"
        )
    if folder.exists():
        raise ValueError(f"{folder} already exists; name a new folder")
    with write_atomically(folder) as temporary:
        for one in chosen:
            (place := temporary / one.name).mkdir(parents=True)
            tables, depth = SuiteScenario(one, runs, seed).tables, one.depth
            for name, (columns, rows) in tables.items():
                form = ["%d" if x in ("run", "step", "landmark") else "%.12g" for x in columns]
                if truth or name != "truth.csv":
                    np.savetxt(place / name, rows, form, ",", header=",".join(columns), comments="")
            told = {
                "runs": runs,
                "seed": seed if truth else None,
                "depth_prior": {"mean": float(depth.mean), "sigma": float(depth.sigma)},
                "checksum": tables["measurements.csv"][1].sum(),
                "scenario": one.to_dict(),
            }
            write_json(place / "scenario.json", told)
        shutil.copy(Path(__file__).with_suffix(".md"), temporary / "README.md")


def read_suite(
    folder: str | Path, names: Iterable[str], seed: int | None = None
) -> dict[str, SuiteScenario]:
    """Return what draws the runs of these scenarios of a suite, by their names.

    A suite without the truth needs its `seed`. Raises ValueError, naming the file, for another.
    """

    def parse(told: Any) -> SuiteScenario:
        if not isinstance(told, dict) or not told.keys() >= {"scenario", "runs", "seed"}:
            raise ValueError("no scenario of a suite, with its runs and seed")
        drawn = told["seed"] if seed is None else seed
        if drawn is None:
            raise ValueError("its seed is hidden with the truth; --seed is needed")
        check_sizes(told["runs"], drawn, "float64", 1)
        found = SuiteScenario(scenario("matched", told["scenario"]), told["runs"], drawn)
        rows = found.tables["measurements.csv"][1]
        if not np.isclose(rows.sum(), told.get("checksum", np.nan), rtol=1e-9):
            raise ValueError(f"seed {drawn} draws other runs; the one of the suite is accepted")
        return found

    paths = {path.parent.name: path for path in sorted(Path(folder).glob("*/scenario.json"))}
    chosen = lookup(f"scenario of the suite in {folder}", names, paths)
    return {name: read_json(path, "scenario", parse) for name, path in chosen.items()}
