"""The numbers of a study as typed results, and the JSON that is made of them and read back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxslam._runtime.files import json_numbers
from jaxslam._runtime.lookup import suggestion
from jaxslam.statistics import Verdict

Steps = Float[np.ndarray, " steps"]
"""One number for every step; NaN where there is none."""


@dataclass(frozen=True, eq=False)
class Nees:
    """The NEES of a filter's poses over time, and the verdict on it."""

    verdict: Verdict
    """The verdict on all steps, the last one and each third together."""
    dof: int
    """The degrees of freedom, which is the mean of a consistent filter."""
    band: tuple[float, float]
    """The exact 95 % band of the mean at one step, of the runs that did not diverge."""
    mean: Steps
    """The mean over the runs that did not diverge."""
    median: Steps
    """The median over all runs, with diverged runs counted as infinite."""
    lost: Steps
    """The share of runs above the 99.99 % quantile of χ² at each step."""

    @property
    def inside(self) -> float:
        """The share of the steps whose mean is in the band."""
        low, high = self.band
        return float(np.mean((self.mean >= low) & (self.mean <= high)))


@dataclass(frozen=True, eq=False)
class Nis:
    """The NIS of a filter over time, over the runs that did not diverge."""

    mean: Steps
    """The mean over the runs."""
    dof: Steps
    """The mean degrees of freedom, which is the mean NIS of a consistent filter."""


@dataclass(frozen=True, eq=False)
class Parts:
    """A number of the position, and one of the orientation."""

    position: Steps
    """The number of the camera's position; an RMSE or σ is in m."""
    orientation: Steps
    """The number of the camera's orientation; an RMSE or σ is in rad."""


@dataclass(frozen=True, eq=False)
class ScaleDrift:
    """The distance of the log-scale of a pose from that of its run, over the surviving runs."""

    rms: Steps
    """The root mean square of the drift."""
    sigma: Steps
    """The root mean square of the σ that the filter claims of it."""
    normalised_rms: Steps
    """The root mean square of the drift over its σ."""
    runs: Int[np.ndarray, " steps"]
    """The number of runs whose unit of length is fixed by then."""
    verdict: Verdict | None
    """The verdict on the drift; None without any run to judge."""


@dataclass(frozen=True, eq=False)
class LogScale:
    """The error of the log-scale in metres, over the surviving runs."""

    error_rms: Steps
    """The root mean square of the error."""
    error_median: Steps
    """The median of the error's size."""
    sigma: Steps
    """The root mean square of the σ that the filter claims of it."""
    sigma_median: Steps
    """The median of that σ."""
    normalised_rms: Steps
    """The root mean square of the error over its σ."""


@dataclass(frozen=True, eq=False)
class LandmarkNees:
    """The NEES of the landmarks in view, over the surviving runs."""

    mean: Steps
    """The mean over the landmarks whose NEES is finite."""
    dof: int
    """The degrees of freedom of one landmark."""
    not_finite: Int[np.ndarray, " steps"]
    """The number of runs with a landmark whose NEES is not finite."""


@dataclass(frozen=True)
class Seconds:
    """The wall time of one filter over all its runs, in seconds."""

    compile: float
    """Seconds until its program was there."""
    run: float
    """Seconds from then on."""


@dataclass(frozen=True, eq=False, repr=False)
class FilterResult:
    """What a study found of one filter; arrays have one number for every step."""

    name: str
    """The name of the filter in its study."""
    nees: Nees
    """The NEES of the camera's pose."""
    not_lost: Steps
    """The mean NEES of the runs that are not lost at each step."""
    lost_ever: Steps
    """The share of runs lost at any step so far, by the stricter limit for so many steps."""
    nis: Nis
    """The NIS of the measurements."""
    rmse: Parts
    """The root mean square error."""
    sigma: Parts
    """The σ that the filter claims, as the root of its mean variance."""
    outside3sigma: Parts
    """The share of errors beyond three of the claimed σ; 0.27 % of Gaussian errors are."""
    beyond_scale: Nees
    """The NEES at the one scale of every run that explains all of its poses best."""
    scale_drift: ScaleDrift
    """The drift of the scale within a run."""
    log_scale: LogScale
    """The error of the scale in metres."""
    reversed: Steps
    """The share of the displaced runs whose estimate points away from the truth."""
    landmark_nees: LandmarkNees
    """The NEES of landmarks."""
    survivors: int
    """The number of runs that did not diverge."""
    diverged: int
    """The number of runs whose NEES is not finite at some step."""
    status: Mapping[str, int]
    """The number of runs in which an update reported each `jaxslam.Status` other than OK."""
    calibration: str | None
    """The filter's treatment of the calibration, where it says so."""
    backend: str | None
    """The backend that computed it: `xla` or `native`."""
    seconds: Seconds
    """The time that it took."""

    @property
    def series(self) -> dict[str, Steps]:
        """The numbers of every step, called as in JSON but with _ between parts."""
        values = {key: attrgetter(path)(self) for key, path in _PATH_OF_KEY.items()}
        return {k.replace(".", "_"): x for k, x in values.items() if isinstance(x, np.ndarray)}

    @property
    def verdict(self) -> Verdict:
        """The verdict on the NEES of the pose."""
        return self.nees.verdict

    @property
    def lost(self) -> Steps:
        """The share of runs that are lost at each step, diverged ones too."""
        return self.nees.lost

    @staticmethod
    def of(values: Mapping[str, object]) -> FilterResult:
        """Return the results with these values at their paths, such as `nees.mean`."""
        found = _nested(values)
        return FilterResult(**found | {x: kind(**found[x]) for x, kind in _PARTS.items()})

    def to_json(self) -> dict[str, Any]:
        """Return what `consistency.json` says of the filter."""
        return _nested({key: _plain(attrgetter(path)(self)) for key, path in _PATH_OF_KEY.items()})

    @staticmethod
    def from_json(name: str, told: Mapping[str, Any]) -> FilterResult:
        """Return the results of which `to_json` made this; what an older version lacks is None."""

        def value(key: str) -> Any:
            found: object = told
            for part in key.split("."):
                found = found.get(part) if isinstance(found, Mapping) else None
            return tuple(found or ()) if key.endswith("band95") else _read(found)

        paths = {path: key for key, path in _PATH_OF_KEY.items() if key != "inside"}
        return FilterResult.of({"name": name} | {path: value(paths[path]) for path in paths})

    def __repr__(self) -> str:
        last = f"NEES {self.nees.mean[-1]:.4g}, RMSE {self.rmse.position[-1]:.3g} m"
        return f"<{self.name}: {self.verdict.word}; {last} at the last step>"


_PARTS: dict[str, Callable[..., Any]] = {
    "nees": Nees, "nis": Nis, "rmse": Parts, "sigma": Parts, "outside3sigma": Parts,
    "beyond_scale": Nees, "scale_drift": ScaleDrift, "log_scale": LogScale,
    "landmark_nees": LandmarkNees, "seconds": Seconds,
}  # fmt: skip
_KEYS = (
    "verdict=nees.verdict", "dof=nees.dof", "calibration", "survivors", "band95=nees.band",
    "nees=nees.mean", "nees_median=nees.median", "nees_not_lost=not_lost", "lost=nees.lost",
    "lost_ever", "inside=nees.inside", "nis=nis.mean", "nis_dof=nis.dof", "rmse.position",
    "rmse.orientation", "sigma.position", "sigma.orientation", "outside3sigma.position",
    "outside3sigma.orientation", "beyond_scale.dof", "beyond_scale.band95=beyond_scale.band",
    "beyond_scale.nees=beyond_scale.mean", "beyond_scale.nees_median=beyond_scale.median",
    "beyond_scale.lost", "beyond_scale.verdict", "scale_drift.rms", "scale_drift.sigma",
    "scale_drift.normalised_rms", "scale_drift.runs", "scale_drift.verdict", "log_scale.error_rms",
    "log_scale.error_median", "log_scale.sigma", "log_scale.sigma_median",
    "log_scale.normalised_rms", "reversed", "landmark_nees=landmark_nees.mean",
    "landmark_dof=landmark_nees.dof", "landmark_not_finite=landmark_nees.not_finite", "diverged",
    "status", "backend", "seconds.compile", "seconds.run",
)  # fmt: skip
_PATH_OF_KEY = {key: path or key for key, _, path in (x.partition("=") for x in _KEYS)}
"""The path in a `FilterResult` of every key of JSON."""


def _nested(values: Mapping[str, object]) -> dict:
    """Dictionaries in dictionaries, of names with dots."""
    found: dict = {}
    for name, value in values.items():
        *outer, last = name.split(".")
        place = found
        for part in outer:
            place = place.setdefault(part, {})
        place[last] = value
    return found


def _plain(value: object) -> Any:
    if not isinstance(value, np.ndarray):
        return list(value) if isinstance(value, tuple) else value
    return value.tolist() if value.dtype.kind == "i" else json_numbers(value)


def _read(value: object) -> Any:
    if isinstance(value, dict) and "word" in value:
        return as_verdict(value)
    if isinstance(value, list):
        return np.array(value) if all(isinstance(x, int) for x in value) else np.array(value, float)
    return value


def as_verdict(told: Mapping[str, Any]) -> Verdict:
    """Return the verdict that JSON has, its parts as verdicts too."""

    def part(value: object) -> Any:
        if isinstance(value, list):
            return [part(x) for x in value]
        return as_verdict(value) if isinstance(value, dict) else value

    return Verdict({key: part(value) for key, value in told.items()})


class UnknownFilterError(KeyError, ValueError):
    """A filter is asked for that a study does not have."""

    __str__ = Exception.__str__


def named(name: str, names: Mapping[str, Any]) -> str:
    """Return the one of these names that is meant: whole, or a part that only one of them has.

    Raises `UnknownFilterError`, a KeyError and a ValueError, where none or several are.
    """
    if name in names:
        return name
    meant = [known for known in names if name in known.split("/")]
    if len(meant) == 1:
        return meant[0]
    told = f"several filters are called {name!r}" if meant else f"no filter is called {name!r}"
    parts = [part for known in names for part in (known, *known.split("/"))]
    hint = "" if meant else suggestion(str(name), parts)
    raise UnknownFilterError(f"{told}{hint}; known: {', '.join(meant or names)}")


class Summary(dict[str, Any]):
    """The content of `consistency.json`, a dict; a filter's part is also `summary[filter]`."""

    def __missing__(self, name: str) -> dict[str, Any]:
        filters = self.get("filters", {})
        try:
            return filters[named(name, filters)]
        except UnknownFilterError as error:
            keys = ", ".join(map(repr, self))
            raise UnknownFilterError(f"{error}; other keys of a summary: {keys}") from None

    def __repr__(self) -> str:
        told = f"{self['runs']} runs of {self['steps']} steps, filters {', '.join(self['filters'])}"
        return f"<summary: {told}; keys {', '.join(self)}>"


@dataclass(frozen=True, eq=False, repr=False)
class Results(Mapping):
    """The results of a study by filter, without its records: what `consistency.json` holds."""

    version: str
    """The version of jaxslam that computed them."""
    scenario: Mapping[str, Any]
    """The fields of the scenario."""
    runs: int
    """The number of runs of every filter."""
    medians_of: int
    """The number of runs, the first ones, that the medians are of."""
    scale_free: bool
    """Whether nothing tells the scale of the world, so that it has an error of its own."""
    steps: int
    """The number of steps of a run."""
    seed: int
    """The seed of all draws."""
    dtype: str
    """The precision, `float64` or `float32`."""
    device: str
    """The device on which the study was computed."""
    time: Steps
    """The time of every step, s."""
    filters: Mapping[str, FilterResult]
    """The results of every filter by its name."""

    def __getitem__(self, name: str) -> FilterResult:
        return self.filters[named(name, self.filters)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.filters)

    def __len__(self) -> int:
        return len(self.filters)

    @property
    def reference(self) -> FilterResult:
        """The filter with the most surviving runs, whose band is shown."""
        return max(self.filters.values(), key=lambda result: result.survivors)

    def to_json(self) -> Summary:
        """Return the content of `consistency.json`."""
        own = {f.name: _plain(getattr(self, f.name)) for f in dataclasses.fields(self)}
        own["filters"] = {name: result.to_json() for name, result in self.filters.items()}
        return Summary(schema=1, **own)

    @staticmethod
    def from_json(told: Mapping[str, Any]) -> Results:
        """Return the results of which `to_json` made this."""
        own: dict[str, Any] = {f.name: told.get(f.name) for f in dataclasses.fields(Results)}
        own["filters"] = {n: FilterResult.from_json(n, f) for n, f in told["filters"].items()}
        own["medians_of"] = told.get("medians_of", told["runs"])  # not in earlier versions
        own["time"] = np.array(told["time"], float)
        return Results(**own)
