"""The noises of a simulated camera found by likelihood, through whole runs of the filter.

    python benchmarks/gradients.py

A filter that starts with wrong σ of the accelerations and of the pixels is differentiated by them
through all frames of all runs, and climbs. Writes `gradients.json` and the table of
`docs/gradients.md`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, Benchmark, table, write_table

import jaxslam
from jaxslam.consistency import draw
from jaxslam.consistency.likelihood import maximum_likelihood

NAMES = ("linear acceleration, m/s²", "angular acceleration, rad/s²", "pixel")
MARK = "<!-- gradients.py -->"


@dataclass(frozen=True, kw_only=True)
class Gradients(Benchmark):
    """Noises by likelihood."""

    scenario: str = "matched-loose"
    """A planar scenario of a camera with a velocity."""
    inverse_depth: tuple[float, float] = (1 / 6, 0.01)
    """Mean and σ of the prior on 1/z: narrow, so that the filter is nearly linear, and its
    likelihood the true one."""
    filter: str = "scale_gauge"
    """An EKF by its name."""
    runs: int = 256
    seed: int = 0
    start: tuple[float, float, float] = (3.0, 0.3, 2.0)
    """Factors by which the filter's σ are wrong at the start."""
    out: Path = RESULTS / "gradients.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        scenario = jaxslam.scenario(self.scenario, inverse_depth=self.inverse_depth)
        room, runs = draw(scenario, self.runs, seed=self.seed)
        (slam,) = jaxslam.make_filters(scenario, [self.filter], ["inverse_scaling"]).values()
        assert isinstance(slam, jaxslam.EkfSlam)
        slam = jaxslam.cast(slam, jnp.float64)
        truth = np.array([*np.asarray(slam.motion.noise_sigma)[[0, 2]], float(slam.sensor.sigma)])
        start = np.log(truth * self.start)
        began = time.perf_counter()
        found = maximum_likelihood(
            lambda theta: with_noises(slam, jnp.exp(theta)), start, room, runs
        )
        yield {
            "version": jaxslam.__version__,
            "scenario": self.scenario,
            "filter": self.filter,
            "inverse_depth": self.inverse_depth,
            "runs": self.runs,
            "steps": scenario.steps,
            "seed": self.seed,
            "names": NAMES,
            "truth": truth.tolist(),
            "start": np.exp(start).tolist(),
            "found": np.exp(found.values).tolist(),
            "relative_standard_error": found.standard_errors.tolist(),
            "iterations": found.iterations,
            "converged": found.converged,
            "seconds": time.perf_counter() - began,
        }

    def report(self, results: dict[str, Any]) -> None:
        header = "σ of", "truth", "start", "found", "standard error", "off by"
        columns = [results[key] for key in ("names", "truth", "start", "found")]
        rows = [
            (
                *(x if isinstance(x, str) else f"{x:.4g}" for x in row),
                f"{error:.1%}",
                f"{found / truth - 1:+.1%}",
            )
            for *row, error in zip(*columns, results["relative_standard_error"], strict=True)
            for truth, found in [(row[1], row[3])]
        ]
        said = f"{_of_what(results)}\n\n{table(header, rows)}"
        write_table(self.docs / "gradients.md", MARK, said)


def with_noises(slam: jaxslam.EkfSlam, sigmas: jax.Array) -> jaxslam.EkfSlam:
    """The filter with these σ of `NAMES`."""
    linear, angular, pixel = sigmas
    motion = replace(slam.motion, noise_sigma=jnp.stack([linear, linear, angular]))
    return replace(slam, motion=motion, sensor=replace(slam.sensor, sigma=pixel))


def _of_what(r: dict[str, Any]) -> str:
    mean, sigma = r["inverse_depth"]
    return (
        f"{r['runs']} runs of `{r['scenario']}`, {r['steps']} frames, seed {r['seed']}, filter "
        f"`{r['filter']}`, prior on 1/z {mean:.3g} ± {sigma:.3g} per m; {r['iterations']} steps, "
        f"{r['seconds']:.0f} s with compilation on two cores."
    )


if __name__ == "__main__":
    Gradients.run()
