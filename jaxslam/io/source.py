"""A calibrated grey video, frame by frame, and the part of one that is wanted."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.io.calibration import Calibration
from jaxslam.io.imu import InertialFiles

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
    pictures; `reference` is the true (or a better) trajectory where one is known. A live camera
    has a `clock`, which says when the picture before came, and no times beforehand. The frames
    are `first`, `first + every`, … of the whole video. `inertial` is where the readings of its IMU
    are, if it has any. Iterating raises `ValueError` for a picture that is missing, cannot be read
    or does not fit the calibration.
    """

    name: str
    calibration: Calibration
    times: Float[np.ndarray, " n"]
    images: Callable[[], Iterator[Image]]
    reference: Trajectory | None = None
    clock: Callable[[], float] | None = None
    first: int = 0
    every: int = 1
    inertial: InertialFiles | None = None

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Frame]:
        # The picture first: a clock is asked after it.
        times = iter(self.times) if self.clock is None else iter(self.clock, None)
        index = self.first
        for image, time in zip(self.images(), times, strict=False):
            check_size(f"{self.name}: image {index}", image, self.calibration)
            yield Frame(index, float(time), image)
            index += self.every
        if index < self.first + self.every * len(self):
            raise ValueError(f"{self.name}: image {index} cannot be read; the sequence ends there")


def check_size(what: str, image: Image, calibration: Calibration) -> None:
    """Raise ValueError unless an image, called `what`, is as large as the calibration says."""
    height, width = image.shape
    if (width, height) != (calibration.width, calibration.height):
        raise ValueError(
            f"{what} is {width}x{height}, but the calibration is for "
            f"{calibration.width}x{calibration.height}"
        )


def selected(
    source: Source, *, start: float = 0.0, every: int = 1, frames: int | None = None
) -> Source:
    """Every `every`-th frame from the one that is nearest to `start` on, at most `frames`.

    `start` is in seconds after the first frame. Raises ValueError for numbers that select none.
    """
    for name, count in (("every", every), ("frames", frames)):
        if count is not None and count < 1:
            raise ValueError(f"{name} must be a positive whole number, not {count}")
    if source.clock is not None and start:
        raise ValueError(f"start is {start} s; a live camera starts when it is opened")
    end = float(np.ptp(source.times)) if len(source) else 0.0
    if not 0 <= start <= end:
        raise ValueError(f"start is {start} s; {source.name} has frames from 0 to {end:.3f} s")
    since = source.times - source.times[:1]
    first = int(np.argmin(np.abs(since - start))) if len(since) else 0
    stop = None if frames is None else first + every * frames
    images = source.images
    return replace(
        source,
        times=source.times[first:stop:every],
        images=lambda: itertools.islice(images(), first, stop, every),
        first=source.first + first * source.every,
        every=source.every * every,
    )


def resized(source: Source, factor: float) -> Source:
    """The source with pictures and calibration resized by a factor, in whole pixels.

    Raises ValueError for a factor that leaves no picture.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"scale must be a positive factor (0.5 for half the size), not {factor}")
    if factor == 1:
        return source
    old, images = source.calibration, source.images
    new = old.resized(round(old.width * factor), round(old.height * factor))
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR

    def smaller() -> Iterator[Image]:
        for index, image in enumerate(images()):
            check_size(f"{source.name}: image {source.first + index * source.every}", image, old)
            yield cv2.resize(image, (new.width, new.height), interpolation=how)

    return replace(source, calibration=new, images=smaller)
