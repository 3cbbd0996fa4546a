"""How far is every filter from the exact posterior, and where does its excess NEES come from?

`python benchmarks/posterior.py` samples the posterior of the same simulated runs that the filters
meet and writes `posterior.json` and a table in `docs/repairs.md`, anew after every scenario and
step. `--cache FOLDER` keeps the draws: the same command with more
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
from benchmark import RESULTS, Benchmark, number, table, write_table
from consistency import label
from exact_posterior.sampler import HMC
from exact_posterior.study import Study, against_filter, converged, draw_runs, pooled, reference
from exact_posterior.summary import summarise_filter, summarise_reference, summarise_sampler

import jaxslam
from jaxslam.consistency import FolderStore, MemoryStore

MARK = "<!-- posterior.py -->"
LEAST_CONVERGED = 0.9
"""Share of the runs; of fewer nothing is said, as those that converge are the easy ones."""


@dataclass(frozen=True, kw_only=True)
class ExactPosterior(Benchmark):
    """Filters beside the exact posterior of the same runs."""

    scenarios: tuple[str, ...] = (
        "matched-loose", "matched-forward-loose", "matched-turn-loose", "matched",
    )  # fmt: skip
    """Simulated worlds of the matched family."""
    steps: tuple[int, ...] = (5,)
    """Steps at which the posterior is taken, each a problem of its own."""
    filters: tuple[str, ...] = (
        "robocentric/inverse_depth",
        "robocentric/inverse_scaling",
        "scale_gauge/inverse_scaling",
        "scale_gauge+directions9/inverse_scaling",
        "scale_gauge+mixture17/inverse_scaling",
        "scale_gauge+scene50+mixture17/inverse_scaling",
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
        write_table(self.docs / "repairs.md", MARK, as_table(results["scenarios"]))


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
        "seconds": seconds,
    }


def _store(study: Study, options: ExactPosterior) -> FolderStore | MemoryStore:
    if options.cache is None:
        return MemoryStore()
    manifest = {
        "scenario": study.scenario.to_dict(),
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
        records = against_filter(
            study, slam, runs, study.scenario.geometry.group(jnp.asarray(draws))
        )
        parts.append({k: np.asarray(v)[: len(chunk)] for k, v in records.items()})
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def as_table(scenarios: dict[str, Any]) -> str:
    """KL from the exact posterior, σ of position over the exact one, mean NEES."""
    found = {
        f"`{name}`, step {steps}": numbers
        for name, by_step in scenarios.items()
        for steps, numbers in by_step.items()
        if "nees" in numbers
    }
    names = list(dict.fromkeys(name for numbers in found.values() for name in numbers["filters"]))
    rows = [
        ("exact posterior", *(_cell(None, 1, n["nees"]["exact"]) for n in found.values())),
        (
            "MAP and Laplace",
            *(
                _cell(None, _sigma(n["laplace"]), n["nees"]["gaussian_prior_laplace"])
                for n in found.values()
            ),
        ),
    ]
    for name in names:
        of = (numbers["filters"].get(name) for numbers in found.values())
        cells = (_cell(f["kl"]["mean"], _sigma(f), f["nees"]) if f else "–" for f in of)
        rows.append((f"`{label(name)}`", *cells))
    return table(["", *found], rows)


def _cell(kl: float | None, sigma: float, nees: dict[str, Any]) -> str:
    return f"{number(kl)}; {number(sigma)}; {number(nees['mean'], '.1f')}"


def _sigma(numbers: dict[str, Any]) -> float:
    return numbers["position"]["sigma_ratio"]


if __name__ == "__main__":
    ExactPosterior.run()
