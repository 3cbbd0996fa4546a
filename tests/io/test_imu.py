"""Inertial readings are the same in every format, cut at any time; what is wrong is named."""

import itertools
import re
from functools import partial

import numpy as np
import pytest
import refusals
from bags import EPOCH, KINDS, ros_of, write_bag
from pictures import picture
from videos import euroc, plain

from jaxslam.io import open_source, read_inertial
from jaxslam.io.imu import InertialLog, inertial_log

SINCE = 0.005 * np.arange(201)
TIMES = EPOCH + SINCE
RATES = np.stack([0.3 * np.sin(3 * SINCE), 0.1 + 0 * SINCE, -0.2 * SINCE], axis=1)
FORCES = np.stack([np.cos(2 * SINCE), 0.5 * SINCE, 9.7 + 0 * SINCE], axis=1)
ROWS = np.column_stack([TIMES, RATES, FORCES])
NANOSECONDS = np.round(TIMES * 1e9).astype(np.int64)


def text(titles, order="tg123a456", *, units=(1, 1, 1), between=",", spare=0, t=None):
    """A table of times, rates and forces in these units, under titles, and spare columns first."""
    t = [f"{x * units[0]:.7f}" for x in TIMES] if t is None else t
    columns = [t, *(RATES * units[1]).T, *(FORCES * units[2]).T]
    order = [0, 4, 5, 6, 1, 2, 3] if order == "tag" else range(7)
    columns = [TIMES * 0 + 3.0] * spare + [columns[i] for i in order]
    lines = [between.join(str(x) for x in row) for row in zip(*columns, strict=True)]
    return "\n".join([titles, *lines] if titles else lines) + "\n"


OF_ROS = [f"{x}.{a}" for x in ("angular_velocity", "linear_acceleration") for a in "xyz"]
EUROC = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
DEG, G = 180 / np.pi, 1 / 9.80665
FORMATS = {
    "EuRoC": text(EUROC, t=NANOSECONDS),
    "seven columns, ns": text("", t=NANOSECONDS),
    "seven columns, s": text("", between=" "),
    "seven columns, ms": text("", units=(1e3, 1, 1)),
    "unknown titles": text("t,one,two,three,four,five,six"),
    "gx": text("timestamp,gx,gy,gz,ax,ay,az"),
    "biases beside": text("b_w_x,timestamp,gx,gy,gz,ax,ay,az", spare=1),
    "forces first": text("timestamp,ax,ay,az,gx,gy,gz", "tag"),
    "degrees and g": text(
        "t [us],gyro.x [deg/s],gyro.y [deg/s],gyro.z [deg/s],acc_x [g],acc_y [g],acc_z [g]",
        units=(1e6, DEG, G),
    ),
    "suffixes": text(
        "time_us;gyro_x_dps;gyro_y_dps;gyro_z_dps;accel_x_mg;accel_y_mg;accel_z_mg",
        units=(1e6, DEG, 1e3 * G), between=";",
    ),
    "words": text(
        "Time (ms)\tGyroscope x (°/s)\tGyroscope y (°/s)\tGyroscope z (°/s)\tAcceleration x (m/s^2)"
        "\tAcceleration y (m/s^2)\tAcceleration z (m/s^2)", units=(1e3, DEG, 1), between="\t",
    ),
    "camel case": text("t,GyroX,GyroY,GyroZ,AccX,AccY,AccZ"),
    "omega": text("# t omega_x omega_y omega_z a_x a_y a_z", between=" "),
    "rostopic echo": text(
        "%time,field.header.seq,field.header.stamp," + ",".join(f"field.{x}" for x in OF_ROS),
        spare=2, t=NANOSECONDS,
    ),
    "bagpy": "\n".join(
        ["Time,header.stamp.secs,header.stamp.nsecs," + ",".join(OF_ROS)]
        + [f"{EPOCH + 9},{t // 10**9},{t % 10**9}," + ",".join(map(repr, row[1:].tolist()))
           for t, row in zip(NANOSECONDS, ROWS, strict=True)]
    ),
}  # fmt: skip


def check(log):
    # Doubles of seconds since 1970 are 2.4e-7 s apart.
    np.testing.assert_allclose(log.times, TIMES, rtol=0, atol=1e-6)
    np.testing.assert_allclose(log.gyroscope, RATES, rtol=0, atol=1e-9)
    np.testing.assert_allclose(log.accelerometer, FORCES, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_has_the_same_readings(name, tmp_path):
    path = tmp_path / "readings.csv"
    path.write_text(FORMATS[name])
    log = read_inertial(path)
    check(log)
    chosen = {"unknown titles": "not known are taken as t", "seven columns, ms": "as 1/1000 s",
              "seven columns, ns": "as 1/1000000000 s", "rostopic echo": "as 1/10"}  # fmt: skip
    assert len(log.notes) == (name in chosen)
    assert all(chosen[name] in note and str(path) in note for note in log.notes)


@pytest.mark.parametrize("kind", KINDS)
def test_a_topic_of_a_bag_has_the_same_readings(kind, tmp_path):
    r = ros_of(kind)
    told = [r.imu(*row) for row in zip(TIMES, RATES, FORCES, strict=True)]
    path = write_bag(tmp_path / kind, {"/imu0": told})
    check(read_inertial(path))
    check(read_inertial(f"{path}:/imu0"))
    two = write_bag(tmp_path / f"two{kind}", {"/imu0": told, "/imu1": told})
    refused(r"2 topics fit --imu; .* /imu0 \(sensor_msgs/Imu, 201 messages\), /imu1", two)
    told = [r.imu(*row, force_known=False) for row in zip(TIMES, RATES, FORCES, strict=True)]
    none = write_bag(tmp_path / f"none{kind}", {"/gyro": told})
    refused(
        r"/gyro: 0 readings \(201 of 201 readings are not finite, .*\); expected at least", none
    )


refused = partial(refusals.refused, read_inertial)


def test_empty_cells_words_for_no_number_and_endless_ones_are_no_readings(tmp_path):
    lines = FORMATS["degrees and g"].splitlines()
    for i, cell in ((3, ""), (5, "nan"), (9, "1e305")):
        lines[i] = ",".join([*lines[i].split(",")[:-1], cell])
    (tmp_path / "r.csv").write_text("\n".join(lines))
    log = read_inertial(tmp_path / "r.csv")
    np.testing.assert_allclose(log.times, np.delete(TIMES, [2, 4, 8]), rtol=0, atol=1e-6)
    assert "3 of 201 readings are not finite, and are left out" in log.notes[0]


def changed(*, rows=slice(None), scale=(1, 1), swap=False, noise=0.0, stamps=None):
    found = ROWS.copy()[rows]
    found[:, 1:4] *= scale[0]
    found[:, 4:] *= scale[1]
    if swap:
        found = found[:, [0, 4, 5, 6, 1, 2, 3]]
    found[:, 4:] += noise * np.random.default_rng(0).normal(size=(len(found), 3))
    for at, value in (stamps or {}).items():
        found[at, 0] = value
    return found


@pytest.mark.parametrize(
    ("rows", "left", "note"),
    [
        (changed(stamps={7: np.nan, 9: np.inf}), [7, 9], "2 of 201 readings are not finite, and"),
        (changed(stamps={7: TIMES[6], 9: TIMES[8]}), [7, 9], "2 of 201 .* stamp of the one before"),
        (changed(stamps={7: TIMES[3]}), [7], "1 of 201 readings have a stamp that goes back"),
        (
            np.delete(ROWS, range(50, 70), 0), [],
            r"missing in 1 places, longest for 0\.105 s after \d+\.\d+ s \(0\.245 s after the",
        ),
        (changed(scale=(20, 1)), [], r"rates of [\d.]+ rad/s \(median\) are high; are they"),
    ],
)  # fmt: skip
def test_what_can_be_repaired_is_and_a_note_says_so(rows, left, note):
    log = inertial_log("mine", rows, 1.0)
    kept = np.delete(rows, left, 0)
    np.testing.assert_array_equal(log.times, kept[:, 0])
    np.testing.assert_array_equal(log.gyroscope, kept[:, 1:4])
    np.testing.assert_array_equal(log.accelerometer, kept[:, 4:])
    assert any(re.match(rf"mine: .*{note}", found) for found in log.notes), log.notes


LOG = InertialLog(SINCE, RATES, FORCES)


def test_pieces_have_the_integral_of_a_signal_that_is_linear_between_readings():
    """Of a signal that is linear all through the pieces are exact, wherever the cuts are."""
    line = InertialLog(SINCE, np.outer(SINCE, [1.0, 2.0, 3.0]), np.outer(SINCE, [0.0, 1.0, -1.0]))
    for start, end in ((0.0, 1.0), (0.0123, 0.7311), (0.0101, 0.0102), (0.005, 0.015)):
        duration, rate, force = line.between(start, end)
        assert duration.sum() == pytest.approx(end - start, rel=1e-12)
        half = (end**2 - start**2) / 2
        np.testing.assert_allclose(duration @ rate, np.multiply(half, [1, 2, 3]), rtol=1e-9)
        np.testing.assert_allclose(duration @ force, np.multiply(half, [0, 1, -1]), rtol=1e-9)
    assert len(line.between(0.005, 0.015)[0]) == 2
    cuts = [0.0012, 0.3, 0.3001, 0.512]
    parts = [LOG.between(a, b) for a, b in itertools.pairwise(cuts)]
    whole = LOG.between(cuts[0], cuts[-1])
    for i in (1, 2):
        total = sum(part[0] @ part[i] for part in parts)
        np.testing.assert_allclose(total, whole[0] @ whole[i], rtol=0, atol=1e-14)


GAP = inertial_log("mine", np.delete(np.column_stack([SINCE, RATES, FORCES]), range(50, 90), 0))


def of_text(content):
    def read(folder):
        if content is not None:
            (folder / "r.csv").write_text(content)
        read_inertial(folder if content is None else folder / "r.csv")

    return read


def of_rows(**how):
    return lambda _: inertial_log("mine", changed(**how), 1.0)


def between(log, start, end):
    return lambda _: log.between(start, end)


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (of_text(None), r"has no readings of an IMU; expected imu\.csv, "),
        (of_text(""), "r.csv has no readings; expected lines of seven numbers t, gyroscope"),
        (of_text("1,2,3\n"), r"r.csv, line 1: 3 columns are no readings of an IMU; expected seven"),
        (of_text("t,gx,gy,gz,ax,ay\n1,2,3,4,5,6\n"), r"6 columns \(t, gx, gy, gz, ax, ay\) are no"),
        (of_text(text("")[:-30]), "r.csv, line 201: expected seven numbers"),
        (of_text(text("t,mag_x,mag_y,mag_z,b_a_x,b_a_y,b_a_z,s", spare=1)), "8 columns .* no rea"),
        (of_rows(swap=True), r"mine: .* swapped \(medians of 9\.\d+ rad/s and .* first"),
        (of_rows(scale=(100, 1)), r"mine: .*rates look like degrees .*\[deg/s\]"),
        (of_rows(scale=(1, G)), r"mine: .*look like g .*\[g\], or multiply .* 9\.80665"),
        (of_rows(scale=(1, 0), noise=0.6), r"specific forces are without gravity .*Android"),
        (of_rows(scale=(1, 1e3 * G)), r"specific forces are large .* 9\d\d m/s²\).*\[mg\]"),
        (of_rows(rows=slice(None, None, -1)), r"200 of 201 stamps go back, the first from"),
        (of_rows(rows=slice(2)), "2 readings; expected at least three, each"),
        (of_rows(rows=slice(None, None, 30)), r"readings are 0\.15 s apart; expected an IMU of"),
        (between(LOG, -0.1, 0.1), r"the log: readings from 0\.0* s to 1\.0* s do not cover"),
        (between(LOG, 0.9, 1.1), r"do not cover those from 0\.9\d* s to 1\.1"),
        (between(LOG, EPOCH + 0.5, EPOCH + 1.5), "the clocks differ"),
        (between(LOG, 0.3, 0.2), "from 0.3 s to 0.2 s is empty"),
        (between(LOG, 0.1, np.nan), "is empty"),
        (between(GAP, 0.3, 0.4), r"mine: no readings from 0\.245\d* s to"),
    ],
)
def test_what_no_imu_measures_is_refused_with_what_to_do(read, message, tmp_path):
    refusals.refused(read, message, tmp_path)


def test_a_gap_is_bridged_and_ends_may_be_off_by_what_doubles_round():
    seconds, rates, _ = GAP.between(0.2, 0.5)
    assert seconds.sum() == pytest.approx(0.3, rel=1e-12)
    assert rates[:, 1] == pytest.approx(0.1)
    log = InertialLog(TIMES, RATES, FORCES)
    seconds, rates, _ = log.between(TIMES[0] - 5e-7, TIMES[-1] + 5e-7)
    whole = log.between(TIMES[0], TIMES[-1])
    np.testing.assert_allclose(seconds @ rates, whole[0] @ whole[1], rtol=0, atol=1e-6)


def folder_with(write, name):
    def written(folder):
        path = write(folder)
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(FORMATS["EuRoC"])
        return path

    return written


def bag_with_both(folder):
    r = ros_of("run.bag")
    told = [r.imu(*row) for row in zip(TIMES, RATES, FORCES, strict=True)]
    pictures = [r.image(t, picture(i), "mono8") for i, t in enumerate(TIMES[:3])]
    return write_bag(folder / "run.bag", {"/image_raw": pictures, "/imu": told})


@pytest.mark.filterwarnings("ignore:.*has no calibration")
@pytest.mark.parametrize(
    "write",
    [
        folder_with(euroc, "mav0/imu0/data.csv"),
        lambda x: folder_with(euroc, "mav0/imu0/data.csv")(x) / "mav0",
        *[folder_with(plain, name) for name in ("imu.csv", "imu0.csv", "imu.txt")],
        bag_with_both,
    ],
)
def test_a_recording_knows_where_its_readings_are(write, tmp_path):
    path = write(tmp_path)
    source = open_source(path, every=2, scale=0.5)
    assert source.inertial is not None
    check(read_inertial(source.inertial.readings))
    check(read_inertial(path))
    (tmp_path / "none").mkdir()
    assert open_source(plain(tmp_path / "none")).inertial is None
