"""Trajectories that programs log, with their covariances where they have any: one table of formats.

A file is read by what is in it: its titles (`named`), its number of columns (`unnamed`), or its
own marks (`geodetic`, `square`, `graph`).
"""

from __future__ import annotations

from pathlib import Path

from jaxslam.io.logs import geodetic, graph, named, square, unnamed
from jaxslam.io.logs.log import Log
from jaxslam.io.text import table_of, text_lines

FORMATS = (
    ("SQUARE of smfeval", square.read),
    ("RTKLIB's .pos", geodetic.read_rtklib),
    ("titles such as t,tx,ty,tz,qx,qy,qz,qw", named.read),
    *unnamed.FORMATS,
)
"""What a format is called, and what reads a table of it, or returns None."""


def read_log(path: str | Path) -> Log:
    """Read a trajectory of any known format. Raises ValueError, naming file and line, and for what
    is in no known format, which those are and what was found."""
    path = Path(path)
    lines = text_lines(path, "trajectory", comments=True)
    other = graph.read(path, lines) or geodetic.read_novatel(path, lines)
    if other is not None:
        return other
    table = table_of(path, lines, "poses", unnamed.EXPECTED)
    for _, read in FORMATS:
        found = read(table)
        if found is not None:
            return found
    known = "; ".join(name for name, _ in FORMATS)
    more = ", …" * (len(table.titles) > 12)
    titles = f" ({', '.join(table.titles[:12])}{more})" if table.titles else ""
    raise ValueError(
        f"{table.place(0)}: {table.rows.shape[1]} columns{titles} are no known format; expected "
        f"{unnamed.EXPECTED}, or one of: {known}"
    )
