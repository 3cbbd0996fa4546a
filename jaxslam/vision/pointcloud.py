"""The map as a point cloud file: landmarks with their covariances in PLY."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.files import write_atomically

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
        "comment landmarks in the world frame; every map has a unit of length of its own, and",
        "comment covariances are given that unit",
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
