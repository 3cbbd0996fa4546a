"""The noises of a simulated camera found by likelihood, through whole runs of the filter.

    python benchmarks/gradients.py

A filter that starts with wrong σ of the accelerations and of the pixels is differentiated by them
through all frames of all runs, and climbs. Writes `benchmarks/results/gradients.json` and the table
of `docs/gradients.md`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import write_atomically, write_json
from jaxslam.consistency.likelihood import maximum_likelihood
from jaxslam.consistency.montecarlo import draw

NAMES = ("linear acceleration, m/s²", "angular acceleration, rad/s²", "pixel")
MARK = "<!-- written by benchmarks/gradients.py -->"


@dataclass(frozen=True)
class Options:
    """What to measure."""

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
    out: Path = Path("benchmarks/results/gradients.json")
    page: Path = Path("docs/gradients.md")


def with_noises(slam: jaxslam.EkfSlam, sigmas: jax.Array) -> jaxslam.EkfSlam:
    """The filter with these σ of `NAMES`."""
    linear, angular, pixel = sigmas
    motion = replace(slam.motion, noise_sigma=jnp.stack([linear, linear, angular]))
    return replace(slam, motion=motion, sensor=replace(slam.sensor, sigma=pixel))


def measure(options: Options) -> dict[str, object]:
    scenario = jaxslam.scenario(options.scenario, inverse_depth=options.inverse_depth)
    room, runs = draw(scenario, options.runs, seed=options.seed)
    (slam,) = jaxslam.make_filters(scenario, [options.filter], ["inverse_scaling"]).values()
    assert isinstance(slam, jaxslam.EkfSlam)
    slam = jaxslam.cast(slam, jnp.float64)
    truth = np.array([*np.asarray(slam.motion.noise_sigma)[[0, 2]], float(slam.sensor.sigma)])
    start = np.log(truth * options.start)
    began = time.perf_counter()
    found = maximum_likelihood(lambda theta: with_noises(slam, jnp.exp(theta)), start, room, runs)
    return {
        "version": jaxslam.__version__,
        "scenario": options.scenario,
        "filter": options.filter,
        "inverse_depth": options.inverse_depth,
        "runs": options.runs,
        "steps": scenario.steps,
        "seed": options.seed,
        "names": NAMES,
        "truth": truth.tolist(),
        "start": np.exp(start).tolist(),
        "found": np.exp(found.values).tolist(),
        "relative_standard_error": found.standard_errors.tolist(),
        "iterations": found.iterations,
        "converged": found.converged,
        "seconds": time.perf_counter() - began,
    }


def table(r: dict) -> str:
    """The page's table."""
    lines = [
        f"{r['runs']} runs of `{r['scenario']}`, {r['steps']} frames, seed {r['seed']}, filter "
        f"`{r['filter']}`, prior on 1/z {r['inverse_depth'][0]:.3g} ± {r['inverse_depth'][1]:.3g} "
        f"per m; "
        f"{r['iterations']} steps, {r['seconds']:.0f} s with compilation on two cores.",
        "",
        "| σ of | truth | start | found | standard error | off by |",
        "|---|---|---|---|---|---|",
    ]
    rows = zip(
        r["names"], r["truth"], r["start"], r["found"], r["relative_standard_error"], strict=True
    )
    for name, truth, start, found, error in rows:
        lines.append(
            f"| {name} | {truth:.4g} | {start:.4g} | {found:.4g} | {error:.1%} "
            f"| {found / truth - 1:+.1%} |"
        )
    return "\n".join(lines)


def main(options: Options) -> None:
    with jax.enable_x64(True):
        results = measure(options)
    write_json(options.out, results)
    before, _, after = options.page.read_text().partition(MARK)
    _, _, rest = after.partition(MARK)
    with write_atomically(options.page) as path:
        path.write_text(f"{before}{MARK}\n{table(results)}\n{MARK}{rest}")
    print(table(results))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
