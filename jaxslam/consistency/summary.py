"""What a study says: per step and per filter, the numbers of `consistency.json` and its table."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import reduce
from operator import add
from typing import Any

import numpy as np

from jaxslam.consistency.montecarlo import Study
from jaxslam.consistency.statistics import lost_threshold, mean_band
from jaxslam.consistency.store import Records
from jaxslam.consistency.verdict import Tally, sentences
from jaxslam.forms.state import Status
from jaxslam.slam.filter import innermost

SCHEMA = 1
_STEPS_AT_ONCE = 50
"""Steps of which the median holds all runs in memory."""


def summarise(study: Study) -> dict[str, Any]:
    """The content of `consistency.json`, ready for `json.dumps`.

    A run diverges when its NEES is not finite, or its covariance not positive definite, at any
    step. With such a run the verdict has no mean; the means of every step are over the
    `survivors`, and `band95` and `inside` are of so many. `lost` (at the step) and `lost_ever`
    (at any so far) count diverged runs as lost. `landmark_nees` is over the landmarks whose NEES
    is finite; of the surviving runs' `landmark_not_finite` had one that is not. `status` counts the
    runs in which an update said that something was wrong (`jaxslam.Status`).
    """
    from jaxslam import __version__

    return {
        "schema": SCHEMA,
        "version": __version__,
        "scenario": dataclasses.asdict(study.scenario),
        "runs": study.runs,
        "steps": study.scenario.steps,
        "seed": study.seed,
        "dtype": study.dtype,
        "device": study.device,
        "time": [round((i + 1) / study.scenario.rate, 6) for i in range(study.scenario.steps)],
        "filters": {name: _summarise_filter(study, name) for name in study.filters},
    }


def _summarise_filter(study: Study, name: str) -> dict[str, Any]:
    geometry = study.scenario.world
    dof, n = geometry.tangent_dim, geometry.point_dim
    sums = _sums(study, name, dof)
    healthy = study.runs - int(sums["diverged"])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums["nees"] / healthy
        kept = sums["kept_nees"] / sums["kept"]
        error, variance = sums["squared_error"] / healthy, sums["variance"] / healthy
        landmark = sums["landmark_nees"] / sums["landmark_count"]
        nis, nis_dof = sums["nis"] / healthy, sums["nis_dof"] / healthy
    low, high = mean_band(dof, max(healthy, 1))

    def by_part(per_axis):
        return {
            "position": _numbers(np.sqrt(per_axis[:, :n].sum(axis=1))),
            "orientation": _numbers(np.sqrt(per_axis[:, n:].sum(axis=1))),
        }

    seconds = study.seconds[name]
    return {
        "verdict": tally(study, name).verdict(),
        "dof": dof,
        "calibration": treatment(study.filters[name]),
        "survivors": healthy,
        "band95": [low, high],
        "nees": _numbers(mean),
        "nees_median": _numbers(_median(study, name)),
        "nees_not_lost": _numbers(kept),
        "lost": _numbers((sums["lost"] + sums["diverged"]) / study.runs),
        "lost_ever": _numbers((sums["lost_ever"] + sums["diverged"]) / study.runs),
        "inside": float(np.mean((mean >= low) & (mean <= high))),
        "nis": _numbers(nis),
        "nis_dof": _numbers(nis_dof),
        "rmse": by_part(error),
        "sigma": by_part(variance),
        "landmark_nees": _numbers(landmark),
        "landmark_dof": n,
        "landmark_not_finite": [int(count) for count in sums["landmark_not_finite"]],
        "diverged": int(sums["diverged"]),
        "status": {s.name.lower(): int(sums[f"status_{s.name}"]) for s in Status if s != Status.OK},
        "seconds": {"compile": seconds.compile, "run": seconds.run},
    }


def treatment(slam: Any) -> str | None:
    """How a filter treats its sensor's calibration, where it says so."""
    inner = innermost(slam)
    return None if inner is None else inner.calibration.name


def _sums(study: Study, name: str, dof: int) -> dict[str, Any]:
    """Sums over the runs that did not diverge, chunk by chunk."""
    threshold, total = lost_threshold(dof), {}
    for records in _chunks(study, name):
        healthy = _healthy(records)
        good = {k: v[healthy] for k, v in records.items() if not k.startswith("sample_")}
        with np.errstate(invalid="ignore"):
            kept = good["nees"] <= threshold
        finite = good["landmark_count"] - good["landmark_not_finite"]
        part = {
            "diverged": np.sum(~healthy),
            "nees": good["nees"].sum(axis=0),
            "kept": kept.sum(axis=0),
            "kept_nees": np.where(kept, good["nees"], 0.0).sum(axis=0),
            "lost": (~kept).sum(axis=0),
            "lost_ever": np.logical_or.accumulate(~kept, axis=1).sum(axis=0),
            "nis": good["nis"].sum(axis=0),
            "nis_dof": good["nis_dof"].sum(axis=0),
            "squared_error": (good["error"] ** 2).sum(axis=0),
            "variance": good["variance"].sum(axis=0),
            "landmark_nees": (good["landmark_nees"] * finite).sum(axis=0),
            "landmark_count": finite.sum(axis=0),
            "landmark_not_finite": good["landmark_not_finite"].sum(axis=0),
            **{
                f"status_{s.name}": np.any(records["status"] == s, axis=1).sum()
                for s in Status
                if s != Status.OK
            },
        }
        total = {key: total.get(key, 0) + value for key, value in part.items()}
    return total


def tally(study: Study, name: str) -> Tally:
    """What the verdict on one filter is made of; tallies of other seeds may be added."""
    dof = study.scenario.world.tangent_dim
    return reduce(add, (Tally.of(r["nees"], dof) for r in _chunks(study, name, ("nees",))))


def _median(study: Study, name: str) -> np.ndarray:
    """Median over all runs, diverged ones above everything."""
    medians = []
    for start in range(0, study.scenario.steps, _STEPS_AT_ONCE):
        part = slice(start, start + _STEPS_AT_ONCE)
        columns = [
            np.where(_healthy(records)[:, None], records["nees"], np.inf)[:, part]
            for records in _chunks(study, name, ("nees",))
        ]
        medians.append(np.median(np.concatenate(columns), axis=0))
    return np.concatenate(medians)


def _healthy(records: Records) -> np.ndarray:
    return np.asarray(np.isfinite(records["nees"]).all(axis=1))


def _chunks(study: Study, name: str, names: tuple[str, ...] | None = None) -> Iterator[Records]:
    for chunk in study.chunks:
        yield study.store.load(name, chunk, names)


def _numbers(values: np.ndarray) -> list[float | None]:
    """For JSON, which has no NaN."""
    return [float(value) if np.isfinite(value) else None for value in values]


def table(summary: dict[str, Any]) -> str:
    """The verdict on every filter, then the numbers of the last step, one filter a line."""
    filters = summary["filters"]
    wide = max(31, *map(len, filters)) + 1
    header = (
        f"{'filter/landmarks':<{wide}}{'NEES mean':>10}{'95 % band':>14}{'median':>8}{'others':>8}"
        f"{'lost':>7}{'ever':>7}{'diverged':>9}{'NIS/dof':>8}{'RMSE m':>8}{'σ m':>8}{'seconds':>9}"
    )
    return "\n".join(
        [
            *("\n    ".join([f"{name}:", *sentences(f["verdict"])]) for name, f in filters.items()),
            "",
            header,
            *(_row(f"{name:<{wide}}", f) for name, f in filters.items()),
            f"last of {summary['steps']} steps, {summary['runs']} runs of seed {summary['seed']}; "
            f"a consistent filter has mean NEES {next(iter(filters.values()))['dof']}; verdicts: "
            "of time averages, [99 % interval]",
            "lost: NEES above the 99.99 % quantile of χ² now, ever: at any step; others: mean of "
            "those not lost now",
            *_notes(filters),
        ]
    )


def _row(name: str, f: dict[str, Any]) -> str:
    with np.errstate(invalid="ignore"):  # a filter that compares nothing has no NIS
        nis = np.nansum(np.array(f["nis"], float)) / np.nansum(np.array(f["nis_dof"], float))
    band = f"{f['band95'][0]:.3f}–{f['band95'][1]:.3f}"
    return (
        f"{name}{_last(f['nees'], 10, 3)}{band:>14}{_last(f['nees_median'], 8, 2)}"
        f"{_last(f['nees_not_lost'], 8, 3)}{_share(f['lost'][-1]):>7}"
        f"{_share(f['lost_ever'][-1]):>7}{f['diverged']:>9d}{nis:>8.3f}"
        f"{_last(f['rmse']['position'], 8, 3)}{_last(f['sigma']['position'], 8, 3)}"
        f"{f['seconds']['compile'] + f['seconds']['run']:>9.1f}"
    )


def _notes(filters: dict[str, Any]) -> Iterator[str]:
    """What the means of the table leave out."""
    for name, f in filters.items():
        if f["diverged"]:
            yield f"{name}: means and band are of the {f['survivors']} runs that did not diverge"
        if count := sum(f["landmark_not_finite"]):
            yield f"{name}: {count} NEES of landmarks are not finite, and not in their mean"


def _last(values: list[float | None], width: int, digits: int) -> str:
    value = values[-1]
    if value is None:
        return f"{'–':>{width}}"
    return f"{value:>{width}.{digits}f}" if abs(value) < 1e4 else f"{value:>{width}.2g}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.1%}"
