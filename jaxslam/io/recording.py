"""Recordings, and what layouts of videos share: image files and lists of times."""

import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import LARGEST
from jaxslam.io.calibration import Calibration
from jaxslam.io.imu import InertialFiles, inertial_files
from jaxslam.io.lens_files import read_calibration
from jaxslam.io.logs.log import UNITS, unit_of
from jaxslam.io.source import Image, Trajectory
from jaxslam.io.text import numbers, text_lines
from jaxslam.io.tum import not_rigid, read_tum

SINCE_1970 = 1e8
"""A name that is as large a number, or larger, may be a time."""
IMAGE_TYPES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")

Calibrator = Callable[[int, int], Calibration]
"""A calibration for images of so many pixels across and down."""


@dataclass(frozen=True)
class Recording:
    """A video before its first image is looked at; the fields are those of a `Source`.

    `calibration` is what the layout knows of the camera, or None; `inertial` is where its IMU is
    read (`jaxslam.io.imu`), the readings and the files of its calibration.
    """

    name: str
    times: Float[np.ndarray, " n"]
    images: Callable[[], Iterator[Image]]
    calibration: Calibrator | None = None
    reference: Trajectory | None = None
    clock: Callable[[], float] | None = None
    inertial: InertialFiles | None = None


class Layout(NamedTuple):
    """A way videos lie on disk: its name, how it is recognised, how it is opened.

    `open` gets the path and the frame rate (1/s) for layouts that hold no times.
    """

    name: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, float], Recording]


def of_files(
    path: Path,
    files: list[Path],
    times: Float[np.ndarray, " n"],
    calibration: Calibrator | None = None,
    reference: Trajectory | None = None,
) -> Recording:
    """A recording of image files of the folder `path`.

    Its `calibration.json`, where it has one, is better than what the layout says.
    """
    if (own := path / "calibration.json").is_file():
        calibration = fixed(read_calibration(own))
    name = path.resolve().name
    inertial = inertial_files(path)
    return Recording(
        name, times, lambda: map(read_image, files), calibration, reference, inertial=inertial
    )


def of_listing(
    path: Path, listing: Path, folder: Path, calibration: Calibrator | None = None
) -> Recording:
    """A recording of the files in a folder that a list of times names, `groundtruth.txt` in `path`
    being the true trajectory where it is there."""
    times, names = read_timestamps(listing)
    truth = path / "groundtruth.txt"
    reference = Trajectory(*read_tum(truth)) if truth.is_file() else None
    return of_files(path, listed(listing, folder, names), times, calibration, reference)


def listed(listing: Path, folder: Path, names: list[str]) -> list[Path]:
    """Files in a folder whose names a list holds. Raises ValueError for one that is missing."""
    files = [folder / name for name in names]
    for name, file in zip(names, files, strict=True):
        if not os.path.isfile(file):  # which a name that no file can have is not either
            raise ValueError(f"{listing} names {name}, but {file} is missing")
    return files


def read_image(path: Path) -> Image:
    """The image in a file as grey uint8 (height, width); `ValueError` names what cannot be read."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        data = np.empty(0, np.uint8)
    return decoded(path, data)


def decoded(place: Path | str, data: np.ndarray) -> Image:
    """The image in the bytes of a PNG, JPEG or the like; `ValueError` names the place."""
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"{place}: cannot be read as an image")
    return image


def image_files(path: Path) -> list[Path]:
    """The images in a folder, numbers in their names compared as numbers (2 before 10)."""
    files = [x for x in path.iterdir() if x.suffix.lower() in IMAGE_TYPES and x.name[0] != "."]
    return sorted(files, key=lambda file: _natural(file.name))


def _natural(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _open_plain(path: Path, rate: float) -> Recording:
    files = image_files(path)
    times = _times_of_names(files)
    if times is not None:
        warnings.warn(f"{path}: the names of the pictures are taken as their times", stacklevel=2)
    return of_files(path, files, np.arange(len(files)) / rate if times is None else times)


def _times_of_names(files: Sequence[Path]) -> Float[np.ndarray, " n"] | None:
    """The names as times since 1970, in s or a part of it; None where they are none."""
    told = numbers([file.stem for file in files], len(files))
    if told is None or len(files) < 2 or min(told) < SINCE_1970 or not (np.diff(told) > 0).all():
        return None
    unit = unit_of(np.array(told))
    return None if unit is None else np.array(told) * UNITS[unit]


def fixed(calibration: Calibration) -> Calibrator:
    """A calibration that states its size itself."""
    return lambda width, height: calibration


def read_timestamps(
    path: Path, ticks: float = 1.0, separator: str | None = None
) -> tuple[Float[np.ndarray, " n"], list[str]]:
    """Times in seconds and file names from lines `time file`; # starts a comment line.

    A second has so many `ticks`. Raises `ValueError`, naming file and line, unless times are
    finite and increase.
    """
    lines = text_lines(path)
    if not lines:
        raise ValueError(f"{path} has no lines with a time and a file")
    told = [_timestamp(f"{path}, line {n}", line, separator) for n, line in lines.items()]
    times = np.array([time for time, _ in told]) / ticks
    check_increasing(f"{path}, line", list(lines), times)
    return times, [name for _, name in told]


def check_increasing(place: str, lines: Sequence[int], times: Float[np.ndarray, " n"]) -> None:
    """Raise ValueError, naming the place and its number, unless times, in seconds, increase."""
    for i in np.flatnonzero(~(np.diff(times) > 0))[:1]:
        before, time = times[i : i + 2].tolist()
        raise ValueError(f"{place} {lines[i + 1]}: time {time} s does not come after {before} s")


def check_rigid(path: Path, T: Float[np.ndarray, "n 4 4"]) -> None:
    """Raise ValueError unless poses are turned and moved, and nothing else, by 1 %."""
    wrong = not_rigid(T, 0.01) | ~(np.abs(T[:, :3, 3]).max(axis=1) <= LARGEST)
    if wrong.any():
        pose = int(np.argmax(wrong))
        raise ValueError(f"{path}: pose {pose} is not a rigid motion [R t] with a rotation R")


def _timestamp(place: str, line: str, separator: str | None) -> tuple[float, str]:
    words = line.split(separator, maxsplit=1)
    time = numbers(words[:1], 1)
    if len(words) != 2 or time is None:
        raise ValueError(f"{place}: expected a finite time and a file, not {line!r}")
    return time[0], words[1].strip()


TIMESTAMPED = Layout(
    "a folder with images/ and timestamps.txt",
    lambda path: (path / "timestamps.txt").is_file(),
    lambda path, _rate: of_listing(path, path / "timestamps.txt", path / "images"),
)
PLAIN = Layout(
    "a folder of images", lambda path: path.is_dir() and bool(image_files(path)), _open_plain
)
