"""Trajectories as text in the format of TUM's benchmark: `t tx ty tz qx qy qz qw` a line.

And those of other programs, and what files of a time and numbers a line have in common.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST, write_atomically


class Table(NamedTuple):
    """Numbers as text: what its comments say, its rows and the lines that they stand on."""

    comments: tuple[str, ...]
    rows: Float[np.ndarray, "n k"]
    lines: tuple[int, ...]


def quaternions(R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4"]:
    """Return rotation matrices as quaternions x, y, z, w, of which w is not negative."""
    from scipy.spatial.transform import Rotation

    if not len(R):  # Rotation refuses an empty stack
        return np.empty((0, 4))
    return Rotation.from_matrix(R).as_quat(canonical=True)


def poses(translation: ArrayLike, quaternion: ArrayLike) -> Float[np.ndarray, "n 4 4"]:
    """Poses from positions (n, 3) and quaternions x, y, z, w (n, 4), which get normalised."""
    from scipy.spatial.transform import Rotation  # slow to import

    rotation = Rotation.from_quat(np.asarray(quaternion, dtype=float).reshape(-1, 4))
    result = np.tile(np.eye(4), (len(rotation), 1, 1))
    result[:, :3, :3] = rotation.as_matrix()
    result[:, :3, 3] = translation
    return result


def read_tum(path: str | Path) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Times (n,) in seconds and poses T_wc (n, 4, 4) from lines `t tx ty tz qx qy qz qw`.

    Empty lines and those that start with # are skipped. Raises `ValueError`, naming the file and
    the line, for anything else that is not eight finite numbers with a non-zero quaternion.
    """
    columns = "t tx ty tz qx qy qz qw"
    _, rows, lines = read_table(path, "trajectory", "poses", f"eight finite numbers {columns}", 8)
    return rows[:, 0], rows_as_poses(lambda i: f"{path}, line {lines[i]}", rows)


def rows_as_poses(place: Callable[[int], str], rows: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
    """Poses from rows `t tx ty tz qx qy qz qw …`. Raises ValueError, naming the place."""
    size = np.abs(rows[:, 4:8]).max(axis=1)
    if (zero := np.flatnonzero(size == 0)).size:
        raise ValueError(f"{place(zero[0])}: the quaternion is zero, so it is not a rotation")
    far = ~((np.abs(rows).max(axis=1) <= LARGEST) & (size >= 1 / LARGEST))  # or not finite
    if (wrong := np.flatnonzero(far)).size:
        raise ValueError(
            f"{place(wrong[0])}: expected finite numbers up to {LARGEST:.0e} and a quaternion "
            f"longer than {1 / LARGEST:.0e}"
        )
    return poses(rows[:, 1:4], rows[:, 4:8])


_LATEST = 1e11
"""Seconds since 1970 of the year 5138."""


def check_seconds(what: str, times: Float[np.ndarray, " n"]) -> None:
    """Raise ValueError where times are too large to be seconds, since 1970 or from pose to pose."""
    last = float(np.abs(times).max())
    step = float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0
    # Seconds between two poses, more than a moving thing has.
    if last <= _LATEST and step <= 1e3:
        return
    by_size = ((1e17, "nanoseconds"), (1e14, "microseconds"), (0.0, "milliseconds"))
    by_step = ((1e6, "nanoseconds"), (0.0, "microseconds"))
    size, units = (last, by_size) if last > _LATEST else (step, by_step)
    unit = next(unit for least, unit in units if size >= least)
    told = f"up to {last:.3g}" if last > _LATEST else f"{step:.3g} from one to the next"
    raise ValueError(f"{what}: times {told} look like {unit}; expected seconds")


def not_rigid(T: Float[np.ndarray, "*k d d"], tolerance: float) -> Bool[np.ndarray, "*k"]:
    """The mask of matrices that are no [R t; 0 1] with R a rotation, to a tolerance."""
    n = T.shape[-1] - 1
    R = T[..., :n, :n]
    with np.errstate(over="ignore", invalid="ignore"):
        skewed = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(n)).max(axis=(-2, -1))
        turned_over = ~(np.linalg.det(R) > 0)
    return ~(skewed <= tolerance) | turned_over | (T[..., n, :] != np.eye(n + 1)[n]).any(axis=-1)


def text_lines(path: str | Path, what: str = "file", *, comments: bool = False) -> dict[int, str]:
    """The lines of a text file that are not empty, by their numbers, from 1; with the `comments`
    (#), or without. Raises ValueError for a file, called `what`, that is no text."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ValueError(f"{path}: cannot read the {what} ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: cannot be read as text") from None
    return {
        number: line.strip()
        for number, line in enumerate(lines, start=1)
        if line.strip() and (comments or not _is_comment(line))
    }


def read_table(
    path: str | Path,
    what: str,
    holds: str,
    row: str,
    columns: int | None,
    *,
    finite: bool = True,
    spare: bool = False,
) -> Table:
    """Lines of so many numbers, apart as in `words`, but for empty lines and comments (#).

    With None of as many as the first has; a line of words before it is a comment too. Rows may
    have `spare` numbers, which are left out, and all are finite, unless that is not asked for.
    Raises `ValueError`, naming the file and the line: it is a `what` that holds `holds`, and a
    `row` of it is what is accepted.
    """
    told = text_lines(path, what, comments=True)
    comments = {number: line for number, line in told.items() if _is_comment(line)}
    rows = {n: line for n, line in told.items() if n not in comments}
    if columns is None and rows:
        first = min(rows)
        if not any(numbers([word], 1, finite=False) for word in words(rows[first])):
            comments = {first: rows.pop(first)} | comments
        columns = len(words(rows[min(rows)])) if rows else 0
    if not rows:
        raise ValueError(f"{path} has no {holds}; expected lines of {row}")
    table = []
    for place, line in rows.items():
        found = numbers(words(line)[: columns if spare else None], columns or 0, finite=finite)
        if found is None:
            raise ValueError(f"{path}, line {place}: expected {row}")
        table.append(found)
    return Table(tuple(comments.values()), np.array(table), tuple(rows))


def words(line: str) -> list[str]:
    """Apart by spaces, by commas, or by semicolons, as where a comma is in a number."""
    return line.replace(";" if ";" in line else ",", " ").split()


def numbers(told: Sequence[str], count: int, *, finite: bool = True) -> list[float] | None:
    """Read words as `count` numbers, finite unless that is not asked for; None if they are not."""
    try:
        found = [float(word) for word in told]
    except ValueError:
        return None
    whole = len(found) == count and (not finite or all(map(math.isfinite, found)))
    return found if whole else None


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def write_tum(path: str | Path, times: ArrayLike, T_wc: ArrayLike, remark: str = "") -> None:
    """Write times (n,) in seconds and poses (n, 4, 4) in TUM format, whole or not at all.

    Quaternions are normalised, w comes last and is not negative. The `remark` is for the header.
    """
    T_wc = np.asarray(T_wc, dtype=float).reshape(-1, 4, 4)
    table = np.empty((len(T_wc), 7))
    table[:, :3] = T_wc[:, :3, 3]
    table[:, 3:] = quaternions(T_wc[:, :3, :3])
    remark = f"; {remark}" if remark else ""
    header = f"tx ty tz qx qy qz qw (s; camera in the world frame{remark})"
    write_table(path, header, times, table, "poses", ".9f")


def write_table(
    path: str | Path, header: str, times: ArrayLike, table: np.ndarray, what: str, number: str
) -> None:
    """A line of each time and row, under a comment that names the columns after the time."""
    times = np.asarray(times, dtype=float)
    if times.shape != (len(table),):
        raise ValueError(f"{len(times)} times for {len(table)} {what}; their numbers must be equal")
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f"# t {header}\n")
        for time, row in zip(times, table, strict=True):
            file.write(f"{time:.9f} " + " ".join(format(value, number) for value in row) + "\n")


WITH_COVARIANCE = 20
"""Numbers of a line of OpenVINS's `pose_to_file`: `t p q`, and the upper triangles of Pr and Pp."""
_STATE, _CAMERA = 19, 15
"""Numbers of a line of OpenVINS's states, and more for each camera."""
_TUM = 8
_ROWS = {
    4: "four finite numbers t x y θ (s, m, rad)",
    12: "12 finite numbers, the rows of a 3x4 T_wc (KITTI)",
    WITH_COVARIANCE: "20 finite numbers t tx ty tz qx qy qz qw, 6 of Pr and 6 of Pp (OpenVINS)",
}


def width(path: Path) -> int:
    """How many numbers, or words, the first line has that is no comment; 0 of an empty file."""
    for line in text_lines(path).values():
        return len(words(line))
    return 0


def read_log(
    path: Path,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n d d"], Float[np.ndarray, "m t t"]]:
    """Times (n,) in s, poses (n, 4, 4), or (n, 3, 3) in the plane, in m, and their covariances.

    A line is `t tx ty tz qx qy qz qw` (TUM), `t x y θ`, or the rows of a 3x4 T_wc (KITTI; times are
    those of `times.txt` beside it, else the number of the line, from 0). It may also be `t p q`
    with the upper triangles of the covariances of orientation and position (OpenVINS's
    `pose_to_file`), or `t q p` and more (its states). Its quaternions of JPL have the numbers of
    Hamilton's, of the body in the
    world. Covariances (n, 6, 6), of the error `split` along `mixed` axes, position first, are those
    of `pose_to_file`; other files have none, (0, 6, 6). Raises ValueError, naming file and line.
    """
    none, columns = np.empty((0, 6, 6)), width(path)
    if columns >= _STATE and (columns - _STATE) % _CAMERA == 0:
        row = f"{columns} finite numbers t, q, p and the rest of OpenVINS's state"
    elif columns in _ROWS:
        row = _ROWS[columns]
    else:
        return *read_tum(path), none
    _, rows, lines = read_table(path, "trajectory", "poses", row, columns)
    if columns == 4:
        return rows[:, 0], _planar(path, rows, lines), none
    if columns == 12:
        return _times(path, len(rows)), _matrices(path, rows, lines), none
    if columns != WITH_COVARIANCE:
        rows = rows[:, [0, 5, 6, 7, 1, 2, 3, 4]]
    T = rows_as_poses(lambda i: f"{path}, line {lines[i]}", rows[:, :_TUM])
    return rows[:, 0], T, _blocks(rows[:, _TUM:]) if columns == WITH_COVARIANCE else none


def _planar(path: Path, rows: np.ndarray, lines: tuple[int, ...]) -> Float[np.ndarray, "n 3 3"]:
    far = np.flatnonzero(np.abs(rows).max(axis=1) > LARGEST)
    if far.size:
        raise ValueError(f"{path}, line {lines[far[0]]}: expected numbers up to {LARGEST:.0e}")
    return of_xytheta(rows[:, 1:])


def of_xytheta(poses: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Matrices of poses x, y, θ in the plane; NaN of NaN."""
    x, y, angle = np.moveaxis(poses, -1, 0)
    with np.errstate(invalid="ignore"):
        c, s, zero = np.cos(angle), np.sin(angle), 0 * angle
    rows = (c, -s, x), (s, c, y), (zero, zero, zero + 1)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _matrices(path: Path, rows: np.ndarray, lines: tuple[int, ...]) -> Float[np.ndarray, "n 4 4"]:
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows.reshape(-1, 3, 4)
    wrong = np.flatnonzero(not_rigid(T, 1e-3) | ~(np.abs(rows).max(axis=1) <= LARGEST))
    if wrong.size:
        place = f"{path}, line {lines[wrong[0]]}"
        raise ValueError(
            f"{place}: not a rigid motion [R t] with a rotation R; expected {_ROWS[12]}"
        )
    left, _, right = np.linalg.svd(T[:, :3, :3])  # rounding to six digits, taken away
    T[:, :3, :3] = left @ right
    return T


def _times(path: Path, poses: int) -> Float[np.ndarray, " n"]:
    beside = path.parent / "times.txt"
    if not beside.is_file():
        return np.arange(float(poses))
    times = read_table(beside, "times", "times", "finite times in seconds", 1).rows[:, 0]
    if len(times) != poses:
        raise ValueError(f"{beside} has {len(times)} times for the {poses} poses of {path}")
    return times


def _blocks(rows: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 6 6"]:
    """Covariances, position first, of the triangles of the orientation's and the position's."""
    P = np.zeros((len(rows), 6, 6))
    i, j = np.triu_indices(3)
    P[:, 3 + i, 3 + j] = P[:, 3 + j, 3 + i] = rows[:, :6]
    P[:, i, j] = P[:, j, i] = rows[:, 6:]
    return P
