"""A file from which a tracker goes on: a header of words and numbers, and arrays.

A state is written record by record, by the names of their fields. What several records share, as
maps that are remembered share submaps, is written once, and of a filter's own pytrees the leaves.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam._runtime.files import Json, one_line, read_arrays, write_atomically
from jaxslam.io.calibration import Calibration, as_fields, from_fields
from jaxslam.tracking.landmarks import Landmark, Points
from jaxslam.tracking.map import Map, TrackerState
from jaxslam.tracking.patches import Patch
from jaxslam.tracking.places.submaps import LoopClosure, Submap, shapes
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.unit import Join, MapInWorld

FORMAT = "jaxslam tracker 10"
Header = Mapping[str, Json]
"""Words and numbers, as JSON has them."""
Arrays = Mapping[str, np.ndarray]

_RECORDS: tuple[type, ...] = (
    TrackerState, Map, MapInWorld, PoseWithCovariance, Landmark, Patch, Points, Submap,
    LoopClosure, Join,
)  # fmt: skip
"""What a state is made of, beside numbers, arrays, tuples and mappings."""
_TREES = ("state", "frozen")
"""Fields that are a filter's own pytrees."""


def save(
    path: str | Path, state: TrackerState, settings: TrackerSettings, filter_name: str | None
) -> None:
    """Write a tracker, whole or not at all, with the name of a filter beyond the settings."""
    writer = _Writer()
    written, arrays = writer.written(state), writer.arrays
    header = {
        "calibration": as_fields(state.calibration),
        "settings": asdict(settings),
        "filter": filter_name,
        "state": written,
        "records": writer.records,
        "arrays": [[x.dtype.name, x.shape] for x in arrays],
    }
    flat: dict[str, list[np.ndarray]] = {}
    for x in arrays:
        flat.setdefault(x.dtype.name, []).append(x.ravel())
    write_record(path, header, {name: np.concatenate(some) for name, some in flat.items()})


@dataclass
class _Writer:
    """Makes JSON of values, and gathers the records and arrays to which it refers."""

    records: list[Json] = field(default_factory=list)
    arrays: list[np.ndarray] = field(default_factory=list)
    places: dict[int, tuple[int, object]] = field(default_factory=dict)
    """Where each is of its kind, by its identity, and itself: another could have that."""

    def written(self, value: object) -> Json:
        """The value: a record or an array by its place, a tuple as a list, a mapping as pairs."""
        if isinstance(value, _RECORDS):
            if id(value) not in self.places:
                # What it refers to comes before it.
                record = {name: self._field(value, name) for name in _names(type(value))}
                self.places[id(value)] = len(self.records), value
                self.records.append([type(value).__name__, record])
            return {"record": self.places[id(value)][0]}
        if isinstance(value, Mapping):
            return {"pairs": [[self.written(key), self.written(x)] for key, x in value.items()]}
        if isinstance(value, tuple):
            return [self.written(x) for x in value]
        if isinstance(value, np.ndarray | jax.Array):
            if id(value) not in self.places:
                self.places[id(value)] = len(self.arrays), value
                self.arrays.append(np.asarray(value))
            return {"array": self.places[id(value)][0]}
        return value.item() if isinstance(value, np.generic) else value

    def _field(self, record: object, name: str) -> Json:
        value = getattr(record, name)
        return self.written(tuple(jax.tree.leaves(value)) if name in _TREES else value)


def _names(record: type) -> list[str]:
    """The fields of a record that are written: not what it could compute again, nor the filter."""
    if not is_dataclass(record):
        return list(Points._fields)
    return [one.name for one in fields(record) if one.compare and one.name != "calibration"]


def load(
    path: str | Path, make: Callable[[Calibration, TrackerSettings], Any], *, own_filter: bool
) -> Any:
    """Read the tracker in a file; `make` makes a new one, whose `state` is then the one that was
    saved. `own_filter` if its filter is not in the settings.

    Raises ValueError for a file that is none, or of another filter.
    """
    header, arrays = read_record(path)
    if header.get("filter") is not None and not own_filter:
        raise ValueError(f"{path} was saved with the filter {header['filter']}; pass that filter")
    try:
        given = header["settings"]
        if set(given) != {one.name for one in fields(TrackerSettings)}:
            raise ValueError(f"{path} was saved by another version, with different settings")
        tracker = make(from_fields(header["calibration"]), TrackerSettings(**given))
        with jax.enable_x64(True):
            tracker.state = _Reader(header, arrays, tracker.state).state
            if not isinstance(tracker.state, TrackerState):
                raise TypeError("it has no state")
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(f"{path} is damaged ({one_line(error)})") from None
    return tracker


class _Reader:
    """Makes of what was written what it was, of a tracker that begins with the state `new`."""

    def __init__(self, header: Header, arrays: Arrays, new: TrackerState) -> None:
        self._new, self._like = new, {"state": new.map.state}
        ends = dict.fromkeys(arrays, 0)
        self._arrays: list[np.ndarray] = []
        for name, shape in header["arrays"]:
            begin = ends[name]
            ends[name] += int(np.prod(shape, dtype=int))
            self._arrays.append(arrays[name][begin : ends[name]].reshape(shape))
        self._records: list[object] = []
        kinds = {kind.__name__: kind for kind in _RECORDS}
        for name, record in header["records"]:
            parts = {key: self._field(key, given) for key, given in record.items()}
            made = partial(replace, new) if name == "TrackerState" else kinds[name]
            self._records.append(made(**parts))
        self.state = self._value(header["state"])

    def _value(self, given: Json) -> Json:
        if isinstance(given, list):
            return tuple(self._value(x) for x in given)
        if not isinstance(given, dict):
            return given
        if "pairs" in given:
            return {self._value(key): self._value(x) for key, x in given["pairs"]}
        return self._records[given["record"]] if "record" in given else self._arrays[given["array"]]

    def _field(self, name: str, given: Json) -> Json:
        """A field's value. Raises ValueError where a filter's pytree has other leaves."""
        value = self._value(given)
        if name not in _TREES:
            return value
        if name not in self._like:
            slam, state = self._new.estimator.slam, self._new.map.state
            capacity = self._new.estimator.settings.capacity
            self._like[name] = shapes(slam, state, capacity)[0]
        old, structure = jax.tree.flatten(self._like[name])
        if [(x.shape, x.dtype) for x in value] != [(x.shape, x.dtype) for x in old]:
            raise ValueError("the saved state belongs to a different filter")
        return jax.tree.unflatten(structure, [jnp.asarray(x) for x in value])


def write_record(path: str | Path, header: Header, arrays: Arrays) -> None:
    """Write both as one .npz archive, whole or not at all. Numbers keep their last digit."""
    text = json.dumps({"format": FORMAT, **header})
    with write_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, header=np.array(text), **arrays)


def read_record(path: str | Path) -> tuple[dict[str, Json], dict[str, np.ndarray]]:
    """Header and arrays. Raises ValueError, naming the file, for one of another kind."""
    arrays = read_arrays(path)
    try:
        header = json.loads(str(arrays.pop("header")))
    except (ValueError, KeyError):
        header = {}
    if not isinstance(header, dict):
        header = {}
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} is not a saved tracker ({FORMAT})")
    return header, arrays
