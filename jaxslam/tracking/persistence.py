"""A file from which a tracker goes on: a header of words and numbers, and arrays by name.

The arrays are those of a pytree: the filter's state, the poses, the landmarks by their slots, and
those that left the map.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam._runtime.files import Json, one_line, read_arrays, write_atomically
from jaxslam.io.calibration import Calibration, as_fields, from_fields
from jaxslam.tracking.landmarks import NO_POINTS, Points, joined, stacked, unstacked
from jaxslam.tracking.map import Map, Remembered
from jaxslam.tracking.places.joining import Join
from jaxslam.tracking.places.submaps import Submap, no_loop, shapes
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.unit import MapInWorld

FORMAT = "jaxslam tracker 9"

NUMBERS = {
    "restarts": "map.latest",
    "submaps": "map.latest_submap",
    "reversed": "reversed",
    "refused": "refused",
    "steps": "steps",
    "_time": "time",
    "_unmeasured": "unmeasured",
    "_searching": "searching",
    "_elsewhere": "elsewhere",
    "_doubtful": "policy.doubtful",
}
"""What a tracker counts and measures, as the file calls it, and where it keeps it."""


_OF_PLACE = ("log_unit", "log_scale", "sigma_log_scale", "unit_fixed")
"""The numbers of a `MapInWorld`."""
_POSES = ("origin", "camera", "here", "told", "known")
"""… and its poses."""


@runtime_checkable
class Resumable(Protocol):
    """The parts of a tracker that are kept, beside its `NUMBERS`."""

    calibration: Calibration
    settings: TrackerSettings
    failed: Counter[str]
    joins: tuple[Join, ...]
    map: Map


T = TypeVar("T", bound=Resumable)


def save(path: str | Path, tracker: Resumable, filter_name: str | None) -> None:
    """Write a tracker, whole or not at all, with the name of a filter beyond the settings."""
    kept = tracker.map
    numbers = {name: attrgetter(where)(tracker) for name, where in NUMBERS.items()}
    header = {
        "calibration": as_fields(tracker.calibration),
        "settings": asdict(tracker.settings),
        "filter": filter_name,
        "numbers": {"created": kept.created, "deleted": kept.deleted, **numbers},
        "failed": dict(tracker.failed),
    }
    # The map as it is, those that it may come back to, and all as their submaps began: once each.
    latest = [kept.now(), *kept.known()]
    maps = _Once(one for last in latest for one in (*last.earlier, last))
    submaps = _Once(one for map in maps.all for one in map.submaps)
    loops = _Once(one for map in maps.all for one in map.loops)
    header["maps"] = [
        {
            "number": one.number,
            "submap": one.submap,
            "submaps": submaps.places(one.submaps),
            "loops": loops.places(one.loops),
            "earlier": maps.places(one.earlier),
            **{name: getattr(one.place, name) for name in _OF_PLACE},
        }
        for one in maps.all
    ]
    header["submaps"] = [one.number for one in submaps.all]
    header["loops"] = len(loops.all)
    header["joins"] = [{**asdict(one), "moved": one.moved.tolist()} for one in tracker.joins]
    header["latest"], header["seen"] = maps.places(latest), kept.seen is not None
    arrays = dict(joined([NO_POINTS, *kept.finished])._asdict())
    arrays |= {f"charted/{name}": array for name, array in stacked(kept.charted).items()}
    for i, one in enumerate(maps.all):
        poses = [_pair(getattr(one.place, name)) for name in _POSES]
        own = leaves(one.state, "state") | leaves(poses, "poses") | stacked(one.landmarks)
        arrays |= {f"{i}/{name}": array for name, array in own.items()}
    for i, submap in enumerate(submaps.all):
        parts = submap.frozen, submap.points, submap.covariances, *_pair(submap.camera)
        arrays |= leaves(parts, f"submap {i}")
    for i, loop in enumerate(loops.all):
        arrays |= leaves(loop, f"loop {i}")
    write_record(path, header, arrays)


def load(
    path: str | Path, make: Callable[[Calibration, TrackerSettings], T], *, own_filter: bool
) -> T:
    """Read the tracker in a file by `make`; `own_filter` if its filter is not in the settings.

    Raises ValueError for a file that is none, or of another filter.
    """
    header, arrays = read_record(path)
    if header.get("filter") is not None and not own_filter:
        raise ValueError(f"{path} was saved with the filter {header['filter']}; pass that filter")
    try:
        settings = TrackerSettings(**header["settings"])
    except TypeError:
        raise ValueError(f"{path} was saved by another version, with different settings") from None
    except KeyError:
        raise ValueError(f"{path} is damaged: it has no settings") from None
    try:
        tracker = make(from_fields(header["calibration"]), settings)
        _restore(tracker, header, arrays)
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(f"{path} is damaged ({one_line(error)})") from None
    return tracker


def _restore(
    tracker: Resumable, header: Mapping[str, Json], arrays: Mapping[str, np.ndarray]
) -> None:
    """Make of a new tracker what was saved."""
    kept, numbers = tracker.map, header["numbers"]
    for name, where in NUMBERS.items():
        piece, _, attribute = where.rpartition(".")
        setattr(attrgetter(piece)(tracker) if piece else tracker, attribute, numbers[name])
    tracker.failed.update(header["failed"])
    joins = header["joins"]
    tracker.joins = tuple(Join(**one | {"moved": np.array(one["moved"])}) for one in joins)
    kept.finished.append(Points(*(arrays[name] for name in Points._fields)))
    with jax.enable_x64(True):
        kept.charted = unstacked(_of(arrays, "charted"))
        maps = _remembered(header, arrays, kept)
        now, *known = [maps[place] for place in header["latest"]]
        kept.become(now)
        kept.measure_unit()
    kept.seen = known.pop(0) if header["seen"] else None
    kept.left = known[::-1]


Kept = TypeVar("Kept")


class _Once(Generic[Kept]):
    """Objects, of which several maps may have the same, each once."""

    def __init__(self, some: Iterable[Kept]) -> None:
        self.all = list({id(one): one for one in some}.values())

    def places(self, some: Iterable[Kept]) -> list[int]:
        """Return where these are."""
        place = {id(one): i for i, one in enumerate(self.all)}
        return [place[id(one)] for one in some]


def _pair(pose: PoseWithCovariance) -> tuple[np.ndarray, np.ndarray]:
    return pose.T_wc, pose.covariance


def _of(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with this one, without it."""
    prefix = f"{name}/"
    return {key.removeprefix(prefix): x for key, x in arrays.items() if key.startswith(prefix)}


def _remembered(
    header: Mapping[str, Json], arrays: Mapping[str, np.ndarray], kept: Map
) -> list[Remembered]:
    """All maps in the file, of a tracker that keeps such maps."""
    like, slam, settings = kept.estimator.state, kept.estimator.slam, kept.settings
    submaps, loops, maps = [], [], []
    if header["submaps"]:
        ended = *shapes(slam, like, settings.capacity), np.zeros((4, 4)), np.zeros((6, 6))
        for k, number in enumerate(header["submaps"]):
            frozen, *rest = grown(ended, arrays, f"submap {k}")
            points, covariances, *pose = map(np.asarray, rest)
            submaps.append(Submap(frozen, points, covariances, PoseWithCovariance(*pose), number))
        nothing = no_loop(settings.wanted, submaps[0].frozen.state.landmarks.shape[1])
        loops += [grown(nothing, arrays, f"loop {k}") for k in range(header["loops"])]
    for i, told in enumerate(header["maps"]):
        own = _of(arrays, str(i))
        place = MapInWorld(**{name: told[name] for name in _OF_PLACE})
        for k, name in enumerate(_POSES):
            pose = PoseWithCovariance(own[f"poses/{2 * k}"], own[f"poses/{2 * k + 1}"])
            setattr(place, name, pose)
        chain = (
            tuple(of_all[k] for k in told[name])
            for name, of_all in (("submaps", submaps), ("loops", loops), ("earlier", maps))
        )
        numbers, state = (told["number"], told["submap"]), grown(like, own, "state")
        maps.append(Remembered(*numbers, state, unstacked(own), place, *chain))
    return maps


def write_record(
    path: str | Path, header: Mapping[str, Json], arrays: Mapping[str, np.ndarray]
) -> None:
    """Write both as one .npz archive, whole or not at all. Numbers keep their last digit."""
    text = json.dumps({"format": FORMAT, **header}, allow_nan=False)
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


def leaves(tree: PyTree, name: str) -> dict[str, np.ndarray]:
    """The arrays of a pytree by `name` and their places."""
    return {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def grown(like: PyTree, arrays: Mapping[str, np.ndarray], name: str) -> PyTree:
    """The pytree that `leaves` were of, built as `like`. Raises ValueError where that differs."""
    old, structure = jax.tree.flatten(like)
    prefix = f"{name}/"
    found = [arrays.get(f"{prefix}{i}") for i in range(len(old))]
    count = sum(key.startswith(prefix) for key in arrays)
    pairs = zip(found, old, strict=True)
    same = [x is not None and (x.shape, x.dtype) == (leaf.shape, leaf.dtype) for x, leaf in pairs]
    if count != len(old) or not all(same):
        raise ValueError("the saved state belongs to a different filter")
    return jax.tree.unflatten(structure, [jnp.asarray(new) for new in found])
