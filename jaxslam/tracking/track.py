"""Track a whole video and write its files, from the trajectory to the overlay."""

from __future__ import annotations

import csv
import dataclasses
import math
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.stats import chi2

from jaxslam._runtime.files import write_atomically, write_json
from jaxslam._version import __version__
from jaxslam.filters.protocol import AbstractStaged
from jaxslam.io.calibration import INTRINSICS, as_fields
from jaxslam.io.source import Frame, Source, Trajectory
from jaxslam.plots.tracking import plot_map
from jaxslam.tracking.film import Aside, OverlayWriter
from jaxslam.tracking.overlay import draw_overlay, overlay_size
from jaxslam.tracking.pointcloud import write_ply
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.target import Target, as_summary
from jaxslam.tracking.tracker import Points, Tracked, Tracker
from jaxslam.tracking.trajectory import (
    absolute_trajectory_error,
    alignment,
    relative_pose_error,
    write_covariances,
    write_trajectory,
)
from jaxslam.tracking.viewer import Viewer

SCHEMA = 1
WARM_UP = 3
"""Frames in which functions are compiled; they count in `seconds.start`, not in the quantiles."""
_MAP_EVERY = 10
"""Frames from one map of a recording to the next."""
_COLUMNS = (
    "frame", "time", "state", "map", "matches", "nis", "nis_dof",
    "sigma_position", "sigma_orientation", "sigma_log_scale", "log_scale", "unit_fixed",
)  # fmt: skip
TOO_SURE = (
    "the intrinsics are estimated: sigma of them, and of poses with them, is known to be too small"
)
"""What is to be said wherever it stands."""
_KNOWN_DEPTH = 0.3
"""A point is put into the map where its σ is below this share of its distance."""


def track(
    source: Source,
    out: str | Path,
    settings: TrackerSettings | None = None,
    *,
    slam: AbstractStaged | None = None,
    target: Target | None = None,
    overlay: bool = True,
    viewer: str | Path | None = None,
    progress: Callable[[int], None] = lambda frames: None,
) -> dict[str, Any]:
    """Track `source`, write `trajectory.txt`, `covariance.txt`, `frames.csv`, `summary.json`,
    `map.ply`, `map.png` and, if wanted, `overlay.mp4` into the folder `out`, and return the
    summary.

    An interruption (KeyboardInterrupt) or an unreadable frame (ValueError) leaves all of them for
    the frames so far, and is raised again. `slam` is a filter of one's own, in place of the one
    that the settings name. `target`, known points that the first frame sees, makes the map metric.
    `viewer` is a file for the rerun viewer, FILE.rrd, written beside the others.
    """
    recording = None if viewer is None else Viewer(viewer, source.calibration)
    tracker = Tracker(source.calibration, settings or TrackerSettings(), slam, target)
    if source.clock is not None:
        tracker.compile()
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    history: list[Tracked] = []
    seconds: list[float] = []
    try:
        film = out / "overlay.mp4" if overlay else None
        _track_frames(source, tracker, film, recording, history, seconds, progress)
    except BaseException:
        if history:
            _write(source, tracker, history, seconds, out)
        raise
    return _write(source, tracker, history, seconds, out)


def describe(summary: dict[str, Any]) -> str:
    """The summary in a few lines."""
    nis, seconds = summary["nis"], summary["seconds"]
    per_dof = nis["mean"] / nis["dof"] if nis["dof"] else float("nan")
    lines = [
        f"{summary['source']}: {summary['tracked']} of {summary['frames']} frames tracked, "
        f"{summary['matches_per_frame']:.1f} matches a frame, NIS per dof {per_dof:.2f}",
        f"{seconds['per_frame_median'] * 1e3:.0f} ms a frame (median), "
        f"{seconds['total']:.1f} s in all, {seconds['start']:.1f} s of them to start",
    ]
    if summary["maps"] > 1:
        lines.append(
            f"{summary['maps']} maps, each in a unit of its own: frames.csv says where they begin"
        )
    lines += [_unit_line(unit) for unit in summary["units"] if unit["sigma_log_scale"] is not None]
    camera = summary["calibration"]
    if "estimated" in camera:
        pairs = ((key, camera["estimated"][key], camera["sigma"][key]) for key in INTRINSICS)
        lines.append("camera: " + ", ".join(f"{k} {x:.1f} ± {s:.1f}" for k, x, s in pairs))
        lines.append(camera["caveat"])
    if "ate" in summary:
        ate = summary["ate"]
        share = ate["rmse"] / ate["path_length"] if ate["path_length"] else float("nan")
        lines.append(
            f"absolute trajectory error after {ate['alignment']} alignment: {ate['rmse']:.4f} on "
            f"a path of {ate['path_length']:.2f}, {share:.2%} (a straight line's "
            f"{ate['straight_line']:.4f}); sign {ate['sign']:.2f}, "
            f"orientation {ate['orientation_rmse']:.2f}°"
        )
    if "no_ate" in summary:
        lines.append(f"no trajectory error: {summary['no_ate']}")
    return "\n".join(lines)


def _track_frames(
    source: Source,
    tracker: Tracker,
    film: Path | None,
    viewer: Viewer | None,
    history: list[Tracked],
    seconds: list[float],
    progress: Callable[[int], None],
) -> None:
    with _shown(source, tracker, film, viewer, history) as show:
        start = time.perf_counter()
        for frame in source:
            history.append(tracker.track(frame))
            show(frame)
            now = time.perf_counter()
            seconds.append(now - start)
            start = now
            progress(1)


@contextmanager
def _shown(
    source: Source,
    tracker: Tracker,
    film: Path | None,
    viewer: Viewer | None,
    history: list[Tracked],
) -> Generator[Callable[[Frame], None]]:
    """What shows the newest frame, as film and in the viewer, aside from the tracking."""
    with ExitStack() as stack:
        writer = None if film is None else stack.enter_context(_writer(source, film))
        recording = None if viewer is None else stack.enter_context(viewer)
        aside = stack.enter_context(Aside())

        def show(frame: Frame) -> None:
            if writer is not None:
                aside.give(_film, writer, frame, history[-1])
            if recording is not None:
                aside.give(recording.show, frame, history[-1])
                if len(history) % _MAP_EVERY == 0:
                    aside.give(recording.show_map, _mapped(tracker, history))

        try:
            yield show
        finally:
            if recording is not None and history:
                aside.give(recording.show_map, _mapped(tracker, history))


def _writer(source: Source, path: Path) -> OverlayWriter:
    size = overlay_size(source.calibration.width, source.calibration.height)
    return OverlayWriter(path, size, _rate(source.times))


def _film(writer: OverlayWriter, frame: Frame, result: Tracked) -> None:
    writer.write(_overlay(frame, result))


def _rate(times: np.ndarray) -> float:
    """Frames per second."""
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 30.0


def _overlay(frame: Frame, result: Tracked) -> np.ndarray:
    """The picture of what was sought and found in a frame."""
    new = result.created
    nothing = np.full((len(new), 2), np.nan)
    return draw_overlay(
        frame.image,
        predicted=np.concatenate([result.predicted, nothing]),
        covariances=np.concatenate([result.search, np.full((len(new), 2, 2), np.nan)]),
        matched=np.concatenate([result.matched, new]),
        status=[*result.status, *["new"] * len(new)],
        notes=_notes(result),
        banner=_banner(result),
    )


def _notes(result: Tracked) -> tuple[str, str]:
    """Which frame it is, and the σ of its pose in the map's unit."""
    camera, log_scale = result.camera, result.sigma_log_scale
    degrees = math.degrees(camera.sigma_orientation)
    scale = "" if log_scale is None else f"  log scale {log_scale:.3g}"
    opening = "" if result.unit_fixed else "  unit open"
    return (
        f"frame {result.index}  {result.time:.2f} s  map {result.map}{opening}",
        f"sigma: position {camera.sigma_position:.3g} units  {degrees:.3g} deg{scale}",
    )


def _banner(result: Tracked) -> str:
    """What nobody is to overlook: nothing while all is well."""
    if result.starts:
        return f"LOST: MAP {result.map} BEGINS" if result.lost else ""
    return "" if result.state == "tracked" else result.state.upper()


def _write(
    source: Source, tracker: Tracker, history: list[Tracked], seconds: list[float], out: Path
) -> dict[str, Any]:
    times, T_wc = _trajectory(history)
    write_trajectory(out / "trajectory.txt", times, T_wc)
    scaled = any(result.sigma_log_scale is not None for result in history)
    covariances = [result.covariance for result in history]
    camera = tracker.camera()
    caveat = TOO_SURE if camera is not None and camera[0] == "estimated" else ""
    write_covariances(out / "covariance.txt", times, covariances, given_scale=scaled, caveat=caveat)
    write_frames(out / "frames.csv", history)
    summary = _summary(source, tracker, history, seconds)
    write_json(out / "summary.json", summary, allow_nan=False)
    _draw_map(_mapped(tracker, history), history, _reference_in_map(source, history), out)
    return summary


def _draw_map(
    known: Points, history: list[Tracked], reference: np.ndarray | None, out: Path
) -> None:
    write_ply(out / "map.ply", known.points, known.covariances, known.numbers, known.maps)
    begun = [place for place, result in enumerate(history) if result.starts and result.map]
    plot_map(
        _trajectory(history).T_wc,
        known.points,
        known.in_map,
        reference=reference,
        path=out / "map.png",
        unit="map units",
        lost=[result.lost for result in history],
        begun=begun,
        begun_covariances=[history[place].camera.position_covariance for place in begun],
    )


def write_frames(path: str | Path, history: list[Tracked]) -> None:
    """Write what became of every frame as CSV, whole or not at all.

    `state` is `start` (of a map; where it is not the first, the camera is lost too), `tracked` or
    `lost`, `map` the number of the map, from 0. σ of position (map units) and orientation (rad)
    are roots of the summed variances of the three axes, zero in the first frame alone, which is
    the world's, and of poses in the map's one unit. `log_scale` is the log of that unit in metres
    as the filter believes it to be at this frame, and `sigma_log_scale` its σ; both empty where
    the filter is in no doubt of it: then nobody has measured it. `unit_fixed` is 0 while the map's
    start is being found out, when the filter changes its unit with every frame, else 1.
    """
    with write_atomically(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(_row(result) for result in history)


def _row(result: Tracked) -> list[Any]:
    camera = result.camera
    numbers = (
        camera.sigma_position, camera.sigma_orientation, result.sigma_log_scale, result.log_scale,
    )  # fmt: skip
    return [
        result.index,
        f"{result.time:.9f}",
        result.state,
        result.map,
        result.status.count("matched"),
        f"{result.nis:.6g}",
        result.nis_dof,
        *("" if number is None else f"{number:.6g}" for number in numbers),
        int(result.unit_fixed),
    ]


def _mapped(tracker: Tracker, history: list[Tracked]) -> Points:
    """The landmarks whose depth became known in their maps."""
    landmarks = tracker.points()
    with np.errstate(invalid="ignore"):  # of unknown depth, a variance can be anything
        sigma = np.sqrt(np.trace(landmarks.in_map, axis1=1, axis2=2))
        known = np.isfinite(sigma) & (sigma < _KNOWN_DEPTH * _distances(landmarks, history))
    return Points(*(part[known] for part in landmarks))


def _distances(landmarks: Points, history: list[Tracked]) -> Float[np.ndarray, " n"]:
    """To the nearest camera of their map; zero of a landmark that is nowhere."""
    cameras = _trajectory(history).T_wc[:, :3, 3]
    maps = np.array([result.map for result in history])
    distances = np.zeros(len(landmarks.numbers))
    somewhere = np.isfinite(landmarks.points).all(axis=1)
    for number in np.unique(landmarks.maps):
        those = somewhere & (landmarks.maps == number)
        distances[those] = KDTree(cameras[maps == number]).query(landmarks.points[those])[0]
    return distances


def _scale_between_maps(settings: TrackerSettings) -> float:
    """σ of the logarithm of the ratio of two maps' units, as far as the prior on depth tells.

    A unit is known as well as what all depths of a scene have in common: at the worst as one of
    them, σ/ρ of its inverse depth, in each of the two maps.
    """
    depth = settings.depth
    return math.sqrt(2) * float(depth.sigma / depth.mean)


def _units(history: list[Tracked]) -> list[dict[str, Any]]:
    """Of every map: the frame from which on the filter's unit was fixed, and the log of the map's
    unit in metres as it is believed at the map's end, with σ; null where there is no doubt."""
    units = []
    for number in range(history[-1].map + 1):
        of_map = [result for result in history if result.map == number]
        fixed = (result.index for result in of_map if result.unit_fixed)
        last = of_map[-1]
        units.append(
            {
                "map": number,
                "fixed_at": next(fixed, None),
                "log_scale": last.log_scale,
                "sigma_log_scale": last.sigma_log_scale,
            }
        )
    return units


def _unit_line(unit: dict[str, Any]) -> str:
    """What is known of a map's unit."""
    length, times = math.exp(unit["log_scale"]), math.exp(unit["sigma_log_scale"])
    return (
        f"map {unit['map']}: one unit of length throughout, by the prior on depth {length:.2f} m, "
        f"give or take a factor of {times:.2g} (1 sigma)"
    )


def _calibration(tracker: Tracker) -> dict[str, Any]:
    """What the camera was taken for, and where it is estimated, what it is in the end with σ."""
    camera = tracker.camera()
    given = as_fields(tracker.calibration)
    if camera is None:
        return {"given": given}
    treatment, mean, covariance = camera
    result = {"treatment": treatment, "given": given}
    if treatment == "estimated":
        sigma = np.sqrt(np.diagonal(covariance))
        result["estimated"] = dict(zip(INTRINSICS, mean.tolist(), strict=True))
        result["sigma"] = dict(zip(INTRINSICS, sigma.tolist(), strict=True))
        result["caveat"] = f"{TOO_SURE}; docs/own-video.md says how much"
    return result


def _summary(
    source: Source, tracker: Tracker, history: list[Tracked], seconds: list[float]
) -> dict[str, Any]:
    lost = sum(result.lost for result in history)
    updates = history[1:]
    dof = sum(result.nis_dof for result in updates)
    count = max(len(updates), 1)
    later = seconds[WARM_UP:] or seconds
    summary = {
        "schema": SCHEMA,
        "version": __version__,
        "source": source.name,
        "filter": tracker.filter_name,
        "settings": dataclasses.asdict(tracker.settings),
        "calibration": _calibration(tracker),
        "frames": len(history),
        "tracked": len(history) - lost,
        "lost": lost,
        "restarts": tracker.restarts,
        "maps": tracker.restarts + 1,
        "units": _units(history),
        "failed_updates": dict(tracker.failed),
        "reversed_tests": tracker.reversed,
        "landmarks": {
            "mean": float(np.mean([len(result.status) for result in updates] or [0])),
            "created": tracker.created,
            "deleted": tracker.deleted,
        },
        "matches_per_frame": sum(result.nis_dof for result in updates) / 2 / count,
        "nis": {"mean": sum(result.nis for result in updates) / count, "dof": dof / count},
        "nis_ungated": _ungated(updates),
        "seconds": {
            "total": sum(seconds),
            "start": sum(seconds[:WARM_UP]),
            "per_frame_median": float(np.median(later)),
            "per_frame_p99": float(np.quantile(later, 0.99)),
        },
    }
    if tracker.target is not None and tracker.sighting is not None:
        summary["target"] = as_summary(tracker.target, tracker.sighting)
    if tracker.restarts:
        summary["log_scale_sigma_between_maps"] = _scale_between_maps(tracker.settings)
    return summary | _errors(source, history)


def _ungated(updates: list[Tracked]) -> dict[str, Any]:
    """What the predictions are worth: squared innovations of all that was found, wrong matches and
    all, by the median of χ² of 2 degrees of freedom, and the share beyond its 95 %."""
    squared = np.concatenate([np.zeros(0), *(result.innovations for result in updates)])
    if not len(squared):
        return {"matches": 0, "median": None, "beyond95": None}
    return {
        "matches": len(squared),
        "median": float(np.median(squared) / chi2.median(2)),
        "beyond95": float(np.mean(squared > chi2.ppf(0.95, 2))),
    }


def _trajectory(history: list[Tracked]) -> Trajectory:
    times = np.array([result.time for result in history])
    return Trajectory(times, np.stack([result.T_wc for result in history]))


def _reference_in_map(source: Source, history: list[Tracked]) -> np.ndarray | None:
    """What of the reference is of the time of these frames, (m, 4, 4), aligned as for its error."""
    if source.reference is None:
        return None
    trajectory, (times, T_wc) = _trajectory(history), source.reference
    try:
        there = alignment(*trajectory, *source.reference)
    except ValueError:
        return None
    same = (times >= trajectory.times[0]) & (times <= trajectory.times[-1])
    return there.inverse().moved(T_wc[same])


def _errors(source: Source, history: list[Tracked]) -> dict[str, Any]:
    """The trajectory error, where there is a reference, or why it cannot be told."""
    if source.reference is None:
        return {}
    trajectories = *_trajectory(history), *source.reference
    try:
        errors: dict[str, Any] = {"ate": absolute_trajectory_error(*trajectories)}
    except ValueError as error:  # of few frames, or of a camera that stood still
        return {"no_ate": str(error)}
    with suppress(ValueError):  # of less than a second
        errors["rpe"] = relative_pose_error(*trajectories)
    return errors
