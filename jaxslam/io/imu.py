"""Readings of an inertial sensor (IMU), whoever wrote them, checked and cut at times of pictures.

A text of readings is known by its titles, or is EuRoC's `t, gyroscope, accelerometer`; a topic of a
ROS bag is of `sensor_msgs/Imu`.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import LARGEST
from jaxslam.io.ros import Message, bag_and_topic, chosen, messages, seconds
from jaxslam.io.text import Table, read_table

MESSAGES = ("sensor_msgs/msg/Imu",)
READINGS = ("imu.csv", "imu0.csv", "imu.txt", "imu0/data.csv", "mav0/imu0/data.csv")
"""Where a folder of pictures has its readings, the first that is there."""
CALIBRATIONS = (
    "imu.yaml", "kalibr_imu_chain.yaml", "imu0/sensor.yaml", "mav0/imu0/sensor.yaml",
    "dso/imu_config.yaml", "camchain-imucam.yaml", "kalibr_imucam_chain.yaml", "cam0/sensor.yaml",
    "mav0/cam0/sensor.yaml", "dso/camchain.yaml",
)  # fmt: skip
"""Where a folder of pictures has the calibration of its IMU, all that are there."""
EXPECTED = "seven numbers t, gyroscope (rad/s), accelerometer (m/s²), or titles t,gx,gy,gz,ax,ay,az"
_GRAVITY = 9.80665
_STEPS = (1e-4, 0.1)
"""From a reading to the next, s: no two units of time fit."""
_GAP, _UNCOVERED = 1.5, 3.0
"""A gap is longer than so many steps, and one that no interval lies in longer than so many."""
_FEW = 0.01
"""Few stamps go back if they are at most such a share of all."""
_TOUCH = 1e-6
"""Seconds by which an interval may pass the ends: doubles since 1970 are 2.4e-7 s apart."""
_MEANINGS = {
    "t": r"(?:t|stamps?|time_?stamps?|time|secs?|seconds)()(?:_(.*))?",
    "g": r"(?:g|w|ω|gyro?|gyroscope|omega|w_rs_s|ang(?:ular)?_?vel(?:ocity)?"
    r"|(?:angular|rot(?:ation)?)_?rate)_?([xyz])(?:_(.*))?",
    "a": r"(?:a|f|accelerometer|(?:lin(?:ear)?_?)?acc(?:el(?:eration)?)?|specific_?force|a_rs_s)"
    r"_?([xyz])(?:_(.*))?",
}
"""The titles of a time, of a gyroscope and of an accelerometer, of which axis and in which unit."""
_NO_READING = r"b_|.*(bias|cov|std|sigma|orientation)"
_TICKS = ((r"n(s|ano).*", 1e9), (r"(u|µ|μ|micro)s.*", 1e6), (r"m(s|illi).*", 1e3),
          (r"s|secs?|seconds", 1.0))  # fmt: skip
"""Units of time that a title says, by how many are a second."""
_UNITS = ((r"m(dps|deg.*)", np.pi / 180e3), (r"dps|deg.*|°.*", np.pi / 180),
          (r"gs?|gforce", _GRAVITY), (r"mgs?", _GRAVITY / 1e3), (r".*", 1.0))  # fmt: skip
"""Units of readings that a title says, in rad/s and m/s²."""


Rows = Float[np.ndarray, "_ 7"]
"""Rows `t, gyroscope, accelerometer`."""


class InertialLog(NamedTuple):
    """The readings of an IMU in its own axes, at increasing times."""

    times: Float[np.ndarray, " n"]
    """Seconds by the clock of the IMU."""
    gyroscope: Float[np.ndarray, "n 3"]
    """Angular rates, rad/s."""
    accelerometer: Float[np.ndarray, "n 3"]
    """Specific forces, m/s²: at rest 9.8 upwards."""
    name: str = "the log"
    """The file or topic."""
    notes: tuple[str, ...] = ()
    """What was repaired, and what is to be known, each one sentence."""

    def between(
        self, start: float, end: float
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Durations, s, angular rates and specific forces that are constant over each of them.

        Readings are samples of a signal that is linear between them. It is cut at the samples
        inside of the interval and at both of its ends, and a piece has the mean of its two ends
        (trapezoids): its integral is that of the signal. The durations add up to `end − start`.
        Raises ValueError where the interval is empty, or no reading covers it: outside of the log,
        or as a whole in a gap of more than three steps.
        """
        if not start < end:
            raise ValueError(f"{self.name}: an interval from {start} s to {end} s is empty")
        first, last = self.times[[0, -1]].tolist()
        if not first - _TOUCH <= start < end <= last + _TOUCH:
            clock = "; the clocks differ" if start > last or end < first else ""
            told = f"readings from {first:.6f} s to {last:.6f} s do not cover those from"
            raise ValueError(f"{self.name}: {told} {start:.6f} s to {end:.6f} s{clock}")
        low, high = np.searchsorted(self.times, start, "right"), np.searchsorted(self.times, end)
        near = slice(max(low - 1, 0), high + 1)
        own = self.times[near]
        if low == high and np.ptp(own) > _UNCOVERED * np.median(np.diff(self.times)):
            raise ValueError(f"{self.name}: no readings from {own[0]:.6f} s to {own[-1]:.6f} s")
        at = np.concatenate([[start], self.times[low:high], [end]])
        both = np.hstack([self.gyroscope[near], self.accelerometer[near]])
        ends = np.stack([np.interp(at, own, x) for x in both.T], axis=1)
        pieces = (ends[1:] + ends[:-1]) / 2
        return np.diff(at), pieces[:, :3], pieces[:, 3:]


class InertialFiles(NamedTuple):
    """Where a recording with pictures has its IMU; nothing of it is read yet."""

    readings: Path
    """What `read_inertial` reads; a bag may turn out to have none."""
    calibration: tuple[Path, ...] = ()
    """What `read_inertial_calibration` reads, together."""


def inertial_files(folder: Path) -> InertialFiles | None:
    """The readings in a folder of pictures and the files of their calibration; None without any."""
    told = tuple(folder / name for name in CALIBRATIONS if (folder / name).is_file())
    there = (folder / name for name in READINGS if (folder / name).is_file())
    return next((InertialFiles(readings, told) for readings in there), None)


def read_inertial(path: str | Path) -> InertialLog:
    """Read the readings in a text, in a ROS bag (`BAG` or `BAG:TOPIC`) or in a folder of pictures.

    A column's unit is the one in its title, as `[deg/s]`, `[g]`, `_us`, and else rad/s and m/s²;
    times are in the unit in which an IMU has 10 Hz to 10 kHz. Raises ValueError, naming the file,
    for readings that cannot be of a gyroscope and an accelerometer in these units; what could be
    repaired is in `notes`.
    """
    if (place := bag_and_topic(path)) is not None:
        topic = chosen(*place, MESSAGES, "--imu")
        return inertial_log(str(topic), np.array([_row(x) for x in messages(topic)]), 1.0)
    if Path(path).is_dir():
        if (found := inertial_files(Path(path))) is None:
            raise ValueError(f"{path} has no readings of an IMU; expected {', '.join(READINGS)}")
        path = found.readings
    return inertial_log(str(path), *_of_table(read_table(path, "log", "readings", EXPECTED)))


def _row(message: Message) -> list[float]:
    """A reading, NaN where its covariance says, by −1, that there is none of a sensor."""
    row = [seconds(message)]
    for what in ("angular_velocity", "linear_acceleration"):
        there = getattr(message, f"{what}_covariance")[0] != -1
        row += [getattr(getattr(message, what), x) if there else np.nan for x in "xyz"]
    return row


def _of_table(table: Table) -> tuple[np.ndarray, float | None, tuple[str, ...]]:
    """Rows (n, 7), how many units of their time are a second where that is said, and notes."""
    cells = np.where(np.abs(table.rows) <= LARGEST, table.rows, np.nan)
    found: dict[str, list[tuple[int, str]]] = {}
    for column, title in enumerate(table.titles):
        base, _, unit = re.sub(r"[\])]", "", title.lower()).replace("(", "[").partition("[")
        name = re.sub(r"[^\w°]+", "_", base).strip("_")
        for what, pattern in _MEANINGS.items():
            own = re.fullmatch(rf"(?:.*?_)??{pattern}", name)
            if own and not re.match(_NO_READING, name):
                unit = re.sub(r"[^\w°]|_", "", unit or own[2] or "")
                found.setdefault(what + own[1], []).append((column, unit))
                break
    readings = [what + axis for what in "ga" for axis in "xyz"]
    if not found.keys() >= {"t", *readings}:
        titles = f" ({', '.join(table.titles)})" if table.titles else ""
        if table.rows.shape[1] != 7 or found.keys() & set(readings):
            told = f"{table.rows.shape[1]} columns{titles} are no readings of an IMU"
            raise ValueError(f"{table.place(0)}: {told}; expected {EXPECTED}")
        note = f"titles{titles} that are not known are taken as t, gyroscope, accelerometer"
        return cells, None, (note,) * bool(titles)
    times = [x for x in found["t"] if "stamp" in table.titles[x[0]].lower()] or found["t"]
    parts = [x for x in times if re.fullmatch(r"n?(ano)?secs?", x[1])]  # of ROS: both make a time
    times = parts if len(parts) == 2 else times[:1]
    told = [_first(_TICKS, unit) for _, unit in times]
    columns = [found[what][0] for what in readings]
    factors = [_first(_UNITS, unit) or 1.0 for _, unit in columns]
    t = sum(cells[:, i] / (ticks or 1.0) for (i, _), ticks in zip(times, told, strict=True))
    rows = np.column_stack([t, cells[:, [i for i, _ in columns]] * factors])
    return rows, None if told[0] is None else 1.0, ()


def _first(table: Sequence[tuple[str, float]], word: str) -> float | None:
    return next((value for pattern, value in table if re.fullmatch(pattern, word)), None)


def inertial_log(
    name: str, rows: Rows, ticks: float | None = None, notes: tuple[str, ...] = ()
) -> InertialLog:
    """The log of rows `t, gyroscope, accelerometer`, checked. A second has so many `ticks` of `t`;
    None are as many as an IMU has between 10 Hz and 10 kHz.

    Raises ValueError, naming the log, for what cannot be repaired.
    """
    rows, told = _increasing(name, np.reshape(rows, (-1, 7)))
    steps = np.diff(rows[:, 0])
    step = float(np.median(steps))
    fit = (x for x in (1.0, 1e3, 1e6, 1e9) if _STEPS[0] <= step / x < _STEPS[1])
    unit = next(fit, None) if ticks is None else ticks
    if unit is None or not _STEPS[0] <= step / unit < _STEPS[1]:
        raise ValueError(
            f"{name}: readings are {step / (unit or 1.0):.3g} s apart; expected an IMU of 10 Hz to "
            "10 kHz, with times in s, ms, us or ns, which a title such as t [us] says"
        )
    if ticks is None and unit != 1.0:
        told += (f"times are taken as 1/{unit:.0f} s",)
    times, steps, step = rows[:, 0] / unit, steps / unit, step / unit
    gaps = np.flatnonzero(steps > _GAP * step)
    if gaps.size:
        longest = int(gaps[np.argmax(steps[gaps])])
        told += (
            f"readings are missing in {gaps.size} places, longest for {steps[longest]:.3g} s after "
            f"{times[longest]:.6f} s ({times[longest] - times[0]:.3f} s after the first)",
        )
    told += _plausible(name, rows[:, 1:4], rows[:, 4:])
    said = tuple(f"{name}: {note}" for note in (*notes, *told))
    return InertialLog(times, rows[:, 1:4], rows[:, 4:], name, said)


def _increasing(name: str, rows: Rows) -> tuple[Rows, tuple[str, ...]]:
    """The finite rows whose times come after all before, and what was left out."""
    count, whole = len(rows), rows[np.isfinite(rows).all(axis=1)]
    latest = np.maximum.accumulate(np.r_[-np.inf, whole[:-1, 0]])[: len(whole)]
    twice, back = whole[:, 0] == latest, whole[:, 0] < latest
    if back.sum() > max(1, _FEW * len(whole)):
        i = int(np.argmax(back))
        raise ValueError(
            f"{name}: {back.sum()} of {len(whole)} stamps go back, the first from {latest[i]:.6f} "
            f"to {whole[i, 0]:.6f}; expected readings of one sensor in order of time"
        )
    left = {
        "are not finite": count - len(whole),
        "have the stamp of the one before": int(twice.sum()),
        "have a stamp that goes back": int(back.sum()),
    }
    rows = whole[~(twice | back)]
    told = tuple(f"{n} of {count} readings {x}, and are left out" for x, n in left.items() if n)
    if len(rows) < 3:
        which = f" ({'; '.join(told)})" if told else ""
        raise ValueError(
            f"{name}: {len(rows)} readings{which}; expected at least three, each with a time after "
            "the one before, three rates and three specific forces"
        )
    return rows, told


def _plausible(
    name: str, gyroscope: Float[np.ndarray, "n 3"], accelerometer: Float[np.ndarray, "n 3"]
) -> tuple[str, ...]:
    """A note where rates are high. Raises ValueError for other units, a swap, and no gravity."""
    low, force, high = np.quantile(np.linalg.norm(accelerometer, axis=1), [0.25, 0.5, 0.75])
    rate = float(np.median(np.linalg.norm(gyroscope, axis=1)))
    least, most = 0.5 * _GRAVITY, 2 * _GRAVITY
    for holds, wrong, do in (
        (force < least and abs(rate / _GRAVITY - 1) < 0.25, "rates and specific forces are swapped",
         "put the gyroscope first, or name the columns"),
        (0.8 < force < 1.25 and high - low < 0.4 * force, "specific forces look like g",
         f"title their columns [g], or multiply them by {_GRAVITY}"),
        (force < least, "specific forces are without gravity",
         "log what the accelerometer measures (Android: not the linear acceleration)"),
        (force > most, "specific forces are large", "give m/s², or title their columns [mg]"),
        (rate > 10, "rates look like degrees",
         "title their columns [deg/s], or multiply them by π/180"),
    ):  # fmt: skip
        if holds:
            medians = f"medians of {rate:.3g} rad/s and {force:.3g} m/s²"
            raise ValueError(f"{name}: {wrong} ({medians}); {do}")
    return (f"rates of {rate:.3g} rad/s (median) are high; are they degrees?",) * (rate > 3)
