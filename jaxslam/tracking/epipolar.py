"""The test of which matches of two pictures can be of one rigid scene, whatever its depths."""

import cv2
import numpy as np
from jaxtyping import Bool

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.optics import on_pinhole
from jaxslam.tracking.pose_with_covariance import Places

MINIMAL = 5
"""Matches through which there always is an essential matrix."""
CONFIDENCE = 0.9999


def of_one_motion(
    before: Places, now: Places, calibration: Calibration, sigma: float
) -> Bool[np.ndarray, " n"]:
    """Return those near the epipolar lines of the essential matrix with the most of them near, by
    MAGSAC++ (Barath et al., CVPR 2020) in OpenCV; `sigma` is a pixel's. None of fewer than six,
    and none far from the axis of a fisheye.

    Neither a prior on depth nor one on the motion is needed, and no linear prediction.
    """
    (first, inside), (second, within) = (on_pinhole(calibration, x) for x in (before, now))
    near = inside & within
    if near.sum() <= MINIMAL:
        return np.zeros(len(before), bool)
    E, agree = cv2.findEssentialMat(
        first[near], second[near], calibration.matrix, method=cv2.USAC_MAGSAC, prob=CONFIDENCE,
        threshold=3 * sigma,
    )  # fmt: skip
    near[near] = False if E is None else agree[:, 0].astype(bool)
    return near
