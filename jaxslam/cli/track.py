"""`jaxslam track`: a camera through a video."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.cli.extra import one_line_warnings, require_vision, seconds
from jaxslam.filters.association import ASSOCIATIONS
from jaxslam.filters.words import FILTERS
from jaxslam.landmarks import LANDMARKS
from jaxslam.tracking.settings import METRIC, TrackerSettings


@dataclass(frozen=True)
class TrackOptions:
    """Track a camera through a video: trajectory, map, overlay."""

    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """Video file, folder of images, data set folder (TUM RGB-D, EuRoC, KITTI odometry, 7-Scenes),
    ROS 1 or ROS 2 bag, or the number of a live camera, such as 0. Default: a synthetic video."""
    topic: str | None = None
    """Image topic of a bag. Default: its only image topic."""
    calibration: Path | None = None
    """Camera calibration, a JSON file with model (pinhole, rational or fisheye), width, height, fx,
    fy, cx, cy and distortion (in OpenCV's order), or a file of OpenCV, ROS, Kalibr, EuRoC, TUM-VI,
    ORB-SLAM, COLMAP or another program (docs/own-video.md)."""
    fov: float | None = None
    """Horizontal field of view in degrees, in place of a calibration; focal length, centre and
    distortion (k1, k2) of the lens are then estimated.
    With neither, a typical field of view is assumed."""
    reference: Path | None = None
    """Reference trajectory in TUM format, for the absolute trajectory error. Default: that of the
    data set, if it has one."""
    target: Path | None = None
    """JSON file of known points visible in the first frame; the map is then in metres."""
    imu: Annotated[
        tuple[Path, ...] | None,
        tyro.conf.arg(
            metavar="[FILE]",
            help="Readings of an inertial unit (docs/own-video.md); the map is then in metres. "
            "Without a FILE those of the data set or bag.",
        ),
    ] = None
    imu_calibration: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE]")] = ()
    """Calibration of that unit: densities and its pose on the camera, as Kalibr's imu.yaml and
    camchain-imucam.yaml. Default: that of the data set, if it has one."""
    map: Path | None = None
    """map.npz of an earlier video by the same camera: localise in that map, with the settings saved
    in it, and continue it."""
    out: Path = Path("results")
    """Output folder for trajectory.txt, covariance.txt, frames.csv, summary.json, map.ply, map.npz,
    map.png and overlay.mp4."""
    frames: int | None = None
    """Maximum number of frames to track. Default: all; 150 for the synthetic video."""
    start: float = 0.0
    """Where to start, in seconds after the first frame; the nearest frame is used."""
    every: int = 1
    """Track every n-th frame only."""
    scale: float | None = None
    """Resize pictures and calibration by this factor. Default: without a target, pictures larger
    than 1280 pixels are reduced to a half, a third and so on."""
    seed: int = 0
    """Seed of the synthetic video; nothing else is random."""
    rate: float = 30.0
    """Frame rate of a folder of images without timestamps, frames per second."""
    filter: Annotated[
        str,
        tyro.conf.arg(
            help=f"Filter: {', '.join(FILTERS)}; modifiers can be added, as in robocentric+oc. "
            f"recommended means {TrackerSettings.filter}, or {METRIC} with a target."
        ),
    ] = "recommended"
    landmarks: Annotated[
        str, tyro.conf.arg(help=f"Landmark parametrization: {', '.join(LANDMARKS)}.")
    ] = TrackerSettings.landmarks
    calibration_treatment: str | None = TrackerSettings.calibration
    """How the filter treats the calibration: white, consider, estimated or known. Default:
    estimated, with the σ that it states, or else 0.3 % of the focal lengths."""
    nearest_depth: float = TrackerSettings.nearest_depth
    """Smallest expected depth, d_min, which sets the map unit: the prior on depth extends from here
    to infinity."""
    pixel_sigma: float = TrackerSettings.pixel_sigma
    """Standard deviation of a match, pixels."""
    readout: Annotated[str, tyro.conf.arg(metavar="TIME")] = "0ms"
    """Time from the first row's exposure to the last row's, of a rolling shutter, such as 20ms; a
    number alone is in seconds."""
    acceleration_sigma: float = TrackerSettings.acceleration_sigma
    """Standard deviation of the linear acceleration, map units/s²."""
    angular_acceleration_sigma: float = TrackerSettings.angular_acceleration_sigma
    """Standard deviation of the angular acceleration, rad/s²."""
    association: Annotated[
        str, tyro.conf.arg(help=f"How wrong matches are rejected: {', '.join(ASSOCIATIONS)}.")
    ] = TrackerSettings.association
    wanted: int = TrackerSettings.wanted
    """Number of landmarks to keep in view."""
    overlay: bool = True
    """Whether to write overlay.mp4."""
    viewer: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Recording for the Rerun viewer, written during tracking."""

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
            raise ValueError("give --map or --target, not both: a saved map already has a unit")
        target = None if self.target is None else read_target(self.target)
        if self.imu_calibration and self.imu is None:
            raise ValueError("--imu-calibration needs --imu, which says that readings are used")
        with one_line_warnings():
            inertial = None if self.imu is None else self._inertial(source)
        total = len(source) or self.frames
        # What the bar says while the first frames wait for their programs.
        with warming_bar(total, "frame", "compiling …", WARM_UP, "tracking") as progress:
            summary = track(
                source,
                self.out,
                self._settings(),
                target=target,
                known=self.map,
                inertial=inertial,
                overlay=self.overlay,
                viewer=self.viewer,
                progress=progress,
            )
        print(describe(summary))
        written = (
            "trajectory.txt, covariance.txt, frames.csv, summary.json, map.ply, map.npz, map.png"
        )
        print(f"wrote {written}{', overlay.mp4' if self.overlay else ''} to {self.out}")
        if self.viewer is not None:
            print(f"wrote {self.viewer}; view it with: rerun {self.viewer}")

    def _source(self):
        from jaxslam.io.opening import open_source
        from jaxslam.io.source import resized, selected
        from jaxslam.tracking.synthetic import synthetic_source

        if self.source is not None:
            names = ("calibration", "fov", "reference", "rate", "start", "every", "frames")
            how: Any = {name: getattr(self, name) for name in names}
            return open_source(
                self.source if self.topic is None else f"{self.source}:{self.topic}",
                **how,
                # A target's pixels are those of the pictures as they are.
                scale=1.0 if self.scale is None and self.target else self.scale,
            )
        if self.calibration or self.fov is not None or self.reference or self.target or self.topic:
            raise ValueError(
                "--calibration, --fov, --reference, --target and --topic need a SOURCE: the "
                "synthetic video has its own calibration and reference"
            )
        source = synthetic_source(
            frames=150 if self.frames is None else self.frames, seed=self.seed
        )
        part = selected(source, start=self.start, every=self.every)
        return part if self.scale is None else resized(part, self.scale)

    def _inertial(self, source):
        from jaxslam.io.imu import read_inertial
        from jaxslam.io.imu_calibration import read_inertial_calibration
        from jaxslam.tracking.inertial import Inertial

        assert self.imu is not None
        own, files = source.inertial, self.imu_calibration
        if self.map is not None or self.target is not None:
            raise ValueError("--imu starts a map of its own: give it without --map and --target")
        if source.clock is not None or len(self.imu) > 1 or not (self.imu or own):
            raise ValueError(
                f"--imu takes one FILE of readings for a recording: {source.name} has none of its "
                "own, or is a live camera"
            )
        readings = self.imu[0] if self.imu else own.readings
        files = files or (() if own is None else own.calibration)
        if not files:
            raise ValueError(
                f"the noise and the pose of the IMU of {readings} are not known: give "
                "--imu-calibration imu.yaml camchain-imucam.yaml (docs/own-video.md)"
            )
        log, calibration = read_inertial(readings), read_inertial_calibration(*files)
        for note in (*log.notes, *calibration.compared(log)):
            warnings.warn(note, stacklevel=2)
        return Inertial.of(log, calibration, source.times)

    def _settings(self):
        metric = self.filter == "recommended" and self.target is not None
        own: Any = {x.name: getattr(self, x.name, x.default) for x in fields(TrackerSettings)}
        return TrackerSettings(
            **own | {
                "filter": METRIC if metric else self.filter,
                "calibration": self.calibration_treatment,
                "readout": seconds("--readout", self.readout),
            }
        )  # fmt: skip
