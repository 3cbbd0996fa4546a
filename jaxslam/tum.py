"""Trajectories as text in the format of TUM's benchmark: `t tx ty tz qx qy qz qw` a line."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def poses(translation: ArrayLike, quaternion: ArrayLike) -> Float[np.ndarray, "n 4 4"]:
    """Poses from positions (n, 3) and quaternions x, y, z, w (n, 4), which get normalised."""
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
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ValueError(f"{path}: cannot read the trajectory ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file") from None
    rows = [
        _tum_row(path, number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise ValueError(f"{path}: holds no poses; lines of t tx ty tz qx qy qz qw are accepted")
    table = np.array(rows)
    return table[:, 0], poses(table[:, 1:4], table[:, 4:])


def _tum_row(path: Path, number: int, line: str) -> list[float]:
    try:
        row = [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        row = []
    if len(row) != 8 or not np.all(np.isfinite(row)):
        raise ValueError(
            f"{path}, line {number}: eight finite numbers t tx ty tz qx qy qz qw are accepted"
        )
    if not any(row[4:]):
        raise ValueError(f"{path}, line {number}: the quaternion is zero")
    return row
