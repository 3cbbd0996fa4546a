"""Files that are written whole or not at all, and read with the file's name in every error."""

from __future__ import annotations

import errno
import json
import os
import shutil
import struct
import textwrap
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

T = TypeVar("T")
Json = Any
"""A value as JSON has it: a number, a word, a list, an object, or null."""
LARGEST = 1e100
"""The largest number of a pose or a picture that is read: its square is finite."""


@contextmanager
def write_atomically(path: str | Path) -> Generator[Path, None, None]:
    """Yield a temporary name beside `path`; the file or folder there becomes `path` at the end.

    Folders above it are made. After an exception what is temporary is removed and an older `path`
    stays as it was. The temporary name ends like `path`, since many writers choose the format by
    it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text, whole or not at all."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def append_whole(path: str | Path, text: str) -> None:
    """Add text to a file, all of it or nothing. Raises OSError."""
    data = text.encode()
    with Path(path).open("ab", buffering=0) as file:
        end = file.tell()
        if file.write(data) < len(data):  # a disk that is full
            file.truncate(end)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def read_json(path: str | Path, what: str, parse: Callable[[Json], T]) -> T:
    """Return what `parse` makes of a JSON file. Raises ValueError, naming the file, where it cannot
    be read (`what` says of what), is not JSON, or is refused by `parse`."""
    path = Path(path)
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot read the {what} ({error.strerror})") from None
    except ValueError as error:  # bad JSON and bad UTF-8 alike
        raise ValueError(f"{path}: not a JSON file ({error})") from None
    try:
        return parse(fields)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_json(path: str | Path, value: Json, **options: Any) -> None:
    """Write a value as JSON, whole or not at all; `options` are `json.dumps`'s."""
    write_text(path, json.dumps(value, indent=1, **options) + "\n")


def read_arrays(path: str | Path, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz file, or those of them that are named and there; nothing in it is run.

    Raises ValueError, naming the file, for one that cannot be read, or that holds objects.
    """
    path = Path(path)
    try:
        with path.open("rb") as raw:  # NumPy leaves what it opens itself open, where it is broken
            arrays = _loaded(raw, names)
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot read the arrays ({error.strerror or error})") from None
    except _NOT_ARRAYS as error:
        pickled = "pickle" in str(error)  # NumPy's advice then is to trust the file
        why = "it is another kind of file, or contains objects" if pickled else one_line(error)
        raise ValueError(f"{path}: not an npz file of numbers ({why})") from None
    for name, x in arrays.items():
        if not isinstance(x, np.ndarray):  # a member that is no array comes as its bytes
            raise ValueError(f"{path}: not an npz file of numbers ({name} is not an array)")
    return arrays


def _loaded(raw: BinaryIO, names: Iterable[str] | None) -> dict[str, np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers that are not quite NumPy's
        file = np.load(raw, allow_pickle=False)
        if isinstance(file, np.ndarray):
            raise ValueError("one array, without a name")
        wanted = file.files if names is None else [n for n in names if n in file.files]
        return {name: file[name] for name in wanted}


_NOT_ARRAYS = (
    ValueError, EOFError, KeyError, NotImplementedError, TypeError, MemoryError, RuntimeError,
    SyntaxError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What a broken archive, or an array with a broken header, ends in."""


def one_line(error: BaseException) -> str:
    """Return an error's message, on one line that is not too long."""
    return textwrap.shorten(str(error), 200, placeholder=" …")


def json_numbers(values: np.ndarray) -> list[float | None]:
    """Return numbers for JSON, which has no NaN: None instead."""
    return [float(value) if np.isfinite(value) else None for value in values]
