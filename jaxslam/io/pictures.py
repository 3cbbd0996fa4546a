"""Pictures as people have them, made what the tracker looks at: grey, 8 bits."""

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

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
