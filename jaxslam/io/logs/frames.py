"""The tracker's own record of all frames: which are lost, and of which map they are."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jaxslam.io.text import text_lines

_COLUMNS = ("time", "state", "map", "unit_fixed")
_ROW = re.compile(r"-?\d+(\.\d*)?,\w+,\d{1,6},[01]")
_FRAME = "a finite time, a state, the number of a map, and unit_fixed 0 or 1"


def read_frames(path: Path) -> tuple[np.ndarray, ...] | None:
    """The times of a tracker's frames, which are lost, their maps, and whether the unit of those is
    fixed (docs/gauge.md); None where there is no file of it, or another one of its name.

    Raises ValueError, naming the line, for what a tracker does not write.
    """
    try:
        told = text_lines(path)
    except ValueError:  # there is none, or it is no text
        return None
    # Reasons are words with spaces, and most cells of the last columns are empty: nobody's table.
    titles, *rows = (line.split(",") for line in told.values() or [""])
    if not rows or not set(_COLUMNS) <= set(titles):
        return None
    columns = [titles.index(name) for name in _COLUMNS]
    for line, row in zip(list(told)[1:], rows, strict=True):
        if len(row) != len(titles) or not _ROW.fullmatch(",".join(row[i] for i in columns)):
            raise ValueError(f"{path}, line {line}: expected {_FRAME}")
    time, state, number, fixed = np.array(rows)[:, columns].T
    return time.astype(float), state == "lost", number.astype(int), fixed == "1"
