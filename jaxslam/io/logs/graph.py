"""The vertices of g2o's graphs: poses without stamps, by their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxslam.io.logs.log import Log, log, planar
from jaxslam.io.text import table_of

_SPATIAL, _PLANAR = "VERTEX_SE3:QUAT", "VERTEX_SE2"
NOTE = (
    "of a graph of g2o vertices alone are read; the covariances of its library are of the vector "
    "part of a quaternion, half the angle (angle=half, error=right)"
)


def read(path: Path, lines: Mapping[int, str]) -> Log | None:
    """The poses of a g2o file; None of another. Raises ValueError, naming the line."""
    kinds = {line.split(maxsplit=1)[0] for line in lines.values()}
    kind = next((kind for kind in (_SPATIAL, _PLANAR) if kind in kinds), None)
    if kind is None:
        return None
    count = 8 if kind == _SPATIAL else 4
    told = {n: line.removeprefix(kind) for n, line in lines.items() if line.startswith(kind)}
    row = f"{kind}, a number, and {count - 1} finite numbers"
    table = table_of(path, told, "vertices", row)
    values = table.numbers(row, range(count), spare=False)
    values = values[np.argsort(values[:, 0], kind="stable")]
    found = planar(table, values, "s") if kind == _PLANAR else log(table, values, unit="s")
    return found._replace(notes=(*found.notes, NOTE), stamped=False)
