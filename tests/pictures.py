"""Small pictures for tests of what reads them."""

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
