"""Microsoft's 7-Scenes: `frame-XXXXXX.color.png` with a pose beside each, at 30 Hz.

Shotton et al., CVPR 2013. The lens is the data set's nominal one; a picture's pose, of the depth
camera, is taken for the colour camera's.
"""

from pathlib import Path

import numpy as np

from jaxslam.io.calibration import Calibration
from jaxslam.io.recording import Layout, Recording, check_rigid, fixed, of_files
from jaxslam.io.source import Trajectory
from jaxslam.io.text import read_table

RATE = 30.0
CAMERA = Calibration(640, 480, 585.0, 585.0, 320.0, 240.0)
PICTURE, POSE = ".color.png", ".pose.txt"


def _open(path: Path, _rate: float) -> Recording:
    files = sorted(path.glob(f"frame-*{PICTURE}"))
    times = np.array([_number(file) for file in files]) / RATE
    return of_files(path, files, times, fixed(CAMERA), _truth(files, times))


def _number(file: Path) -> int:
    """The XXXXXX of a frame's name: a picture left out leaves a gap in time."""
    number = file.name.removeprefix("frame-").removesuffix(PICTURE)
    if not number.isdecimal():
        raise ValueError(f"{file}: expected the name frame-NUMBER{PICTURE}")
    return int(number)


def _truth(files: list[Path], times: np.ndarray) -> Trajectory | None:
    """T_wc of the frames that have one; where tracking failed, it is not finite."""
    stems = [file.with_name(file.name.removesuffix(PICTURE) + POSE) for file in files]
    known = [place for place, stem in enumerate(stems) if stem.is_file()]
    T_wc = np.array([_pose(stems[place]) for place in known]).reshape(-1, 4, 4)
    finite = np.isfinite(T_wc).all(axis=(1, 2))
    for place, T in zip(np.array(known, int)[finite], T_wc[finite], strict=True):
        check_rigid(stems[place], T[None])
    return Trajectory(times[known][finite], T_wc[finite]) if finite.any() else None


def _pose(path: Path) -> np.ndarray:
    row = "four numbers, a row of a 4x4 matrix,"
    matrix = read_table(path, "pose", "pose", row).rows[:, :4]
    if matrix.shape != (4, 4):
        raise ValueError(f"{path} has {len(matrix)} rows; expected a 4x4 matrix")
    return matrix


SEVEN_SCENES = Layout(
    "7-Scenes (frame-XXXXXX.color.png)",
    lambda path: path.is_dir() and any(path.glob(f"frame-*{PICTURE}")),
    _open,
)
