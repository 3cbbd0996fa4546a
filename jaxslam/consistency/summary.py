"""The summary of a study: per step and filter, the numbers of `consistency.json` and its table."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

import numpy as np

from jaxslam._runtime.files import json_numbers
from jaxslam._runtime.lookup import suggestion
from jaxslam.consistency.store import Records, Store
from jaxslam.consistency.sums import (
    RECORDS,
    Sums,
    added,
    keeps_records,
    sums_of,
    survived,
    tally_of,
)
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.observations import Status
from jaxslam.simulation import Scenario
from jaxslam.statistics.bands import mean_band
from jaxslam.statistics.beyond_scale import SCALE, one_scale_of
from jaxslam.statistics.verdict import Tally, lost_runs, sentences

Summary = dict[str, Any]
"""The content of `consistency.json`, or what it says of one filter."""
SCHEMA = 1
_VALUES_AT_ONCE = 10**7
"""The most values of a record in memory for medians: all runs, and as many steps as fit."""
_OF_MEDIANS = ("nees", "log_scale", "log_scale_sigma", *SCALE)


@dataclass(frozen=True)
class Seconds:
    """The wall time of one filter over all its runs, in seconds."""

    compile: float
    """Seconds until its program was there."""
    run: float
    """Seconds from then on."""


@dataclass(frozen=True, repr=False)
class Study:
    """The finished runs of a study: the store of their records, and what is needed to read them."""

    scenario: Scenario
    """The world that was simulated."""
    filters: Mapping[str, AbstractFilter]
    """The filters by the names under which their records are kept."""
    runs: int
    """The number of runs of every filter, on the same worlds."""
    seed: int
    """The seed of all draws."""
    dtype: str
    """`float64` or `float32`."""
    chunks: tuple[range, ...]
    """The runs that were computed, and are kept, together."""
    store: Store
    """The store that has the records."""
    seconds: Mapping[str, Seconds]
    """The time that each filter took."""
    device: str
    """The device on which it was computed."""
    reduced: bool = False
    """Whether of all chunks but the first only sums are kept."""
    backends: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """The backend that computed each filter."""

    @property
    def whole(self) -> tuple[range, ...]:
        """The chunks whose records are kept."""
        return tuple(chunk for chunk in self.chunks if keeps_records(chunk, self.reduced))

    def loaded(self, name: str) -> Iterator[Records]:
        """Yield of every chunk the records of a filter that a summary reads. Raises ValueError."""
        for chunk in self.chunks:
            whole = keeps_records(chunk, self.reduced)
            records = self.store.load(name, chunk, RECORDS if whole else None)
            for key in RECORDS if whole else ():
                if records[key].ndim != 2 + (key in ("error", "variance")):
                    where = f"{name}, runs {chunk.start} to {chunk.stop - 1}"
                    raise ValueError(f"{where}: the record {key} is damaged; run again")
            yield records

    def __repr__(self) -> str:
        """Return its table, so that a study prints as its result."""
        return table(summarise(self))

    def summary(self) -> Summary:
        """Return `summarise(study)`, the content of `consistency.json`."""
        return summarise(self)

    def __getattr__(self, name: str) -> NoReturn:
        drawn = " (jaxslam.plots.plot_consistency(study) draws it)"
        meant = drawn if name.startswith("plot") else suggestion(name, dir(type(self)))
        raise AttributeError(f"a Study has no attribute {name!r}{meant}")


def as_summary(given: Study | Summary) -> Summary:
    """A summary, or that of a study. Raises ValueError for anything else."""
    if isinstance(given, dict) and "filters" in given:
        return given
    return summarise(given)  # ty: ignore[invalid-argument-type]


def summarise(study: Study) -> Summary:
    """The content of `consistency.json`, ready for `json.dumps`.

    A run diverges when its NEES is not finite, or its covariance not positive definite, at any
    step. With such a run the verdict has no mean; the means of every step are over the
    `survivors`, and `band95` and `inside` are of so many. `lost` (at the step) and `lost_ever`
    (at any so far) count diverged runs as lost. `landmark_nees` is over the landmarks whose NEES
    is finite; of the surviving runs' `landmark_not_finite` had one that is not. `status` counts the
    runs in which an update said that something was wrong (`jaxslam.Status`).

    `beyond_scale` is NEES at the one scale of every run that explains all of its poses best
    (`beyond_scale.one_scale`), in the filter's own unit, with the same numbers: that scale takes
    from one degree of freedom a run to one a pose, and band and verdict allow for both.
    `scale_drift` is how far the scale of a pose is from that of its run, with the σ claimed of it;
    `log_scale` the error of the scale in metres, the σ claimed (root mean squares and medians)
    and the error in σ; `reversed` the share of the displaced runs whose estimate points away from
    the truth. Where the sensor measures metres, or the motion is given in metres, they say little.

    `outside3sigma` is the share of errors beyond three of the claimed σ, axis by axis and then the
    mean of the axes: 0.27 % of Gaussian errors.
    Medians are over the first `medians_of` runs, all but where a study keeps sums alone.
    Raises ValueError for what is no study.
    """
    if not isinstance(study, Study):
        raise ValueError(
            f"a study is summarised, as monte_carlo gives it, not {type(study).__name__}"
        )
    from jaxslam._version import __version__

    return {
        "schema": SCHEMA,
        "version": __version__,
        "scenario": dataclasses.asdict(study.scenario),
        "runs": study.runs,
        "medians_of": sum(map(len, study.whole)),
        "scale_free": study.scenario.scale_free,
        "steps": study.scenario.steps,
        "seed": study.seed,
        "dtype": study.dtype,
        "device": study.device,
        "time": [round((i + 1) / study.scenario.rate, 6) for i in range(study.scenario.steps)],
        "filters": {name: _summarise_filter(study, name) for name in study.filters},
    }


def _summarise_filter(study: Study, name: str) -> Summary:
    geometry = study.scenario.world
    dof, n = geometry.tangent_dim, geometry.point_dim
    (sums, lost), medians = _sums_and_lost(study, name), _medians(study, name)
    healthy = study.runs - int(sums["diverged"])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums["nees"] / healthy
        kept = sums["kept_nees"] / sums["kept"]
        error, variance = sums["squared_error"] / healthy, sums["variance"] / healthy
        landmark = sums["landmark_nees"] / sums["landmark_count"]
        nis, nis_dof = sums["nis"] / healthy, sums["nis_dof"] / healthy
    low, high = mean_band(dof, max(healthy, 1))

    def by_part(per_axis):
        with np.errstate(invalid="ignore"):  # of a variance that is negative
            parts = np.sqrt(per_axis[:, :n].sum(axis=1)), np.sqrt(per_axis[:, n:].sum(axis=1))
        return dict(zip(("position", "orientation"), map(json_numbers, parts), strict=True))

    seconds = study.seconds[name]
    return {
        "verdict": {**tally_of(sums, "nees", dof).verdict(), "lost_runs": lost},
        "dof": dof,
        "calibration": treatment(study.filters[name]),
        "survivors": healthy,
        "band95": [low, high],
        "nees": json_numbers(mean),
        "nees_median": json_numbers(medians.nees),
        "nees_not_lost": json_numbers(kept),
        "lost": json_numbers((sums["lost"] + sums["diverged"]) / study.runs),
        "lost_ever": json_numbers((sums["lost_ever"] + sums["diverged"]) / study.runs),
        "inside": float(np.mean((mean >= low) & (mean <= high))),
        "nis": json_numbers(nis),
        "nis_dof": json_numbers(nis_dof),
        "rmse": by_part(error),
        "sigma": by_part(variance),
        "outside3sigma": {
            "position": json_numbers(_ratio(sums["outside"][:, :n].mean(axis=1), healthy)),
            "orientation": json_numbers(_ratio(sums["outside"][:, n:].mean(axis=1), healthy)),
        },
        "beyond_scale": {
            "dof": dof,
            "band95": [mean_band(dof - 1, max(healthy, 1))[0], high],
            "nees": json_numbers(sums["beyond_scale"] / max(healthy, 1)),
            "nees_median": json_numbers(medians.at_one_scale),
            "lost": json_numbers((sums["beyond_lost"] + sums["diverged"]) / study.runs),
            "verdict": tally_of(sums, "beyond_scale", dof).verdict(),
        },
        "scale_drift": _drift(sums, dof),
        "log_scale": _log_scale(sums, medians, healthy),
        "reversed": json_numbers(_ratio(sums["reversed"], sums["displaced"])),
        "landmark_nees": json_numbers(landmark),
        "landmark_dof": n,
        "landmark_not_finite": [int(count) for count in sums["landmark_not_finite"]],
        "diverged": int(sums["diverged"]),
        "status": {s.name.lower(): int(sums[f"status_{s.name}"]) for s in Status if s != Status.OK},
        "backend": study.backends.get(name),
        "seconds": {"compile": seconds.compile, "run": seconds.run},
    }


def _drift(sums: Sums, dof: int) -> Summary:
    """The root mean squares over the surviving runs whose unit is fixed; no verdict without any."""
    count = sums["drift_count"]
    of_drift = tally_of(sums, "drift", dof)
    return {
        "rms": _rms(sums["squared_drift"], count),
        "sigma": _rms(sums["drift_variance"], count),
        "normalised_rms": _rms(sums["normalised_drift"], count),
        "runs": [int(n) for n in count],
        "verdict": of_drift.verdict() if of_drift.runs else None,
    }


def _log_scale(sums: Sums, medians: _Medians, healthy: int) -> Summary:
    """The root mean squares over the surviving runs; medians over all."""
    return {
        "error_rms": _rms(sums["squared_log_scale"], healthy),
        "error_median": json_numbers(medians.log_scale),
        "sigma": _rms(sums["log_scale_variance"], healthy),
        "sigma_median": json_numbers(medians.log_scale_sigma),
        "normalised_rms": _rms(sums["normalised_log_scale"], healthy),
    }


def _rms(squares: np.ndarray, counts: np.ndarray | int) -> list[float | None]:
    return json_numbers(np.sqrt(_ratio(squares, counts)))


def _ratio(sums: np.ndarray, counts: np.ndarray | int) -> np.ndarray:
    """Divide sums by counts, NaN where nothing was counted."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return sums / counts


def treatment(slam: AbstractFilter) -> str | None:
    """The treatment of the sensor's calibration by a filter, where it says so."""
    inner = slam.unwrapped
    return inner.calibration.name if isinstance(inner, EkfSlam) else None


def tally(study: Study, name: str, record: str = "nees") -> Tally:
    """The tally for the verdict on one filter; tallies of other seeds may be added.

    It is of the `nees` of its poses, of the part that is `beyond_scale`, or of the `drift` of the
    scale.
    """
    return tally_of(_sums(study, name), record, study.scenario.world.tangent_dim)


def _sums(study: Study, name: str) -> Sums:
    """The sums of all chunks."""
    return _sums_and_lost(study, name)[0]


def _sums_and_lost(study: Study, name: str) -> tuple[Sums, list[int] | None]:
    """The sums of all chunks, and the numbers of lost runs, None where not all records are kept."""
    dof, lost = study.scenario.world.tangent_dim, []

    def each() -> Iterator[Sums]:
        for chunk, kept in zip(study.chunks, study.loaded(name), strict=True):
            if not study.reduced:
                lost.extend(chunk.start + run for run in lost_runs(kept["nees"], dof))
            yield sums_of(kept, dof)

    return added(each()), None if study.reduced else lost


class _Medians(NamedTuple):
    """The medians of every step, over all runs whose records are kept, diverged ones infinite."""

    nees: np.ndarray
    at_one_scale: np.ndarray
    log_scale: np.ndarray
    """The median of its error's size."""
    log_scale_sigma: np.ndarray


def _medians(study: Study, name: str) -> _Medians:
    """Compute the medians, reading every chunk once for as many steps as are held in memory."""
    medians, at_once = [], max(1, _VALUES_AT_ONCE // study.runs)
    for start in range(0, study.scenario.steps, at_once):
        part, columns = slice(start, start + at_once), []
        for chunk in study.whole:
            kept = study.store.load(name, chunk, _OF_MEDIANS)
            survivors = survived(kept)[:, None]
            values = (
                kept["nees"], one_scale_of(kept).nees, np.abs(kept["log_scale"]),
                kept["log_scale_sigma"],
            )  # fmt: skip
            columns.append([np.where(survivors, x, np.inf)[:, part] for x in values])
        medians.append([np.median(np.concatenate(x), axis=0) for x in zip(*columns, strict=True)])
    return _Medians(*(np.concatenate(x) for x in zip(*medians, strict=True)))


def table(summary: Summary | Study) -> str:
    """The verdict on every filter, then the numbers of the last step, one filter a line.

    It is that of a `summary`, or of a study, which is summarised here.
    """
    summary = as_summary(summary)
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
            "of all steps, the last and each third together, [99 % interval]",
            "lost: NEES above the 99.99 % quantile of χ² at the last step; ever: NEES above a "
            "stricter limit at some step (so `ever` can be smaller than `lost`); others: mean "
            "NEES of the runs not lost at the last step",
            *(_scale_table(filters, wide) if summary["scale_free"] else ()),
            *_notes(filters),
        ]
    )


def _row(name: str, f: Summary) -> str:
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


def _scale_table(filters: Summary, wide: int) -> Iterator[str]:
    """The table of errors that are not of scale, and of those of the scale, at the last step."""
    yield ""
    yield (
        f"{'at one scale a run':<{wide}}{'NEES mean':>10}{'95 % band':>14}{'median':>8}{'lost':>7}"
        f"{'reversed':>10}{'drift':>8}{'drift/σ':>9}{'log-scale error':>17}{'claimed σ':>11}"
        f"{'error/σ':>9}  verdict; on the drift"
    )
    for name, f in filters.items():
        word = (f["scale_drift"]["verdict"] or {"word": "–"})["word"]
        beyond, scale, drift = f["beyond_scale"], f["log_scale"], f["scale_drift"]
        low, high = beyond["band95"]
        yield (
            f"{name:<{wide}}{_last(beyond['nees'], 10, 3)}{f'{low:.3f}–{high:.3f}':>14}"
            f"{_last(beyond['nees_median'], 8, 2)}{_share(beyond['lost'][-1]):>7}"
            f"{_share(f['reversed'][-1]):>10}{_last(drift['rms'], 8, 3)}"
            f"{_last(drift['normalised_rms'], 9, 2)}{_last(scale['error_rms'], 17, 3)}"
            f"{_last(scale['sigma_median'], 11, 3)}{_last(scale['normalised_rms'], 9, 2)}"
            f"  {beyond['verdict']['word']}; {word}"
        )
    dof = next(iter(filters.values()))["beyond_scale"]["dof"]
    yield (
        f"at the one scale of the truth that explains all poses of a run best: a right NEES is "
        f"{dof - 1} to {dof}; reversed: displaced away from the truth; drift of log-scale along a "
        "run, and its error in metres: rms, claimed σ: median"
    )


def _notes(filters: Summary) -> Iterator[str]:
    """Remarks on what the means of the table leave out."""
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
