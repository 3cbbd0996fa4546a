"""EuRoC's layout (ASL): `mav0/cam0` with its `sensor.yaml`, and the body's true motion.

Burri et al., IJRR 2016. The truth is of the body; the camera is at T_BS in it. TUM-VI's has no
`sensor.yaml`; its lens is in `dso/camchain.yaml`.
"""

from pathlib import Path

from jaxslam.io.imu_calibration import pose_of_keys
from jaxslam.io.lens_files import read_calibration, yaml_keys
from jaxslam.io.recording import Layout, Recording, fixed, listed, of_files, read_timestamps
from jaxslam.io.source import Trajectory
from jaxslam.io.text import read_table
from jaxslam.io.tum import rows_as_poses

NANOSECONDS = 1e9
TRUTH = "state_groundtruth_estimate0"
KEY = "T_BS.data"


def _open(path: Path, _rate: float) -> Recording:
    camera = _camera(path) or path
    root, listing = camera.parent, camera / "data.csv"
    times, names = read_timestamps(listing)
    files = listed(listing, camera / "data", names)
    yaml, truth = camera / "sensor.yaml", root / TRUTH / "data.csv"
    lenses = (x for x in (yaml, path / "dso" / "camchain.yaml") if x.is_file())  # or TUM-VI's
    calibration = next((fixed(read_calibration(x)) for x in lenses), None)
    reference = _camera_truth(truth, yaml) if truth.is_file() and yaml.is_file() else None
    return of_files(path, files, times, calibration, reference)


def _camera(path: Path) -> Path | None:
    """The folder of the camera: `mav0/cam0`, `cam0`, or the one given."""
    places = (path / "mav0" / "cam0", path / "cam0", path)
    return next((x for x in places if (x / "data.csv").is_file() and (x / "data").is_dir()), None)


def _camera_truth(truth: Path, yaml: Path) -> Trajectory:
    """`T_WS = T_WB T_BS`, of rows `ns, px, py, pz, qw, qx, qy, qz`."""
    T_BS = pose_of_keys(yaml, yaml_keys(yaml), {KEY: False})
    if T_BS is None:
        raise ValueError(f"{yaml}: {KEY}: [16 finite numbers] is missing")
    columns = "eight finite numbers ns px py pz qw qx qy qz"
    table = read_table(truth, "truth", "poses", columns)
    rows = table.numbers(columns, (0, 1, 2, 3, 5, 6, 7, 4))
    return Trajectory(rows[:, 0] / NANOSECONDS, rows_as_poses(table.place, rows) @ T_BS)


EUROC = Layout("EuRoC (mav0/cam0/data.csv)", lambda path: _camera(path) is not None, _open)
