"""What a tracker says of its frames, `frames.csv`: which poses of a trajectory can be judged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE

FRAMES = "frames.csv"
_NEEDED = ("time", "state", "map", "unit_fixed")
_MOST_MAPS = 1_000_000


class Frames(NamedTuple):
    """Of all frames of a video, docs/gauge.md."""

    times: Float[np.ndarray, " k"]
    lost: Bool[np.ndarray, " k"]
    maps: Int[np.ndarray, " k"]
    """The number of the map. Each has a unit of length of its own."""
    fixed: Bool[np.ndarray, " k"]
    """Whether the unit of the map is; before that it changes with the frames."""


class Judged(NamedTuple):
    """Which poses of a run have a part in the verdict, and how many have none."""

    poses: Bool[np.ndarray, " n"]
    map: int = 0
    """The one that is judged."""
    elsewhere: int = 0
    """Poses of other maps."""
    lost: int = 0
    opening: int = 0
    """Poses from before the unit of the map was fixed."""


def judged(folder: Path, times: Float[np.ndarray, " n"], known: Bool[np.ndarray, " n"]) -> Judged:
    """Of poses at these times, what the tracker's file in the folder leaves to be judged.

    It is the longest map, without frames that are lost or whose unit is not fixed. A pose that is
    `known` exactly stays: it is where the map begins, and has a place in any unit. All poses
    where there is no such file. Raises ValueError where it is of other times, or nothing is left.
    """
    path = folder / FRAMES
    frames = read_frames(path)
    if frames is None:
        return Judged(np.ones(len(times), bool))
    order = np.argsort(frames.times, kind="stable")
    place = np.interp(times, frames.times[order], np.arange(len(order)))
    nearest = order[np.rint(place).astype(int)]
    away = np.abs(frames.times[nearest] - times)
    if away.max() > MAX_TIME_DIFFERENCE:
        raise ValueError(
            f"{path}: no frame is within {MAX_TIME_DIFFERENCE} s of the pose at "
            f"{times[np.argmax(away)]:.3f} s; the frames of the trajectory beside it are accepted"
        )
    _, lost, maps, fixed = (x[nearest] for x in frames)
    usable = fixed & ~lost
    if not usable.any():
        raise ValueError(f"{path}: no pose is of a frame that is not lost and whose unit is fixed")
    number = int(np.argmax(np.bincount(maps[usable])))
    own = maps == number
    opening = own & ~lost & ~fixed & ~known
    return Judged(
        own & ~lost & ~opening, number, *(int(x.sum()) for x in (~own, own & lost, opening))
    )


def read_frames(path: Path) -> Frames | None:
    """What the file of a tracker says; None where there is none, or another one of its name.

    Raises ValueError, naming the line, for what a tracker does not write.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    titles = [word.strip() for word in lines[0].split(",")] if lines else []
    if not set(_NEEDED) <= set(titles):
        return None
    places, rows = [titles.index(name) for name in _NEEDED], []
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            told = line.split(",")
            row = _row([told[place] for place in places if place < len(told)])
            if row is None:
                raise ValueError(
                    f"{path}, line {number}: a finite time, a state, the number of a map and "
                    "unit_fixed, 0 or 1, are accepted"
                )
            rows.append(row)
    if not rows:
        raise ValueError(f"{path}: holds no frames")
    return Frames(*(np.array(column) for column in zip(*rows, strict=True)))


def _row(told: list[str]) -> tuple[float, bool, int, bool] | None:
    """Numbers of a frame, in the order of `Frames`; None of what is no frame."""
    try:
        time, state, number, fixed = told
        row = float(time), state == "lost", int(number), bool(("0", "1").index(fixed.strip()))
    except ValueError:
        return None
    return row if np.isfinite(row[0]) and 0 <= row[2] <= _MOST_MAPS else None


def left_out(runs: Sequence[Judged]) -> Iterator[str]:
    """A sentence for every reason why poses of the runs are not judged."""
    logged = sum(len(one.poses) for one in runs)
    if elsewhere := sum(one.elsewhere for one in runs):
        which = (
            f"map {runs[0].map}, the longest," if len(runs) == 1 else "of each run the longest map"
        )
        yield (
            f"{which} is evaluated: {elsewhere} of {logged} poses are of other maps, each in a "
            "unit of its own, and are left out"
        )
    if lost := sum(one.lost for one in runs):
        yield f"{lost} of {logged} poses are of frames that are lost, and are left out"
    if opening := sum(one.opening for one in runs):
        yield (
            f"{opening} of {logged} poses are from before the unit of their map was fixed, and are "
            "left out"
        )
