"""Open a video wherever it comes from, with the best calibration that is known."""

import itertools
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxslam.io.calibration import GUESSED_FIELD_OF_VIEW, Calibration, from_field_of_view
from jaxslam.io.camera import CAMERA
from jaxslam.io.euroc import EUROC
from jaxslam.io.file import VIDEO
from jaxslam.io.kitti import KITTI
from jaxslam.io.lens_files import read_calibration
from jaxslam.io.recording import PLAIN, TIMESTAMPED, Recording, image_files
from jaxslam.io.ros_images import ROS
from jaxslam.io.seven_scenes import SEVEN_SCENES
from jaxslam.io.source import Source, Trajectory, check_size, resized, selected
from jaxslam.io.tum import read_tum
from jaxslam.io.tum_rgbd import TUM_RGBD

LAYOUTS = (CAMERA, VIDEO, TUM_RGBD, EUROC, KITTI, SEVEN_SCENES, TIMESTAMPED, PLAIN, ROS)
"""The first that recognises a path opens it; a new layout is one file and one name."""
WIDEST = 1280
"""Pixels along the longer side up to which pictures are taken as they are."""


def open_source(
    path: str | Path,
    *,
    calibration: str | Path | None = None,
    fov: float | None = None,
    reference: str | Path | None = None,
    rate: float = 30.0,
    start: float = 0.0,
    every: int = 1,
    frames: int | None = None,
    scale: float | None = None,
) -> Source:
    """The video at `path`, in the first of `LAYOUTS` that recognises it.

    `calibration` (JSON, or of another program), `fov` (horizontal field of view, degrees) and
    `reference` (TUM trajectory) override what the layout holds; where nothing is known of the
    camera, its calibration is guessed, with a warning. `rate` is the frame rate in 1/s of a plain
    folder of images. Every `every`-th frame is taken, from `start` seconds after the first on, at
    most `frames` of them. Pictures and calibration are resized by the factor `scale`; by default
    those of more than `WIDEST` pixels are reduced to a half, a third and so on, with a warning.
    Raises `ValueError`, naming the file and line, for anything missing, unreadable or
    contradictory; the first image is read here, later ones as the source is iterated over.
    """
    if calibration and fov is not None:
        raise ValueError("give a calibration or a field of view, not both")
    recording = open_recording(path, rate)
    image = next(recording.images(), None)
    if image is None:
        raise ValueError(f"{path}: no frame can be read")
    height, width = image.shape
    camera = _calibration(recording, width, height, calibration, fov)
    check_size(f"{recording.name}: image 0", image, camera)
    held: Any = vars(recording) | {"calibration": camera}
    source = Source(**held)
    if reference is not None:
        source = replace(source, reference=Trajectory(*read_tum(reference)))
    if scale is None:
        scale = _scale_for(recording.name, width, height)
    return resized(selected(source, start=start, every=every, frames=frames), scale)


def open_recording(path: str | Path, rate: float = 30.0) -> Recording:
    """The recording at `path`, before an image is read. Raises ValueError."""
    path = Path(path)
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"rate must be a positive number of frames per second, not {rate}")
    for layout in LAYOUTS:
        if layout.recognises(path):
            return layout.open(path, rate)
    if not path.exists():
        before = str(path).rpartition(":")[0]
        if before and Path(before).exists():
            raise ValueError(f"{before} is no bag: only a bag has topics")
        raise ValueError(f"{path}: no such file or folder")
    names = "; ".join(layout.name for layout in LAYOUTS)
    raise ValueError(f"{path}: {_found(path)}, not a known kind of source; known: {names}")


def _found(path: Path) -> str:
    """A few words on what was found."""
    if not path.is_dir():
        return f"a file {path.suffix or 'without a suffix'}"
    names = [file.name + "/" * file.is_dir() for file in itertools.islice(path.iterdir(), 5)]
    inner = [x.name for x in sorted(path.iterdir()) if x.is_dir() and image_files(x)]
    hint = f" (pictures are in {', '.join(inner[:5])}: give one of these)" if inner else ""
    return f"a folder with {', '.join(sorted(names)) + ', …' if names else 'nothing in it'}{hint}"


def _scale_for(name: str, width: int, height: int) -> float:
    """Return by how much pictures are made smaller that are too large to be tracked well."""
    part = math.ceil(max(width, height) / WIDEST)
    if part > 1:
        warnings.warn(
            f"{name}: pictures of {width}x{height} are reduced to 1/{part} of their size, which is "
            "faster and suits the size of the patches; --scale 1 keeps their size",
            stacklevel=3,
        )
    return 1 / part


def _of_pictures(name: str, camera: Calibration, width: int, height: int) -> Calibration:
    """A calibration at the size of the pictures, where theirs is the same shape."""
    if camera.width == width or camera.width * height != camera.height * width:
        return camera
    warnings.warn(
        f"{name} is for {camera.width}x{camera.height}: it is taken to be of the same pictures "
        f"before they were resized to {width}x{height}",
        stacklevel=3,
    )
    return camera.resized(width, height)


def _calibration(
    recording: Recording, width: int, height: int, file: str | Path | None, fov: float | None
) -> Calibration:
    """The user's, or the layout's, or a guess."""
    if file:
        return _of_pictures(str(file), read_calibration(file, (width, height)), width, height)
    if fov is not None:
        return from_field_of_view(width, height, fov)
    if recording.calibration is not None:
        own = recording.calibration(width, height)
        return _of_pictures(f"{recording.name}: its calibration", own, width, height)
    warnings.warn(
        f"{recording.name} has no calibration: a horizontal field of view of "
        f"{GUESSED_FIELD_OF_VIEW:g}° is guessed, and the lens estimated. Better: give a "
        "calibration (docs/own-video.md) or the camera's field of view",
        stacklevel=3,
    )
    return from_field_of_view(width, height)
