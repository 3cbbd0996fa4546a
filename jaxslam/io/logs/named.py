"""Tables whose titles name their columns, in any order, whatever else they hold."""

from __future__ import annotations

import re

import numpy as np

from jaxslam.io.logs.log import MIXED, Log, log, planar, symmetric, unit_in
from jaxslam.io.text import Table

_BEFORE = r"(?:(?:field|msg|pose|transform|position|translation|pos|trans)[._ ]?)*"
_TURN = (
    r"(?:(?:field|msg|pose|transform|orientation|rotation|rot|quaternion|quat|att|attitude|q_rs|q)"
    r"[._ ]?)+"
)
_MEANINGS = {
    "time": re.compile(
        r"(?:t|(?:field\.)?(?:header\.)?(?:time_?stamps?|stamp|time|secs?|seconds))(?:_?[num]?s)?"
    ),
    "position": re.compile(rf"{_BEFORE}(?:t|p|p_rs_r)?[._ ]?([xyz])(?:_m)?"),
    "turn": re.compile(rf"{_TURN}([xyzw])"),
    "angle": re.compile(r"(?:θ|theta|yaw|heading|th|psi)(?:_?deg(?:rees)?|_?rad)?"),
    "variance": re.compile(r"p([xyz]{2})|q([rpy]{2})"),
}
_POSITION, _TURNS = "xyz", "rpy"
_ERRORS = {
    "type1": {"error": "right", "axes": "body"},
    "type2": {"error": "left", "axes": "world"},
    "type5": {"error": "split", "axes": "mixed"},
}
"""What cnspy calls the error of a covariance, in its column `est_err_type`."""


def read(table: Table) -> Log | None:
    """The poses of a table whose titles name time, position and, if any, orientation; None of
    others. Variances are `pxx, pxy …` and `qrr, qrp …` of cnspy, with its kind of error."""
    named = meanings(table.titles)
    if not {"t", "x", "y"} <= named.keys() or not (named.keys() & {"z", "θ"}):
        return None
    time = named["t"]
    unit = unit_in(table.titles[time])
    expected = f"finite numbers of {', '.join(table.titles[i] for i in sorted(named.values()))}"
    table.numbers(expected, [time])
    if "z" not in named:
        rows = table.numbers(expected, [named[x] for x in "txyθ"])
        if any("deg" in title.lower() for title in table.titles):
            rows[:, 3] = np.radians(rows[:, 3])
        return planar(table, rows, unit)
    turns = ["qx", "qy", "qz", "qw"]
    columns = [*"txyz", *(turns if named.keys() >= {*turns} else ())]
    P, said = _covariances(table, named)
    note = "its titles do not say of which error its covariances are: taken as split, mixed"
    notes = (note,) if said is MIXED else ()
    found = log(table, table.rows[:, [named[x] for x in columns]], P, said, unit)
    return found._replace(notes=(*found.notes, *notes))


def meanings(titles: tuple[str, ...]) -> dict[str, int]:
    """The columns of `t`, `x`, `y`, `z`, `qx` … `qw`, `θ`, and of variances as `p` or `q` and two
    axes; the first of each."""
    named: dict[str, int] = {}
    for column, title in enumerate(titles):
        base = re.sub(r"[\[(].*", "", title.lower()).strip(" #%.")
        for what, pattern in _MEANINGS.items():
            if found := pattern.fullmatch(base):
                axis = found[found.lastindex] if found.lastindex else ""
                name = {"time": "t", "position": axis, "turn": f"q{axis}", "angle": "θ"}
                named.setdefault(name.get(what, base), column)
                break
    return named


def _covariances(table: Table, named: dict[str, int]) -> tuple[np.ndarray | None, dict[str, str]]:
    places, columns = [], []
    for name, column in named.items():
        axes = _POSITION if name[0] == "p" else _TURNS
        if len(name) == 3 and name[0] in "pq":
            places.append(tuple(axes.index(x) + 3 * (axes == _TURNS) for x in name[1:]))
            columns.append(column)
    if not {(0, 0), (1, 1), (2, 2)} <= set(places):
        return None, {}
    P = symmetric(table.rows[:, columns], places)
    kinds = {
        x for i, column in table.words.items() if table.titles[i] == "est_err_type" for x in column
    }
    if len(kinds) > 1 or not kinds <= _ERRORS.keys():
        raise ValueError(
            f"{table.path}: est_err_type is {', '.join(sorted(kinds))}; expected one of "
            f"{', '.join(_ERRORS)} in all lines"
        )
    return P, _ERRORS[kinds.pop()] if kinds else MIXED
