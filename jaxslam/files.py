"""Files that are written whole or not at all, and read with the file's name in every error."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


@contextmanager
def write_atomically(path: str | Path) -> Generator[Path, None, None]:
    """Yield a temporary name beside `path`; what was written there becomes `path` at the end.

    After an exception the temporary file is removed and an older `path` stays as it was. The
    temporary name ends like `path`, since many writers choose the format by it.
    """
    path = Path(path)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_json(path: str | Path, what: str, parse: Callable[[Any], T]) -> T:
    """What `parse` makes of a JSON file. Raises ValueError, naming the file, where it cannot be
    read (`what` says of what), is not JSON, or is refused by `parse`."""
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


def json_numbers(values: np.ndarray) -> list[float | None]:
    """For JSON, which has no NaN."""
    return [float(value) if np.isfinite(value) else None for value in values]
