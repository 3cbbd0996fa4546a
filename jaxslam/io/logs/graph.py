"""The vertices of g2o's graphs: poses without stamps, by their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxslam.io.logs.log import Log, log, planar
from jaxslam.io.text import Table, rows_of

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
    words = {number: line.split() for number, line in lines.items()}
    told = {number: own for number, (first, *own) in words.items() if first == kind}
    values = rows_of(path, told, count, f"{kind}, a number, and {count - 1} finite numbers")
    order = np.argsort(values[:, 0], kind="stable")
    values = values[order]
    table = Table(path, (), (), values, tuple(np.array(list(told))[order].tolist()), {})
    found = planar(table, values, "s") if kind == _PLANAR else log(table, values, unit="s")
    return found._replace(notes=(NOTE,), stamped=False)
