"""Trajectories as text in the format of TUM's benchmark: `t tx ty tz qx qy qz qw` a line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST, write_text
from jaxslam.io.text import read_table

Times = Float[np.ndarray, " n"]
"""Times of poses or of other rows, s, or in a unit yet to be found."""


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
    return transforms(rotation.as_matrix(), np.broadcast_to(translation, (len(rotation), 3)))


def transforms(R: Float[np.ndarray, "*n 3 3"], p: np.ndarray) -> Float[np.ndarray, "*n 4 4"]:
    """Matrices [R p; 0 1] of rotations and of positions, (…, 3) or (…, 3, 1)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p.reshape(*R.shape[:-1]), 1.0
    return T


def read_tum(path: str | Path) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Times (n,) in seconds and poses T_wc (n, 4, 4) from lines `t tx ty tz qx qy qz qw`.

    Empty lines and those that start with # are skipped. Raises `ValueError`, naming the file and
    the line, for anything else that is not eight finite numbers with a non-zero quaternion.
    """
    expected = "eight finite numbers t tx ty tz qx qy qz qw"
    table = read_table(path, "trajectory", "poses", expected)
    rows = table.numbers(expected, range(8), spare=False)
    return rows[:, 0], rows_as_poses(table.place, rows)


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


def not_rigid(T: Float[np.ndarray, "*k d d"], tolerance: float) -> Bool[np.ndarray, "*k"]:
    """The mask of matrices that are no [R t; 0 1] with R a rotation, to a tolerance."""
    n = T.shape[-1] - 1
    R = T[..., :n, :n]
    with np.errstate(over="ignore", invalid="ignore"):
        skewed = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(n)).max(axis=(-2, -1))
        turned_over = ~(np.linalg.det(R) > 0)
    return ~(skewed <= tolerance) | turned_over | (T[..., n, :] != np.eye(n + 1)[n]).any(axis=-1)


def write_tum(path: str | Path, times: ArrayLike, T_wc: ArrayLike, remark: str = "") -> None:
    """Write times (n,) in seconds and poses (n, 4, 4) in TUM format, whole or not at all."""
    write_text(path, tum_text(times, T_wc, remark))


def tum_text(times: ArrayLike, T_wc: ArrayLike, remark: str = "") -> str:
    """Times (n,) in seconds and poses (n, 4, 4) in TUM format.

    Quaternions are normalised, w comes last and is not negative. The `remark` is for the header.
    """
    T_wc = np.asarray(T_wc, dtype=float).reshape(-1, 4, 4)
    table = np.column_stack([T_wc[:, :3, 3], quaternions(T_wc[:, :3, :3])])
    remark = f"; {remark}" if remark else ""
    header = f"tx ty tz qx qy qz qw (s; camera in the world frame{remark})"
    return table_text(header, times, table, "poses", ".9f")


def table_text(header: str, times: ArrayLike, table: np.ndarray, what: str, number: str) -> str:
    """A line of each time and row, under a comment that names the columns after the time."""
    times = np.asarray(times, dtype=float)
    if times.shape != (len(table),):
        raise ValueError(f"{len(times)} times for {len(table)} {what}; their numbers must be equal")
    rows = (" ".join(format(value, number) for value in row) for row in table)
    lines = (f"{time:.9f} {row}\n" for time, row in zip(times, rows, strict=True))
    return f"# t {header}\n{''.join(lines)}"


def of_xytheta(poses: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Matrices of poses x, y, θ in the plane; NaN of NaN."""
    x, y, angle = np.moveaxis(poses, -1, 0)
    with np.errstate(invalid="ignore"):
        c, s, zero = np.cos(angle), np.sin(angle), 0 * angle
    rows = (c, -s, x), (s, c, y), (zero, zero, zero + 1)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
