"""A folder of images, with their times in `timestamps.txt` or at a frame rate."""

from pathlib import Path

import numpy as np

from jaxslam.io.recording import Layout, Recording, image_files, of_files, of_listing


def _open_plain(path: Path, rate: float) -> Recording:
    files = image_files(path)
    return of_files(path, files, np.arange(len(files)) / rate)


TIMESTAMPED = Layout(
    "a folder with images/ and timestamps.txt",
    lambda path: (path / "timestamps.txt").is_file(),
    lambda path, _rate: of_listing(path, path / "timestamps.txt", path / "images"),
)
PLAIN = Layout(
    "a folder of images", lambda path: path.is_dir() and bool(image_files(path)), _open_plain
)
