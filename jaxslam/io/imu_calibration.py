"""The calibration of an inertial sensor (IMU): its noise, and where it is on the camera.

Files are those of Kalibr, OpenVINS and EuRoC (also TUM-VI).
"""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.io.imu import InertialLog, inertial_files
from jaxslam.io.lens_files import yaml_keys
from jaxslam.io.text import numbers_of, text_lines
from jaxslam.io.tum import not_rigid

_APART = 5.0
"""Times that a density and the scatter of readings may differ by."""
_DENSITIES = {
    "gyroscope_noise_density": ("rad/s/√Hz", 0.1),
    "gyroscope_random_walk": ("rad/s²/√Hz", 0.1),
    "accelerometer_noise_density": ("m/s²/√Hz", 1.0),
    "accelerometer_random_walk": ("m/s³/√Hz", 1.0),
}
"""Kalibr's names of the densities, their units, and more than any sensor has."""
_CAMERAS = {"T_cam_imu": False, "T_imu_cam": True}
"""Names of T_CI, and of its inverse."""
_SHAPES = ("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC", "gyroscopes.M", "accelerometers.M")
"""What OpenVINS and Kalibr call scale factors, misalignments and turns of the two sensors."""
_FARTHEST = 10.0
"""Metres between a camera and its IMU."""


class InertialCalibration(NamedTuple):
    """The noise of an IMU, white and of its biases, and where it is on the camera."""

    gyroscope_noise_density: float
    """White noise, rad/s/√Hz: σ of a reading is the density times √rate."""
    gyroscope_random_walk: float
    """The bias, rad/s²/√Hz: σ of its change in t seconds is the density times √t."""
    accelerometer_noise_density: float
    """White noise, m/s²/√Hz."""
    accelerometer_random_walk: float
    """The bias, m/s³/√Hz."""
    camera_from_imu: Float[np.ndarray, "4 4"]
    """T_CI (m): a point p in the IMU's axes is T_CI p in those of the camera."""
    clock_offset: float | None = None
    """Seconds by which the clock of the IMU is ahead of the camera's, `t_imu = t_cam + offset`, as
    Kalibr's `timeshift_cam_imu`; None where that is not stated."""

    def compared(self, log: InertialLog) -> tuple[str, ...]:
        """A sentence for each density of white noise that is five times more, or less, than that of
        a log at its calmest; of a standard deviation per reading among others.

        Of white noise of density n, readings δ s apart differ by σ = n √(2/δ) from one to the next;
        that of the calmest tenth of its seconds is taken, in which there is the least motion.
        """
        notes, step = [], float(np.median(np.diff(log.times)))
        for sensor in ("gyroscope", "accelerometer"):
            squares = (np.diff(getattr(log, sensor), axis=0) ** 2).mean(axis=1)
            count = min(max(round(1 / step), 1), len(squares))
            of_seconds = squares[: len(squares) // count * count].reshape(-1, count).mean(axis=1)
            seen = np.sqrt(np.quantile(of_seconds, 0.1) * step / 2)
            what, stated = f"{sensor}_noise_density", getattr(self, f"{sensor}_noise_density")
            why = f"if it is the σ of a reading, divide it by √rate, {step**-0.5:.3g}"
            if stated < seen:
                why = "from vibration or a worse sensor: a filter trusts it too much"
            if not seen / _APART <= stated <= seen * _APART:
                told = f"{what} is {stated:.3g}, but the calmest readings of {log.name} scatter"
                notes.append(f"{told} as of {seen:.3g}; {why}")
        return tuple(notes)


def read_inertial_calibration(*paths: str | Path) -> InertialCalibration:
    """Read the calibration of an IMU from files, or folders of pictures with them, taken together.

    Densities are those of Kalibr's `imu.yaml`, OpenVINS' `kalibr_imu_chain.yaml` or EuRoC's
    `imu0/sensor.yaml`. The camera is at T_CI, the `T_cam_imu` of Kalibr's
    camchain (or the inverse of `T_imu_cam`), after the inverse of the IMU's `T_i_b` where there is
    one; or at T_BC⁻¹ T_BI, the two `T_BS` of EuRoC, whose body is the IMU where it states none.
    Raises ValueError for what is missing, or implausible, by its name, and warns of scale factors
    and misalignments, which are not read.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        found = inertial_files(path)
        files += [path] if found is None else found.calibration
    sensor: dict[str, object] = {}
    mount: dict[str, object] = {}
    for file in files:
        text_lines(file, "calibration")  # which says what cannot be read
        fields = yaml_keys(file)
        (sensor if _DENSITIES.keys() & fields.keys() else mount).update(fields)
    place = ", ".join(map(str, files or paths))
    densities = [_density(place, sensor, name) for name in _DENSITIES]
    T_CI = _camera_from_imu(place, sensor, mount)
    left, _, right = np.linalg.svd(T_CI[:3, :3])  # rounding in the file, taken away
    T_CI[:3, :3] = left @ right
    shapes = {name: numbers_of(sensor.get(name)) for name in _SHAPES}
    uneven = [
        x for x, M in shapes.items() if M and not np.allclose(M, np.eye(3).ravel(), atol=1e-3)
    ]
    if uneven:
        told = f"{', '.join(uneven)} of the IMU are not applied to its readings"
        warnings.warn(f"{place}: {told}; apply them before", stacklevel=2)
    shift = numbers_of((sensor | mount).get("timeshift_cam_imu"))
    return InertialCalibration(*densities, T_CI, shift[0] if shift else None)


def _density(place: str, fields: dict[str, object], name: str) -> float:
    unit, most = _DENSITIES[name]
    found = numbers_of(fields.get(name))
    if len(found) != 1 or not 0 <= found[0] <= most or (found[0] == 0 and "noise" in name):
        told = f"{name} is {found[0]:g}" if found else f"{name} is missing"
        raise ValueError(
            f"{place}: {told}; expected a positive density in {unit}, up to {most:g} (divide the σ "
            "of a reading by √rate, and multiply degrees by π/180)"
        )
    return found[0]


def _camera_from_imu(
    place: str, sensor: dict[str, object], mount: dict[str, object]
) -> Float[np.ndarray, "4 4"]:
    """T_CI by the keys of an IMU and of a camera. Raises ValueError where there is none."""
    T_CB = pose_of_keys(place, sensor | mount, _CAMERAS)
    of_body = {"T_i_b": True}
    if T_CB is None:
        T_CB, of_body = pose_of_keys(place, mount, {"T_BS.data": True}), {"T_BS.data": False}
    if T_CB is None:
        raise ValueError(
            f"{place}: the pose of the camera is missing; expected T_cam_imu of Kalibr's camchain, "
            "OpenVINS' T_imu_cam, or EuRoC's cam0/sensor.yaml (T_BS)"
        )
    T_BI = pose_of_keys(place, sensor, of_body)
    return T_CB if T_BI is None else T_CB @ T_BI


def pose_of_keys(
    place: object, fields: dict[str, object], names: dict[str, bool]
) -> Float[np.ndarray, "4 4"] | None:
    """The first pose of these names, inverted where that is said; None without one."""
    name = next((x for x in names if len(numbers_of(fields.get(x))) == 16), "")
    if not name:
        return None
    T = np.reshape(numbers_of(fields[name]), (4, 4))
    if not_rigid(T[None], 0.01)[0] or np.abs(T[:3, 3]).max() > _FARTHEST:
        raise ValueError(
            f"{place}: {name} is no pose; expected [R t; 0 1] with R orthonormal and t in metres, "
            f"up to {_FARTHEST:g} m"
        )
    return np.linalg.inv(T) if names[name] else T
