"""The map as a point cloud file: landmarks with their covariances in PLY."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.files import write_atomically

_PROPERTIES = ("x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")


def write_ply(path: str | Path, points: ArrayLike, covariances: ArrayLike, ids: ArrayLike) -> None:
    """Write points (n, 3) in metres in the world frame as ASCII PLY, whole or not at all.

    `covariances` (n, 3, 3) in metres^2 become six properties (the upper triangle, row by row),
    `ids` (n,) whole numbers. Raises `ValueError` where the numbers of rows differ or a point is
    not finite, which no viewer reads.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    covariances = np.asarray(covariances, dtype=float).reshape(-1, 3, 3)
    ids = np.asarray(ids, dtype=np.int64).reshape(-1)
    if not len(points) == len(covariances) == len(ids):
        raise ValueError(
            f"{len(points)} points, {len(covariances)} covariances and {len(ids)} ids; "
            "as many of each are accepted"
        )
    table = np.column_stack([points, covariances[:, *np.triu_indices(3)]])
    if not np.all(np.isfinite(table)):
        raise ValueError("a point or covariance is not finite; leave such landmarks out")
    header = [
        "ply",
        "format ascii 1.0",
        "comment landmarks in the world frame, m; covariance in m^2",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in _PROPERTIES),
        "property int id",
        "end_header",
    ]
    rows = [
        " ".join(f"{value:.9g}" for value in row) + f" {number}"
        for row, number in zip(table, ids, strict=True)
    ]
    with write_atomically(path) as temporary:
        temporary.write_text("\n".join(header + rows) + "\n", encoding="ascii")
