"""Is the exact posterior of a camera that sets out from rest calibrated, and how many modes has it?

`python benchmarks/from_rest_posterior.py` draws the posterior of simulated runs by tempered
sequential Monte Carlo, each twice with other particles, runs filters on the same runs, and writes
`from_rest_posterior.json`, anew after every chunk, and a table in `docs/from-rest.md`. `--cache
FOLDER` keeps what was drawn, and the same command goes on with it; once all is drawn it measures
the filters alone.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, Benchmark, table, write_table
from exact_posterior.mixtures import mixture_divergence, mixture_of_modes
from exact_posterior.modes import LEAST_SHARE, halves, reversed_draws, second_mode
from exact_posterior.moments import pose_moments
from exact_posterior.multimodal import Draws, pool, tempered_sample
from exact_posterior.problem import make_problem
from exact_posterior.ranks import ranks, uniformity
from exact_posterior.study import Study, against_filter, draw_runs, gaussian_sum
from exact_posterior.summary import position_dim, summarise_filter, summarise_nees
from exact_posterior.tempered import SMC

import jaxslam
from jaxslam._runtime.watchdog import finished
from jaxslam.consistency import FolderStore, MemoryStore
from jaxslam.geometry import Pose, difference
from jaxslam.statistics.bands import normalised_squared

Records = dict[str, np.ndarray]

STREAM = 0x74656D70
"""What is folded into a run's key for the particles, which are not the run's own draws."""
REPEATS = 2
SAMPLER = (
    "landmarks_effective", "rounds", "acceptance", "least_distinct", "least_effective",
)  # fmt: skip
BY_RUN = (
    "pooled_nees", "nees", "log_evidence", "reversed", "second_mode", "pooled_second_mode",
)  # fmt: skip
BY_RUN_OF_FILTER = ("nees", "kl_of_sum", "reversed", "exact_reversed")
BEGIN = "<!-- from_rest_posterior.py -->"
"""Behind this the page is written."""
KEPT = 99
"""Draws that a truth is ranked among."""
THINNED = 8
"""One draw of so many is kept for the ranks."""


@dataclass(frozen=True, kw_only=True)
class FromRestPosterior(Benchmark):
    """The exact posterior from rest, and filters beside it."""

    steps: int = 10
    """Frames after the first; the posterior is taken at the last."""
    landmarks: int = 12
    velocity_sigma: tuple[float, ...] = (0.5, 0.5, 0.2)
    """σ of the velocity around rest, m/s and rad/s."""
    runs: int = 60
    chunk: int = 10
    """Runs after which the numbers are written."""
    seed: int = 0
    smc: SMC = field(default_factory=SMC)
    filters: tuple[str, ...] = ("scale_gauge+mixture5+rest",)
    """Measured on the same runs, and never kept."""
    cache: Path | None = None
    """Folder that keeps what was drawn, by chunks."""
    out: Path = RESULTS / "from_rest_posterior.json"

    def __post_init__(self) -> None:
        if self.runs < 2 or self.chunk < 1:
            raise ValueError(f"at least 2 runs in chunks of 1, not {self.runs} and {self.chunk}")

    def measure(self) -> Iterator[dict[str, Any]]:
        """The summary of all runs so far, after every chunk."""
        of = {"schema": 1, "version": jaxslam.__version__, **_settings(self)}
        of["device"] = jax.devices()[0].device_kind
        study, store = standstill(self), _store(self)
        parts, others = [], {name: [] for name in self.filters}
        for start in range(0, self.runs, self.chunk):
            chunk = range(start, min(start + self.chunk, self.runs))
            if not store.has("from_rest", chunk):
                began = time.perf_counter()
                store.save("from_rest", chunk, drawn(study, self, chunk))
                print(f"{chunk.stop} runs, {time.perf_counter() - began:.0f} s", flush=True)
            parts.append(store.load("from_rest", chunk))
            for name, of_chunks in others.items():
                of_chunks.append(beside(study, name, self, chunk, parts[-1]["poses"]))
            filters = {name: _joined(of_chunks) for name, of_chunks in others.items()}
            yield of | summarise(_joined(parts), filters)

    def report(self, results: dict[str, Any]) -> None:
        write_table(self.docs / "from-rest.md", BEGIN, as_table(results))


def standstill(options: FromRestPosterior) -> Study:
    """The study of a planar camera whose velocity is only known to be about 0."""
    scenario = jaxslam.scenario(
        "matched-loose",
        steps=options.steps,
        landmarks=options.landmarks,
        velocity=(0.0, 0.0, 0.0),
        velocity_sigma=options.velocity_sigma,
    )
    return Study(scenario, options.steps)


def drawn(study: Study, options: FromRestPosterior, indices: range) -> Records:
    """Records of runs, axes run, repeat; the program is the same for all chunks."""
    runs = draw_runs(study, options.seed, indices)
    problems = jax.vmap(partial(make_problem, study.scenario))(runs)
    truth = jax.tree.map(lambda x: x[:, -1], runs.poses)
    keys = jax.vmap(partial(_keys, jax.random.key(options.seed)))(jnp.asarray(indices))
    where = f"tempered particles of {study.scenario.name}, runs {indices}"
    found = finished(_drawn(options.smc, problems, truth, keys), where)
    return {name: np.asarray(value) for name, value in found.items()}


def _keys(key: jax.Array, index: jax.Array) -> jax.Array:
    """One of every repeat, and one of their pool."""
    return jax.random.split(jax.random.fold_in(jax.random.fold_in(key, index), STREAM), REPEATS + 1)


@partial(jax.jit, static_argnums=0)
def _drawn(settings: SMC, problems, truth, keys) -> dict[str, jax.Array]:
    """One run and repeat after the other: each has as many rounds as it needs."""

    def of_run(data):
        problem, truth, keys = data
        repeats = jax.lax.map(partial(tempered_sample, settings, problem), keys[:-1])
        of_repeat = jax.vmap(partial(_of_draws, truth))(repeats)
        pooled = pool(repeats, keys[-1])
        own = {f"pooled_{name}": x for name, x in _of_draws(truth, pooled).items()}
        kept = pose_moments(pooled.last)[2][::THINNED]
        poses = pooled.last.parameters()
        particles = jax.vmap(_of_particles)(repeats)
        return {**of_repeat, **own, **particles, "draws": kept, "poses": poses}

    return jax.lax.map(of_run, (problems, truth, keys))


def _of_draws(truth: Pose, draws: Draws) -> dict[str, jax.Array]:
    """NEES, modes and divergences of the last pose, in the right tangent at its mean."""
    mean, P, tangents = pose_moments(draws.last)
    error = difference(truth, mean)
    behind = reversed_draws(draws.last)
    group = halves(tangents)
    group = jnp.where(second_mode(tangents, group) >= LEAST_SHARE, group, False)
    one, two = (mixture_of_modes(draws.last, x.astype(int), 2) for x in (group & False, group))
    return {
        "nees": normalised_squared(error, P),
        "error": error,
        "covariance": P,
        "mean": mean.parameters(),
        "log_evidence": draws.log_evidence,
        "reversed": jnp.mean(behind, dtype=P.dtype),
        "reversed_mode": second_mode(draws.last.translation(), behind),
        "second_mode": jnp.mean(group, dtype=P.dtype),
        "kl_of_one_gaussian": mixture_divergence(draws.last, one),
        "kl_of_two_gaussians": mixture_divergence(draws.last, two),
    }


def _of_particles(draws: Draws) -> dict[str, jax.Array]:
    """How well the particles did."""
    trace = draws.trace
    return {
        "landmarks_effective": draws.effective,
        "reached": draws.reached,
        "rounds": jnp.sum(~jnp.isnan(trace.power)),
        "acceptance": jnp.nanmean(trace.acceptance),
        "least_distinct": jnp.nanmin(trace.distinct),
        "least_effective": jnp.nanmin(trace.effective),
    }


def beside(
    study: Study, name: str, options: FromRestPosterior, indices: range, poses: np.ndarray
) -> Records:
    """Records of a filter on the same runs, beside parameters of the drawn T_BC, axes run, draw."""
    (slam,) = jaxslam.make_filters(study.scenario, [name], ["inverse_scaling"]).values()
    runs = draw_runs(study, options.seed, indices)
    T_BC = study.scenario.geometry.group(jnp.asarray(poses))
    found = against_filter(study, slam, runs, T_BC, gaussian_sum)
    found = finished(found, f"{name} beside the posterior of runs {indices}")
    return {key: np.asarray(value) for key, value in found.items()}


def summarise(records: Records, filters: Mapping[str, Records]) -> dict[str, Any]:
    """Numbers of the runs whose particles reached the whole likelihood in every repeat."""
    used = np.all(records["reached"], axis=1)
    r = {name: value[used] for name, value in records.items()}
    dof = r["error"].shape[-1]
    _, p = uniformity(ranks(r["pooled_error"], r["draws"], KEPT), KEPT)
    return {
        "runs": len(used),
        "used": int(used.sum()),
        "nees": {**summarise_nees(r["pooled_nees"], dof), **_expected(r)},
        "nees_of_repeats": [summarise_nees(nees, dof) for nees in r["nees"].T],
        "rank_p_values": [float(value) for value in p],
        "rmse": _root_mean_square(r["pooled_error"]),
        "sigma": _root_mean_square(np.sqrt(np.diagonal(r["pooled_covariance"], 0, 1, 2))),
        "modes": _modes(r),
        "repeats": _agreement(r),
        "kl": {name: _quantiles(r[name]) for name in r if name.startswith("pooled_kl_")},
        "filters": {name: _of_filter(found, records, used) for name, found in filters.items()},
        "sampler": {name: _quantiles(r[name]) for name in SAMPLER},
        "by_run": {name: np.round(r[name], 4).tolist() for name in BY_RUN},
    }


def _of_filter(found: Records, records: Records, used: np.ndarray) -> dict[str, Any]:
    """A filter beside the exact posterior, as one Gaussian and as all that it has."""
    exact = {f"exact_{name}": records[f"pooled_{name}"] for name in ("error", "covariance")}
    f = {name: value[used] for name, value in found.items()}
    own, draws = f["reversed"], f["exact_reversed"]
    return {
        **summarise_filter(found, exact, used),
        "rmse": _root_mean_square(f["error"]),
        "sigma": _root_mean_square(np.sqrt(np.diagonal(f["covariance"], 0, 1, 2))),
        "kl_of_sum": _quantiles(f["kl_of_sum"]),
        "reversed": {
            "correlation": float(np.corrcoef(own, draws)[0, 1]),
            "mean_difference": float(np.mean(np.abs(own - draws))),
        },
        "by_run": {name: np.round(f[name], 4).tolist() for name in BY_RUN_OF_FILTER},
    }


def _expected(r: Records) -> dict[str, float]:
    """By the posteriors' own draws: σ of the mean NEES, and p that its ranks among theirs are even.

    The mean is the degrees of freedom whatever the posteriors' shape, but for those with long tails
    or several modes the χ² band is too narrow.
    """
    own = np.einsum(
        "rsi,rij,rsj->rs", r["draws"], np.linalg.inv(r["pooled_covariance"]), r["draws"]
    )
    _, p = uniformity(ranks(r["pooled_nees"][:, None], own[..., None], KEPT), KEPT)
    spread = np.sqrt(np.sum(np.var(own, axis=1))) / len(own)
    return {"spread_of_mean": float(spread), "rank_p_value": float(p[0])}


def _modes(r: Records) -> dict[str, Any]:
    """Share of the runs with a second mode of more than 5 %: any, and the reversed one."""
    found = {}
    for name in ("second_mode", "reversed_mode"):
        weights = r[f"pooled_{name}"]
        several = weights > LEAST_SHARE
        found[name] = {
            "runs": float(several.mean()),
            "runs_by_repeat": [float(x) for x in np.mean(r[name] > LEAST_SHARE, axis=0)],
            "weight": _quantiles(weights[several]) if several.any() else None,
            "nees": float(r["pooled_nees"][several].mean()) if several.any() else None,
        }
    return found


def _agreement(r: Records) -> dict[str, Any]:
    """Differences of the two repeats: log evidence, weights, mean and log σ."""
    sigma = np.sqrt(np.diagonal(r["pooled_covariance"], 0, 1, 2))
    apart = (r["error"][:, 0] - r["error"][:, 1]) / sigma
    spreads = np.sqrt(np.diagonal(r["covariance"], 0, 2, 3))
    return {
        "log_evidence": _quantiles(np.abs(np.diff(r["log_evidence"]))),
        "reversed": _quantiles(np.abs(np.diff(r["reversed"]))),
        "second_mode": _quantiles(np.abs(np.diff(r["second_mode"]))),
        "mean_over_sigma": _quantiles(np.abs(apart)),
        "log_sigma": _quantiles(np.abs(np.diff(np.log(spreads), axis=1))),
    }


def _quantiles(values: np.ndarray) -> dict[str, float]:
    names = {"median": 0.5, "worst_tenth": 0.9, "most": 1.0, "least": 0.0}
    return {name: float(np.quantile(values, q)) for name, q in names.items()}


def _root_mean_square(values: np.ndarray) -> list[float]:
    """Of each coordinate over the runs."""
    return np.sqrt(np.mean(values**2, axis=0)).tolist()


def _joined(parts: Sequence[Records]) -> Records:
    """The records of all chunks, one after the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _store(options: FromRestPosterior) -> FolderStore | MemoryStore:
    if options.cache is None:
        return MemoryStore()
    return FolderStore(options.cache, _settings(options), resume=True)


def _settings(options: FromRestPosterior) -> dict[str, Any]:
    """What the numbers depend on."""
    given = dataclasses.asdict(options)
    return {name: given[name] for name in ("steps", "landmarks", "velocity_sigma", "seed", "smc")}


def as_table(summary: dict[str, Any]) -> str:
    """The exact posterior, the best sums of Gaussians, and the filters, on the same runs."""
    header = ["", "NEES", "RMSE, m", "over the exact one", "σ, m", "KL, nats", "reversed weight"]
    kl = {name: summary["kl"][f"pooled_kl_of_{name}"] for name in ("one_gaussian", "two_gaussians")}
    rows = [
        ["exact posterior", f"{summary['nees']['mean']:.2f}", *_accuracy(summary, 1.0), "0", "0"],
        ["its mean and covariance", "", "", "", "", _median(kl["one_gaussian"]), ""],
        ["a Gaussian for each mode", "", "", "", "", _median(kl["two_gaussians"]), ""],
        *(_row(*item) for item in summary["filters"].items()),
    ]
    return table(header, rows)


def _row(name: str, found: dict[str, Any]) -> list[str]:
    accuracy = _accuracy(found, found["position"]["rmse_ratio"])
    nees, wrong = found["nees"]["mean"], found["reversed"]
    weight = f"{wrong['mean_difference']:.3f}; {wrong['correlation']:.2f}"
    return [f"`{name}`", f"{nees:.2f}", *accuracy, _median(found["kl_of_sum"]), weight]


def _accuracy(found: dict[str, Any], ratio: float) -> list[str]:
    """RMSE of the position, over the exact one, and σ."""
    position = slice(position_dim(len(found["rmse"])))
    rmse, sigma = (np.linalg.norm(found[key][position]) for key in ("rmse", "sigma"))
    return [f"{rmse:.3f}", f"{ratio:.2f}", f"{sigma:.3f}"]


def _median(quantiles: dict[str, float]) -> str:
    return f"{quantiles['median']:.2f}; {quantiles['worst_tenth']:.2f}"


if __name__ == "__main__":
    FromRestPosterior.run()
