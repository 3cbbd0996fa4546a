"""The pictures of a topic of a ROS bag, and the lens in the `camera_info` beside it."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from jaxslam.io.calibration import Calibration
from jaxslam.io.imu import InertialFiles
from jaxslam.io.lens_files import lens as lens_of
from jaxslam.io.recording import Calibrator, Layout, Recording, check_increasing, decoded
from jaxslam.io.ros import BAG, Message, Topic, bag_and_topic, chosen, messages, seconds
from jaxslam.io.source import Image

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_COLOURS, _MOSAICS = ("bgr", "rgb", "bgra", "rgba"), ("rggb", "bggr", "gbrg", "grbg")
_GREY = {
    "mono": (1, None),
    **{x: (len(x), getattr(cv2, f"COLOR_{x.upper()}2GRAY")) for x in _COLOURS},
    **{f"bayer_{x}": (1, getattr(cv2, f"COLOR_Bayer{x.upper()}2GRAY")) for x in _MOSAICS},
}
"""Numbers of a pixel by encoding, before its bits, and how OpenCV makes them grey."""
_ACCEPTED = f"{', '.join(_GREY)} of 8 or 16 bits"


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

    def images() -> Iterator[Image]:
        told = (x for x in enumerate(messages(topic)) if new[x[0]])
        return (as_image(f"{topic}, message {i}", x) for i, x in told)

    lens, inertial = _calibrator(topic), InertialFiles(bag)
    return Recording(f"{topic}", stamps[new], images, lens, inertial=inertial)


def as_image(place: str, message: Message) -> Image:
    """The picture of a message, grey; of 16 bits the upper eight. Raises ValueError."""
    if not hasattr(message, "encoding"):
        return decoded(place, message.data)
    encoding = {"8UC1": "mono8", "8UC3": "bgr8"}.get(message.encoding, message.encoding)
    name, size = encoding.removesuffix("8").removesuffix("16"), 2 if encoding.endswith("16") else 1
    if name not in _GREY or name == encoding:
        raise ValueError(f"{place}: unknown encoding {encoding!r}; known: {_ACCEPTED}")
    channels, how = _GREY[name]
    height, width, step = message.height, message.width, message.step
    used = width * channels * size
    if not (0 < used <= step and 0 < height * step <= len(message.data)):
        raise ValueError(
            f"{place}: {len(message.data)} bytes in rows of {step} are not a complete "
            f"{width}x{height} picture in {encoding}"
        )
    rows = message.data[: height * step].reshape(height, step)[:, :used]
    rows = rows[:, 0 if message.is_bigendian else size - 1 :: size]
    pixels = np.ascontiguousarray(rows.reshape((height, width, channels)[: 2 + (channels > 1)]))
    return pixels if how is None else cv2.cvtColor(pixels, how)


def _calibrator(topic: Topic) -> Calibrator | None:
    """The lens in the first `camera_info` beside the pictures: K and D, or P if they are rectified.

    That is of the whole sensor, of which pixels may be binned. None where K is zero: not
    calibrated. Another distortion is refused when it is asked for.
    """
    camera, _, last = topic.name.removesuffix("/compressed").rpartition("/")
    beside = Topic(topic.parent, f"{camera}/camera_info", "sensor_msgs/msg/CameraInfo")
    info: Message = next(messages(beside), None)
    D, K, P = (getattr(info, x, getattr(info, x.lower(), np.empty(0))) for x in "DKP")  # ROS 1, 2
    if not K.any():
        return None

    def lens(_width: int, _height: int) -> Calibration:
        rectified = "rect" in last
        matrix = (P if rectified else K).reshape(3, -1)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        binned = [max(int(getattr(info, f"binning_{axis}")), 1) for axis in "xy"]
        try:
            names = [info.distortion_model] if info.distortion_model else []
            model, distortion = lens_of(*(([], []) if rectified else (names, D.tolist())))
            whole = Calibration(
                info.width, info.height, *matrix, distortion=distortion, model=model
            )
            return whole.resized(info.width // binned[0], info.height // binned[1])
        except ValueError as error:
            raise ValueError(f"{beside}: {error}") from None

    return lens


ROS = Layout(BAG, lambda path: bag_and_topic(path) is not None, _open)
