"""The poses of the tracker's own log that are evaluated, by its record of all frames."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE
from jaxslam.io.text import text_lines
from jaxslam.io.tum import Times

FRAMES = "frames.csv"
_COLUMNS = ("time", "state", "map", "unit_fixed")
_ROW = re.compile(r"-?\d+(\.\d*)?,\w+,\d{1,6},[01]")
_FRAME = "a finite time, a state, the number of a map, and unit_fixed 0 or 1"


class EvaluatedPoses(NamedTuple):
    """A mask of the poses of a run that have a part in the verdict, and of the others why not."""

    poses: Bool[np.ndarray, " n"]
    map: int
    """The map that is evaluated."""
    others: Mapping[str, Bool[np.ndarray, " n"]]
    """Masks of the poses of other maps, of lost frames, and from before the unit was fixed."""


def evaluated_poses(folder: Path, times: Times, known: Bool[np.ndarray, " n"]) -> EvaluatedPoses:
    """The poses at these times that the tracker's file in the folder leaves to be evaluated.

    They are of the longest map, without frames that are lost or whose unit is not fixed. A pose
    that is `known` exactly stays: it is where the map begins, and has a place in any unit. All
    poses where there is no such file. Raises ValueError where it is of other times, or nothing is
    left.
    """
    path = folder / FRAMES
    frames = read_frames(path)
    if frames is None:
        return EvaluatedPoses(np.ones(len(times), bool), 0, {})
    order = np.argsort(frames[0], kind="stable")
    place = np.interp(times, frames[0][order], np.arange(len(order)))
    nearest = order[np.rint(place).astype(int)]
    at, lost, maps, fixed = (x[nearest] for x in frames)
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
    opening = own & ~lost & ~fixed & ~known
    others = {
        "poses are of other maps, each with its own unit": ~own,
        "poses are of frames that are lost": own & lost,
        "poses are from before the unit of their map was fixed": opening,
    }
    return EvaluatedPoses(own & ~lost & ~opening, number, others)


def read_frames(path: Path) -> tuple[np.ndarray, ...] | None:
    """The times of a tracker's frames, which are lost, their maps, and whether the unit of those is
    fixed (docs/gauge.md); None where there is no file of it, or another one of its name.

    Raises ValueError, naming the line, for what a tracker does not write.
    """
    try:
        told = text_lines(path)
    except ValueError:  # there is none, or it is no text
        return None
    # Reasons are words with spaces, and most cells of the last columns are empty: nobody's table.
    titles, *rows = (line.split(",") for line in told.values() or [""])
    if not rows or not set(_COLUMNS) <= set(titles):
        return None
    columns = [titles.index(name) for name in _COLUMNS]
    for line, row in zip(list(told)[1:], rows, strict=True):
        if len(row) != len(titles) or not _ROW.fullmatch(",".join(row[i] for i in columns)):
            raise ValueError(f"{path}, line {line}: expected {_FRAME}")
    time, state, number, fixed = np.array(rows)[:, columns].T
    return time.astype(float), state == "lost", number.astype(int), fixed == "1"
