"""Calibrations of an IMU in the files of every program are the same; what is wrong is named."""

import re

import numpy as np
import pytest
from refusals import refused
from videos import SENSOR, pose, words

from jaxslam.io import read_inertial_calibration
from jaxslam.io.imu import InertialLog, inertial_files

T_CI = pose(3)
DENSITIES = """accelerometer_noise_density: 2.0e-3  # [ m / s^2 / sqrt(Hz) ] ( "white noise" )
accelerometer_random_walk: 3.0e-03
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk:     1.9393e-05
"""


def rows(T, indent):
    return "".join(f"{indent}- [{words(row, ', ')}]\n" for row in T)


def matrix(name, T):
    data = words(T, ",\n   ")
    return f"{name}\n  cols: 4\n  rows: 4\n  data: [{data}]\n"


def indented(text):
    return "".join(f"  {line}\n" for line in text.splitlines())


def camchain(key, T, indent="  ", shift=""):
    other = f"cam1:\n  {key}:\n{rows(pose(7), indent)}"
    lens = "  intrinsics: [60.0, 60.0, 31.0, 23.0]\n  resolution: [64, 48]\n"
    return f"cam0:\n  {key}: # of the camera\n{rows(T, indent)}{lens}{shift}{other}"


IMU = f"rostopic: /imu0 # of noise\n{DENSITIES}"
SHIFT = "  timeshift_cam_imu: 0.0123\n"
INVERSE = np.linalg.inv(T_CI)
BODY = pose(5)
CAM = SENSOR.format(data=words(BODY @ INVERSE, ","), width=64, height=48)
OPENVINS = f"%YAML:1.0\n\nimu0:\n  T_i_b:\n{rows(BODY, '    ')}{indented(DENSITIES)}"
FILES = {
    "Kalibr": {"imu.yaml": IMU, "camchain-imucam.yaml": camchain("T_cam_imu", T_CI, shift=SHIFT)},
    "OpenVINS": {
        "kalibr_imu_chain.yaml": OPENVINS,
        "kalibr_imucam_chain.yaml": camchain("T_cam_imu", T_CI @ BODY, "    ", SHIFT),
    },
    "OpenVINS, inverse": {
        "kalibr_imu_chain.yaml": OPENVINS,
        "kalibr_imucam_chain.yaml": camchain("T_imu_cam", np.linalg.inv(T_CI @ BODY), "    "),
    },
    "EuRoC": {
        "mav0/imu0/sensor.yaml": matrix("T_BS:", BODY) + DENSITIES,
        "mav0/cam0/sensor.yaml": CAM,
    },
    "TUM-VI": {"dso/imu_config.yaml": IMU, "dso/camchain.yaml": camchain("T_cam_imu", T_CI, "  ")},
    "EuRoC's camera, Kalibr's noise": {
        "imu.yaml": IMU,
        "cam0/sensor.yaml": SENSOR.format(data=words(INVERSE, ","), width=64, height=48),
    },
}


def write(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "imu.csv").write_text("")
    return [folder / name for name in files]


@pytest.mark.parametrize("name", FILES)
def test_the_files_of_every_program_are_one_calibration(name, tmp_path):
    paths = write(tmp_path, FILES[name])
    for given in (paths, paths[::-1], [tmp_path]):
        found = read_inertial_calibration(*given)
        np.testing.assert_allclose(found.camera_from_imu, T_CI, rtol=0, atol=1e-9)
        assert found[:4] == (1.6968e-4, 1.9393e-5, 2e-3, 3e-3)
        assert found.clock_offset == (0.0123 if SHIFT in "".join(FILES[name].values()) else None)
    found = inertial_files(tmp_path)
    assert found is not None
    assert set(found.calibration) == set(paths)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gyroscope_noise_density: 1.6968e-04\n", "", "gyroscope_noise_density is missing; expec"),
        ("1.9393e-05", "many", "gyroscope_random_walk is missing; expected a .* in rad/s²/√Hz"),
        ("2.0e-3", "0.0", "accelerometer_noise_density is 0; expected a positive density in m"),
        ("1.6968e-04", "0.2", r"gyroscope_noise_density is 0\.2; .* up to 0\.1 .*reading by √rate"),
        ("T_cam_imu", "T_cn_cnm1", "the pose of the camera is missing; expected T_cam_imu of Kal"),
        (words(T_CI[0], ", "), words(-T_CI[0], ", "), "T_cam_imu is no pose; expected"),
        (words(T_CI[0], ", "), words([*T_CI[0, :3], 65.0], ", "), "T_cam_imu is no .* up to 10 m"),
        ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0, 0.0]", "T_cam_imu is no pose; expected"),
    ],
)
def test_what_is_missing_or_implausible_is_named(old, new, message, tmp_path):
    spoilt = {name: text.replace(old, new) for name, text in FILES["Kalibr"].items()}
    paths = write(tmp_path, spoilt)
    assert str(paths[0]) in refused(read_inertial_calibration, message, *paths)


def test_poses_and_files_that_are_none_are_refused(tmp_path):
    path = tmp_path / "imu.yaml"
    path.write_text(matrix("T_BS:", np.zeros((4, 4))) + DENSITIES)
    with pytest.raises(ValueError, match="the pose of the camera is missing"):
        read_inertial_calibration(path)
    with pytest.raises(ValueError, match=r"none\.yaml: cannot read the calibration"):
        read_inertial_calibration(tmp_path / "none.yaml")
    path.write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"imu\.yaml: cannot be read as text"):
        read_inertial_calibration(path)


def test_scale_factors_that_are_not_applied_are_named(tmp_path):
    def paths(M):
        shape = f"  Ta:\n{rows(M, '    ')}  Tw:\n{rows(np.eye(3), '    ')}"
        files = FILES["OpenVINS"] | {"kalibr_imu_chain.yaml": OPENVINS + shape}
        return write(tmp_path, files)

    read_inertial_calibration(*paths(np.eye(3)))
    with pytest.warns(
        UserWarning, match="imu_chain.yaml, .*: Ta of the IMU are not applied to its"
    ):
        read_inertial_calibration(*paths(np.diag([1.0, 1.01, 1.0])))


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1.0, None),
        (200**0.5, r"scatter as of \S+; if it is the σ of a reading, divide it by √rate, 14\.1"),
        (0.1, "from vibration or a worse sensor: a filter trusts it too much"),
    ],
)
def test_densities_are_compared_with_a_log_at_its_calmest(factor, told, tmp_path):
    found = read_inertial_calibration(*write(tmp_path, FILES["Kalibr"]))
    draw, times = np.random.default_rng(1), 0.005 * np.arange(4000)
    moved = 0.3 * np.maximum(times[:, None] - 10, 0) * draw.normal(size=(4000, 3))  # after 10 s
    rates = moved + found.gyroscope_noise_density * 200**0.5 * draw.normal(size=(4000, 3))
    forces = moved + found.accelerometer_noise_density * 200**0.5 * draw.normal(size=(4000, 3))
    log = InertialLog(times, rates, forces, "mine")
    stated = found._replace(gyroscope_noise_density=factor * found.gyroscope_noise_density)
    notes = stated.compared(log)
    assert len(notes) == (told is not None)
    for note in notes:
        assert note.startswith("gyroscope_noise_density is ")
        seen = float(note.split("scatter as of ")[1].split(";")[0])
        assert seen == pytest.approx(1.6968e-4, rel=0.1)
        assert re.search(told, note)
