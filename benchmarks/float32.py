"""Is single precision safe? NEES in float32 against float64, run by run on the same pixels.

    python benchmarks/float32.py

Runs are drawn in float64 and rounded, since a seed draws other numbers in another precision. A
filter is *safe* in float32 in a scenario when a study says the same of it in both precisions:

- no run diverges, and no update fails, that does not in float64 (`failed`);
- the NEES of the runs that are lost in neither, averaged over runs and steps, is the same within
  2 %, which is 1 % of σ (`ratio`);
- the shares of lost runs (99.99 % quantile of χ², at any step) differ by 1 % at most (`lost`).

JSON is written after every scenario, and the table of `docs/float32.md`; what is there already is
not done again.
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
from benchmark import RESULTS, Benchmark, table, write_table

import jaxslam
from jaxslam._numerics.arrays import cast
from jaxslam.consistency import DTYPES, draw, filter_run
from jaxslam.models.observations import Status
from jaxslam.simulation import Scenario, sensor_of
from jaxslam.simulation.scenario import BUILT_IN
from jaxslam.statistics.bands import lost_threshold

MARK = "<!-- by float32.py -->"
RATIO, LOST = 0.02, 0.01
"""The most by which a mean NEES, relative, and a share of lost runs may differ."""


@dataclass(frozen=True, kw_only=True)
class Float32(Benchmark):
    """Runs in both precisions."""

    scenarios: tuple[str, ...] = tuple(BUILT_IN)
    filters: tuple[str, ...] = ("robocentric", "world", "scale_gauge", "invariant", "recommended")
    """On Inverse Scaling."""
    runs: int = 200
    out: Path = RESULTS / "float32.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        """Compare all that is not in the file yet."""
        done = self.found() or {"runs": self.runs, "scenarios": {}}
        if done["runs"] != self.runs:
            raise ValueError(f"{self.out} is of {done['runs']} runs: write to another file")
        for name in self.scenarios:
            there = done["scenarios"].setdefault(name, {})
            asked = tuple(f for f in self.filters if f"{f}/inverse_scaling" not in there)
            there.update(measured(name, asked, self.runs))
            yield done

    def report(self, results: dict[str, Any]) -> None:
        header = "scenario", "filter", "NEES, float64 / float32", "ever lost", "failed updates more"
        scenarios = results["scenarios"].items()
        rows = [row(name, full, r) for name, of in scenarios for full, r in of.items()]
        write_table(self.docs / "float32.md", MARK, table([*header, ""], rows))


@eqx.filter_jit
def _filtered(slam, room, sensor, batch):
    records, _, _ = jax.vmap(partial(filter_run, slam, room, sensor))(batch)
    return records["nees"], records["status"]


def filtered(
    slam: Any, scenario: Scenario, room: Any, batch: Any, dtype: str
) -> tuple[np.ndarray, np.ndarray]:
    """NEES and status, runs × steps."""
    with jax.enable_x64(dtype == "float64"):
        slam, sensor, batch = cast((slam, sensor_of(scenario), batch), dtype)
        return jax.device_get(_filtered(slam, room, sensor, batch))


def failed(nees: np.ndarray, status: np.ndarray) -> np.ndarray:
    """Of every run, whether it diverges or an update fails."""
    return ~np.isfinite(nees).all(axis=1) | (status != Status.OK).any(axis=1)


def compared(found: dict[str, tuple[np.ndarray, np.ndarray]], dof: int) -> dict[str, Any]:
    """What changes from float64 to float32."""
    bad = {dtype: failed(*of) for dtype, of in found.items()}
    with np.errstate(invalid="ignore"):
        lost = {k: b | (found[k][0] > lost_threshold(dof)).any(axis=1) for k, b in bad.items()}
    kept = ~lost["float32"] & ~lost["float64"]
    nees = {k: of[0][kept].astype(np.float64) for k, of in found.items()}
    mean = {k: float(x.mean()) if x.size else float("nan") for k, x in nees.items()}
    apart = np.abs(nees["float32"] / nees["float64"] - 1) if kept.any() else np.full(1, np.nan)
    return {
        "failed": int((bad["float32"] & ~bad["float64"]).sum()),
        "ratio": mean["float32"] / mean["float64"],
        "lost": {k: float(x.mean()) for k, x in lost.items()},
        "nees": mean,
        "worst_ratio_99": float(np.quantile(apart, 0.99)),
    }


def safe(result: dict[str, Any]) -> bool:
    """By what the first lines of this file say; NaN is unsafe."""
    more = abs(result["lost"]["float32"] - result["lost"]["float64"])
    return result["failed"] == 0 and abs(result["ratio"] - 1) <= RATIO and more <= LOST + 1e-9


def measured(name: str, filters: tuple[str, ...], runs: int) -> dict[str, Any]:
    """Of one scenario, by filter."""
    scenario = jaxslam.scenario(name)
    room, batch = draw(scenario, runs)
    result = {}
    for given in filters:
        try:
            made = jaxslam.make_filters(scenario, [given], ["inverse_scaling"])
        except ValueError as error:
            print(f"{name}, {given}: left out ({error})")
            continue
        ((full, slam),) = made.items()
        of = {dtype: filtered(slam, scenario, room, batch, dtype) for dtype in DTYPES}
        result[full] = compared(of, scenario.world.tangent_dim)
        print(*row(name, full, result[full]), flush=True)
    return result


def row(scenario: str, name: str, r: dict[str, Any]) -> tuple[str, ...]:
    """A line of the table."""
    word = "safe" if safe(r) else "**unsafe**"
    share = " / ".join(f"{r['lost'][dtype]:.1%}" for dtype in DTYPES)
    nees = " / ".join(f"{r['nees'][dtype]:.3f}" for dtype in DTYPES)
    name = name.removesuffix("/inverse_scaling")
    return f"`{scenario}`", f"`{name}`", nees, share, str(r["failed"]), word


if __name__ == "__main__":
    Float32.run()
