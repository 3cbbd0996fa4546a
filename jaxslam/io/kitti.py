"""KITTI's odometry benchmark: a sequence's `times.txt`, `calib.txt`, images, and the poses.

Geiger, Lenz, Urtasun, CVPR 2012. Of the cameras the left grey one is taken (`image_0`), or else
the left colour one (`image_2`); poses are of the former.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam.io.calibration import Calibration
from jaxslam.io.recording import (
    Calibrator,
    Layout,
    Recording,
    check_rigid,
    image_files,
    of_files,
    read_timestamps,
)
from jaxslam.io.source import Trajectory
from jaxslam.io.text import read_table, table_of, text_lines
from jaxslam.io.tum import Times, transforms

CAMERAS = ("0", "2")


def _open(path: Path, _rate: float) -> Recording:
    camera = next(number for number in CAMERAS if (path / f"image_{number}").is_dir())
    files = image_files(path / f"image_{camera}")
    times, _ = read_timestamps(path / "times.txt")
    calib = path / "calib.txt"
    projection = _projection(calib, camera) if calib.is_file() else None
    calibration = None if projection is None else _calibrator(projection)
    truth = next((file for file in _poses_of(path) if file.is_file()), None)
    reference = None if truth is None else _camera_truth(truth, times, projection)
    return of_files(path, files, times, calibration, reference)


def _projection(path: Path, camera: str) -> Float[np.ndarray, "3 4"]:
    """P of a line `P0: ` and twelve numbers: `pixel ~ P X`, X in the left grey camera's frame."""
    for number, line in text_lines(path).items():
        name, _, rest = line.partition(":")
        if name.strip() == f"P{camera}":
            row = f"P{camera}: and twelve numbers"
            told = table_of(path, {number: rest}, "matrix", row).numbers(
                row, range(12), spare=False
            )
            P = told.reshape(3, 4)
            if not (np.diagonal(P) != 0).all():
                wrong = "not a projection matrix with a positive focal length"
                raise ValueError(f"{path}, line {number}: {wrong}")
            return P
    raise ValueError(f"{path} has no line P{camera}: for the images in image_{camera}")


def _calibrator(P: Float[np.ndarray, "3 4"]) -> Calibrator:
    """The images are rectified: K is the left part of P."""
    numbers = float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2])
    return lambda width, height: Calibration(width, height, *numbers)


def _poses_of(path: Path) -> tuple[Path, Path]:
    """The file of a sequence's poses: beside its images, or in the benchmark's own folder."""
    sequence = path.resolve()
    return path / "poses.txt", sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def _camera_truth(path: Path, times: Times, P: Float[np.ndarray, "3 4"] | None) -> Trajectory:
    """Rows of a 3x4 T_wc; camera c is at `-K⁻¹ P₄` in the left grey one, unturned."""
    row = "12 finite numbers, the rows of a 3x4 T_wc"
    rows = read_table(path, "poses", "poses", row).numbers(row, range(12)).reshape(-1, 3, 4)
    if len(rows) != len(times):
        raise ValueError(f"{path} has {len(rows)} lines for {len(times)} times")
    T_wc = transforms(rows[:, :, :3], rows[:, :, 3])
    check_rigid(path, T_wc)
    if P is not None:
        T_wc[:, :3, 3] -= rows[:, :, :3] @ np.linalg.solve(P[:, :3], P[:, 3])
    return Trajectory(times, T_wc)


KITTI = Layout(
    "KITTI odometry (times.txt and image_0/)",
    lambda path: (
        (path / "times.txt").is_file()
        and any((path / f"image_{number}").is_dir() for number in CAMERAS)
    ),
    _open,
)
