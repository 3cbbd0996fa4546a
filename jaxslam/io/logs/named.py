"""Tables whose titles name their columns, in any order, whatever else they hold."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import partial

import numpy as np

from jaxslam._runtime.files import LARGEST
from jaxslam.io.logs.geodetic import ENU, on_earth
from jaxslam.io.logs.log import (
    DEGREE,
    MIXED,
    NOTHING,
    ROS,
    Log,
    Rows,
    Stack,
    Words,
    in_seconds,
    log,
    of_angles,
    of_two_cells,
    planar,
    symmetric_or_none,
    unit_in,
)
from jaxslam.io.text import Table

_PLACES = ("", "p", "t", "pos", "position", "trans", "translation", "field", "msg", "pose",
           "transform", "point", "r")  # fmt: skip
_TURNS = ("q", "quat", "quaternion", "orientation", "rotation", "rot", "att", "attitude")
_PLACED = dict(zip(("x", "y", "z", "east", "north", "up", *"012"), 3 * "xyz", strict=True))
_TURNED = dict(zip("xyzwijk0123", "xyzwxyzwxyz", strict=True))
_ANGLES = {**dict.fromkeys(("θ", "theta", "yaw", "heading", "th", "psi"), "θ"),
           "roll": "roll", "phi": "roll", "pitch": "pitch"}  # fmt: skip
_EARTH = {
    "latitude": "north",
    "lat": "north",
    "longitude": "east",
    "lon": "east",
    "lng": "east",
    "altitude": "height",
    "alt": "height",
    "height": "height",
}
_OTHERS = {"twist", "vel", "velocity", "linear", "angular", "acc", "acceleration", "bias"}
_TIME = re.compile(
    r"(?:.*_)?(?P<nano>n(?:ano)?secs?)|(?P<header>(?:.*_)?stamp(?:_secs?)?|timestamp_sample)"
    r"|(?:(?:utc|gps|ros)_?)?(?P<t>t|ts|time|[ts]ow|timestamps?|secs?|seconds)(?:_?[num]?s(?:ecs?)?)?"
)
_AXIS = r"roll|pitch|yaw|heading|phi|theta|psi|th|θ|r_?[xyz]|[xyzrpth]"
_DEVIATION = "sigma|sig|std_?dev|std|stdev|sd|dev|unc|uncertainty"
_SPREAD = re.compile(
    r"q(?P<cnspy>[rpy]{2})|(?:[pc]|(?:.*_)?(?:(?P<cov>cov|covariance)|(?P<var>var|variance))"
    r"|(?:.*_)?(?P<inverse>i|inf|info|information|omega)"
    rf"|(?P<sigma>s|σ|(?:.*_)?(?:{_DEVIATION})))_?"
    rf"(?:(?P<number>\d+(?:_\d+)?)|(?P<first>{_AXIS})_?(?P<second>{_AXIS})?)"
)
_ORDER = {"x": 0, "y": 1, "z": 2, **dict.fromkeys(("roll", "phi", "rx", "r"), 3),
          **dict.fromkeys(("pitch", "ry", "p"), 4)}  # fmt: skip
"""The places of axes in a covariance; any other is the yaw."""
_ERRORS = {
    "type1": {"error": "right", "axes": "body"},
    "type2": {"error": "left", "axes": "world"},
    "type5": MIXED,
}
"""What cnspy calls the error of a covariance, in its column `est_err_type`."""


def read(table: Table) -> Log | None:
    """The poses of a table whose titles name time, position and, if any, orientation; None of
    others. Covariances are those of `covariances`. Raises ValueError, naming the line."""
    from scipy.spatial.transform import Rotation  # slow to import

    named, rows = meanings(table.titles), table.rows
    earth = {*_EARTH.values()} <= named.keys() and "x" not in named
    flat = "z" not in named and not earth
    if not ({"t", "x", "y"} <= named.keys() or earth) or (flat and "θ" not in named):
        return None
    titles = {name: table.titles[i] for name, i in named.items()}
    expected = f"finite numbers of {', '.join(table.titles[i] for i in sorted(named.values()))}"
    times, unit = table.numbers(expected, [named["t"]]), unit_in(titles["t"])
    weeks = [i for i, x in enumerate(map(words, table.titles)) if re.fullmatch("(gps_?)?week", x)]
    if weeks:
        one = of_two_cells(np.column_stack([table.numbers(expected, weeks[:1]), times]))
        times, unit = (times, unit) if one is None else (one, "s")
    if "nano" in named and rows[:, named["nano"]].max() < 1e9:
        times, unit = times + 1e-9 * table.numbers(expected, [named["nano"]]), "s"
    P, said, assumed = covariances(table, flat=flat)
    if earth:
        P = np.empty((0, 6, 6)) if P is None or not P[:, :3, :3].any() else P
        P[:, 3:, 3:] = 0.0  # of positions; all is zero where a receiver knows none
        P[~P.any(axis=(1, 2))] = np.nan
        places = [named[x] for x in ("t", "north", "east", "height")]
        place = table.numbers(expected, places, none=True)[:, 1:]
        place[:, :2] /= DEGREE if "rad" in titles["north"].lower() else 1.0
        times, notes = in_seconds(table, times[:, 0], unit)
        return on_earth(times, place, P)._replace(notes=(ENU, *notes))
    if flat:
        found = table.numbers(expected, [named[x] for x in "xyθ"])
        found = planar(table, np.column_stack([times, found]), unit, titles["θ"])
        return found if P is None else found._replace(covariances=P, said=said)
    turns = rows[:, [named[x] for x in ("qx", "qy", "qz", "qw") if x in named]]
    places = rows[:, [named[x] for x in "xyz"]]

    def of(turns: Rows) -> Log:
        found = log(table, np.column_stack([times, places, turns]), P, said, unit)
        return found._replace(assumed=assumed)

    if turns.shape[1] < 4 and {"roll", "pitch", "θ"} <= named.keys():
        order = ("θ", "pitch", "roll")
        angles, title = rows[:, [named[x] for x in order]], "".join(titles[x] for x in order)
        by_angles = partial(Rotation.from_euler, "ZYX")
        return of_angles(lambda x: of(by_angles(x).as_quat()), angles, places[:, :2], title)
    if P is not None and not turns.shape[1]:
        P[~np.isnan(P[:, 0, 0]), 3:, 3:] = 0.0
    return of(turns)


def words(title: str) -> str:
    """The words of a title, without units and frames: of `p_WB_x [m]` `p_x`; none of velocities."""
    title = re.sub(r"\b([pqt])(?:_[A-Z]{1,3})+(?=_)", r"\1", title)
    title = re.sub(r"[\[(](?![xyzw\d])[^\])]*[\])]", "", title.lower())
    told = re.findall(r"[^\W\d_]+|\d+", title)
    return re.sub(r"_(m|rad|deg|degrees)$", "", "_".join(told)) if not _OTHERS & {*told} else ""


def meanings(titles: tuple[str, ...]) -> dict[str, int]:
    """The columns of `t`, `x`, `y`, `z`, `qx` … `qw`, `θ`, `roll`, `pitch`: the first of each, but
    of times that of a header. They may be in two, the second of which is `nano`."""
    found: dict[str, int] = {}
    # Beside an rw, rx is no position.
    turns = (*_TURNS, *("r" for title in titles if re.fullmatch(r"(.*_)?r_?w", words(title))))
    for column, told in enumerate(map(words, titles)):
        time = _TIME.fullmatch(told)
        what = time.lastgroup if time else "" if _spread(told) else _of_pose(told, turns)
        found.setdefault(what or "", column)
    times = {x: found.pop(x) for x in ("header", "t", "nano") if x in found}
    if times:
        found["t"] = next(iter(times.values()))
    return found | ({"nano": times["nano"]} if len(times) > 1 and "nano" in times else {})


def _of_pose(told: str, turns: Collection[str]) -> str:
    """What a title names of a pose: an axis, an angle, or a part of a quaternion, with the names
    of rotations."""
    *before, last = told.split("_")
    for word, axis in ((before[-1] if before else "", last), (last[:-1], last[-1:])):
        if word in turns and axis in _TURNED:
            return f"q{_TURNED[axis]}"
        if word in _PLACES and axis in _PLACED and (word or not axis.isdigit()):
            return _PLACED[axis]
    return _ANGLES.get(last, _EARTH.get(last, ""))


def _spread(told: str) -> re.Match[str] | None:
    """A title as that of a σ, of a variance, or of a number of a covariance."""
    told = re.sub(r"^((?:.*_)?(?:pos|position|ori|orientation)_(?!c).*_)([012])$",
                  lambda x: x[1] + "xyz"[int(x[2])], told)  # fmt: skip
    told = re.sub(r"(?:^|_)(?:rot|rotation|ori|orientation|att|attitude)_(.*_)?([xyz])$",
                  r"_\1r\2", told).strip("_")  # fmt: skip
    told = re.sub(r"_(?:p|pos|position|trans|translation)_([xyz])$", r"_\1", told)
    told = re.sub(rf"^(.*?)_?({_DEVIATION}|var|variance)$", r"\2_\1", told)
    found = _SPREAD.fullmatch(told)
    if found is None:
        return None
    one, alone = found["sigma"] or found["var"], found["first"] and not found["second"]
    fits = bool(alone) == bool(one) and not (found["inverse"] and alone)
    return found if fits or (found["cov"] and alone) else None


def covariances(table: Table, *, flat: bool) -> tuple[Stack | None, Words, bool]:
    """The covariances that titles name, words of their `Convention`, and whether those are assumed:
    σ and variances by axes, as `std_x` and `var_yaw`; pairs, as `pxy`; numbers, as `P12`, and
    `covariance7` of ROS; and `qrp` of cnspy, with its kind of error. An axis without any has the
    variance −1. None where no title names those of x and y and, unless all is `flat`, z. Raises
    ValueError."""
    told = {i: x for i, title in enumerate(table.titles) if (x := _spread(words(title)))}
    places = iter(_places([x["number"] for x in told.values() if x["number"]]))
    cells, axes = {}, MIXED
    for i, found in told.items():
        names = [x.replace("_", "") for x in found.group("first", "second") if x]
        place = [_ORDER.get(x, 5) for x in names]
        place = place or ["rpy".index(x) + 3 for x in found["cnspy"] or ""]
        place = place or next(places, (6, 6))
        if flat and max(place) < 5:  # of x, y and yaw
            place = [5 if x > 1 else x for x in place]
        unit = DEGREE if len(names) == 1 and "deg" in table.titles[i].lower() else 1.0
        column = unit * np.clip(table.rows[:, i], -LARGEST, LARGEST)  # whose square is finite
        cells[place[0], place[-1]] = column ** (2 if found["sigma"] else 1)
        if {"roll", "pitch"} & {*names}:
            axes = {"error": "split", "axes": "rpy"}
        axes = ROS if found["cov"] and not names else axes
    cells.pop((6, 6), None)
    if not {(i, i) for i in range(3 - flat)} <= cells.keys():
        return None, NOTHING, False
    P = symmetric_or_none(table, np.column_stack([*cells.values()]), [*cells])
    if any(x["inverse"] for x in told.values()):
        axes_told = sorted({i for i, j in cells if i == j})
        block = np.ix_(~np.isnan(P[:, 0, 0]), axes_told, axes_told)
        P[block] = np.linalg.pinv(P[block], hermitian=True)
    for i in {*range(6)} - {i for i, j in cells if i == j}:
        P[~np.isnan(P[:, 0, 0]), i, i] = -1.0
    if flat:
        return P[:, [[0], [1], [5]], [0, 1, 5]], ROS, False
    column = table.titles.index("est_err_type") if "est_err_type" in table.titles else -1
    kinds = {*table.words.get(column, ())}
    if len(kinds) > 1 or not kinds <= _ERRORS.keys():
        raise ValueError(
            f"{table.path}: est_err_type is {', '.join(sorted(kinds))}; expected one of "
            f"{', '.join(_ERRORS)} in all lines"
        )
    if kinds:
        return P, _ERRORS[kinds.pop()], False
    return P, axes, True


def _places(told: Sequence[str]) -> list[list[int]]:
    """The places of the numbers of a covariance: of all, or of the upper triangle, row by row; or
    by the two digits of each."""
    size = {36: 6, 21: 6, 9: 3, 6: 3}.get(len(told), 0)
    places = np.argwhere(np.tri(size, k=size * (len(told) == size**2)).T)
    if any(len(x) > 1 for x in told) and all(len(x.replace("_", "")) == 2 for x in told):
        places = np.array([[int(x[0]), int(x[-1])] for x in told])
        places -= places.min()
    return places.tolist()
