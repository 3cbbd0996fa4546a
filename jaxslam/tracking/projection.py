"""Where a map's landmarks are in a picture, and how sure that is."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from jaxslam.io.calibration import Calibration


def seen_from(
    T_wc: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    calibration: Calibration,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Pixels (u, v) of landmarks in the world frame, and their covariances to first order, px².

    u = π(R_cw X + t), P_u = J P_X Jᵀ with J = ∂π/∂t R_cw: the camera is taken to be where T_wc
    says, and the spread is the landmark's alone. Not a number for what is behind the camera or
    out of the picture.
    """
    T_cw = np.linalg.inv(T_wc)
    behind = points @ T_cw[2, :3] + T_cw[2, 3] <= 0
    if behind.all():
        return np.full((len(points), 2), np.nan), np.full((len(points), 2, 2), np.nan)
    turned, moved = cv2.Rodrigues(T_cw[:3, :3])[0], T_cw[:3, 3]
    lens = np.array(calibration.distortion)
    flat = np.ascontiguousarray(points)
    pixels, jacobian = cv2.projectPoints(flat, turned, moved, calibration.matrix, lens)
    pixels = pixels[:, 0]
    J = jacobian[:, 3:6].reshape(-1, 2, 3) @ T_cw[:3, :3]
    size = np.array([calibration.width, calibration.height])
    inside = np.all((pixels >= 0) & (pixels <= size - 1), axis=1) & ~behind
    spread = J @ covariances @ np.swapaxes(J, 1, 2)
    return (
        np.where(inside[:, None], pixels, np.nan),
        np.where(inside[:, None, None], spread, np.nan),
    )
