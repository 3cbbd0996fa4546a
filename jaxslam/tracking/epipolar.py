"""The test of which matches of two pictures can be of one rigid scene, whatever its depths."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jaxslam.io.calibration import Calibration

MINIMAL = 5
"""Matches through which there always is an essential matrix."""
CONFIDENCE = 0.9999


def of_one_motion(
    before: Float[np.ndarray, "m 2"],
    now: Float[np.ndarray, "m 2"],
    calibration: Calibration,
    sigma: float,
) -> Bool[np.ndarray, " m"]:
    """Return those near the epipolar lines of the essential matrix with the most of them near, by
    MAGSAC++ (Barath et al., CVPR 2020) in OpenCV; `sigma` is a pixel's. None of fewer than six.

    Neither a prior on depth nor one on the motion is needed, and no linear prediction.
    """
    if len(before) <= MINIMAL:
        return np.zeros(len(before), bool)
    K, distortion = calibration.matrix, np.array(calibration.distortion, float)
    pixels = [cv2.undistortPoints(x[:, None], K, distortion, P=K)[:, 0] for x in (before, now)]
    E, inside = cv2.findEssentialMat(
        *pixels, K, method=cv2.USAC_MAGSAC, prob=CONFIDENCE, threshold=3 * sigma
    )
    return np.zeros(len(before), bool) if E is None else inside[:, 0].astype(bool)
