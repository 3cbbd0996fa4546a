"""What is read of a log, whatever its format."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import LARGEST
from jaxslam.io.text import Table, without_values
from jaxslam.io.tum import Times, of_xytheta, rows_as_poses

UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
NAMES = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds", "s": "seconds"}
DAY = 86400.0
_EPOCHS = 719529.0, 2440587.5, 40587.0, 25569.0
"""1970-01-01 in days of MATLAB, in Julian and modified Julian ones, and in Excel's."""
_OURS = (9.4e8, 2.21e9)
"""Seconds since 1970 of 2000 to 2040."""
GPS_EPOCH = 315964800.0
"""Seconds of 1970-01-01 to 1980-01-06, from which GPS counts weeks; both without leap seconds."""
WEEK = 604800.0
STEPS = (1e-3, 10.0)
"""The time from a pose to the next, s, which shows the unit of times."""
MIXED = {"error": "split", "axes": "mixed"}
"""The convention of OpenVINS: the position in the world's axes, the rotation in the body's."""
ROS = {"error": "split", "axes": "world"}
"""The convention of PoseWithCovariance, as ROS documents it."""
WHOLE = "a covariance of finite numbers, or of NaN alone (an unknown axis has the variance −1)"
TAKEN = "no title says the unit of its angles: they are taken as {}"
DEGREE = np.pi / 180
_LATEST = 1e11
"""Seconds since 1970 of the year 5138."""
ALONG = 0.7
"""From how well on headings are `along_course`."""
_SINCE = (1e8, 4e9)
"""Seconds since 1970, or since the epoch of GPS, of our time."""


Words = Mapping[str, str]
NOTHING: Words = MappingProxyType({})
Rows = Float[np.ndarray, "n ..."]
"""Numbers of lines."""
Stack = Float[np.ndarray, "k d d"]
"""Poses, one after another."""


class Log(NamedTuple):
    """Poses of a body in its world, in m, and their covariances."""

    times: Float[np.ndarray, " n"]
    """Seconds, or the numbers of the lines where poses have no stamps."""
    poses: Float[np.ndarray, "n d d"]
    """Matrices (n, 4, 4), or (n, 3, 3) in the plane; NaN where the log has none."""
    covariances: Float[np.ndarray, "m t t"]
    """One for every pose, NaN where the log has none; or none at all."""
    said: Words = NOTHING
    """The words of a `Convention` that the format, or the log, is known by."""
    notes: tuple[str, ...] = ()
    """What was made of the file, where that is a choice."""
    stamped: bool = True
    oriented: bool = True
    """Whether it has orientations, or positions alone; those are then identities."""
    world: str = ""
    """The frame in which poses are, by its name; "" where it has none."""
    body: str = ""
    assumed: bool = False
    """Whether the words of its convention are, as its titles say none."""
    otherwise: Stack = np.empty(0)
    """The poses if angles were in degrees, or in radians, where no title says which; or none."""


def log(
    table: Table,
    rows: Rows,
    P: Rows | None = None,
    said: Mapping[str, str] = NOTHING,
    unit: str = "",
) -> Log:
    """A log of rows `t tx ty tz qx qy qz qw`, or of positions alone, `t tx ty tz`. Rows that are
    all NaN but for the time have no pose.

    Raises ValueError, naming file and line.
    """
    oriented = rows.shape[1] == 8
    if not oriented:
        turns = np.where(np.isnan(rows[:, 1:2]), np.nan, [0.0, 0.0, 0.0, 1.0])
        rows = np.column_stack([rows, turns])
    there = np.flatnonzero(~without_values(rows))
    T = np.full((len(rows), 4, 4), np.nan)
    T[there] = rows_as_poses(lambda i: table.place(there[i]), rows[there])
    P = np.empty((0, 6, 6)) if P is None else P
    times, notes = in_seconds(table, rows[:, 0], unit)
    return Log(times, T, P, said, notes, oriented=oriented)


def planar(table: Table, rows: Rows, unit: str = "", title: str = "") -> Log:
    """A log of rows `t x y θ`, whose title may say the unit of θ."""
    times, notes = in_seconds(table, rows[:, 0], unit)

    def of(angle: Rows) -> Log:
        T = of_xytheta(np.column_stack([rows[:, 1:3], angle]))
        return Log(times, T, np.empty((0, 3, 3)), notes=notes)

    return of_angles(of, rows[:, 3:], rows[:, 1:3], title)


def of_angles(of: Callable[[Rows], Log], angles: Rows, places: Rows, title: str) -> Log:
    """The log `of` angles in radians; they are in what a title says, or else by `in_degrees`."""
    told = re.search("deg|rad", title.lower())
    unit = DEGREE if (told[0] == "deg" if told else in_degrees(angles, places)) else 1.0
    first = of(angles * unit)
    if told:
        return first
    notes = first.notes if unit == 1 else (*first.notes, TAKEN.format("degrees"))
    return first._replace(otherwise=of(angles * (DEGREE / unit)).poses, notes=notes)


def in_degrees(angles: Rows, places: Rows) -> bool:
    """Whether angles, the yaw first, are degrees: only so the heading is along the course,
    forwards or backwards, which turns; or as radians they would leap by half a turn."""
    radians, degrees = along_course(angles[:, 0], places)
    if max(radians, degrees) > ALONG:
        return degrees > radians
    a = angles[np.isfinite(angles).all(axis=1)]
    largest, leap = np.abs(a).max(initial=0.0), np.abs(np.diff(a, axis=0)).max(initial=0.0)
    return bool(largest > 2 * np.pi + 0.1 and leap > np.pi)


def in_seconds(table: Table, times: Times, unit: str = "") -> tuple[Times, tuple[str, ...]]:
    """Times in seconds, of the `unit` that is said, there or by the title of a first column; or of
    the only one in which they are `STEPS` apart.

    Raises ValueError, naming the line, for a time that is none.
    """
    table.check(~np.isfinite(times), "a finite time")
    if unit := unit or unit_in("".join(table.titles[:1])):
        return times * UNITS[unit], ()
    days = [x for x in _EPOCHS if _OURS[0] < (times[0] - x) * DAY < _OURS[1]]
    if days and 0 < _step(times) < STEPS[0] / 2:
        return (times - days[0]) * DAY, (f"{table.path}: times are taken as days",)
    try:
        check_seconds(str(table.path), times)
    except ValueError:
        unit = unit_of(times) or ""
        if not unit:
            raise
        return times * UNITS[unit], (f"{table.path}: times are taken as {unit}",)
    return times, ()


def of_two_cells(rows: Rows) -> Rows | None:
    """Rows whose stamps, in two cells, are one: whole seconds and nanoseconds, or the week of GPS
    and its seconds; None of others."""
    first, second = rows[:, 0], rows[:, 1]
    if not ((first == np.floor(first)) & (second >= 0)).all():
        return None
    if (first >= _SINCE[0]).all() and (second == np.floor(second)).all() and second.max() < 1e9:
        return np.column_stack([first + 1e-9 * second, rows[:, 2:]])
    unit = UNITS["ms" if second.max() >= WEEK else "s"]
    if not ((first > 1000) & (first < 5000) & (unit * second < WEEK)).all():
        return None
    return np.column_stack([GPS_EPOCH + WEEK * first + unit * second, rows[:, 2:]])


def along_course(
    yaw: Float[np.ndarray, " n"], places: Rows, units: Sequence[float] = (1.0, DEGREE)
) -> list[float]:
    """How well headings in these units are along the course, forwards or backwards: from 0, as well
    as one that never turns, to 1. Over the steps that show it best, as places are noisy."""
    there = np.isfinite(yaw) & np.isfinite(places).all(axis=1)
    a, p, best = yaw[there], np.clip(places[there], -LARGEST, LARGEST), np.zeros(len(units))
    for every in (max(len(a) // part, 1) for part in (200, 60, 20)):
        along = (p[every:] - p[:-every]) @ [1, 1j]
        middle, length = a[every // 2 :][: len(along)], max(float(np.abs(along).sum()), 1e-9)
        still, *found = (
            float(abs(np.sum(np.abs(along) * np.exp(2j * (x * middle - np.angle(along)))))) / length
            for x in (0.0, *units)
        )
        if still < 0.9:  # of a course that turns
            best = np.maximum(best, (np.array(found) - still) / (1 - still))
    return best.tolist()


def unit_in(title: str) -> str:
    """The unit that a title says, as `t [us]` or `time_us`; "" where it says none."""
    found = re.search(r"\[([num]?s)\]|(?:_|time|stamp)([num]?s)(?:ecs?)?$", title.lower())
    return found[found.lastindex or 0] if found else ""


def unit_of(times: Times) -> str | None:
    """The only unit of `units_of`; None where there is none, or two."""
    fit = units_of(times)
    return fit[0] if len(fit) == 1 else None


def units_of(times: Times) -> list[str]:
    """The units of time in which they are `STEPS` apart, of those the ones in which they are of our
    time; or where they are `STEPS` apart in none, the latter."""
    step, last = _step(times), float(np.abs(times).max())
    near = [unit for unit, scale in UNITS.items() if STEPS[0] <= step * scale <= STEPS[1]]
    ours = [unit for unit, scale in UNITS.items() if _SINCE[0] < last * scale < _SINCE[1]]
    return [unit for unit in near if unit in ours] or near or ours


def _step(times: Times) -> float:
    return float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0


def check_seconds(what: str, times: Times) -> None:
    """Raise ValueError where times are too large to be seconds, since 1970 or from pose to pose."""
    last, step = float(np.abs(times).max()), _step(times)
    # Seconds between two poses, more than a moving thing has.
    if last <= _LATEST and step <= 1e3:
        return
    told = f"up to {last:.3g}" if last > _LATEST else f"{step:.3g} from one to the next"
    units = [NAMES[unit] for unit in units_of(times)] or ["another unit"]
    ask = "; a title such as t_us says which" if len(units) > 1 else ""
    raise ValueError(f"{what}: times {told} look like {' or '.join(units)}; expected seconds{ask}")


def symmetric(
    values: Float[np.ndarray, "n k"], places: Sequence[tuple[int, int]] | np.ndarray, t: int = 6
) -> Float[np.ndarray, "n t t"]:
    """Symmetric matrices with the columns of `values` at these places, and zeros elsewhere."""
    P = np.zeros((len(values), t, t))
    rows, columns = np.transpose(places)
    P[:, rows, columns] = P[:, columns, rows] = values
    return P


def symmetric_or_none(
    table: Table, values: Float[np.ndarray, "n k"], places: Sequence[tuple[int, int]] | np.ndarray
) -> Float[np.ndarray, "n 6 6"]:
    """The same; NaN throughout where all values are NaN. Raises ValueError where only some are."""
    none = np.isnan(values).all(axis=1)
    table.check(np.isnan(values).any(axis=1) & ~none, WHOLE)
    return symmetric(values, places) + np.where(none, np.nan, 0.0)[:, None, None]


def interpolated(
    times: Float[np.ndarray, " m"], poses: Stack, at: Times, *, beyond: bool = False
) -> Float[np.ndarray, "n d d"]:
    """Poses between those of increasing `times`: positions linearly, rotations along the shortest.

    NaN outside of their times, where poses `beyond` the ends are not those of the ends.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    n = poses.shape[-1] - 1
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    first, second = poses[after - 1], poses[np.minimum(after, len(times) - 1)]
    span = times[np.minimum(after, len(times) - 1)] - times[after - 1]
    share = (at - times[after - 1]) / np.where(span > 0, span, 1.0)
    share = np.clip(share, 0, 1) if beyond else np.where((share < 0) | (share > 1), np.nan, share)
    result = np.tile(np.eye(n + 1), (len(at), 1, 1))
    result[:, :n, n] = first[:, :n, n] + share[:, None] * (second - first)[:, :n, n]
    vectors = share[:, None] * turns(first, second)
    there = ~np.isnan(vectors).any(axis=1)
    part = Rotation.from_rotvec(vectors[there]).as_matrix()[:, :n, :n]
    result[there, :n, :n] = first[there, :n, :n] @ part
    result[~there | np.isnan(result).any(axis=(1, 2))] = np.nan
    return result


def turns(first: Stack, second: Stack) -> Float[np.ndarray, "n 3"]:
    """The rotation vectors from poses to others, about the axes of the body; NaN where one is."""
    from scipy.spatial.transform import Rotation

    n = first.shape[-1] - 1
    R = np.swapaxes(first[:, :n, :n], 1, 2) @ second[:, :n, :n]
    there = ~np.isnan(R).any(axis=(1, 2))
    whole, result = np.tile(np.eye(3), (there.sum(), 1, 1)), np.full((len(R), 3), np.nan)
    whole[:, :n, :n] = R[there]
    result[there] = Rotation.from_matrix(whole).as_rotvec()
    return result
