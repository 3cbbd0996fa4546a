"""How far is every filter from the exact posterior, and where does its excess NEES come from?

`python benchmarks/posterior.py` samples the posterior of the same simulated runs that the filters
meet and writes `benchmarks/results/posterior.json`, `docs/posterior.md` and `docs/posterior.png`,
anew after every scenario and step. `--cache FOLDER` keeps the draws: the same command with more
filters then only runs those. `--page-only` makes page and figure from the JSON.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from posterior_page import page

import jaxslam
from jaxslam._runtime.files import write_atomically, write_json
from jaxslam.consistency import FolderStore, MemoryStore
from jaxslam.plots.posterior import plot_posterior
from jaxslam.posterior import (
    HMC,
    Study,
    against_filter,
    converged,
    draw_runs,
    pooled,
    reference,
)
from jaxslam.posterior.summary import summarise_filter, summarise_reference, summarise_sampler

SHOWN_DRAWS = 1000
LEAST_CONVERGED = 0.9
"""Share of the runs; of fewer nothing is said, as those that converge are the easy ones."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

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
    page_only: bool = False
    """Only write page and figure again."""
    out: Path = Path("benchmarks/results")
    """Folder of posterior.json."""
    docs: Path = Path("docs")
    """Folder of posterior.md and posterior.png."""

    def __post_init__(self) -> None:
        if self.runs < 2 or self.chunk < 1:
            raise ValueError(f"at least 2 runs in chunks of 1, not {self.runs} and {self.chunk}")
        for name in self.filters:
            if name.count("/") != 1:
                raise ValueError(f"a filter is named filter/landmarks, not {name!r}")


def measure(options: Options) -> Iterator[dict[str, Any]]:
    """`{scenario: {steps: numbers}}`, yielded after every scenario and step."""
    results: dict[str, Any] = {name: {} for name in options.scenarios}
    for steps in options.steps:  # all scenarios of one length share their compiled programs
        for name in options.scenarios:
            scenario = jaxslam.scenario(name, steps=steps, landmarks=options.landmarks)
            study = Study(scenario, steps, options.hmc, options.starts)
            results[name][str(steps)] = _measure(study, options)
            yield results


def _measure(study: Study, options: Options) -> dict[str, Any]:
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


def _store(study: Study, options: Options) -> FolderStore | MemoryStore:
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


def _reference(study: Study, store, chunk: range, options: Options) -> dict[str, np.ndarray]:
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


def _filter(study: Study, name: str, chunks, reference, options: Options) -> dict[str, np.ndarray]:
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


def main(options: Options) -> None:
    """Measure, and write the three files after every scenario and step."""
    for folder in (options.out, options.docs):
        folder.mkdir(parents=True, exist_ok=True)
    path = options.out / "posterior.json"
    if options.page_only:
        _write_docs(json.loads(path.read_text()), options)
        return
    jax.config.update("jax_enable_x64", True)
    for results in measure(options):
        summary = {
            "schema": 1,
            "version": jaxslam.__version__,
            "landmarks": options.landmarks,
            "runs": options.runs,
            "seed": options.seed,
            "hmc": dataclasses.asdict(options.hmc),
            "starts": options.starts,
            "device": jax.devices()[0].device_kind,
            "scenarios": {name: by_step for name, by_step in results.items() if by_step},
        }
        write_json(path, summary)
        _write_docs(summary, options)


def _write_docs(summary: dict[str, Any], options: Options) -> None:
    plot_posterior(summary, options.docs / "posterior.png")
    with write_atomically(options.docs / "posterior.md") as temporary:
        temporary.write_text(page(summary))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
