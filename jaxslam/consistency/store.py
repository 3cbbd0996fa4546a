"""The stores of the records of simulated runs: in memory, or in a folder to resume from."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxslam._runtime.files import read_arrays, read_json, write_atomically, write_json
from jaxslam.consistency.manifest import Manifest, difference

Records = dict[str, np.ndarray]
SUM = "sum_"
"""The prefix of the names of sums over the runs of a chunk."""
NATIVE = "sample_native"
"""The name of whether a chunk is of the native backend; else it is XLA's."""


@runtime_checkable
class Store(Protocol):
    """A store of records by filter and chunk; a chunk is the range of its runs."""

    def begin(self, made_by: Manifest, filters: Manifest) -> None:
        """Say what decides the records that follow, and what each filter is.

        Raises ValueError where others are kept.
        """
        ...

    def has(self, filter_name: str, chunk: range) -> bool: ...
    def save(self, filter_name: str, chunk: range, records: Records) -> None: ...
    def load(
        self, filter_name: str, chunk: range, names: Iterable[str] | None = None
    ) -> Records: ...


class MemoryStore:
    """A store in memory, for small studies.

    `begin` a study, `save` a chunk, ask whether it `has` one, `load` it. Raises ValueError for a
    study other than the one whose records it keeps.
    """

    def __init__(self) -> None:
        self._records: dict[tuple[str, range], Records] = {}
        self.manifest: Manifest = {"made_by": {}, "filters": {}}

    def begin(self, made_by: Manifest, filters: Manifest) -> None:
        what = "this store's records were"
        self.manifest = _joined(what, self.manifest, made_by, filters, "use another store")

    def has(self, filter_name: str, chunk: range) -> bool:
        return (filter_name, chunk) in self._records

    def save(self, filter_name: str, chunk: range, records: Records) -> None:
        self._records[filter_name, chunk] = records

    def load(self, filter_name: str, chunk: range, names: Iterable[str] | None = None) -> Records:
        records = self._records[filter_name, chunk]
        return {name: records[name] for name in (records if names is None else names)}


class FolderStore:
    """A folder of one file a chunk, written whole or not at all, beside a manifest of their origin.

    `begin` a study, `save` a chunk, ask whether it `has` one, `load` it, which raises ValueError
    for a damaged file. A study says itself what decides its results; `manifest` is whatever else
    does. A folder that was made otherwise is refused when `resume` is set, and emptied of the
    chunks of its manifest if not. Other files are left alone: one in the place of a chunk, or of
    the manifest, is refused.
    """

    def __init__(
        self, folder: str | Path, manifest: Manifest | None = None, *, resume: bool = False
    ) -> None:
        folder = Path(folder)
        self.folder, self._path = folder, folder / "manifest.json"
        self.manifest: Manifest = {"given": _as_json(manifest or {}), "made_by": {}, "filters": {}}
        if self._path.exists():
            found = read_json(self._path, "manifest", _as_manifest)
            if resume:
                if told := difference(found["given"], self.manifest["given"]):
                    raise ValueError(f"{self._made} made with another {told}; {_ANOTHER_FOLDER}")
                self.manifest = found
            for path in self._own(found, unfinished=resume):
                path.unlink(missing_ok=True)
        write_json(self._path, self.manifest)

    @staticmethod
    def reading(folder: Path) -> FolderStore:
        """Return the store of a study that is there, in which nothing is changed.

        Raises ValueError without a manifest.
        """
        store = object.__new__(FolderStore)
        store.folder, store._path = folder, folder / "manifest.json"
        store.manifest = read_json(store._path, "manifest", _as_manifest)
        return store

    def begin(self, made_by: Manifest, filters: Manifest) -> None:
        joined = _joined(self._made, self.manifest, made_by, filters, _ANOTHER_FOLDER)
        for name in filters.keys() - self.manifest["filters"].keys():
            for path in _chunks(self.folder / _folder_of(name)):
                raise ValueError(f"{path} is of no study that is kept here; use another folder")
        if joined != self.manifest:  # before the chunks it names: others are not its study's
            write_json(self._path, joined)
            self.manifest = joined

    def has(self, filter_name: str, chunk: range) -> bool:
        return filter_name in self.manifest["filters"] and self._chunk(filter_name, chunk).exists()

    def save(self, filter_name: str, chunk: range, records: Records) -> None:
        if filter_name not in self.manifest["filters"]:
            self.begin(self.manifest["made_by"], {filter_name: None})
        path = self._chunk(filter_name, chunk)
        with write_atomically(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **records)

    def load(self, filter_name: str, chunk: range, names: Iterable[str] | None = None) -> Records:
        path, names = self._chunk(filter_name, chunk), None if names is None else list(names)
        records = read_arrays(path, names)
        for name in names or ():
            if name not in records:
                raise ValueError(f"{path} lacks {name}: {_DAMAGED}")
        _check_records(path, len(chunk), records)
        return records

    @property
    def _made(self) -> str:
        return f"cannot resume: {self._path} was"

    def _own(self, manifest: Manifest, *, unfinished: bool) -> list[Path]:
        """The files of a manifest's chunks, or only those that a killed process left unfinished."""
        folders = [self.folder / _folder_of(name) for name in manifest["filters"]]
        begun = [path for folder in folders for path in _chunks(folder, _UNFINISHED)]
        return begun if unfinished else [*begun, *(p for x in folders for p in _chunks(x))]

    def _chunk(self, filter_name: str, chunk: range) -> Path:
        name = f"{chunk.start:07d}-{chunk.stop - 1:07d}.npz"
        return self.folder / _folder_of(filter_name) / name


_CHUNK = re.compile(r"\d{7,}-\d{7,}\.npz")
_UNFINISHED = re.compile(rf"\.\d+\.{_CHUNK.pattern}")


def _chunks(folder: Path, named: re.Pattern[str] = _CHUNK) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if named.fullmatch(path.name))


def _folder_of(filter_name: str) -> str:
    """A folder's name for each filter's, never the same for two, even where case is ignored.

    "/" is "-", and what is not a-z, 0-9, _ or + is its bytes in UTF-8, as in a URL.
    """

    def escaped(match: re.Match[str]) -> str:
        return "".join(f"%{byte:02X}" for byte in match[0].encode())

    return re.sub("[^a-z0-9_+/]", escaped, filter_name).replace("/", "-") or "%"


_DAMAGED = "it is damaged; remove it, and run again with --resume"


def _check_records(path: Path, runs: int, records: Records) -> None:
    """Raise ValueError unless all are numbers, and what is of each run is of so many runs."""
    of_runs = (x for name, x in records.items() if not name.startswith(("sample_", SUM)))
    numbers = all(x.dtype.kind in "fiub" for x in records.values())
    if not numbers or any(x.shape[:1] != (runs,) for x in of_runs):
        raise ValueError(f"{path} holds other records than those of {runs} runs: {_DAMAGED}")


_ANOTHER_FOLDER = "use another folder (--out), or begin again without resume"


def _as_json(manifest: Manifest) -> Manifest:
    return json.loads(json.dumps(manifest))


def _as_manifest(found: Any) -> Manifest:
    keys = {"given", "made_by", "filters"}
    if not isinstance(found, dict) or not all(isinstance(found.get(k), dict) for k in keys):
        raise ValueError("is no manifest of this version; use another folder, or remove that one")
    return found


def _joined(
    what: str, kept: Manifest, made_by: Manifest, filters: Manifest, advice: str
) -> Manifest:
    """What is kept with a study joined to it. Raises ValueError for one that is made otherwise, or
    a filter that has the name of another one."""
    made_by, filters = _as_json(made_by), _as_json(filters)
    pairs = [("", kept["made_by"] or made_by, made_by)] + [
        (f"filter {name}: ", kept["filters"][name], filters[name])
        for name in kept["filters"].keys() & filters.keys()
    ]
    for where, then, now in pairs:
        if told := difference(then, now):
            raise ValueError(f"{what} made with another {where}{told}; {advice}")
    return {**kept, "made_by": made_by, "filters": {**kept["filters"], **filters}}
