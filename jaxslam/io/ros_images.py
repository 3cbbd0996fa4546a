"""The pictures of a topic of a ROS bag, and the lens in the `camera_info` beside it."""

import itertools
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from jaxslam.io.calibration import Calibration
from jaxslam.io.imu import InertialFiles
from jaxslam.io.lens_files import as_sent
from jaxslam.io.lens_files import lens as lens_of
from jaxslam.io.pictures import of_eight_bits
from jaxslam.io.recording import Calibrator, Layout, Recording, check_increasing, decoded
from jaxslam.io.ros import BAG, Message, Topic, bag_and_topic, chosen, messages, seconds

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_SAME = {
    "8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC1": "mono16", "16UC3": "bgr16",
    "yuv422": "uyvy8", "uyvy": "uyvy8", "yuv422_yuy2": "yuy28", "yuyv": "yuy28", "nv12": "mono8",
    "nv21": "mono8", "nv24": "mono8",
}  # fmt: skip
"""Encodings by other names; those of planes begin with that of brightness."""
_COLOURS, _MOSAICS = ("bgr", "rgb", "bgra", "rgba"), ("rggb", "bggr", "gbrg", "grbg")
_GREY = {
    "mono": (1, None),
    **{x: (len(x), getattr(cv2, f"COLOR_{x.upper()}2GRAY")) for x in _COLOURS},
    **{f"bayer_{x}": (1, getattr(cv2, f"COLOR_Bayer{x.upper()}2GRAY")) for x in _MOSAICS},
    **{x: (2, getattr(cv2, f"COLOR_YUV2GRAY_{x.upper()}")) for x in ("uyvy", "yuy2")},
}
"""Numbers of a pixel by encoding, before its bits, and how OpenCV makes them grey."""
_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_ACCEPTED = f"{', '.join(_GREY)} of 8 or 16 bits, {', '.join(_SAME)}"


def _open(path: Path, _rate: float) -> Recording:
    bag, named = bag_and_topic(path) or (path, "")
    topic = chosen(bag, named, IMAGES, "--topic")
    stamps = np.array([seconds(message) for message in messages(topic)])
    new = np.diff(stamps, prepend=-np.inf) != 0
    new |= new.sum() < 0.5 * len(new)  # never stamped
    if not new.all():
        told = f"{(~new).sum()} of {len(new)} pictures have the stamp of the one before"
        warnings.warn(f"{topic}: {told}, and are left out", stacklevel=2)
    check_increasing(f"{topic}, message", np.flatnonzero(new).tolist(), stamps[new])

    def images(every: int) -> Iterator[np.ndarray]:
        told = (x for x in enumerate(messages(topic)) if new[x[0]])
        part = itertools.islice(told, 0, None, every)
        return (as_image(f"{topic}, message {i}", x) for i, x in part)

    lens, inertial, name = _calibrator(topic), InertialFiles(bag), f"{topic}"
    pictures = of_eight_bits(name, images, len(stamps))
    return Recording(name, stamps[new], pictures, lens, inertial=inertial)


def as_image(place: str, message: Message) -> np.ndarray:
    """The picture of a message, grey, of 8 or 16 bits. Raises ValueError."""
    if not hasattr(message, "encoding"):
        image = decoded(place, message.data, _FLAGS)
        mosaic = re.match(r"(bayer_\w{4})\d+;(?!.*(bgr|rgb)8$)", message.format)
        how = None if mosaic is None else _GREY[mosaic[1]][1]
        return image if how is None else cv2.cvtColor(image, how)
    encoding = _SAME.get(message.encoding, message.encoding)
    name, size = encoding.removesuffix("8").removesuffix("16"), 2 if encoding.endswith("16") else 1
    if name not in _GREY or name == encoding:
        raise ValueError(f"{place}: unknown encoding {encoding!r}; known: {_ACCEPTED}")
    channels, how = _GREY[name]
    height, width, step = message.height, message.width, message.step
    used = width * channels * size
    if not (0 < used <= step and 0 < height * step <= len(message.data)):
        raise ValueError(
            f"{place}: {len(message.data)} bytes in rows of {step} are not a complete "
            f"{width}x{height} picture in {message.encoding}"
        )
    rows = message.data[: height * step].reshape(height, step)[:, :used]
    numbers = np.ascontiguousarray(rows).view(f"{'<>'[bool(message.is_bigendian)]}u{size}")
    shape = (height, width, channels)[: 2 + (channels > 1)]
    pixels = numbers.astype(np.uint8 if size == 1 else np.uint16).reshape(shape)
    return pixels if how is None else cv2.cvtColor(pixels, how)


def _calibrator(topic: Topic) -> Calibrator | None:
    """The lens in the first `camera_info` beside the pictures: K and D, or P if they are rectified.

    That is of the whole sensor, of which a part may be read, and pixels binned. None where it
    is zero: not calibrated. Another distortion is refused when it is asked for.
    """
    camera, slash, last = topic.name.removesuffix("/compressed").rpartition("/")
    rectified = "rect" in last
    beside = Topic(topic.parent, f"{camera}{slash}camera_info", "sensor_msgs/msg/CameraInfo")
    info: Message = next(messages(beside), None)
    D, K, P = (getattr(info, x, getattr(info, x.lower(), np.empty(0))) for x in "DKP")  # ROS 1, 2
    matrix = P if rectified else K
    if not matrix.any():
        return None

    def lens(_width: int, _height: int) -> Calibration:
        pinhole = matrix.reshape(3, -1)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        roi = (info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height)
        part = [int(x) for x in (*roi, info.binning_x, info.binning_y)]
        try:
            names = [info.distortion_model] if info.distortion_model else []
            model, distortion = lens_of(*(([], []) if rectified else (names, D.tolist())))
            whole = Calibration(
                info.width, info.height, *pinhole, distortion=distortion, model=model
            )
            return as_sent(whole, part)
        except ValueError as error:
            raise ValueError(f"{beside}: {error}") from None

    return lens


ROS = Layout(BAG, lambda path: bag_and_topic(path) is not None, _open)
