"""Which treatment of an uncertain calibration is consistent under which truth?

`python benchmarks/calibration.py` runs every treatment (white, consider, estimated, known) where
the intrinsics are drawn in every frame (`white`), once a run (`constant`) or exact (`nominal`),
for a camera that turns and one that does not, and writes `calibration.json` and
`docs/calibration.md`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, OfRuns, at_end, by_batch, number, table

import jaxslam
from jaxslam.consistency import MemoryStore, Seconds, Study, draw, filter_run
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import Room, Run, Scenario
from jaxslam.statistics import mean_band, normalised_squared
from jaxslam.statistics.verdict import LOST_BOUND

MARK, SAID = "<!-- calibration.py -->", "<!-- calibration.py, in words -->"
TRUTH = {
    "white": "drawn in every frame",
    "constant": "drawn once per run",
    "nominal": "exactly the nominal one",
}


@dataclass(frozen=True, kw_only=True)
class CalibrationStudy(OfRuns):
    """Treatments under truths in worlds."""

    scenarios: tuple[str, ...] = ("circle", "matched")
    """Worlds: by default one in which the camera turns, and one in which it only moves sideways."""
    truths: tuple[str, ...] = ("white", "constant", "nominal")
    """How the true intrinsics come about."""
    treatments: tuple[str, ...] = tuple(TREATMENTS)
    """What the filter makes of them."""
    filters: tuple[str, ...] = ("robocentric",)
    landmarks: tuple[str, ...] = ("inverse_scaling",)
    runs: int = 400
    chunk: int = 100
    steps: int = 60
    out: Path = RESULTS / "calibration.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """`{"scenarios": {scenario: {truth: {"filter/landmarks": {treatment: numbers}}}}}` and what
        it is of, after every truth."""
        results: dict[str, Any] = {}
        of = {"schema": 1, "version": jaxslam.__version__, "device": jax.devices()[0].device_kind}
        of |= {key: getattr(self, key) for key in ("runs", "seed", "steps", "truths", "treatments")}
        for name in self.scenarios:
            worlds = {
                truth: jaxslam.scenario(name, steps=self.steps, true_calibration=truth)
                for truth in self.truths
            }
            drawn = {
                truth: draw(world, self.runs, seed=self.seed) for truth, world in worlds.items()
            }
            # One room for all truths, so that a filter compiles once.
            rooms = (room for room, _ in drawn.values())
            room = Room(*np.max([*rooms], axis=0).tolist())
            results[name] = {}
            for truth, scenario in worlds.items():
                rows = results[name].setdefault(truth, {})
                each = itertools.product(self.treatments, self.filters, self.landmarks)
                for treatment, frame, landmark in each:
                    filters = jaxslam.make_filters(scenario, [frame], [landmark], treatment)
                    ((key, slam),) = filters.items()
                    found = self.measured(slam, scenario, room, drawn[truth][1], treatment)
                    rows.setdefault(key, {})[treatment] = found
                    print(name, truth, key, treatment, flush=True)
                yield {**of, "scenarios": results}

    def measured(
        self, slam: AbstractFilter, scenario: Scenario, room: Room, runs: Run, treatment: str
    ) -> dict[str, Any]:
        """Numbers of the last step; of intrinsics where they are estimated."""
        sensor, store, every = scenario.sensor, MemoryStore(), range(self.runs)
        assert isinstance(sensor, Pinhole)
        records, last = by_batch(partial(_batch, slam, room, sensor), runs, self.chunk)
        store.save("slam", every, records)
        study = Study(
            scenario, {"slam": slam}, self.runs, self.seed, "float64", (every,), store,
            {"slam": Seconds(0.0, 0.0)}, jax.devices()[0].device_kind,
        )  # fmt: skip
        f = jaxslam.summarise(study)["filters"]["slam"]
        row = at_end(f)
        rmse, sigma, band = row.pop("rmse"), row.pop("sigma"), mean_band(row["dof"], self.runs)
        verdict = "lost" if row["diverged"] else _verdict(row["nees"], row["lost"], band)
        nis, dof = (float(np.nansum(np.array(f[key], float))) for key in ("nis", "nis_dof"))
        return row | {
            "verdict": verdict,
            "rmse_m": rmse,
            "sigma_over_rmse": sigma / rmse if rmse and sigma else None,
            "nis_per_dof": nis / dof,
            "intrinsics": _intrinsics(last) if treatment == "estimated" else None,
        }

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "calibration.md", SAID, in_words(results)
        yield "calibration.md", MARK, as_tables(results["scenarios"])


@eqx.filter_jit
def _batch(slam: AbstractFilter, room: Room, sensor: Pinhole, runs: Run):
    def one(run: Run):
        records, _, state = filter_run(slam, room, sensor, run)
        estimate, covariance = slam.marginal(state, lambda view: view.core.calibration)
        assert isinstance(run.sensors, Pinhole)
        true = jax.tree.map(lambda x: x[-1], run.sensors.camera).intrinsics
        error = true - sensor.camera.intrinsics
        if estimate.size:  # a known calibration has no estimate
            error = error - estimate
        return records, {"error": error, "covariance": covariance}

    return jax.vmap(one)(runs)


def _verdict(nees: float | None, lost: float, band: tuple[float, float]) -> str:
    """What a mean NEES says of σ, beside its 95 % band; `lost` is the share of runs lost."""
    if lost > LOST_BOUND or nees is None:
        return "lost"
    if nees < band[0]:
        return "under-confident"
    return "over-confident" if nees > band[1] else "consistent"


def _intrinsics(last: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Error and σ of (f, c) or (fx, fy, cx, cy), pixels, at the last step."""
    finite = np.isfinite(last["covariance"]).all(axis=(1, 2))
    error, covariance = last["error"][finite], last["covariance"][finite]
    nees = np.asarray(jax.vmap(normalised_squared)(*map(jnp.asarray, (error, covariance))))
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    return {
        "rmse_px": np.sqrt((error**2).mean(axis=0)).tolist(),
        "sigma_px": np.sqrt(variances.mean(axis=0)).tolist(),
        "nees": float(nees.mean()),
        "dof": error.shape[1],
        "band95": list(mean_band(error.shape[1], len(error))),
    }


# --- what it says -------------------------------------------------------------------------------


def as_tables(scenarios: dict[str, Any]) -> str:
    """A part of the page for every scenario: all rows, and the estimates of intrinsics."""
    parts = []
    for name, by_truth in scenarios.items():
        parts += [f"## `{name}`", _rows(by_truth)]
        if estimates := _estimates(by_truth):
            parts += ["The final intrinsics of `estimated` (initial σ 3 and 2 px):", estimates]
    return "\n\n".join(parts)


def in_words(summary: dict[str, Any]) -> str:
    """The best treatments of every truth over all worlds, and what believing too much costs."""
    best, costs = [], []
    for truth in summary["truths"]:
        worst = _worst(summary, truth)
        if not worst:  # not yet measured
            continue
        least = min(worst.values())
        # Within a tenth of one another: that is what 200 runs scatter.
        good = [t for t, value in worst.items() if value <= 1.1 * least]
        named = " or ".join(f"`{t}`" for t in good)
        numbers = ", ".join(f"{name} {number(value)}" for name, value in worst.items())
        best.append(f"- **{TRUTH[truth].capitalize()}**: {named} (NEES of {numbers}).")
        if "known" in worst and truth != "nominal":
            costs.append(f"{worst['known'] / least:.0f} times ({TRUTH[truth]})")
    text = "\n".join(best)
    if costs:
        text += (
            "\n\nA filter that takes an uncertain calibration as `known` has "
            f"{' and '.join(costs)} the NEES of the best treatment."
        )
    return text


def _worst(summary: dict[str, Any], truth: str) -> dict[str, float]:
    """`{treatment: largest mean NEES over worlds and filters}`; infinite where all diverged."""
    worst: dict[str, float] = {}
    for by_truth in summary["scenarios"].values():
        for by_treatment in by_truth.get(truth, {}).values():
            for treatment, f in by_treatment.items():
                nees = np.inf if f["nees"] is None else f["nees"]
                worst[treatment] = max(worst.get(treatment, 0.0), nees)
    return worst


def _rows(by_truth: dict[str, Any]) -> str:
    filters = _unless_alone("filter", by_truth)
    header = "truth", *filters, "treatment", "NEES", "median", "lost", "RMSE m", "σ/RMSE", "NIS/dof"
    rows = []
    for truth, name, treatment, f in _each(by_truth):
        mean = number(f["nees"])
        rows.append(
            (
                *(truth, *_unless_alone(name, by_truth), treatment),
                f"**{mean}**" if f["verdict"] == "consistent" else mean,
                *(number(f["nees_median"]), f"{f['lost']:.1%}", number(f["rmse_m"], ".3f")),
                *(number(f[key]) for key in ("sigma_over_rmse", "nis_per_dof")),
            )
        )
    return table(header, rows)


def _unless_alone(cell: str, by_truth: dict[str, Any]) -> tuple[str, ...]:
    """A cell of the column that names filters, which is left out where there is only one."""
    alone = len({name for filters in by_truth.values() for name in filters}) == 1
    return () if alone else (cell,)


def _each(by_truth: dict[str, Any]) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    for truth, filters in by_truth.items():
        for name, by_treatment in filters.items():
            for treatment, f in by_treatment.items():
                yield truth, name, treatment, f


def _estimates(by_truth: dict[str, Any]) -> str:
    filters = _unless_alone("filter", by_truth)
    header = ("truth", *filters, "RMSE of f, c, px", "σ, px", "NEES (ideal 2)", "95 % band")
    rows = []
    for truth, name, _, numbers in _each(by_truth):
        f = numbers["intrinsics"]
        if f is None or truth == "white":  # no constant to be right about
            continue
        pixels = (", ".join(f"{x:.2f}" for x in f[key]) for key in ("rmse_px", "sigma_px"))
        low, high = f["band95"]
        named = _unless_alone(name, by_truth)
        rows.append((truth, *named, *pixels, number(f["nees"]), f"{low:.2f}–{high:.2f}"))
    return table(header, rows) if rows else ""


if __name__ == "__main__":
    CalibrationStudy.run()
