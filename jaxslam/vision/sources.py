"""Where a video comes from: layouts of folders and files on disk, opened as a lazy `Source`."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.tum import read_tum
from jaxslam.vision.calibration import Calibration, read_calibration

IMAGE_TYPES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")
VIDEO_TYPES = (".mp4", ".m4v", ".avi", ".mov", ".mkv", ".webm", ".mpg", ".mpeg")

Image = UInt8[np.ndarray, "height width"]


class Trajectory(NamedTuple):
    """Times (n,) in seconds and poses T_wc (n, 4, 4) of the camera in the world."""

    times: Float[np.ndarray, " n"]
    T_wc: Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True)
class Frame:
    """One grey image: its place in the video, its time in seconds, uint8 (height, width)."""

    index: int
    time: float
    image: Image


@dataclass(frozen=True)
class Source:
    """A calibrated grey video, read or rendered frame by frame as it is iterated over.

    `times` (n,) are in seconds; `images` is called anew for every iteration and yields the n
    pictures; `reference` is the true (or a better) trajectory where one is known. Iterating
    raises `ValueError` for a picture that cannot be read or does not fit the calibration.
    """

    name: str
    calibration: Calibration
    times: Float[np.ndarray, " n"]
    images: Callable[[], Iterator[Image]]
    reference: Trajectory | None = None

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Frame]:
        size = (self.calibration.width, self.calibration.height)
        # Not strict: the number of frames a video file states can be a few too many.
        for index, (time, image) in enumerate(zip(self.times, self.images(), strict=False)):
            if image.shape[::-1] != size:
                raise ValueError(
                    f"{self.name}: image {index} is {image.shape[1]}x{image.shape[0]}, "
                    f"the calibration is for {size[0]}x{size[1]}"
                )
            yield Frame(index, float(time), image)


class Layout(NamedTuple):
    """A way videos lie on disk: its name, how it is recognised, how it is opened.

    `open` gets the path, the calibration the user chose (or None) and the frame rate (1/s) for
    layouts that hold no times.
    """

    name: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, Calibration | None, float], Source]


def open_source(
    path: str | Path,
    *,
    calibration: str | Path | None = None,
    reference: str | Path | None = None,
    rate: float = 30.0,
) -> Source:
    """The video at `path`, in the first of `LAYOUTS` that recognises it.

    `calibration` (JSON) and `reference` (TUM trajectory) override what the layout holds; `rate`
    is the frame rate in 1/s of a plain folder of images. Raises `ValueError`, naming the file
    and line, for anything missing, unreadable or contradictory; the first image is read here,
    later ones as the source is iterated over.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"rate is {rate}; a positive number of frames a second is accepted")
    layout = next((layout for layout in LAYOUTS if layout.recognises(path)), None)
    if layout is None:
        names = ", ".join(layout.name for layout in LAYOUTS)
        raise ValueError(f"{path}: unknown kind of source; accepted: {names}")
    source = layout.open(path, read_calibration(calibration) if calibration else None, rate)
    if reference is not None:
        source = replace(source, reference=Trajectory(*read_tum(reference)))
    if next(iter(source), None) is None:
        raise ValueError(f"{path}: not a single frame can be read")
    return source


def read_image(path: Path) -> Image:
    """The image in a file as grey uint8 (height, width); `ValueError` names what cannot be read."""
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise ValueError(f"{path}: cannot be read as an image")
    return image


def image_source(
    path: Path,
    files: list[Path],
    times: Float[np.ndarray, " n"],
    calibration: Calibration,
    reference: Path | None = None,
) -> Source:
    """A source over image files, for the layouts that hold such; `reference` may be missing."""
    trajectory = Trajectory(*read_tum(reference)) if reference and reference.exists() else None

    def images() -> Iterator[Image]:
        return map(read_image, files)

    return Source(path.resolve().name, calibration, times, images, trajectory)


def read_timestamps(path: Path) -> tuple[Float[np.ndarray, " n"], list[str]]:
    """Times in seconds and file names from lines `seconds file`; # starts a comment line.

    Raises `ValueError`, naming file and line, unless times are finite and increase.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        raise ValueError(f"{path}: cannot be read as text") from None
    times: list[float] = []
    names: list[str] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        time, name = _timestamp(f"{path}, line {number}", line)
        if times and time <= times[-1]:
            raise ValueError(
                f"{path}, line {number}: time {time} s does not come after {times[-1]} s"
            )
        times.append(time)
        names.append(name)
    if not times:
        raise ValueError(f"{path}: holds no lines of `seconds file`")
    return np.array(times), names


def _timestamp(place: str, line: str) -> tuple[float, str]:
    words = line.split(maxsplit=1)
    try:
        time = float(words[0])
    except ValueError:
        time = math.nan
    if len(words) != 2 or not math.isfinite(time):
        raise ValueError(f"{place}: `seconds file` with a finite number of seconds is accepted")
    return time, words[1].strip()


def _required(calibration: Calibration | None, path: Path) -> Calibration:
    if calibration is None:
        raise ValueError(f"{path}: comes without a calibration; give one (--calibration FILE)")
    return calibration


def _image_files(path: Path) -> list[Path]:
    """The images in a folder, numbers in their names compared as numbers (2 before 10)."""
    files = [
        file
        for file in path.iterdir()
        if file.suffix.lower() in IMAGE_TYPES and not file.name.startswith(".")
    ]
    return sorted(files, key=lambda file: _natural(file.name))


def _natural(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _open_timestamped(path: Path, calibration: Calibration | None, _rate: float) -> Source:
    times, names = read_timestamps(path / "timestamps.txt")
    files = [path / "images" / name for name in names]
    for file in files:
        if not file.is_file():
            raise ValueError(f"{path / 'timestamps.txt'}: names {file.name}, but {file} is missing")
    calibration = calibration or read_calibration(path / "calibration.json")
    return image_source(path, files, times, calibration, path / "groundtruth.txt")


def _open_folder(path: Path, calibration: Calibration | None, rate: float) -> Source:
    files = _image_files(path)
    if not files:
        raise ValueError(f"{path}: holds no images ({', '.join(IMAGE_TYPES)})")
    return image_source(path, files, np.arange(len(files)) / rate, _required(calibration, path))


def _open_video(path: Path, calibration: Calibration | None, _rate: float) -> Source:
    calibration = _required(calibration, path)
    capture = cv2.VideoCapture(str(path))
    try:
        rate = capture.get(cv2.CAP_PROP_FPS)
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        capture.release()
    if not (math.isfinite(rate) and rate > 0 and count > 0):
        raise ValueError(f"{path}: cannot be read as a video")
    return Source(path.name, calibration, np.arange(count) / rate, lambda: _video_images(path))


def _video_images(path: Path) -> Iterator[Image]:
    capture = cv2.VideoCapture(str(path))
    try:
        while True:
            found, image = capture.read()
            if not found:
                return
            yield image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    finally:
        capture.release()


# The first that recognises a path opens it; a new layout is one function and one row.
LAYOUTS = (
    Layout(
        "a video file (" + ", ".join(VIDEO_TYPES) + ")",
        lambda path: path.is_file() and path.suffix.lower() in VIDEO_TYPES,
        _open_video,
    ),
    Layout(
        "a folder with images/, timestamps.txt and calibration.json",
        lambda path: (path / "timestamps.txt").is_file(),
        _open_timestamped,
    ),
    Layout("a folder of images", Path.is_dir, _open_folder),
)
