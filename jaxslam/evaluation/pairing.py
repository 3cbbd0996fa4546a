"""The estimates, covariances and true poses of a run, at the same times.

Of stamps that are doubled the last is used. A covariance belongs to the estimate nearest in time.
A true pose is interpolated where the truth is dense enough for that; else it is the nearest in
time; and where it is much rarer than the estimate, the estimate is moved to its stamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE, TURNED, angles, apart, associated
from jaxslam.evaluation.clock import Offset, clock_offset
from jaxslam.evaluation.convention import (
    Convention,
    Matrices,
    Squares,
    converted,
    covariances_of_file,
    geometry_of,
)
from jaxslam.evaluation.inputs import exactly_known, without_unknown
from jaxslam.io import ros
from jaxslam.io.logs import read_log
from jaxslam.io.logs.frames import read_frames
from jaxslam.io.logs.log import GPS_EPOCH, TAKEN, WEEK, Log, check_seconds, interpolated
from jaxslam.io.tum import Times

Place: TypeAlias = Path | ros.Topic
LEAST_SHARE = 0.5
"""The share of the comparable poses, and of the estimate's time, that must be compared."""
DENSE = 0.3
"""The largest error of interpolation, in σ of the estimate, of a truth that is interpolated."""
SPARSE = 3.0
"""The number of poses to every true one from which the estimate is taken at the truth's stamps."""
ROUNDED = 1e-4
"""The share of the time between two poses by which stamps that are rounded are others."""
LEAPS, HALF_HOUR = 18.0, 1800.0
"""Seconds from UTC to GPS time since 2017, and between the clocks of two zones."""
_WITHIN = f"within {MAX_TIME_DIFFERENCE} s"
_SAME = Convention("split", "mixed")


class RunFiles(NamedTuple):
    """The name of one trajectory, and the paths of its files, or topics of bags."""

    name: str
    estimate: Place
    covariance: Path | None
    """None of an estimate whose own lines, or messages, hold covariances."""
    truth: Place

    @property
    def of_covariances(self) -> Place:
        """Where covariances are."""
        return self.covariance or self.estimate


@dataclass(frozen=True, eq=False)
class RunLogs:
    """What the files of a run hold."""

    files: RunFiles
    estimate: Log
    """With the covariances of its own poses, NaN where there is none."""
    truth: Log
    covariance_times: Times
    """The stamps of all covariances that there are."""
    unused: Bool[np.ndarray, " m"]
    """A mask of those at no time of the estimate."""
    oriented: bool
    """Whether estimate and truth have orientations."""
    notes: tuple[str, ...]

    @cached_property
    def offset(self) -> Offset | None:
        """By how much the estimate is late, by its rotations."""
        told = self.oriented and self.estimate.stamped
        return clock_offset(self.estimate, self.truth) if told else None


class RunLog(NamedTuple):
    """A run, pose by pose of its estimate; NaN where a file holds nothing."""

    logs: RunLogs
    times: Times
    estimates: Matrices
    covariances: Squares
    truths: Matrices
    map: int
    """The map that is evaluated, by the tracker's own record of its frames."""
    left_out: dict[str, tuple[int, int]]
    """What is left out: how many, and of how many."""
    notes: tuple[str, ...]


def read(place: Place) -> Log:
    """The poses of a file or a topic, in the order of their times, each stamp once.

    Raises ValueError, naming the place.
    """
    of_topic = isinstance(place, ros.Topic)
    return _in_order(place, ros.read_poses(place) if of_topic else read_log(place))


def _in_order(place: Place, log: Log) -> Log:
    back = log.times < np.maximum.accumulate(log.times)
    if 0 < back.sum() <= 0.01 * len(back):  # more are no accident
        log = _of_rows(log, ~back, f"stamps that go back in time and are left out: {back.sum()}")
    _check_times(place, log.times)
    last = np.append(np.diff(log.times) > 0, True)
    told = f"stamps that are doubled: {np.sum(~last)}; of each the last pose is used"
    return log if last.all() else _of_rows(log, last, told)


def _of_rows(log: Log, rows: Bool[np.ndarray, " n"], note: str) -> Log:
    times, poses, P, other = (
        x[rows] if len(x) else x for x in (log.times, log.poses, log.covariances, log.otherwise)
    )
    notes = (*log.notes, note)
    return log._replace(times=times, poses=poses, covariances=P, otherwise=other, notes=notes)


def read_run(run: RunFiles) -> RunLogs:
    """Read the files of one run. Raises ValueError where they do not go together."""
    log, truth = read(run.estimate), read(run.truth)
    if geometry_of(truth.poses) is not geometry_of(log.poses):
        raise ValueError(f"{run.truth}: estimate and truth must both be planar or both be spatial")
    log, truth = _in_one_unit(log, truth)
    if log.stamped != truth.stamped or (not log.stamped and len(log.times) != len(truth.times)):
        raise ValueError(
            f"{run.estimate} has {len(log.times)} poses and {run.truth} {len(truth.times)}, and "
            "not both have stamps: lines would be paired by their numbers; give times (times.txt "
            "beside them, or lines of TUM)"
        )
    own = log
    if run.covariance is not None:
        t = geometry_of(log.poses).tangent_dim
        own = covariances_of_file(run.covariance, t, positions=not log.oriented)
        own = _in_order(run.covariance, _stamped_by(log.times, own))
    elif not len(log.covariances):
        raise ValueError(
            f"{run.estimate} has no covariances; give them by --covariance FILE (beside "
            "estimate.txt, trajectory.txt and state_estimate.txt, covariance.txt or "
            "state_deviation.txt is found by itself)"
        )
    there = ~np.isnan(log.poses[:, 0, 0])
    oriented, told = _oriented(log._replace(poses=log.poses[there]), truth)
    logs = (log, truth) if own is log else (log, truth, own)
    notes = (*(x for one in logs for x in one.notes), *_other_frames(log, truth), *told)
    P, at, of = _nearest(log.times, own.times, own.covariances)
    if not len(at):
        raise _nothing_in_common(run, run.of_covariances, log.times, own.times)
    P = without_unknown(P[None])[0]
    if isinstance(run.estimate, ros.Topic) and run.covariance is None:
        P = _filled_in(run.estimate, P)
    unused = ~np.isin(np.arange(len(own.times)), of)
    log = log._replace(covariances=P, said=own.said, assumed=own.assumed)
    return RunLogs(run, log, truth, own.times, unused, oriented, notes)


def _in_one_unit(log: Log, truth: Log) -> tuple[Log, Log]:
    """Both; or one with its angles in the other unit, where no title says it, and only so the
    rotations agree."""

    def off(own: Log, true: Log) -> float:
        n, known = own.poses.shape[-1] - 1, ~np.isnan(true.poses[:, 0, 0])
        at = interpolated(true.times[known], true.poses[known], own.times)
        there = ~np.isnan(at[:, 0, 0] + own.poses[:, 0, 0])
        return apart(own.poses[there, :n, :n], at[there, :n, :n]) if there.any() else np.inf

    def anew(one: Log) -> Log:
        notes = *one.notes, TAKEN.format("the other's, degrees or radians")
        return one._replace(poses=one.otherwise, notes=notes) if len(one.otherwise) else one

    if not (len(log.otherwise) or len(truth.otherwise)) or len(truth.times) < 2:
        return log, truth
    ways = (log, truth), (anew(log), truth), (log, anew(truth))
    before, *others = (off(*way) for way in ways)
    best = 1 + int(np.argmin(others))
    return ways[best] if before > TURNED and min(others) < before / 4 else ways[0]


def paired(logs: RunLogs, time_offset: float | str = 0.0) -> RunLog:
    """The poses of a run at the same times, whose clock is behind the truth's by an offset in
    seconds, or `auto`. Raises ValueError where few poses can be compared.
    """
    log, files, notes = logs.estimate, logs.files, [*logs.notes]
    if time_offset == "auto":
        found = logs.offset
        time_offset = found.seconds if found is not None and found.found else 0.0
        told = (
            f"taken to be {1e3 * time_offset:.1f} ms late, as found" if time_offset else "in time"
        )
        notes.append(f"the estimate is {told}")
    there = ~np.isnan(log.poses[:, 0, 0])
    stamps, P = log.times[there], log.covariances[there]
    times = stamps - float(time_offset)
    log = log._replace(times=times, poses=log.poses[there], covariances=P)
    true, estimates, why = _truths(logs, log)
    if np.isnan(true[:, 0, 0]).all():
        raise _nothing_in_common(files, files.truth, times, logs.truth.times)
    _check_share(logs, log, true, why)
    left_out = {
        "poses of the estimate are NaN": ~there,
        f"poses have no covariance {_WITHIN}": np.isnan(P[:, 0, 0]),
        "poses have no truth": np.isnan(true[:, 0, 0]),
        "covariances are at no time of the estimate": logs.unused,
    }
    number, others = tracked(files.estimate.parent, stamps, exactly_known(P))
    for out in others.values():
        true = np.where(out[:, None, None], np.nan, true)
    if any(out.any() for out in others.values()):
        notes.append(f"map {number}, the longest, is evaluated")
    masks = {what: out for what, out in (left_out | others).items() if out.any()}
    counts = {what: (int(out.sum()), len(out)) for what, out in masks.items()}
    return RunLog(logs, times, estimates, P, true, number, counts, (*notes, *why))


def with_other(read: RunLog, convention: Convention) -> RunLog:
    """The run compared with another estimate in place of its truth, whose covariances are added.

    Raises ValueError where that has none.
    """
    other, place = read.logs.truth, read.logs.files.truth
    if not len(other.covariances):
        raise ValueError(f"{place} has no covariances; --against needs a log with its own")
    at, of = associated(read.times, other.times)
    P = np.full_like(read.covariances, np.nan)
    said = Convention(**other.said)
    P[at] = converted(other.covariances[of], other.poses[of], said, convention)
    note = (
        f"compared with {place}, whose covariances are added: if the errors of both are "
        "alike, as of one sensor, their difference is smaller than this says"
    )
    return read._replace(covariances=read.covariances + P, notes=(*read.notes, note))


def _check_times(path: Place, times: Float[np.ndarray, " n"]) -> None:
    """Raise ValueError unless times are seconds, of one run, and most of their own each."""
    check_seconds(str(path), times)
    back = np.flatnonzero(np.diff(times) < 0)
    if back.size:
        raise ValueError(
            f"{path}: times decrease from {times[back[0]]:.3f} to {times[back[0] + 1]:.3f} s; "
            "expected one run in temporal order"
        )
    different = len(np.unique(times))
    if different < LEAST_SHARE * len(times):
        raise ValueError(
            f"{path}: its {len(times)} poses have only {different} different times, perhaps "
            "printed with too few digits or never stamped; every pose needs its own time"
        )


def _stamped_by(times: Float[np.ndarray, " n"], own: Log) -> Log:
    """With the stamps of the estimate, line by line, where its own are those rounded."""
    if len(times) != len(own.times) or len(np.unique(own.times)) == len(times):
        return own
    digits = np.diff(np.unique(own.times)).min(initial=np.inf)
    if not np.isfinite(digits) or np.abs(times - own.times).max() > digits:
        return own
    note = f"times of covariances are rounded to {digits:.3g} s: they are taken line by line"
    return own._replace(times=times, notes=(*own.notes, note))


def _nearest(times: Times, others: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, ...]:
    """The values of other times at ours, NaN where there is none; and which belong together."""
    at, of = associated(times, others)
    result = np.full((len(times), *values.shape[1:]), np.nan)
    nearest_last = np.argsort(-np.abs(times[at] - others[of]), kind="stable")
    result[at[nearest_last]] = values[of[nearest_last]]
    return result, at, of


def _nothing_in_common(run: RunFiles, other: Place, *times: np.ndarray) -> ValueError:
    spans = " and ".join(f"{x.min():.3f}–{x.max():.3f} s" for x in times)
    return ValueError(
        f"{run.estimate} and {other} have no time stamps in common {_WITHIN}: {spans}"
        + (_of_clocks(*times) or ". If one clock is known to be late, say --time-offset SECONDS")
    )


def _of_clocks(own: Times, others: Float[np.ndarray, " m"]) -> str:
    """The offset of a known clock, if both would begin together without it; else nothing."""
    late, longest = own.min() - others.min(), max(np.ptp(own), np.ptp(others))
    weeks = GPS_EPOCH + WEEK * max(round((abs(late) - GPS_EPOCH) / WEEK), 0)
    zones = HALF_HOUR * min(round(abs(late) / HALF_HOUR), 28)
    clocks = {LEAPS: "GPS time", LEAPS + 19: "TAI, as of PTP", zones: "another zone"}
    for away, clock in (clocks | {weeks - LEAPS: "GPS time", weeks: "GPS time"}).items():
        if abs(abs(late) - away) < min(longest, 0.01 * away):
            told = f"--time-offset {np.copysign(away, late):.0f}"
            return f". One may be of {clock}, which is {away:.0f} s off: then say {told}"
    return ""


def _filled_in(topic: ros.Topic, P: Float[np.ndarray, "n t t"]) -> Float[np.ndarray, "n t t"]:
    """Without those that a program does not fill in: NaN, or zeros but of the first pose alone.

    Raises ValueError where it fills in none.
    """
    without, zero = np.asarray(np.isnan(P).any(axis=(1, 2))), exactly_known(P)
    if zero[1:].any():
        without |= zero
    if without.all():
        raise ValueError(
            f"{topic}: has no covariances, all {len(P)} are NaN or zero; a verdict needs them"
        )
    return np.where(without[:, None, None], np.nan, P)


def _other_frames(log: Log, truth: Log) -> list[str]:
    """That the logs say that they are of different frames."""
    align = "if these are different worlds, align them (--align yaw or se3)"
    frames = (
        ("of", log.body, truth.body, "what is between counts as error"),
        ("in", log.world, truth.world, align),
    )
    return [
        f"the estimate is {where} {own} and the truth {where} {true}: {told}"
        for where, own, true, told in frames
        if own and true and own != true
    ]


def _oriented(log: Log, truth: Log) -> tuple[bool, list[str]]:
    """Whether both have orientations; a truth whose rotation is always 1 has none, where the
    estimate turns by more than 10°."""
    if not (log.oriented and truth.oriented) or log.poses.shape[-1] == 3:
        return log.oriented and truth.oriented, []
    R, fixed = log.poses[:, :3, :3], truth.poses[~np.isnan(truth.poses[:, 0, 0]), :3, :3]
    turned = np.trace(R[0].T @ R, axis1=1, axis2=2).min() < 1 + 2 * np.cos(np.radians(10.0))
    if len(fixed) and turned and (fixed == np.eye(3)).all():
        return False, ["every orientation of the truth is 0 0 0 1: it has none"]
    return True, []


def _truths(logs: RunLogs, log: Log) -> tuple[Matrices, Matrices, list[str]]:
    """The true poses of every estimate, NaN where there is none, the estimates, and remarks.

    Raises ValueError where there is none.
    """
    oriented, known = logs.oriented, ~np.isnan(logs.truth.poses[:, 0, 0])
    times, poses = logs.truth.times[known], logs.truth.poses[known]
    nearest, at, of = _nearest(log.times, times, poses)
    if len(times) < 3 or not log.stamped:
        return nearest, log.poses, []
    gap, step = (np.median(np.diff(x)) if len(x) > 1 else 0.0 for x in (times, log.times))
    off = np.abs(log.times[at] - times[of]).max() if len(at) else np.inf
    wrong = _interpolation_error(times, poses)
    sigma = _sigmas(log)
    most = (wrong / sigma)[: 2 if oriented else 1].max()
    elsewhere, dense = off > ROUNDED * max(gap, step), gap <= SPARSE * step
    if elsewhere and dense and most <= DENSE:
        whole = interpolated(times, poses, log.times)
        # Not across a hole.
        after = np.clip(np.searchsorted(times, log.times), 1, len(times) - 1)
        whole[times[after] - times[after - 1] > 3 * gap] = np.nan
        note = (
            f"the truth is interpolated to the stamps of the estimate, to {1e3 * wrong[0]:.2g} mm "
            f"and {np.degrees(wrong[1]):.2g}° (median), {most:.2g} σ"
        )
        return whole, log.poses, [note] if most > 0.01 else []
    few = len(np.unique(of)) < LEAST_SHARE * len(times)
    if not dense and (few or off > ROUNDED * step):
        rough = (_interpolation_error(log.times, log.poses) / sigma)[: 2 if oriented else 1].max()
        told = f"the truth has a pose every {gap:.3g} s and the estimate every {step:.3g} s"
        if rough > DENSE and few:
            raise ValueError(
                f"{logs.files.truth}: {told}, at other stamps, and between them the estimate is "
                f"known to {rough:.2g} of its σ only; log it at the stamps of the truth, or take a "
                "truth that is dense enough to be interpolated"
            )
        note = f"{told}: compared at the stamps of the truth, to {rough:.2g} σ of the estimate"
        moved, true = _at_stamps_of_truth(log, times, poses)
        if rough <= DENSE:
            return true, moved, [note]
    note = (
        f"the truth, a pose every {gap:.3g} s, is not interpolated to the estimate's stamps, every "
        f"{step:.3g} s: between its poses it is known to {most:.2g} of the estimate's σ only; a "
        "denser truth would be, or log the estimate at its stamps"
    )
    return nearest, log.poses, [note] if elsewhere and dense else []


def _interpolation_error(times: Times, poses: Matrices) -> Float[np.ndarray, " 2"]:
    """The median error of a pose in the middle of two: m, rad.

    A pose that is interpolated over its neighbours, twice as far apart, is off by four times that.
    """
    between = interpolated(times[::2], poses[::2], times[1:-1:2])
    true = poses[1:-1:2]
    n = poses.shape[-1] - 1
    there = ~np.isnan(between[:, 0, 0])
    if not there.any():
        return np.full(2, np.inf)
    off = np.linalg.norm((between - true)[there, :n, n], axis=1)
    turned = angles(between[there, :n, :n], true[there, :n, :n])
    return np.array([np.median(off), np.median(turned)]) / 4


def _sigmas(log: Log) -> Float[np.ndarray, " 2"]:
    """The median of the least σ of position and of rotation."""
    P, convention = log.covariances, Convention(**log.said)
    there = ~np.isnan(P).any(axis=(1, 2)) & np.any(P, axis=(1, 2))
    if not there.any():
        return np.full(2, np.nan)
    with np.errstate(over="ignore", invalid="ignore"):  # what is too large is refused later
        split = np.nan_to_num(converted(P[there], log.poses[there], convention, _SAME))
    n = log.poses.shape[-1] - 1
    variance = np.maximum(np.diagonal(split, axis1=1, axis2=2), 0.0)
    least = [np.sqrt(np.median(x.min(axis=1))) for x in (variance[:, :n], variance[:, n:])]
    return np.maximum(least, 1e-12)


def _at_stamps_of_truth(log: Log, times: Times, poses: np.ndarray) -> tuple[Matrices, Matrices]:
    """The estimates nearest to true poses, interpolated to their stamps, and those truths."""
    between = (times >= log.times[0]) & (times <= log.times[-1])
    times, poses = times[between], poses[between]
    after = np.clip(np.searchsorted(log.times, times), 1, len(log.times) - 1)
    earlier = times - log.times[after - 1] < log.times[after] - times
    nearest = after - earlier
    moved, true = log.poses.copy(), np.full_like(log.poses, np.nan)
    moved[nearest], true[nearest] = interpolated(log.times, log.poses, times), poses
    return moved, true


def _check_share(logs: RunLogs, log: Log, true: Matrices, why: list[str]) -> None:
    """Raise ValueError where most of a run would not be compared, and say why."""
    own = log.times
    others = (
        (logs.files.of_covariances, logs.covariance_times, ~np.isnan(log.covariances[:, 0, 0])),
        (logs.files.truth, logs.truth.times, ~np.isnan(true[:, 0, 0])),
    )
    there: Bool[np.ndarray, " n"] = others[0][2] & others[1][2]
    fewest = min(len(own), *(len(times) for _, times, _ in others))
    enough = np.sum(there) >= LEAST_SHARE * fewest
    if enough and np.ptp(own[there]) >= LEAST_SHARE * np.ptp(own):
        return
    path, times, _ = min(others, key=lambda other: int(np.sum(other[2])))
    after = np.searchsorted(times, own)
    beside = times[np.clip([after - 1, after], 0, len(times) - 1)]
    away = float(np.median(np.abs(beside - own).min(axis=0)))
    raise ValueError(
        f"{logs.files.estimate}: of its {_held(own)} only {np.sum(there)} can be compared: "
        f"{np.sum(others[0][2])} have a covariance {_WITHIN}, and "
        f"{np.sum(others[1][2])} a truth. {path} has {_held(times)}; the nearest one "
        f"is {away:.3g} s away (median). A verdict needs half the lines of the shortest file, "
        "covering half the duration of the estimate"
        + ("".join(f". Here {x}" for x in why) or _of_clocks(own, times))
    )


def _held(times: Float[np.ndarray, " n"]) -> str:
    return f"{len(times)} times from {times[0]:.3f} to {times[-1]:.3f} s"


def tracked(
    folder: Path, times: Times, known: Bool[np.ndarray, " n"]
) -> tuple[int, dict[str, Bool[np.ndarray, " n"]]]:
    """The map of the poses at these times that the tracker's file in the folder leaves to be
    evaluated, and masks of the others, by why they are not.

    They are of the longest map, without frames that are lost or whose unit is not fixed. A pose
    that is `known` exactly stays: it is where the map begins, and has a place in any unit. All
    poses where there is no such file. Raises ValueError where it is of other times, or nothing is
    left.
    """
    path = folder / "frames.csv"
    frames = read_frames(path)
    if frames is None:
        return 0, {}
    order = np.argsort(frames[0], kind="stable")
    place = np.interp(times, frames[0][order], np.arange(len(order)))
    at, lost, maps, fixed = (x[order[np.rint(place).astype(int)]] for x in frames)
    away = np.abs(at - times)
    if away.max() > MAX_TIME_DIFFERENCE:
        raise ValueError(
            f"{path}: no frame is within {MAX_TIME_DIFFERENCE} s of the pose at "
            f"{times[np.argmax(away)]:.3f} s; it must list the frames of the trajectory beside it"
        )
    usable = fixed & ~lost
    if not usable.any():
        raise ValueError(f"{path}: every frame with a pose is lost or has no fixed unit yet")
    number = int(np.argmax(np.bincount(maps[usable])))
    own = maps == number
    return number, {
        "poses are of other maps, each with its own unit": ~own,
        "poses are of frames that are lost": own & lost,
        "poses are from before the unit of their map was fixed": own & ~lost & ~fixed & ~known,
    }
