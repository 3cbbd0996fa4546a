"""Tables without titles, told by the number of their columns and what is in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxslam.io.logs import named
from jaxslam.io.logs.log import (
    ALONG,
    MIXED,
    NOTHING,
    Log,
    along_course,
    in_seconds,
    log,
    of_two_cells,
    planar,
    symmetric,
    symmetric_or_none,
)
from jaxslam.io.text import Table, read_table
from jaxslam.io.tum import not_rigid, transforms

Reader = Callable[[Table], Log | None]
EXPECTED = "eight finite numbers t tx ty tz qx qy qz qw (TUM)"
UPPER = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
"""An upper triangle of three axes, row by row."""
_LENGTH = 1e-2
"""A quaternion is as long as one, to so much."""


def _of(columns: int, read: Callable[[Table], Log]) -> Reader:
    return lambda table: read(table) if table.rows.shape[1] == columns else None


_BEHIND = {
    8: [], 20: [*((3 + i, 3 + j) for i, j in UPPER), *UPPER],
    29: np.argwhere(np.tri(6).T), 44: [*np.ndindex(6, 6)],
}  # fmt: skip
"""The places of the numbers of a covariance, behind those of a pose: none; of OpenVINS, of rotation
and position; an upper triangle; all."""


def _tum(table: Table) -> Log:
    count = table.rows.shape[1]
    more = "" if count == 8 else f", and {count - 8} of a covariance"
    rows = table.numbers(f"{EXPECTED}{more}", range(8), none=True)
    P = symmetric_or_none(table, table.rows[:, 8:], _BEHIND[count]) if more else None
    return log(table, rows, P, MIXED if count == 20 else NOTHING)


_KITTI, _PLANAR = "12 finite numbers, the rows of a 3x4 T_wc (KITTI)", "four finite numbers t x y θ"


def _kitti(table: Table) -> Log | None:
    """Lines of 12 numbers of T_wc; or of a time, and these or all 16, by rows or columns (ARKit).

    Times are those of `times.txt` beside 12, else the number of the line, from 0."""
    if (count := table.rows.shape[1]) not in (12, 13, 17):
        return None
    M = table.rows[:, count % 4 :].reshape(len(table.rows), -1, 4)
    M = np.swapaxes(M, 1, 2) if M.shape[1] == 4 and (M[:, :3, 3] == 0).all() else M
    if (M[:, 3:] != [0, 0, 0, 1]).any():
        return None
    table.numbers(_KITTI)
    T = transforms(*np.split(M[:, :3], [3], axis=2))
    table.check(not_rigid(T, 1e-3), f"a rigid motion [R t] with a rotation R, {_KITTI}")
    left, _, right = np.linalg.svd(T[:, :3, :3])  # rounding to six digits, taken away
    T[:, :3, :3] = left @ right
    if count > 12:
        times, notes = in_seconds(table, table.rows[:, 0])
        return Log(times, T, np.empty((0, 6, 6)), notes=notes)
    beside = table.path.parent / "times.txt"
    if not beside.is_file():
        return Log(np.arange(float(len(T))), T, np.empty((0, 6, 6)), stamped=False)
    times = read_table(beside, "times", "times", "finite times in seconds")
    seconds = times.numbers("finite times in seconds", [0])[:, 0]
    if len(seconds) != len(T):
        raise ValueError(f"{beside} has {len(seconds)} times for {len(T)} poses of {table.path}")
    return Log(seconds, T, np.empty((0, 6, 6)))


def _state(table: Table) -> Log | None:
    """A line of OpenVINS's states: `t q p …`, whose quaternions of JPL have the numbers of
    Hamilton's, of the body in the world; for each of n cameras 15 numbers more, and 30 of the IMU.
    """
    columns = table.rows.shape[1]
    if columns < 19 or columns - 19 not in (*_of_cameras(table.rows[:, 18], 15, (0, 30)),):
        return None
    rows = table.numbers(f"{columns} finite numbers t, q, p and the rest of OpenVINS's state")
    return log(table, rows[:, [0, 5, 6, 7, 1, 2, 3, 4]])


def is_deviations(rows: Float[np.ndarray, "n k"]) -> bool:
    """Whether these are lines of OpenVINS's deviations, `t σ_q σ_p …`: 14 numbers more for each of
    n cameras, and 28 or 29 of the IMU."""
    columns = rows.shape[1]
    return columns >= 18 and columns - 18 in _of_cameras(rows[:, 17], 14, (0, 28, 29))


def _of_cameras(count: np.ndarray, each: int, more: tuple[int, ...]) -> tuple[int, ...]:
    """How many numbers may be behind the `count` of the cameras."""
    n = count[0]
    whole = np.isfinite(n) and n == round(n) and n >= 0
    return tuple(each * int(n) + x for x in more) if whole else ()


def _w_first(table: Table) -> Log | None:
    """Lines `t p q …` with w first, of EuRoC (17 numbers) and of VINS-Mono (11, or 8 in ns between
    commas; between spaces they are those of ORB-SLAM3, with w last)."""
    count = table.rows.shape[1]
    if count not in (8, 11, 17) or np.abs(table.rows[:, 4:8]).max() > 2:
        return None
    unit = np.abs(np.linalg.norm(table.rows[:, 4:8], axis=1) - 1) < _LENGTH
    if not unit.all() or (count == 8 and (table.rows[0, 0] < 1e17 or table.separator is None)):
        return None
    found = log(table, table.rows[:, [0, 1, 2, 3, 5, 6, 7, 4]])
    note = f"{table.path}: {count} columns are taken as t p q …, with w first (EuRoC, VINS-Mono)"
    return found._replace(notes=(*found.notes, note))


_STAMPED = {8: "t x y z qx qy qz qw"}
_STAMPED[16] = f"t status service lat lon alt {' '.join(f'covariance{i}' for i in range(9))} type"
_STAMPED[44] = _STAMPED[86] = f"{_STAMPED[8]} {' '.join(f'covariance{i}' for i in range(36))}"
"""The titles of so many numbers whose stamp is in two cells: of `ros2 topic echo --csv`, also of a
twist or of NavSatFix, and of weeks of GPS."""
_ANGLES = (
    "t x y z roll pitch yaw", "t roll pitch yaw x y z", "t x y z yaw pitch roll",
    "t yaw pitch roll x y z",
)  # fmt: skip
"""The orders of positions and angles: of NCLT, of FAST-LIO, and of others."""


def _as_titled(table: Table) -> Log | None:
    """Lines of a stamp in two cells, and maybe of a frame, by their titles."""
    if table.rows.shape[1] < 9:
        return None
    blank = [2] if np.isnan(table.rows[:, 2]).all() else []  # a frame without a name
    one = of_two_cells(np.delete(table.rows, [*table.words, *blank], axis=1))
    if one is None or one.shape[1] not in _STAMPED:
        return None
    titles = tuple(_STAMPED[one.shape[1]].split())
    return named.read(table._replace(titles=titles, rows=one, words={}))


def _of_angles(table: Table) -> Log | None:
    """Lines of a time, a position and three angles, in the one of `_ANGLES` whose yaw is along the
    course; or whose angles are bounded where the others' are not."""
    rows = table.rows
    if rows.shape[1] != 7 or (np.abs(np.hypot.reduce(rows[:, 3:7], axis=1) - 1) < _LENGTH).all():
        return None  # a quaternion, without a time

    def fits(order: str) -> float:
        x, y, yaw = (rows[:, order.split().index(name)] for name in ("x", "y", "yaw"))
        return max(along_course(yaw, np.column_stack([x, y])))

    first, *others = _ANGLES
    best = max(others, key=fits)
    bound = [np.abs(rows[:, part]).max() < 2 * np.pi for part in (slice(1, 4), slice(4, 7))]
    found = best if fits(best) > max(ALONG, fits(first)) else first
    if max(map(fits, _ANGLES)) <= ALONG and bound == [True, False]:
        found = others[0]
    return named.read(table._replace(titles=tuple(found.split())))


def _positions(table: Table) -> Log:
    """Positions alone, with the triangle of their covariance: no orientation."""
    rows = table.numbers("10 finite numbers t x y z and the upper triangle of their covariance")
    return log(table, rows[:, :4], symmetric(rows[:, 4:], UPPER), MIXED)


FORMATS: tuple[tuple[str, Reader], ...] = (
    (
        "sec nsec (or a week of GPS and its seconds) x y z qx qy qz qw and maybe ROS' covariance",
        _as_titled,
    ),
    ("t x y z roll pitch yaw, or the angles first", _of_angles),
    ("KITTI, 12 numbers, or 13 and 17 with a time", _kitti),
    ("EuRoC's data.csv and VINS-Mono's result, w first", _w_first),
    ("TUM, 8 numbers", _of(8, _tum)),
    ("t x y θ", _of(4, lambda x: planar(x, x.numbers(_PLANAR)))),
    ("t x y z and a triangle, 10 numbers", _of(10, _positions)),
    ("OpenVINS's states", _state),
    ("OpenVINS's pose_to_file, 20 numbers", _of(20, _tum)),
    ("TUM and a triangle, 29 numbers", _of(29, _tum)),
    ("TUM and a covariance, 44 numbers", _of(44, _tum)),
)
