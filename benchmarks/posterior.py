"""How far is every filter from the exact posterior, and where does its excess NEES come from?

`python benchmarks/posterior.py` samples the posterior of the same simulated runs that the filters
meet and writes `posterior.json`, `docs/posterior.md` and `docs/posterior.png`,
anew after every scenario and step. `--cache FOLDER` keeps the draws: the same command with more
filters then only runs those.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, Benchmark, number, table, write_page
from exact_posterior import (
    HMC,
    Study,
    against_filter,
    converged,
    draw_runs,
    pooled,
    reference,
)
from exact_posterior.figure import plot_posterior
from exact_posterior.summary import summarise_filter, summarise_reference, summarise_sampler

import jaxslam
from jaxslam.consistency import FolderStore, MemoryStore

READING = """\
The rows of a table are a sequence: the exact posterior's own mean and covariance, whose mean NEES
is the number of degrees of freedom whatever its shape; the same with the prior on 1/z that the
filters believe, which has mass at ω < 0; the Gaussian that Laplace puts at the mode of that; and
the filters. What each row adds to the one before is the cost of that step: of the prior, of not
being Gaussian, of recursion and linearisation."""

STAGES = {
    "exact": "exact posterior: its mean and covariance",
    "gaussian_prior": "… with the whole Gaussian prior on 1/z",
    "gaussian_prior_laplace": "… by MAP and Laplace",
}
SHOWN_DRAWS = 1000
LEAST_CONVERGED = 0.9
"""Share of the runs; of fewer nothing is said, as those that converge are the easy ones."""


@dataclass(frozen=True, kw_only=True)
class ExactPosterior(Benchmark):
    """Filters beside the exact posterior of the same runs."""

    scenarios: tuple[str, ...] = ("matched-loose", "matched", "matched-forward-loose")
    """Simulated worlds of the matched family."""
    steps: tuple[int, ...] = (5,)
    """Steps at which the posterior is taken, each a problem of its own."""
    filters: tuple[str, ...] = (
        "robocentric/inverse_scaling",
        "world/inverse_scaling",
        "robocentric/inverse_depth",
        "scale_gauge/inverse_scaling",
    )
    """`filter/landmarks`."""
    landmarks: int = 6
    """Landmarks of every problem."""
    runs: int = 48
    """Problems of every scenario and step."""
    chunk: int = 48
    """Problems sampled in one batch."""
    seed: int = 0
    hmc: HMC = field(default_factory=HMC)
    starts: int = 4
    """Starts of the batch MAP."""
    cache: Path | None = None
    """Folder that keeps the draws; resumed if it was made with the same numbers."""
    out: Path = RESULTS / "posterior.json"

    def __post_init__(self) -> None:
        if self.runs < 2 or self.chunk < 1:
            raise ValueError(f"at least 2 runs in chunks of 1, not {self.runs} and {self.chunk}")
        for name in self.filters:
            if name.count("/") != 1:
                raise ValueError(f"a filter is named filter/landmarks, not {name!r}")

    def measure(self) -> Iterator[dict[str, Any]]:
        """`{"scenarios": {scenario: {steps: numbers}}}` and what it is of, after every one."""
        of = {"schema": 1, "version": jaxslam.__version__, "hmc": dataclasses.asdict(self.hmc)}
        of |= {key: getattr(self, key) for key in ("landmarks", "runs", "seed", "starts")}
        of["device"] = jax.devices()[0].device_kind
        results: dict[str, Any] = {}
        # All scenarios of one length share their compiled programs.
        for steps, name in itertools.product(self.steps, self.scenarios):
            scenario = jaxslam.scenario(name, steps=steps, landmarks=self.landmarks)
            study = Study(scenario, steps, self.hmc, self.starts)
            results.setdefault(name, {})[str(steps)] = _measure(study, self)
            yield {**of, "scenarios": results}

    def report(self, results: dict[str, Any]) -> None:
        plot_posterior(results, self.docs / "posterior.png")
        write_page(self.docs / "posterior.md", page(results))


def _measure(study: Study, options: ExactPosterior) -> dict[str, Any]:
    store, start = _store(study, options), time.perf_counter()
    chunks = [
        range(i, min(i + options.chunk, options.runs))
        for i in range(0, options.runs, options.chunk)
    ]
    parts = [_reference(study, store, chunk, options) for chunk in chunks]
    records = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    used = converged(records, "exact") & converged(records, "gaussian_prior")
    if used.mean() < LEAST_CONVERGED:
        return summarise_sampler(records, used)
    summary = summarise_reference(records, used)
    seconds = {"reference": time.perf_counter() - start}
    by_filter = {}
    for name in options.filters:
        start = time.perf_counter()
        by_filter[name] = _filter(study, name, chunks, records, options)
        seconds[name] = time.perf_counter() - start
    return {
        **summary,
        "filters": {name: summarise_filter(own, records, used) for name, own in by_filter.items()},
        "telling": _telling(study, records, used, by_filter),
        "seconds": seconds,
    }


def _store(study: Study, options: ExactPosterior) -> FolderStore | MemoryStore:
    if options.cache is None:
        return MemoryStore()
    manifest = {
        "scenario": dataclasses.asdict(study.scenario),
        "steps": study.steps,
        "hmc": dataclasses.asdict(study.hmc),
        "starts": study.starts,
        "seed": options.seed,
    }
    folder = options.cache / f"{study.scenario.name}-{study.steps}"
    return FolderStore(folder, manifest, resume=True)


def _reference(study: Study, store, chunk: range, options: ExactPosterior) -> dict[str, np.ndarray]:
    """Records of both posteriors, `exact_…` and `gaussian_prior_…`, and the exact draws."""
    if not store.has("posterior", chunk):
        # The last chunk is padded by the runs that follow, to be of the same shape.
        padded = range(chunk.start, chunk.start + options.chunk)
        runs = draw_runs(study, options.seed, padded)
        found, chains = reference(study, runs, options.seed, padded)
        found["exact_T_BC"] = jax.vmap(pooled)(chains).parameters()
        arrays = {k: np.asarray(v)[: len(chunk)] for k, v in jax.device_get(found).items()}
        store.save("posterior", chunk, arrays)
        print(f"{study.scenario.name} {study.steps}: {chunk.stop} runs", flush=True)
    return store.load("posterior", chunk)


def _filter(
    study: Study, name: str, chunks, reference, options: ExactPosterior
) -> dict[str, np.ndarray]:
    frame, landmarks = name.split("/")
    (slam,) = jaxslam.make_filters(study.scenario, [frame], [landmarks]).values()
    parts = []
    for chunk in chunks:
        padded = range(chunk.start, chunk.start + options.chunk)
        runs = draw_runs(study, options.seed, padded)
        draws = reference["exact_T_BC"][chunk.start : chunk.stop]
        draws = np.concatenate([draws, draws[: len(padded) - len(chunk)]])
        records = against_filter(study, slam, runs, study.scenario.world.group(jnp.asarray(draws)))
        parts.append({k: np.asarray(v)[: len(chunk)] for k, v in records.items()})
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _telling(study: Study, reference, used, filters) -> dict[str, Any]:
    """One run for the figure: the one whose first filter is the median in NEES of the used."""
    nees = next(iter(filters.values()))["nees"]
    order = np.argsort(np.where(used, nees, np.inf))
    run = int(order[int(used.sum()) // 2])
    n = study.scenario.world.point_dim
    draws = reference["exact_draws"][run, :, :n]
    shown = np.linspace(0, len(draws) - 1, min(SHOWN_DRAWS, len(draws))).astype(int)
    center = reference["exact_position"][run]
    laplace = {k: reference[f"gaussian_prior_laplace_{k}"][run] for k in ("position", "covariance")}
    gaussians = {
        "MAP + Laplace": laplace,
        **{
            k: {"position": f["position"][run], "covariance": f["covariance"][run]}
            for k, f in filters.items()
        },
    }
    return {
        "run": run,
        "truth": (reference["exact_truth"][run, :n] + center).tolist(),
        "draws": np.round(draws[shown] + center, 5).tolist(),
        "gaussians": {
            name: {
                "mean": np.asarray(g["position"]).tolist(),
                "covariance": np.asarray(g["covariance"])[:n, :n].tolist(),
            }
            for name, g in gaussians.items()
        },
    }


def page(summary: dict[str, Any]) -> str:
    """The Markdown page: how to read it, the figure, then the tables."""
    hmc = summary["hmc"]
    parts = [
        "# The exact posterior, and how far the filters are from it",
        "Made by `python benchmarks/posterior.py`; do not edit. "
        f"{summary['runs']} runs with {summary['landmarks']} landmarks, seed {summary['seed']}, "
        f"float64; Hamiltonian Monte Carlo with {hmc['chains']} chains of {hmc['draws']} draws "
        f"after {hmc['warmup']}; MAP from {summary['starts']} "
        "starts. A row is over the runs of which both posteriors converged (R̂ ≤ 1.05 and 100 "
        "effective draws of pose, velocity and density). All rows of a scenario and step are of "
        "the same runs.",
        READING,
        "![Draws of one run, NEES and σ](posterior.png)",
    ]
    for scenario, by_step in summary["scenarios"].items():
        for steps, numbers in by_step.items():
            parts += [f"## `{scenario}`, step {steps}", *_section(numbers)]
    return "\n\n".join(parts) + "\n"


def _section(numbers: dict[str, Any]) -> list[str]:
    if "nees" not in numbers:
        return [_not_converged(numbers)]
    sampler, minima = numbers["sampler"]["exact"], numbers["minima"]["gaussian_prior"]
    low, high = numbers["nees"]["exact"]["band95"]
    calibration = numbers["calibration"]
    sigma, rmse = numbers["sigma"]["exact"], numbers["rmse"]
    p = ", ".join(
        f"{name} {value:.2f}"
        for name, value in zip(calibration["names"], calibration["p"], strict=True)
    )
    return [
        f"{numbers['used']} of {numbers['runs']} runs converged (median R̂ "
        f"{sampler['rhat_median']:.3f}, median effective draws {sampler['ess_median']:.0f}, "
        f"{sampler['divergent']:.1%} of the transitions divergent, {sampler['leapfrogs']:.0f} "
        f"leapfrog steps a draw). Exact σ (median): {1000 * sigma['position']:.1f} mm and "
        f"{1000 * sigma['orientation']:.2f} mrad. RMSE of its mean: {1000 * rmse['position']:.1f} "
        f"mm and {1000 * rmse['orientation']:.2f} mrad. Ranks of the truth uniform, p: {p}. "
        f"Several minima of the MAP in {minima['runs_with_several']:.0%} of the runs; the start at "
        f"the prior mean misses the best in {minima['prior_mean_missed_best']:.0%}.",
        _rows(numbers, (low, high)),
    ]


def _not_converged(numbers: dict[str, Any]) -> str:
    sampler = numbers["sampler"]["exact"]
    return (
        f"Only {numbers['used']} of {numbers['runs']} runs converged (median R̂ "
        f"{sampler['rhat_median']:.2f}, median effective draws {sampler['ess_median']:.0f}, "
        f"{sampler['divergent']:.1%} of the transitions divergent): the draws are not the "
        "posterior's, and nothing is compared with them."
    )


def _rows(numbers: dict[str, Any], band: tuple[float, float]) -> str:
    header = (
        "", f"NEES, mean ± s.e. (band {band[0]:.2f}–{band[1]:.2f})", "median", "lost",
        "σ/exact position, orientation", "RMSE/exact position, orientation", "KL median, mean",
        "W₁/σ",
    )  # fmt: skip
    ratios = {"exact": ("1, 1", "1, 1"), "gaussian_prior": ("–", "–")}
    ratios["gaussian_prior_laplace"] = _ratios(numbers["laplace"])
    rows = [
        (name, *_nees(numbers["nees"][key]), *ratios[key], "–", "–") for key, name in STAGES.items()
    ]
    for name, f in numbers["filters"].items():
        kl = f"{_digits(f['kl']['median'])}, {_digits(f['kl']['mean'])}"
        distances = ", ".join(_digits(value) for value in f["wasserstein"])
        rows.append((name, *_nees(f["nees"]), *_ratios(f), kl, distances))
    return table(header, rows)


def _nees(nees: dict[str, Any]) -> tuple[str, str, str]:
    mean = f"{_digits(nees['mean'])} ± {_digits(nees['standard_error'])}"
    return mean, _digits(nees["median"]), f"{nees['lost']:.1%}"


def _ratios(numbers: dict[str, Any]) -> tuple[str, str]:
    position, orientation = numbers["position"], numbers["orientation"]
    sigma, rmse = (
        f"{_digits(position[key])}, {_digits(orientation[key])}"
        for key in ("sigma_ratio", "rmse_ratio")
    )
    return sigma, rmse


def _digits(value: float | None) -> str:
    return number(value, ".3g")


if __name__ == "__main__":
    ExactPosterior.run()
