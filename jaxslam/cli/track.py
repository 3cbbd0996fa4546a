"""`jaxslam track`: a camera through a video."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.landmarks import LANDMARKS
from jaxslam.names import FILTERS
from jaxslam.simulation.scenario import CALIBRATIONS
from jaxslam.vision.settings import TrackerSettings


@dataclass(frozen=True)
class TrackOptions:
    """Options of the command; every field is an option."""

    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """Folder of images, data set folder or video file. Without it: a synthetic video."""
    calibration: Path | None = None
    """Camera's JSON file: model, width, height, fx, fy, cx, cy, distortion (OpenCV's order)."""
    reference: Path | None = None
    """Reference trajectory in TUM format, to report the absolute trajectory error."""
    out: Path = Path("results")
    """Folder for trajectory.txt, covariance.txt, frames.csv, map.ply, map.png, overlay.mp4 and
    summary.json."""
    frames: int | None = None
    """Frames of the synthetic video; 150 by default."""
    seed: int = 0
    """Seed of the synthetic video; nothing else is random."""
    rate: float = 30.0
    """Frames per second of a folder of images without timestamps."""
    filter: Annotated[
        str,
        tyro.conf.arg(help=f"Filter: {', '.join(FILTERS)}; may be modified, as in robocentric+oc."),
    ] = TrackerSettings.filter
    landmarks: Annotated[
        str, tyro.conf.arg(help=f"Landmark parametrization: {', '.join(LANDMARKS)}.")
    ] = TrackerSettings.landmarks
    calibration_treatment: Annotated[
        str, tyro.conf.arg(help=f"How the filter treats it: {', '.join(CALIBRATIONS)}.")
    ] = TrackerSettings.calibration
    nearest_depth: float = TrackerSettings.nearest_depth
    """d_min, which sets the unit of the map: the prior on depth reaches from here to infinity."""
    pixel_sigma: float = TrackerSettings.pixel_sigma
    """Standard deviation of a match, pixels."""
    acceleration_sigma: float = TrackerSettings.acceleration_sigma
    """Standard deviation of the linear acceleration, map units/s²."""
    angular_acceleration_sigma: float = TrackerSettings.angular_acceleration_sigma
    """Standard deviation of the angular acceleration, rad/s²."""
    wanted: int = TrackerSettings.wanted
    """Landmarks to keep in view."""

    def run(self) -> None:
        """Track the video, print the summary, write its files."""
        # Their own complaints about broken files would come beside our one line.
        os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        try:
            import cv2  # noqa: F401
            import evo  # noqa: F401
        except ImportError as error:
            raise ValueError(
                f"tracking needs the vision extra ({error.name} is missing): "
                "pip install 'jaxslam[vision]'"
            ) from None
        from tqdm import tqdm

        from jaxslam.vision.track import describe, track

        source = self._source()
        with tqdm(total=len(source), unit="frame", disable=None) as bar:
            summary = track(source, self.out, self._settings(), progress=bar.update)
        print(describe(summary))
        print(
            "wrote trajectory.txt, covariance.txt, frames.csv, map.ply, map.png, overlay.mp4, "
            f"summary.json in {self.out}"
        )

    def _source(self):
        from jaxslam.vision.sources import open_source
        from jaxslam.vision.synthetic import synthetic_source

        if self.source is not None:
            if self.frames is not None:
                raise ValueError("--frames is for the synthetic video: leave SOURCE out")
            return open_source(
                self.source,
                calibration=self.calibration,
                reference=self.reference,
                rate=self.rate,
            )
        if self.calibration or self.reference:
            raise ValueError(
                "--calibration and --reference need a SOURCE: the synthetic video has its own"
            )
        return synthetic_source(frames=150 if self.frames is None else self.frames, seed=self.seed)

    def _settings(self):
        return TrackerSettings(
            filter=self.filter,
            landmarks=self.landmarks,
            calibration=self.calibration_treatment,
            nearest_depth=self.nearest_depth,
            pixel_sigma=self.pixel_sigma,
            acceleration_sigma=self.acceleration_sigma,
            angular_acceleration_sigma=self.angular_acceleration_sigma,
            wanted=self.wanted,
        )
