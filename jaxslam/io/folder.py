"""A folder of images, with their times in `timestamps.txt` or at a frame rate."""

from pathlib import Path

import numpy as np

from jaxslam.io.recording import (
    Layout,
    Recording,
    image_files,
    listed,
    of_files,
    read_timestamps,
)
from jaxslam.io.source import Trajectory
from jaxslam.io.tum import read_tum


def _open_timestamped(path: Path, _rate: float) -> Recording:
    listing = path / "timestamps.txt"
    times, names = read_timestamps(listing)
    truth = path / "groundtruth.txt"
    reference = Trajectory(*read_tum(truth)) if truth.is_file() else None
    return of_files(path, listed(listing, path / "images", names), times, reference=reference)


def _open_plain(path: Path, rate: float) -> Recording:
    files = image_files(path)
    return of_files(path, files, np.arange(len(files)) / rate)


TIMESTAMPED = Layout(
    "a folder with images/ and timestamps.txt",
    lambda path: (path / "timestamps.txt").is_file(),
    _open_timestamped,
)
PLAIN = Layout(
    "a folder of images", lambda path: path.is_dir() and bool(image_files(path)), _open_plain
)
