"""`jaxslam track`: a camera through a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.cli.extra import one_line_warnings, require_vision
from jaxslam.filters.association import ASSOCIATIONS
from jaxslam.filters.words import FILTERS
from jaxslam.landmarks import LANDMARKS
from jaxslam.tracking.settings import METRIC, TrackerSettings

_COMPILING = "compiling …"
"""What the bar says while the first frames wait for their programs."""


@dataclass(frozen=True)
class TrackOptions:
    """Options of the command; every field is an option."""

    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """Video file, folder of images, data set folder (TUM RGB-D, EuRoC, KITTI odometry, 7-Scenes),
    bag of ROS 1 or 2, or the number of a camera, 0. Without it: a synthetic video."""
    topic: str | None = None
    """Of a bag: the topic of its pictures; by default the only one that has any."""
    calibration: Path | None = None
    """Camera's JSON file: model, width, height, fx, fy, cx, cy, distortion (OpenCV's order)."""
    fov: float | None = None
    """Horizontal field of view in place of a calibration, degrees; it is estimated then. With
    neither, a usual one is guessed."""
    reference: Path | None = None
    """Reference trajectory in TUM format, to report the absolute trajectory error; by default the
    data set's own."""
    target: Path | None = None
    """JSON file of known points that the first frame sees: the map is in metres."""
    map: Path | None = None
    """The map.npz of another video by the same camera: this one is localised in its map, and goes
    on with it, by its settings."""
    out: Path = Path("results")
    """Folder for trajectory.txt, covariance.txt, frames.csv, summary.json, map.ply, map.npz,
    map.png and overlay.mp4."""
    frames: int | None = None
    """Frames to track, at the most; of the synthetic video 150 by default."""
    start: float = 0.0
    """Where to begin, seconds after the first frame: at the frame that is nearest."""
    every: int = 1
    """Track every n-th frame only."""
    scale: float | None = None
    """Make pictures, and their calibration, so many times as large: 0.5 for half the size. By
    default, and without a target, those above 1280 pixels are halved, or a third and so on."""
    seed: int = 0
    """Seed of the synthetic video; nothing else is random."""
    rate: float = 30.0
    """Frames per second of a folder of images without timestamps."""
    filter: Annotated[
        str,
        tyro.conf.arg(
            help=f"Filter: {', '.join(FILTERS)}; may be modified, as in robocentric+oc. "
            f"recommended stands for {TrackerSettings.filter}, with a target for {METRIC}."
        ),
    ] = "recommended"
    landmarks: Annotated[
        str, tyro.conf.arg(help=f"Landmark parametrization: {', '.join(LANDMARKS)}.")
    ] = TrackerSettings.landmarks
    calibration_treatment: str | None = TrackerSettings.calibration
    """How the filter treats it: white, consider, estimated or known. By default one that a field
    of view tells, or that is guessed, is estimated, and any other is known."""
    nearest_depth: float = TrackerSettings.nearest_depth
    """d_min, which sets the unit of the map: the prior on depth reaches from here to infinity."""
    pixel_sigma: float = TrackerSettings.pixel_sigma
    """Standard deviation of a match, pixels."""
    acceleration_sigma: float = TrackerSettings.acceleration_sigma
    """Standard deviation of the linear acceleration, map units/s²."""
    angular_acceleration_sigma: float = TrackerSettings.angular_acceleration_sigma
    """Standard deviation of the angular acceleration, rad/s²."""
    association: Annotated[
        str, tyro.conf.arg(help=f"Which matches are believed: {', '.join(ASSOCIATIONS)}.")
    ] = TrackerSettings.association
    wanted: int = TrackerSettings.wanted
    """Landmarks to keep in view."""
    overlay: bool = True
    """Whether to write overlay.mp4."""
    viewer: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Recording for the rerun viewer, written as the frames come."""

    def run(self) -> None:
        """Track the video, print the summary, write its files."""
        require_vision("tracking")
        from jaxslam._runtime.progress import warming_bar
        from jaxslam.tracking.summary import WARM_UP, describe
        from jaxslam.tracking.target import read_target
        from jaxslam.tracking.video import track

        with one_line_warnings():
            source = self._source()
        if self.map is not None and self.target is not None:
            raise ValueError("give --map or --target, not both: a saved map has its unit")
        target = None if self.target is None else read_target(self.target)
        total = len(source) or self.frames
        with warming_bar(total, "frame", _COMPILING, WARM_UP, "tracking") as progress:
            summary = track(
                source,
                self.out,
                self._settings(),
                target=target,
                known=self.map,
                overlay=self.overlay,
                viewer=self.viewer,
                progress=progress,
            )
        print(describe(summary))
        written = (
            "trajectory.txt, covariance.txt, frames.csv, summary.json, map.ply, map.npz, map.png"
        )
        print(f"wrote {written}{', overlay.mp4' if self.overlay else ''} in {self.out}")
        if self.viewer is not None:
            print(f"wrote {self.viewer}: rerun {self.viewer} shows it")

    def _source(self):
        from jaxslam.io.opening import open_source
        from jaxslam.io.source import resized, selected
        from jaxslam.tracking.synthetic import synthetic_source

        if self.source is not None:
            return open_source(
                self.source if self.topic is None else f"{self.source}:{self.topic}",
                calibration=self.calibration,
                fov=self.fov,
                reference=self.reference,
                rate=self.rate,
                start=self.start,
                every=self.every,
                frames=self.frames,
                # A target's pixels are those of the pictures as they are.
                scale=1.0 if self.scale is None and self.target else self.scale,
            )
        if self.calibration or self.fov is not None or self.reference or self.target or self.topic:
            raise ValueError(
                "--calibration, --fov, --reference, --target and --topic need a SOURCE: the "
                "synthetic video has its own"
            )
        source = synthetic_source(
            frames=150 if self.frames is None else self.frames, seed=self.seed
        )
        part = selected(source, start=self.start, every=self.every)
        return part if self.scale is None else resized(part, self.scale)

    def _settings(self):
        metric = self.filter == "recommended" and self.target is not None
        return TrackerSettings(
            filter=METRIC if metric else self.filter,
            landmarks=self.landmarks,
            calibration=self.calibration_treatment,
            nearest_depth=self.nearest_depth,
            pixel_sigma=self.pixel_sigma,
            acceleration_sigma=self.acceleration_sigma,
            angular_acceleration_sigma=self.angular_acceleration_sigma,
            association=self.association,
            wanted=self.wanted,
        )
