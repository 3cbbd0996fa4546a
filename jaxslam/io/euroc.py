"""EuRoC's layout (ASL): `mav0/cam0` with its `sensor.yaml`, and the body's true motion.

Burri et al., IJRR 2016. The truth is of the body; the camera is at T_BS in it. TUM-VI's has no
`sensor.yaml`; its lens is in `dso/camchain.yaml`.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import one_line
from jaxslam.io.lens_files import read_calibration
from jaxslam.io.recording import (
    Layout,
    Recording,
    check_rigid,
    fixed,
    listed,
    of_files,
    read_timestamps,
)
from jaxslam.io.source import Trajectory
from jaxslam.io.text import numbers, read_table, text_lines
from jaxslam.io.tum import poses

NANOSECONDS = 1e9
TRUTH = "state_groundtruth_estimate0"


def _open(path: Path, _rate: float) -> Recording:
    root = _root(path)
    camera = root / "cam0"
    listing = camera / "data.csv"
    times, names = read_timestamps(listing, NANOSECONDS, ",")
    files = listed(listing, camera / "data", names)
    yaml, truth = camera / "sensor.yaml", root / TRUTH / "data.csv"
    lenses = (x for x in (yaml, path / "dso" / "camchain.yaml") if x.is_file())  # or TUM-VI's
    calibration = next((fixed(read_calibration(x)) for x in lenses), None)
    reference = _camera_truth(truth, yaml) if truth.is_file() and yaml.is_file() else None
    return of_files(path, files, times, calibration, reference)


def _root(path: Path) -> Path:
    """The folder with `cam0`: `mav0`, or the one given."""
    return path / "mav0" if (path / "mav0").is_dir() else path


def _camera_truth(truth: Path, yaml: Path) -> Trajectory:
    """`T_WS = T_WB T_BS`, of rows `ns, px, py, pz, qw, qx, qy, qz`."""
    T_BS = np.reshape(_numbers(yaml, "\n".join(text_lines(yaml).values()), "data", 16), (4, 4))
    check_rigid(yaml, T_BS[None])
    columns = "eight finite numbers ns px py pz qw qx qy qz"
    table = read_table(truth, "truth", "poses", columns).numbers(columns, range(8))
    try:
        T_WB = poses(table[:, 1:4], table[:, [5, 6, 7, 4]])
    except ValueError as error:
        raise ValueError(f"{truth}: {one_line(error)}") from None
    check_rigid(truth, T_WB)
    return Trajectory(table[:, 0] / NANOSECONDS, T_WB @ T_BS)


def _numbers(path: Path, text: str, key: str, count: int) -> Float[np.ndarray, " n"]:
    """The list of numbers `key: [1, 2, …]`, over as many lines as it takes."""
    found = re.search(rf"^{key}:\s*\[([^\]]*)\]", text, re.MULTILINE)
    told = numbers(found[1].split(",") if found else [], count)
    if told is None:
        raise ValueError(f"{path}: {key}: [{count} finite numbers] is missing")
    return np.array(told)


EUROC = Layout(
    "EuRoC (mav0/cam0/data.csv)", lambda path: (_root(path) / "cam0" / "data.csv").is_file(), _open
)
