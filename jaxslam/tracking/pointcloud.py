"""The map as a point cloud file: landmarks with their covariances in PLY."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxslam._runtime.files import write_atomically

_PROPERTIES = ("x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")


def write_ply(
    path: str | Path,
    points: ArrayLike,
    covariances: ArrayLike,
    ids: ArrayLike,
    maps: ArrayLike | None = None,
) -> None:
    """Write points (n, 3) in map units in the world frame as ASCII PLY, whole or not at all.

    `covariances` (n, 3, 3) in units^2 become six properties (the upper triangle, row by row),
    `ids` (n,) and `maps` (n,), the number of each point's map (0), whole numbers. Raises
    `ValueError` where the numbers of rows differ or a point is not finite, which no viewer reads.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    covariances = np.asarray(covariances, dtype=float).reshape(-1, 3, 3)
    ids = np.asarray(ids, dtype=np.int64).reshape(-1)
    maps = np.zeros_like(ids) if maps is None else np.asarray(maps, dtype=np.int64).reshape(-1)
    if not len(points) == len(covariances) == len(ids) == len(maps):
        raise ValueError(
            f"{len(points)} points, {len(covariances)} covariances, {len(ids)} ids and "
            f"{len(maps)} maps; as many of each are accepted"
        )
    table = np.column_stack([points, covariances[:, *np.triu_indices(3)]])
    if not np.all(np.isfinite(table)):
        raise ValueError("a point or covariance is not finite; leave such landmarks out")
    header = [
        "ply",
        "format ascii 1.0",
        "comment landmarks in the world frame; one unit of length a map, another in every map, as",
        "comment in trajectory.txt, and covariances are of positions in that unit",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in _PROPERTIES),
        "property int id",
        "property int map",
        "end_header",
    ]
    rows = [
        " ".join(f"{value:.9g}" for value in row) + f" {number} {map_number}"
        for row, number, map_number in zip(table, ids, maps, strict=True)
    ]
    with write_atomically(path) as temporary:
        temporary.write_text("\n".join(header + rows) + "\n", encoding="ascii")


class Cloud(NamedTuple):
    """What a file of `write_ply` holds."""

    points: Float[np.ndarray, "n 3"]
    """Map units, in the world frame."""
    covariances: Float[np.ndarray, "n 3 3"]
    ids: Int[np.ndarray, " n"]
    maps: Int[np.ndarray, " n"]


def read_ply(path: str | Path) -> Cloud:
    """Read what `write_ply` wrote. Raises `ValueError` for any other file."""
    path = Path(path)
    try:
        header, _, rows = path.read_text(encoding="ascii").partition("end_header\n")
        table = np.array([row.split() for row in rows.splitlines()], dtype=float)
    except (OSError, ValueError):
        header, table = "", np.zeros(0)
    named = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    table = table.reshape(-1, len(_PROPERTIES) + 2) if not table.size else table
    if named != [*_PROPERTIES, "id", "map"] or table.shape[1:] != (len(named),):
        raise ValueError(f"{path} is not a map.ply as jaxslam track writes it")
    covariances = np.zeros((len(table), 3, 3))
    upper = np.triu_indices(3)
    covariances[:, *upper] = covariances[:, *upper[::-1]] = table[:, 3:9]
    return Cloud(table[:, :3], covariances, table[:, 9].astype(int), table[:, 10].astype(int))
