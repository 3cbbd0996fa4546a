"""Filters that respect what cannot be observed, beside those that do not, with a single camera.

`python benchmarks/observability.py` runs every frame plain, observability-constrained (`+oc`), with
first-estimate Jacobians (`+fej`) and invariant, and writes `observability.json`.
Rows that the file has with as many runs are not run again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import RESULTS, OfRuns, at_end

import jaxslam
from jaxslam.consistency import Study


@dataclass(frozen=True, kw_only=True)
class Observability(OfRuns):
    """Every filter in every scenario."""

    filters: tuple[str, ...] = (
        "robocentric/inverse_scaling", "robocentric+oc/inverse_scaling",
        "world/inverse_scaling", "world+oc/inverse_scaling", "world+fej/inverse_scaling",
        "world+fej2/inverse_scaling", "world+decoupled/inverse_scaling",
        "invariant/inverse_scaling", "robocentric/inverse_depth", "robocentric+oc/inverse_depth",
        "world/inverse_depth", "world+oc/inverse_depth",
    )  # fmt: skip
    """`filter/landmarks`."""
    scenarios: tuple[str, ...] = (
        "matched", "matched-loose", "matched-forward", "matched-forward-loose", "circle",
    )  # fmt: skip
    chunk: int = 100
    out: Path = RESULTS / "observability.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        """Add to `{scenario: {"filter/landmarks": numbers at the end}}`."""
        yield from self.each(self._measured, self.scenarios, self.filters, ("scenarios",))

    def _measured(self, scenario: str, name: str) -> dict[str, Any]:
        study, found = self.study(jaxslam.scenario(scenario), name)
        seconds = round(found["seconds"]["run"] / self.runs, 4)
        return at_end(found) | {"along": _along(study, name), "seconds_per_run": seconds}


def _along(study: Study, name: str) -> dict[str, float]:
    """Median over the runs of the last step's |error| and σ along the nominal direction of
    motion, m: with a single camera both are those of the scale."""
    axis = int(np.argmax(np.abs(study.scenario.velocity[: study.scenario.geometry.point_dim])))
    records = [study.store.load(name, chunk, ("error", "variance")) for chunk in study.chunks]
    error, variance = (
        np.concatenate([record[key][:, -1, axis] for record in records])
        for key in ("error", "variance")
    )
    return {
        "error": round(float(np.nanmedian(np.abs(error))), 4),
        "sigma": round(float(np.nanmedian(np.sqrt(variance))), 4),
    }


if __name__ == "__main__":
    Observability.run()
