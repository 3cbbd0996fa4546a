"""The summary of a tracked video: how well it went, of what, and how far from a reference."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import asdict

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.stats import chi2

from jaxslam._runtime.files import Json
from jaxslam._version import __version__
from jaxslam.io.calibration import INTRINSICS, MODELS, Calibration, as_fields
from jaxslam.io.source import Source, Trajectory
from jaxslam.tracking.focal import CLEAR, better_lens
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.observations import only
from jaxslam.tracking.report import History
from jaxslam.tracking.target import as_summary
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import (
    absolute_trajectory_error,
    alignment,
    orientation_error,
    relative_pose_error,
)

WARM_UP = 3
"""Frames in which functions are compiled; they count in `seconds.start`, not in the quantiles."""
TOO_SURE = (
    "The lens was estimated, so its σ, and that of the poses, is too small: see docs/own-video.md"
)
"""The caveat on an estimated calibration."""

Summary = dict[str, Json]
"""A summary as JSON has it."""


def summarised(
    source: Source, tracker: Tracker, history: History, points: Points, seconds: list[float]
) -> Summary:
    """Summarise the frames, and the landmarks as they are known at the end."""
    lost = sum(result.lost for result in history)
    updates = [result for result in history[1:] if not result.repeated]
    dof = sum(result.nis_dof for result in updates)
    count = max(len(updates), 1)
    later = seconds[WARM_UP:] or seconds or [0.0]
    lens = _lens(tracker)
    summary = {
        "schema": 1,
        "version": __version__,
        "source": source.name,
        "filter": tracker.filter_name,
        "settings": asdict(tracker.settings),
        "calibration": _calibration(tracker, lens, history, points),
        "lens": lens,
        "frames": len(history),
        "tracked": len(history) - lost,
        "lost": lost,
        "lost_reasons": dict(Counter(result.reason for result in history if result.reason)),
        "restarts": tracker.restarts,
        "repeated": sum(result.repeated for result in history),
        "unit": tracker.unit,
        "maps": max(1, len({result.map for result in history if not result.lost})),
        "relocalised": sum(result.relocalised for result in history),
        "submaps": len({result.submap for result in history}),
        "loops": sum(result.loop is not None for result in history),
        "loops_refused": tracker.refused,
        "joined": [
            {"map": one.map, "to": one.to, "log_ratio": one.log_ratio, "sigma": one.sigma}
            for one in tracker.joins
        ],
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
    if (inertial := tracker.inertial) is not None:
        biases, sigma = tracker.biases()
        summary["inertial"] = {
            "readings": inertial.log.name,
            "start": inertial.why_moving or "at rest",
            "biases": biases[:6].tolist(),
            "biases_sigma": sigma[:6].tolist(),
            "clock_offset": (biases[6:] + inertial.clock_offset).tolist(),  # none where known
            "clock_offset_sigma": sigma[6:].tolist(),
        }
        with suppress(ValueError):
            trajectories = *trajectory_of(history), *(source.reference or ([], []))
            summary["ate_metres"] = absolute_trajectory_error(*trajectories, scaled=False)
    elif tracker.restarts:
        # Each unit is known as well as what all depths of a scene have in common: at the worst as
        # one of them, σ/ρ of its inverse depth.
        prior = tracker.settings.depth
        summary["log_scale_sigma_between_maps"] = math.sqrt(2) * float(prior.sigma / prior.mean)
    return summary | trajectory_errors(source, history)


def describe(summary: Summary) -> str:
    """The summary in a few lines."""
    nis, seconds = summary["nis"], summary["seconds"]
    if not summary["landmarks"]["created"]:
        return (
            f"{summary['source']}: no map could be started: none of its {summary['frames']} "
            "frames has enough corners. Are the pictures dark or featureless?"
        )
    per_dof = f", NIS per dof {nis['mean'] / nis['dof']:.2f}" if nis["dof"] else ""
    lines = [
        f"{summary['source']}: {summary['tracked']} of {summary['frames']} frames tracked, "
        f"{summary['matches_per_frame']:.1f} matches per frame{per_dof}",
        f"{seconds['per_frame_median'] * 1e3:.0f} ms per frame (median), "
        f"{seconds['total']:.1f} s in total, including {seconds['start']:.1f} s to start",
    ]
    if summary["lost"]:
        reasons = (f"{count} {reason}" for reason, count in summary["lost_reasons"].items())
        lines.append(f"lost frames: {summary['lost']} ({', '.join(reasons)})")
    if summary["repeated"]:
        lines.append(
            f"{summary['repeated']} pictures repeat the one before and were not used: is the rate "
            "of the video higher than the camera's?"
        )
    if summary["relocalised"]:
        lines.append(f"relocalised in an earlier map: {summary['relocalised']} ×")
    if summary["loops"]:
        lines.append(f"closed loops: {summary['loops']}; all poses were corrected")
    for one in summary["joined"]:
        lines.append(
            f"map {one['map']} was joined to map {one['to']}; the ratio of their units is known to "
            f"{one['sigma']:.1%}"
        )
    if summary["maps"] > 1:
        own = ", each with its own unit" if summary["unit"] == "map" else ""
        lines.append(f"{summary['maps']} maps{own}; frames.csv shows where each begins")
    lines += [_unit_line(unit) for unit in summary["units"] if unit["sigma_log_scale"] is not None]
    camera = summary["calibration"]
    if lens := summary["lens"]:
        told = (
            f"{key} {one['value']:.{digits}f} ± {one['sigma']:.{digits}f}"
            for key, one in lens.items()
            for digits in [1 if key in INTRINSICS else 3]
        )
        lines += ["camera: " + ", ".join(told), *([camera["caveat"]] if "caveat" in camera else [])]
    if "better_lens" in camera:
        lines.append(_better(camera["better_lens"], camera["given"]))
    if unit := summary.get("inertial"):
        lines.append(f"positions are in metres, by {unit['readings']}; start: {unit['start']}")
    for ate in (summary[key] for key in ("ate_metres", "ate") if key in summary):
        share = ate["rmse"] / ate["path_length"] if ate["path_length"] else float("nan")
        lines.append(
            f"absolute trajectory error after {ate['alignment']} alignment: {ate['rmse']:.4f} on "
            f"a path of {ate['path_length']:.2f}, {share:.2%} (that of a straight line: "
            f"{ate['straight_line']:.4f}); sign {ate['sign']:.2f}; "
            f"orientation error {ate['orientation_rmse']:.2f}°"
        )
    if "no_ate" in summary:
        turned = summary.get("orientation_rmse")
        angle = "" if turned is None else f"; orientation error {turned:.2f}°"
        lines.append(f"no trajectory error: {summary['no_ate']}{angle}")
    return "\n".join(lines)


def known_points(landmarks: Points, history: History) -> Points:
    """The landmarks whose depth became known in their maps."""
    with np.errstate(invalid="ignore"):  # of unknown depth, a variance can be anything
        sigma = np.sqrt(np.trace(landmarks.in_map, axis1=1, axis2=2))
        # A point is put into the map where its σ is below this share of its distance.
        known = np.isfinite(sigma) & (sigma < 0.3 * _distances(landmarks, history))
    return only(landmarks, known)


def _distances(landmarks: Points, history: History) -> Float[np.ndarray, " n"]:
    """Return distances to the nearest camera of their map; zero of a landmark that is nowhere."""
    cameras = trajectory_of(history).T_wc[:, :3, 3]
    maps = np.array([result.map for result in history])
    distances = np.zeros(len(landmarks.numbers))
    somewhere = np.isfinite(landmarks.points).all(axis=1)
    for number in np.unique(landmarks.maps):
        those = somewhere & (landmarks.maps == number)
        distances[those] = KDTree(cameras[maps == number]).query(landmarks.points[those])[0]
    return distances


def trajectory_of(history: History) -> Trajectory:
    """The poses of the frames at their times."""
    times = np.array([result.time for result in history])
    return Trajectory(times, np.stack([result.T_wc for result in history]))


def reference_in_map(source: Source, history: History) -> np.ndarray | None:
    """Return what of the reference is of the time of these frames, (m, 4, 4), aligned as for its
    error."""
    if source.reference is None:
        return None
    trajectory, (times, T_wc) = trajectory_of(history), source.reference
    try:
        there = alignment(*trajectory, *source.reference)
    except ValueError:
        return None
    same = (times >= trajectory.times[0]) & (times <= trajectory.times[-1])
    return there.inverse().moved(T_wc[same])


def _units(history: History) -> list[Summary]:
    """Return, for every map, the frame from which on the filter's unit was fixed, and the log of
    the map's unit in metres as believed at its end, with σ; null where there is no doubt."""
    return [
        {
            "map": number,
            "fixed_at": next((result.index for result in of if result.unit_fixed), None),
            "log_scale": of[-1].log_scale,
            "sigma_log_scale": of[-1].sigma_log_scale,
        }
        for number in sorted({result.map for result in history})
        for of in [[result for result in history if result.map == number]]
    ]


def _unit_line(unit: Summary) -> str:
    """Return what is known of a map's unit."""
    length, times = math.exp(unit["log_scale"]), math.exp(unit["sigma_log_scale"])
    return (
        f"map {unit['map']}: positions are in map units; one unit is roughly {length:.2f} m "
        f"(within a factor of {times:.2g}, 1σ)"
    )


def _calibration(tracker: Tracker, lens: Summary, history: History, points: Points) -> Summary:
    """Return what the camera was taken for, and where it is estimated or considered, what it is in
    the end with σ: what is considered was found by the start, and left since. Where it is known,
    the lens that fits much better, if one does."""
    camera = tracker.camera()
    given = as_fields(tracker.calibration)
    if camera is None:
        return {"given": given}
    result = {"treatment": camera[0], "given": given}
    if lens:
        for key, number in (("estimated", "value"), ("sigma", "sigma")):
            result[key] = {name: one[number] for name, one in lens.items() if name in INTRINSICS}
    if caveat := caveat_of(camera[0], tracker.calibration):
        result["caveat"] = caveat
    if not tracker.calibration.guessed:
        better = better_lens(history, points, tracker.calibration)
        if better.left < CLEAR:
            result["better_lens"] = better.as_summary(tracker.calibration)
    return result


def caveat_of(treatment: str, calibration: Calibration) -> str:
    """The caveat on a lens that is treated so, and of which little was known."""
    return TOO_SURE if treatment == "estimated" and calibration.guessed else ""


def _lens(tracker: Tracker) -> Summary:
    """Return what was estimated or considered of the lens, in pixels and, of k1 and k2, numbers."""
    camera = tracker.camera()
    if camera is None or camera[0] not in ("estimated", "consider"):
        return {}
    names = (*INTRINSICS, *MODELS[tracker.calibration.model].split())
    sigma = np.sqrt(np.diagonal(camera[2]))
    numbers = zip(names, camera[1].tolist(), sigma.tolist(), strict=False)
    return {name: {"value": x, "sigma": s} for name, x, s in numbers if s > 0}


def _better(better: Summary, given: Summary) -> str:
    """Return the sentence that a lens was given which does not fit."""
    fx, k1 = given["fx"], (given["distortion"] or [0.0])[0]
    what = "LENS DISTORTION" if better["distortion"] else "LENS"
    return (
        f"{what}: fx {better['fx']:.0f} and k1 {better['k1']:.3f} fit the matches better than the "
        f"given {fx:.0f} and {k1:.3f}: they reduce the squared errors by "
        f"{1 - better['squares_left']:.0%}. Is this the calibration of this camera, at this zoom "
        "and image size?"
    )


def _ungated(updates: History) -> Summary:
    """Return what the predictions are worth: squared innovations of all that was found, wrong
    matches and all, by the median of χ² of 2 degrees of freedom, and the share beyond its 95 %."""
    squared = np.concatenate([np.zeros(0), *(result.innovations for result in updates)])
    if not len(squared):
        return {"matches": 0, "median": None, "beyond95": None}
    return {
        "matches": len(squared),
        "median": float(np.median(squared) / chi2.median(2)),
        "beyond95": float(np.mean(squared > chi2.ppf(0.95, 2))),
    }


def trajectory_errors(source: Source, history: History) -> Summary:
    """The trajectory error, where there is a reference, or why it cannot be computed."""
    if source.reference is None:
        return {}
    trajectories = *trajectory_of(history), *source.reference
    try:
        errors: Summary = {"ate": absolute_trajectory_error(*trajectories)}
    except ValueError as error:  # of few frames, or of a camera that stood still
        errors = {"no_ate": str(error)}
        with suppress(ValueError):  # it may have turned
            errors["orientation_rmse"] = orientation_error(*trajectories)
        return errors
    with suppress(ValueError):  # of less than a second
        errors["rpe"] = relative_pose_error(*trajectories)
    return errors
