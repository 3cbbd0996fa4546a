"""Recordings, and what layouts of videos share: image files and lists of times."""

import functools
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
from jaxslam.io.logs.log import STEPS, UNITS, unit_of
from jaxslam.io.pictures import of_eight_bits, orientation
from jaxslam.io.source import Image, Trajectory
from jaxslam.io.text import numbers, text_lines, with_iso
from jaxslam.io.tum import not_rigid, read_tum

SINCE_1970 = 1e9
"""Seconds until 2001: a time since 1970 is that large, and no ten times as large."""
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
    if len(files) != len(times):
        raise ValueError(f"{path}: there are {len(times)} times for {len(files)} pictures")
    if (own := path / "calibration.json").is_file():
        calibration = fixed(read_calibration(own))
    how = functools.cache(lambda: _how_to_read(path, files))

    def read(every: int) -> Iterator[np.ndarray]:
        return (read_image(file, how()) for file in files[::every])

    name, inertial = path.resolve().name, inertial_files(path)
    images = of_eight_bits(name, read, len(files))
    return Recording(name, times, images, calibration, reference, inertial=inertial)


def _how_to_read(path: Path, files: Sequence[Path]) -> int:
    """OpenCV's flags: grey of any depth, upright where all pictures are turned alike."""
    jpegs = [x for x in files if x.suffix.lower() in (".jpg", ".jpeg") and x.is_file()]
    turned = {orientation(file) for file in jpegs}
    if len(turned) > 1:
        told = f"{path}: pictures are turned differently (EXIF orientations {sorted(turned)})"
        warnings.warn(f"{told}; all are taken as the sensor saw them", stacklevel=2)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    return flags if len(turned) == 1 else flags | cv2.IMREAD_IGNORE_ORIENTATION


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
    """Files in a folder whose names a list holds, or all. Raises ValueError for one that is
    missing."""
    files = [folder / name for name in names] or image_files(folder)
    for name, file in zip(names, files, strict=False):
        if not os.path.isfile(file):  # which a name that no file can have is not either
            raise ValueError(f"{listing} names {name}, but {file} is missing")
    return files


def read_image(path: Path, how: int = cv2.IMREAD_GRAYSCALE) -> np.ndarray:
    """The image in a file, grey (height, width), uint8 where OpenCV's flags `how` do not say
    otherwise; `ValueError` names what cannot be read."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        data = np.empty(0, np.uint8)
    return decoded(path, data, how)


def decoded(place: Path | str, data: np.ndarray, how: int = cv2.IMREAD_GRAYSCALE) -> np.ndarray:
    """The image in the bytes of a PNG, JPEG or the like; `ValueError` names the place."""
    try:
        image = cv2.imdecode(data, how)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"{place}: cannot be read as an image")
    return image


def image_files(path: Path) -> list[Path]:
    """The images in a folder, numbers in their names compared as numbers (2 before 10)."""
    files = [x for x in path.iterdir() if x.suffix.lower() in IMAGE_TYPES and x.name[0] != "."]
    files.sort(key=lambda file: _natural(file.name))
    told = _numbers(files)
    return files if told is None else [files[i] for i in np.argsort(told, kind="stable")]


def _natural(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _numbers(files: Sequence[Path]) -> Float[np.ndarray, " n"] | None:
    """The numbers by which names differ: whole ones, decimal ones, or seconds and their part."""
    shared = os.path.commonprefix([x.stem for x in files])  # noqa: RUF071 (of names, not of paths)
    common = len(re.sub(r"(\d{9,}[._-]|\d+\.)?\d*$", "", shared))
    told = [re.sub(r"^(\d{9,})[_-](?=\d)", r"\1.", x.stem[common:]) for x in files]
    found = [x for x in (re.fullmatch(r"([\d.]+)(\D*)", x) for x in told) if x is not None]
    alike = len(found) == len(files) and len({x[2] for x in found}) == 1
    read = numbers([x[1] for x in found], len(files)) if alike else None
    return None if read is None else np.array(read)


def _open_plain(path: Path, rate: float) -> Recording:
    files = image_files(path)
    return of_files(path, files, _times_of_names(path, files, rate))


def _times_of_names(path: Path, files: Sequence[Path], rate: float) -> Float[np.ndarray, " n"]:
    """The times of pictures by their names, with a warning: since 1970 in s or a part of it, or at
    this rate by their numbers, some of which may be missing."""
    times, told, words = np.arange(len(files)) / rate, _numbers(files), ""
    if files and re.search(r"\d{9}|\d{8}[_-]\d{6}", files[0].stem):
        words = f"names are not read as times; --rate ({rate:g} pictures per second) is taken"
    if told is not None and len(files) > 1:
        steps, unit = np.diff(told), _since_1970(told)
        each = np.median(steps)
        counted = each > 0 and not (steps % each).any() and not (told % 1).any()
        if unit and (steps > 0).all() and STEPS[0] <= each * unit <= STEPS[1]:
            times, words = told * unit, "the names of the pictures are taken as their times"
        elif not unit and counted and each < steps.max() <= 10 * each:
            times, missing = (told - told[0]) / each / rate, (steps / each - 1).sum()
            words = f"{missing:.0f} pictures are missing by their numbers, and their time is kept"
    if words:
        warnings.warn(f"{path}: {words}", stacklevel=2)
    return times


def _since_1970(times: Float[np.ndarray, " n"]) -> float:
    """Seconds of the unit in which times are since 1970; 0 where they are not."""
    return next((x for x in UNITS.values() if 1 <= times[0] * x / SINCE_1970 < 10), 0.0)


def fixed(calibration: Calibration) -> Calibrator:
    """A calibration that states its size itself."""
    return lambda width, height: calibration


def read_timestamps(path: Path) -> tuple[Float[np.ndarray, " n"], list[str]]:
    """Times in seconds and file names from lines `time file`, or `time` alone; # is a comment.

    Times are seconds or a part of them, or dates. Raises `ValueError`, naming file and line, unless
    they are finite and increase.
    """
    lines = text_lines(path)
    if not lines:
        raise ValueError(f"{path} has no lines with a time and a file")
    told = [_timestamp(f"{path}, line {n}", line) for n, line in lines.items()]
    times = np.array([time for time, _ in told])
    unit, name = _since_1970(times) or 1.0, unit_of(times)
    if unit == 1.0 and name not in ("s", None) and np.median(np.diff(times)) > STEPS[1]:
        unit = UNITS[name]
        warnings.warn(f"{path}: times are taken as {name}", stacklevel=2)
    check_increasing(f"{path}, line", list(lines), times * unit)
    return times * unit, [name for _, name in told if name]


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


def _timestamp(place: str, line: str) -> tuple[float, str]:
    word, *name = re.split(r"[,\s]+", with_iso(line), maxsplit=1)
    time = numbers([word], 1)
    if time is None:
        raise ValueError(f"{place}: expected a finite time and a file, not {line!r}")
    return time[0], "".join(name).strip()


def _open_timestamped(path: Path, _rate: float) -> Recording:
    folder = next(x for x in (path / "images", path / "data", path) if x.is_dir())
    return of_listing(path, path / "timestamps.txt", folder)


TIMESTAMPED = Layout(
    "a folder with images/ and timestamps.txt",
    lambda path: (path / "timestamps.txt").is_file(),
    _open_timestamped,
)
PLAIN = Layout(
    "a folder of images", lambda path: path.is_dir() and bool(image_files(path)), _open_plain
)
