"""Pictures as people have them, made what the tracker looks at: grey, 8 bits."""

import functools
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

_ORIENTATION = re.compile(
    rb"Exif\0\0.*?(?:\x12\x01\x03\0\x01\0\0\0(.)\0|\x01\x12\0\x03\0\0\0\x01\0(.))", re.DOTALL
)
"""The entry of a JPEG's EXIF: its tag, its kind, one of it, and the orientation, in both orders."""
_ACCEPTED = (
    "a picture is uint8, or floats from 0 to 1, of shape (height, width) or (height, width, 3)"
)


def as_grey(image: ArrayLike) -> UInt8[np.ndarray, "height width"]:
    """The picture in grey, uint8; one that is so already is itself.

    Colours come in OpenCV's order: blue, green, red. Raises ValueError for anything else, with
    what it is.
    """
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,)) or not array.size:
        raise ValueError(f"{_ACCEPTED}, not of shape {np.shape(image)}")
    array = _in_bytes(array)
    return array if array.ndim == 2 else cv2.cvtColor(array, cv2.COLOR_BGR2GRAY)


def _in_bytes(array: np.ndarray) -> np.ndarray:
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array)
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"{_ACCEPTED}, not {array.dtype}")
    if not np.all((array >= 0) & (array <= 1)):
        raise ValueError(f"{_ACCEPTED}, not floats from {array.min():g} to {array.max():g}")
    return np.rint(255 * array).astype(np.uint8)


def of_eight_bits(
    name: str, pictures: Callable[[int], Iterable[np.ndarray]], count: int
) -> Callable[[], Iterator[UInt8[np.ndarray, "height width"]]]:
    """Grey pictures, so many, with 8 bits: as they are, or of 16 bits the upper 8.

    `pictures` gives every n-th of them. Where they use less than half of the levels of 16 bits, as
    those of a thermal camera do, all are stretched by one gain about their means, which drift as
    the sensor warms, with a warning.
    """

    @functools.cache
    def levels() -> tuple[float, float]:
        about = [x.ravel()[::7] - x.mean() for x in pictures(count // 16 + 1)]
        low, high = np.percentile(np.concatenate(about), (0.5, 99.5)).tolist()
        if 0 < high - low < 2**15:
            told = f"more than 8 bits, of which {high - low:.0f} grey levels are used"
            warnings.warn(f"{name}: pictures have {told}; these are made 256", stacklevel=2)
        return low, high - low

    def of_bytes(picture: np.ndarray) -> UInt8[np.ndarray, "height width"]:
        if picture.dtype == np.uint8:
            return picture
        low, spread = levels()
        if 0 < spread < 2**15:
            picture = (picture - picture.mean() - low) * (255 * 256 / spread)
        return np.clip(picture / 256, 0, 255).astype(np.uint8)

    return lambda: map(of_bytes, pictures(1))


def orientation(path: Path) -> int:
    """The orientation (EXIF, 1 to 8) in which a JPEG is to be shown; 1 where it states none."""
    with path.open("rb") as file:
        found = _ORIENTATION.search(file.read(2**16))
    return (found[1] or found[2])[0] if found else 1
