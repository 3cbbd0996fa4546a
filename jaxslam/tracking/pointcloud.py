"""The map as a point cloud: landmarks with covariances as a PLY file, and laid over pictures."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxslam._runtime.files import write_text
from jaxslam.io.calibration import Calibration
from jaxslam.io.logs.log import symmetric
from jaxslam.tracking.optics import sighted
from jaxslam.tracking.pose_with_covariance import Places, Positions, Spreads, Transform

_PROPERTIES = ("x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")


def write_ply(
    path: str | Path,
    points: ArrayLike,
    covariances: ArrayLike,
    ids: ArrayLike,
    maps: ArrayLike,
) -> None:
    """Write points (n, 3) in map units in the world frame as ASCII PLY, whole or not at all.

    `covariances` (n, 3, 3) in units^2 become six properties (the upper triangle, row by row),
    `ids` (n,) and `maps` (n,), the number of each point's map, whole numbers. Raises
    `ValueError` where the numbers of rows differ or a point is not finite, which no viewer reads.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    covariances = np.asarray(covariances, dtype=float).reshape(-1, 3, 3)
    ids = np.asarray(ids, dtype=np.int64).reshape(-1)
    maps = np.asarray(maps, dtype=np.int64).reshape(-1)
    if not len(points) == len(covariances) == len(ids) == len(maps):
        raise ValueError(
            f"{len(points)} points, {len(covariances)} covariances, {len(ids)} ids and "
            f"{len(maps)} maps; their numbers must be equal"
        )
    table = np.column_stack([points, covariances[:, *np.triu_indices(3)]])
    if not np.all(np.isfinite(table)):
        raise ValueError("a point or covariance is not finite; leave such landmarks out")
    header = [
        "ply",
        "format ascii 1.0",
        "comment landmarks in the world frame, positions and covariances in the unit of each map,",
        "comment as in trajectory.txt",
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
    write_text(path, "\n".join(header + rows) + "\n")


class Cloud(NamedTuple):
    """The content of a file of `write_ply`."""

    points: Positions
    """Map units, in the world frame."""
    covariances: Spreads
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
    covariances = symmetric(table[:, 3:9], np.transpose(np.triu_indices(3)), 3)
    return Cloud(table[:, :3], covariances, table[:, 9].astype(int), table[:, 10].astype(int))


def seen_from(
    T_wc: Transform, points: Positions, covariances: Spreads, calibration: Calibration
) -> tuple[Places, Float[np.ndarray, "n 2 2"]]:
    """Pixels (u, v) of landmarks in the world frame, and their covariances to first order, px².

    u = π(R_cw X + t), P_u = J P_X Jᵀ with J = ∂π/∂t R_cw: the camera is taken to be where T_wc
    says, and the spread is the landmark's alone. Not a number for what the lens does not see or is
    out of the picture.
    """
    R_wc = T_wc[:3, :3]
    pixels, slopes, seen = sighted(calibration, (points - T_wc[:3, 3]) @ R_wc)
    J = slopes[:, :2] @ R_wc.T
    size = np.array([calibration.width, calibration.height])
    inside = np.all((pixels >= 0) & (pixels <= size - 1), axis=1) & seen
    return (
        np.where(inside[:, None], pixels, np.nan),
        np.where(inside[:, None, None], J @ covariances @ np.swapaxes(J, 1, 2), np.nan),
    )
