"""A video file, with the times that it gives its pictures itself."""

import itertools
import math
import warnings
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from jaxslam.io.pictures import as_grey, of_eight_bits
from jaxslam.io.recording import Layout, Recording

_GREY_16 = int.from_bytes(b"Y1\0\x10", "little")
"""FFmpeg's name of grey pictures of 16 bits."""
VIDEO_TYPES = (".mp4", ".m4v", ".avi", ".mov", ".mkv", ".webm", ".mpg", ".mpeg")


def _open(path: Path, _rate: float) -> Recording:
    times = read_times(path)

    def images(every: int) -> Iterator[np.ndarray]:
        return itertools.islice(_images(path), 0, None, every)

    return Recording(path.name, times, of_eight_bits(path.name, images, len(times)))


def read_times(path: Path) -> Float[np.ndarray, " n"]:
    """The time of every picture that can be read, in seconds: a pass over the whole file.

    Phones film at a rate that varies. A file whose times do not increase has those of its frame
    rate, and a file with fewer pictures than it says ends early, with a warning each. Raises
    ValueError where there is no picture.
    """
    with opened(path) as capture:
        stated, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        times = []
        while capture.grab():
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
    if not times:
        raise ValueError(f"{path}: cannot be read as a video")
    # Where the file states no number, this one is of its length at the rate: frames may be dropped.
    if len(times) < stated and times[-1] * rate < stated - 1.75:
        warnings.warn(
            f"{path}: only {len(times)} of the {stated:.0f} pictures it claims to have can be read",
            stacklevel=2,
        )
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    return _at_rate(path, times, int(wrong[0]) + 1, rate) if len(wrong) else np.array(times)


def _at_rate(path: Path, times: list[float], wrong: int, rate: float) -> Float[np.ndarray, " n"]:
    place = f"picture {wrong} is at {times[wrong]:.3f} s, after one at {times[wrong - 1]:.3f} s"
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"{path}: {place}, and its frame rate is unknown")
    warnings.warn(f"{path}: {place}; {rate:g} frames per second are assumed instead", stacklevel=2)
    return np.arange(len(times)) / rate


@contextmanager
def opened(where: Path | int) -> Generator[cv2.VideoCapture]:
    """A capture of a file or of a camera's number, released at the end."""
    capture = cv2.VideoCapture(where if isinstance(where, int) else str(where))
    try:
        yield capture
    finally:
        capture.release()


def _images(path: Path) -> Iterator[np.ndarray]:
    with opened(path) as capture:
        if int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) == _GREY_16:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # which would leave the upper 8 bits
        while True:
            found, image = capture.read()
            if not found:
                return
            yield image if image.dtype == np.uint16 else as_grey(image)


VIDEO = Layout(
    "a video file (" + ", ".join(VIDEO_TYPES) + ")",
    lambda path: path.is_file() and path.suffix.lower() in VIDEO_TYPES,
    _open,
)
