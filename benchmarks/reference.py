"""What a sequence's pictures say of the orientations of its reference.

    python benchmarks/reference.py ../shared/data/kitti06_first51

Hundreds of corners are followed from frame to frame, there and back, and the rotation between two
frames is that of the essential matrix which most of them agree with: no filter, and no prior, takes
part. Where nearly all agree to a pixel with a rotation that is not the reference's, a NEES against
that reference measures the reference. Only of pictures between which the camera moves: of a short
baseline the rotation is not known.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import tyro
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jaxslam.io.opening import open_source

CORNERS = 1500
APART = 7.0
"""Pixels between corners."""
RETURNED = 0.3
"""Pixels: a corner that is followed back to farther from where it was is none."""
NEAR = 1.0
"""Pixels from its epipolar line within which a corner agrees."""


def followed(
    before: UInt8[np.ndarray, "h w"], now: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "k 1 2"], Float[np.ndarray, "k 1 2"]]:
    """Corners of a picture and where they are in another one."""
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.003, APART)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, corners.copy(), maxLevel=5)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, there.copy(), maxLevel=5)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < RETURNED
    kept = (found[:, 0] > 0) & (found_back[:, 0] > 0) & returned
    return corners[kept], there[kept]


def rotation(
    before: Float[np.ndarray, "k 1 2"], now: Float[np.ndarray, "k 1 2"], K: np.ndarray
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """R of the motion X' = R X + t, and the share of the corners that agree with it."""
    E, near = cv2.findEssentialMat(
        before, now, K, method=cv2.USAC_MAGSAC, prob=0.99999, threshold=NEAR
    )
    _, R, _, _ = cv2.recoverPose(E, before, now, K, mask=near.copy())
    return R, float(np.mean(near > 0))


def main(sequence: tyro.conf.Positional[Path], frames: int = 15, every: int = 1) -> None:
    """Print, frame by frame, how far the reference is turned against the pictures.

    Args:
        sequence: Data set folder with a reference.
        frames: Frames that are compared.
        every: Frames from one to the next.
    """
    source = open_source(sequence)
    if source.reference is None:
        raise SystemExit(f"{sequence}: there is no reference")
    K, distortion = source.calibration.matrix, np.array(source.calibration.distortion, float)
    whole, line = np.eye(3), "{:5d}  {:7d}  {:5.2f}  {:14.3f}  {:20.2f}".format
    compared = [f for f in source if f.index % every == 0][:frames]
    nearest = [np.argmin(np.abs(source.reference.times - frame.time)) for frame in compared]
    truth = source.reference.T_wc[nearest]
    print("frame  corners  agree  this step, deg  since the first, deg")
    for i in range(1, len(compared)):
        corners = followed(compared[i - 1].image, compared[i].image)
        R, agree = rotation(*(cv2.undistortPoints(x, K, distortion, P=K) for x in corners), K)
        whole = R @ whole
        step, since = (np.linalg.inv(truth[i]) @ truth[j] for j in (i - 1, 0))
        degrees = [
            Rotation.from_matrix(ours @ T[:3, :3].T).magnitude() * 180 / np.pi
            for ours, T in ((R, step), (whole, since))
        ]
        count = len(corners[0])
        print(line(compared[i].index, count, agree, *degrees))


if __name__ == "__main__":
    tyro.cli(main)
