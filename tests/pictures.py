"""Small pictures for tests of what reads them."""

import struct

import cv2
import numpy as np

WIDTH, HEIGHT = 64, 48


def picture(index):
    """A grey image that tells its index by its brightness."""
    return np.full((HEIGHT, WIDTH), 10 * index + 5, np.uint8)


def write_pictures(folder, names):
    """`picture(0)`, `picture(1)`, … under these names."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(index))


def brightness(source):
    return [int(frame.image[0, 0]) for frame in source]


def jpeg(image, orientation=1, order="<"):
    """The bytes of a JPEG with an EXIF orientation, its number in this order of bytes."""
    entry = struct.pack(f"{order}HHIHH", 0x0112, 3, 1, orientation, 0)
    mark = b"II" if order == "<" else b"MM"
    tiff = mark + struct.pack(f"{order}HIH", 42, 8, 1) + entry + bytes(4)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    exif = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
