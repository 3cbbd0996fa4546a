"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


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
