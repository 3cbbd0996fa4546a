"""A study: its runs, and the results that are computed from their records, filter by filter."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxslam._runtime import plotted
from jaxslam._runtime.files import read_json, write_atomically, write_json
from jaxslam._runtime.lookup import suggestion
from jaxslam.consistency.manifest import Manifest, described
from jaxslam.consistency.results import FilterResult, Results, Seconds, Summary, named
from jaxslam.consistency.store import FolderStore, Records, Store
from jaxslam.consistency.sums import (
    RECORDS,
    Sums,
    added,
    keeps_records,
    sums_of,
    survived,
    tally_of,
)
from jaxslam.consistency.table import as_html, as_text
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.observations import Status
from jaxslam.simulation import Scenario, scenario
from jaxslam.statistics import Tally, lost_runs, mean_band
from jaxslam.statistics.beyond_scale import SCALE, one_scale_of

_VALUES_AT_ONCE = 10**7
"""The most values of a record in memory for medians: all runs, and as many steps as fit."""
_IN_BOTH = ("runs", "seed", "dtype", "device")
"""The attributes of a study that its results have too."""
_FILES = {"consistency.json", "consistency.png", "consistency.pdf", "runs"}
"""The names in the folder of a study that is saved, which may be written over."""


@dataclass(frozen=True, eq=False, repr=False)
class Study(Mapping):
    """The finished runs of a study, and what it found of each filter: `study[name].nees.mean`.

    A filter's name may be a part that only one has, as `study["recommended"]`. It prints as its
    table.
    """

    scenario: Scenario
    """The world that was simulated."""
    filters: Mapping[str, Any]
    """The filters by the names under which their records are kept; of a study that was loaded,
    their descriptions."""
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
    made_by: Manifest = dataclasses.field(default_factory=dict)
    """All that decides the runs, as JSON."""
    calibrations: Mapping[str, str | None] = dataclasses.field(default_factory=dict)
    """Each filter's treatment of the calibration, where it says so."""

    __eq__, __hash__ = object.__eq__, object.__hash__

    def __getitem__(self, name: str) -> FilterResult:
        name = named(name, self.filters)
        if name not in self._found:
            self._found[name] = _result(self, name)
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.filters)

    def __len__(self) -> int:
        return len(self.filters)

    @cached_property
    def _found(self) -> dict[str, FilterResult]:
        """The results that were asked for; runs that are finished do not change."""
        return {}

    @property
    def whole(self) -> tuple[range, ...]:
        """The chunks whose records are kept."""
        return tuple(chunk for chunk in self.chunks if keeps_records(chunk, self.reduced))

    @property
    def results(self) -> Results:
        """The results of all filters, which need no records any more."""
        from jaxslam._runtime import __version__

        steps = self.scenario.steps
        return Results(
            version=__version__,
            scenario=self.scenario.to_dict(),
            medians_of=sum(map(len, self.whole)),
            scale_free=self.scenario.scale_free,
            steps=steps,
            time=np.array([round((i + 1) / self.scenario.rate, 6) for i in range(steps)]),
            filters=dict(self),
            **{name: getattr(self, name) for name in _IN_BOTH},
        )

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

    def records(self, name: str) -> Records:
        """Return the records (runs, steps, …) of a filter's runs, see `consistency.filter_run`.

        Of a study of sums they are those of the first chunk.
        """
        name = named(name, self.filters)
        parts = [self.store.load(name, chunk, RECORDS) for chunk in self.whole]
        return {key: np.concatenate([part[key] for part in parts]) for key in RECORDS}

    def summary(self) -> Summary:
        """Return `summarise(study)`, the content of `consistency.json`."""
        return self.results.to_json()

    to_json = summary

    def table(self) -> str:
        """Return the verdicts and the numbers of the last step as text."""
        return as_text(self.results)

    def plot(self, path: str | Path | None = None, *, column: bool = False) -> Any:
        """Return the figure of the study, see `jaxslam.plots.plot_consistency`."""
        return plotted("plot_consistency")(self, path=path, column=column)

    def to_dataframe(self) -> Any:
        """Return the numbers of every filter and step as a `pandas.DataFrame`.

        Its columns are called as in `consistency.json`, as `rmse_position`. Raises ValueError
        without pandas.
        """
        pandas, time = _library("pandas"), self.results.time
        frames = [{"filter": name, "time": time} | self[name].series for name in self]
        return pandas.concat([pandas.DataFrame(x) for x in frames], ignore_index=True)

    def to_xarray(self) -> Any:
        """Return the records of every filter, run and step as an `xarray.Dataset`.

        Of a study of sums they are those of the first chunk. Raises ValueError without xarray.
        """
        xarray, records = _library("xarray"), [self.records(name) for name in self.filters]
        axes = ("filter", "run", "step", "axis")
        joined = {key: np.stack([x[key] for x in records]) for key in RECORDS}
        coords = {"filter": list(self.filters), "time": ("step", self.results.time)}
        return xarray.Dataset({key: (axes[: x.ndim], x) for key, x in joined.items()}, coords)

    def save(self, folder: str | Path) -> Path:
        """Write the study into a folder, whole or not at all; return its path.

        The folder is as `jaxslam consistency --out` writes it: `consistency.json`, and the records
        in `runs`. `Study.load` reads both. A study that is there is written over. Raises ValueError
        for a folder with anything else in it.
        """
        folder = Path(folder)
        if isinstance(self.store, FolderStore) and self.store.folder == folder / "runs":
            write_json(folder / "consistency.json", self.to_json(), allow_nan=False)
            return folder
        if folder.exists() and (others := {path.name for path in folder.iterdir()} - _FILES):
            raise ValueError(f"{folder} has other files ({min(others)}); name a new folder")
        with write_atomically(folder) as temporary:
            store = FolderStore(temporary / "runs")
            sizes = {"chunk": len(self.chunks[0]), "reduced": self.reduced}
            filters = {name: described(slam) for name, slam in self.filters.items()}
            store.begin({**self.made_by, **sizes}, filters)
            for name, chunk in product(self.filters, self.chunks):
                store.save(name, chunk, self.store.load(name, chunk))
            write_json(temporary / "consistency.json", self.to_json(), allow_nan=False)
            if folder.exists():
                shutil.rmtree(folder)
        return folder

    @staticmethod
    def load(folder: str | Path) -> Study:
        """Return the study that `save`, or `jaxslam consistency --out`, wrote into a folder.

        Raises ValueError, naming the file, for what is missing or damaged.
        """
        folder = Path(folder)
        told = read_json(folder / "consistency.json", "study", Results.from_json)
        store = FolderStore.reading(folder / "runs")
        made_by, filters = store.manifest["made_by"], store.manifest["filters"]
        study = Study(
            scenario=scenario("matched", dict(told.scenario)),
            filters={name: filters.get(name) for name in told},
            chunks=divided(told.runs, made_by["chunk"]),
            store=store,
            seconds={name: result.seconds for name, result in told.items()},
            reduced=made_by["reduced"],
            backends={name: result.backend for name, result in told.items()},
            made_by=made_by,
            calibrations={name: result.calibration for name, result in told.items()},
            **{name: getattr(told, name) for name in _IN_BOTH},
        )
        for name, chunk in product(study.filters, study.chunks):
            if not store.has(name, chunk):
                runs = f"runs {chunk.start} to {chunk.stop - 1} of {name}"
                raise ValueError(f"{store.folder} lacks {runs}; run it again with --resume")
        return study

    def __repr__(self) -> str:
        return self.table()

    def _repr_html_(self) -> str:
        return as_html(self.results)

    def __getattr__(self, name: str) -> NoReturn:
        if name in {field.name for field in dataclasses.fields(FilterResult)} | {"verdict", "lost"}:
            meant = f"; each filter has one: study[{next(iter(self.filters))!r}].{name}"
        else:
            meant = suggestion(name, dir(type(self)))
        raise AttributeError(f"a Study has no attribute {name!r}{meant}")


def _library(name: str) -> Any:
    """A library that is no requirement. Raises ValueError without it."""
    try:
        return import_module(name)
    except ImportError:
        raise ValueError(f"this needs {name}: pip install {name}") from None


def divided(runs: int, chunk: int) -> tuple[range, ...]:
    """Divide so many runs into chunks."""
    return tuple(range(i, min(i + chunk, runs)) for i in range(0, runs, chunk))


def results_of(given: Study | Results | Mapping[str, Any]) -> Results:
    """The results of a study, or those of which a summary was made. Raises ValueError."""
    if isinstance(given, Study):
        return given.results
    if isinstance(given, Results):
        return given
    if isinstance(given, dict) and "filters" in given:
        return Results.from_json(given)
    raise ValueError(f"a study is summarised, as monte_carlo gives it, not {type(given).__name__}")


def summarise(study: Study | Results) -> Summary:
    """The content of `consistency.json`, ready for `json.dumps`; `study[filter]` has it typed.

    A run diverges when its NEES is not finite, or its covariance not positive definite, at any
    step. With such a run the verdict has no mean; the means of every step are over the
    `survivors`, and `band95` and `inside` are of so many. `lost` (at the step) and `lost_ever`
    (at any so far) count diverged runs as lost. `landmark_nees` is over the landmarks whose NEES
    is finite; of the surviving runs' `landmark_not_finite` had one that is not. `status` counts the
    runs in which an update said that something was wrong (`jaxslam.Status`).

    `beyond_scale` is NEES at the one scale of every run that explains all of its poses best
    (`beyond_scale.one_scale`), in the filter's own unit, with the same numbers. That scale takes
    from one degree of freedom per run to one per pose; band and verdict allow for both.
    `scale_drift` is how far the scale of a pose is from that of its run, with the σ claimed of it.
    `log_scale` is the error of the scale in metres, the σ claimed (root mean squares and medians)
    and the error in σ. `reversed` is the share of the displaced runs whose estimate points away
    from the truth. Where the sensor measures metres, or the motion is given in metres, they say
    little.

    `outside3sigma` is the share of errors beyond three of the claimed σ, axis by axis and then the
    mean of the axes: 0.27 % of Gaussian errors.
    Medians are over the first `medians_of` runs, all but where a study keeps sums alone.
    Raises ValueError for what is no study.
    """
    return results_of(study).to_json()


def table(summary: Study | Results | Mapping[str, Any]) -> str:
    """The verdict on every filter, then the numbers of the last step, one filter a line.

    It is that of a `summary`, or of a study, which is summarised here. Raises ValueError for
    anything else.
    """
    return as_text(results_of(summary))


_MEANS = {
    "nees.mean": ("nees", "survivors"),
    "nees.lost": ("lost", "runs"),
    "not_lost": ("kept_nees", "kept"),
    "lost_ever": ("lost_ever", "runs"),
    "nis.mean": ("nis", "survivors"),
    "nis.dof": ("nis_dof", "survivors"),
    "beyond_scale.mean": ("beyond_scale", "survivors"),
    "beyond_scale.lost": ("beyond_lost", "runs"),
    "reversed": ("reversed", "displaced"),
    "landmark_nees.mean": ("landmark_nees", "landmark_count"),
}
"""The sums and counts of which results are means."""
_ROOTS = {
    "scale_drift.rms": ("squared_drift", "drift_count"),
    "scale_drift.sigma": ("drift_variance", "drift_count"),
    "scale_drift.normalised_rms": ("normalised_drift", "drift_count"),
    "log_scale.error_rms": ("squared_log_scale", "survivors"),
    "log_scale.sigma": ("log_scale_variance", "survivors"),
    "log_scale.normalised_rms": ("normalised_log_scale", "survivors"),
}
"""The same of roots of means."""


@np.errstate(invalid="ignore", divide="ignore")  # NaN where nothing was counted
def _result(study: Study, name: str) -> FilterResult:
    dof, n = study.scenario.geometry.tangent_dim, study.scenario.geometry.point_dim
    sums, lost = _sums_and_lost(study, name)
    diverged = int(sums["diverged"])
    healthy = study.runs - diverged
    sums |= {key: sums[key] + diverged for key in ("lost", "lost_ever", "beyond_lost")}
    sums |= {"survivors": healthy, "runs": study.runs}
    bands = [mean_band(degrees, max(healthy, 1)) for degrees in (dof, dof - 1)]
    drift = tally_of(sums, "drift", dof)
    found = {path: sums[key] / sums[count] for path, (key, count) in _MEANS.items()}
    found |= {path: np.sqrt(sums[key] / sums[count]) for path, (key, count) in _ROOTS.items()}
    for part, axes in (("position", slice(n)), ("orientation", slice(n, None))):
        for path, key in (("rmse", "squared_error"), ("sigma", "variance")):
            found[f"{path}.{part}"] = np.sqrt((sums[key] / healthy)[:, axes].sum(axis=1))
        found[f"outside3sigma.{part}"] = sums["outside"][:, axes].mean(axis=1) / healthy
    return FilterResult.of({
        **found,
        **_medians(study, name),
        "name": name,
        "nees.verdict": tally_of(sums, "nees", dof).verdict() | {"lost_runs": lost},
        "nees.dof": dof,
        "nees.band": bands[0],
        "beyond_scale.verdict": tally_of(sums, "beyond_scale", dof).verdict(),
        "beyond_scale.dof": dof,
        "beyond_scale.band": (bands[1][0], bands[0][1]),
        "scale_drift.runs": sums["drift_count"],
        "scale_drift.verdict": drift.verdict() if drift.runs and healthy else None,
        "landmark_nees.dof": n,
        "landmark_nees.not_finite": sums["landmark_not_finite"].astype(int),
        "survivors": healthy,
        "diverged": diverged,
        "status": {s.name.lower(): int(sums[f"status_{s.name}"]) for s in Status if s != Status.OK},
        "calibration": study.calibrations.get(name),
        "backend": study.backends.get(name),
        "seconds.compile": study.seconds[name].compile,
        "seconds.run": study.seconds[name].run,
    })  # fmt: skip


def treatment(slam: AbstractFilter) -> str | None:
    """The treatment of the sensor's calibration by a filter, where it says so."""
    return None if slam.model is None else slam.model.calibration.name


def tally(study: Study, name: str, record: str = "nees") -> Tally:
    """The tally for the verdict on one filter; tallies of other seeds may be added.

    It is of the `nees` of its poses, of the part that is `beyond_scale`, or of the `drift` of the
    scale.
    """
    return tally_of(_sums_and_lost(study, name)[0], record, study.scenario.geometry.tangent_dim)


def _sums_and_lost(study: Study, name: str) -> tuple[Sums, list[int] | None]:
    """The sums of all chunks, and the numbers of lost runs, None where not all records are kept."""
    dof, lost = study.scenario.geometry.tangent_dim, []

    def each() -> Iterator[Sums]:
        for chunk, kept in zip(study.chunks, study.loaded(name), strict=True):
            if not study.reduced:
                lost.extend(chunk.start + run for run in lost_runs(kept["nees"], dof))
            yield sums_of(kept, dof)

    return added(each()), None if study.reduced else lost


def _medians(study: Study, name: str) -> dict[str, np.ndarray]:
    """The medians of every step, over all runs whose records are kept, diverged ones infinite.

    Every chunk is read once for as many steps as are held in memory.
    """
    medians, at_once = [], max(1, _VALUES_AT_ONCE // study.runs)
    for start in range(0, study.scenario.steps, at_once):
        part, columns = slice(start, start + at_once), []
        for chunk in study.whole:
            kept = study.store.load(name, chunk, ("nees", "log_scale", "log_scale_sigma", *SCALE))
            survivors = survived(kept)[:, None]
            values = {
                "nees.median": kept["nees"],
                "beyond_scale.median": one_scale_of(kept).nees,
                "log_scale.error_median": np.abs(kept["log_scale"]),
                "log_scale.sigma_median": kept["log_scale_sigma"],
            }
            columns.append({k: np.where(survivors, x, np.inf)[:, part] for k, x in values.items()})
        medians.append({k: np.median(np.concatenate([x[k] for x in columns]), 0) for k in values})
    return {key: np.concatenate([x[key] for x in medians]) for key in medians[0]}
