"""Where the records of simulated runs are kept: in memory, or in a folder to resume from."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxslam.files import read_arrays, read_json, write_atomically, write_json

Records = dict[str, np.ndarray]
SUM = "sum_"
"""Before the names of sums over the runs of a chunk."""


@runtime_checkable
class Store(Protocol):
    """Records by filter and chunk; a chunk is the range of its runs."""

    def has(self, filter_name: str, chunk: range) -> bool: ...
    def save(self, filter_name: str, chunk: range, records: Records) -> None: ...
    def load(
        self, filter_name: str, chunk: range, names: Iterable[str] | None = None
    ) -> Records: ...


class MemoryStore:
    """Keeps everything, for small studies: `save` a chunk, does it `has` one, `load` it."""

    def __init__(self) -> None:
        self._records: dict[tuple[str, range], Records] = {}

    def has(self, filter_name: str, chunk: range) -> bool:
        return (filter_name, chunk) in self._records

    def save(self, filter_name: str, chunk: range, records: Records) -> None:
        self._records[filter_name, chunk] = records

    def load(self, filter_name: str, chunk: range, names: Iterable[str] | None = None) -> Records:
        records = self._records[filter_name, chunk]
        return {name: records[name] for name in (records if names is None else names)}


class FolderStore:
    """One file a chunk, written whole or not at all, beside a manifest of what made them: `save` a
    chunk, does it `has` one, `load` it, which raises ValueError for a damaged file.

    `manifest` holds whatever decides a run's result. A folder made with another manifest is
    refused when `resume` is set, and emptied of its chunks otherwise.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], *, resume: bool) -> None:
        self.folder = folder
        path = folder / "manifest.json"
        wanted = json.loads(json.dumps(manifest))
        if resume and path.exists():
            _check_same(path, read_json(path, "manifest", _as_manifest), wanted)
            for unfinished in folder.glob("*/.*.npz"):  # by a process that was killed
                unfinished.unlink(missing_ok=True)
        else:
            for old in folder.glob("*/*.npz"):
                old.unlink()
            folder.mkdir(parents=True, exist_ok=True)
            write_json(path, wanted)

    def has(self, filter_name: str, chunk: range) -> bool:
        return self._path(filter_name, chunk).exists()

    def save(self, filter_name: str, chunk: range, records: Records) -> None:
        path = self._path(filter_name, chunk)
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **records)

    def load(self, filter_name: str, chunk: range, names: Iterable[str] | None = None) -> Records:
        path, names = self._path(filter_name, chunk), None if names is None else list(names)
        records = read_arrays(path, names)
        for name in names or ():
            if name not in records:
                raise ValueError(f"{path} lacks {name}: {_DAMAGED}")
        _check_records(path, len(chunk), records)
        return records

    def _path(self, filter_name: str, chunk: range) -> Path:
        name = f"{chunk.start:07d}-{chunk.stop - 1:07d}.npz"
        return self.folder / filter_name.replace("/", "-") / name


_DAMAGED = "it is damaged; remove it, and run again with --resume"


def _check_records(path: Path, runs: int, records: Records) -> None:
    """Raise ValueError unless all are numbers, and what is of each run is of so many runs."""
    of_runs = (x for name, x in records.items() if not name.startswith(("sample_", SUM)))
    numbers = all(x.dtype.kind in "fiub" for x in records.values())
    if not numbers or any(x.shape[:1] != (runs,) for x in of_runs):
        raise ValueError(f"{path} holds other records than those of {runs} runs: {_DAMAGED}")


def _as_manifest(found: Any) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ValueError(f"holds a {type(found).__name__}; an object is accepted")
    return found


def _check_same(path: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    for key in {**wanted, **found}:
        now, then = wanted.get(key), found.get(key)
        if now != then:
            raise ValueError(
                f"cannot resume: {path} was made with another {key} ({then!r}, now {now!r}); "
                "use another --out or leave --resume out"
            )
