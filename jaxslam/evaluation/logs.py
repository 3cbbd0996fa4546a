"""Logs of somebody's filter: arrays in npz or CSV, trajectories in folders, to a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import read_arrays
from jaxslam._runtime.lookup import suggestion
from jaxslam.evaluation.convention import CHOICES
from jaxslam.evaluation.evaluate import Evaluation, evaluate
from jaxslam.evaluation.poses import evaluate_poses
from jaxslam.evaluation.trajectories import evaluate_runs, named, runs_of, stated_before
from jaxslam.io.tum import read_table, words

_KEYS = (
    "errors", "innovations", "covariances", "estimates", "truths", "times", "names", *CHOICES,
)  # fmt: skip
_CONTENTS = (
    "errors and covariances, innovations and covariances, or estimates, covariances and truths"
)


def evaluate_log(
    source: str | Path,
    *,
    covariance: str | Path | None = None,
    truth: str | Path | None = None,
    stated: Mapping[str, str] | None = None,
    align: str = "none",
    axes_used: str | Sequence[str] = (),
    nis: bool = False,
    truth_sigma: Sequence[float] | None = None,
) -> Evaluation:
    """The verdict on what a file or a folder holds.

    `source` is an npz file of arrays, a CSV file of `run, step, errors, upper triangle` lines, a
    trajectory in TUM format with its `covariance` and `truth`, or a folder: one run, or one a
    sub-folder, of `estimate.txt`, `covariance.txt` and `truth.txt`. Where the tracker's
    `frames.csv` is beside a trajectory, its longest map is evaluated, without frames that are lost
    or whose unit was not fixed yet. What is `stated` of the convention (`error`, `axes`, `order`,
    `scale`) comes before what the files say. How poses are aligned, which axes are used, and
    what σ the truth has, see `evaluate_poses`. With `nis` errors are innovations. Raises
    ValueError, naming the file.
    """
    source, stated = Path(source), dict(stated or {})
    how = {"align": align, "axes_used": axes_used, "truth_sigma": truth_sigma}
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder")
    if source.suffix in (".npz", ".csv"):
        for name, value in (("covariance", covariance), ("truth", truth)):
            if value is not None:
                raise ValueError(f"{source}: a {name} file goes with a trajectory, not with arrays")
        arrays, runs, steps = (_npz(source), (), ()) if source.suffix == ".npz" else _csv(source)
        found = named(source, lambda: _evaluate_arrays(arrays, stated, how, nis), runs, steps)
        return replace(found, run_names=runs)
    if nis:
        raise ValueError(f"{source}: innovations come in an npz or CSV file, not in a trajectory")
    return evaluate_runs(runs_of(source, covariance, truth), stated, how)


def _evaluate_arrays(
    arrays: dict[str, Any], stated: dict[str, str], how: dict[str, Any], nis: bool
) -> Evaluation:
    """Of errors, innovations or poses, by the names of the arrays."""
    held = [name for name in ("errors", "innovations", "estimates") if name in arrays]
    needed = {"covariances", *(["truths"] if held == ["estimates"] else [])}
    if len(held) != 1 or not needed <= arrays.keys():
        raise ValueError(f"holds {', '.join(arrays)}; {_CONTENTS} are accepted")
    times, P = arrays.get("times"), arrays["covariances"]
    if held == ["estimates"]:
        said = {name: str(arrays[name]) for name in CHOICES if name in arrays}
        convention = stated_before(said, stated)
        truths = arrays["truths"]
        return evaluate_poses(arrays["estimates"], P, truths, convention, times=times, **how)
    if stated or how["align"] != "none" or how["axes_used"] or how["truth_sigma"] is not None:
        raise ValueError(
            "conventions, alignments, axes used are of poses, and so is σ of a truth; here are "
            "errors, which are what they are; estimates, covariances and truths are accepted"
        )
    quantity = "NIS" if nis or held == ["innovations"] else "NEES"
    names = [str(name) for name in np.ravel(arrays.get("names", ()))]
    return evaluate(arrays[held[0]], P, times=times, names=names, quantity=quantity)


def _npz(path: Path) -> dict[str, Any]:
    """The arrays of a file; nothing in it is run."""
    arrays: dict[str, Any] = dict(read_arrays(path))
    for name in arrays:
        if name not in _KEYS:
            meant = suggestion(name, _KEYS)
            raise ValueError(f"{path}: unknown array {name!r}{meant}; known: {', '.join(_KEYS)}")
    return arrays


_APART = 2
"""Runs whose steps together are more than so many times those of the longest do not share them."""
_COLUMNS = "4 for n = 1, 7 for 2, 11 for 3, 29 for 6"


def _csv(path: Path) -> tuple[dict[str, Any], tuple[str, ...], tuple[str, ...]]:
    """Lines `run, step, n errors, n (n + 1)/2 of the upper triangle`; a first one of names.

    The arrays, and what runs and steps are called in the file.
    """
    row = "numbers run, step, n errors and the n (n + 1)/2 of the upper triangle row by row"
    comments, rows, lines = read_table(path, "log", "errors", row, None)
    n = round((np.sqrt(9 + 8 * (rows.shape[1] - 2)) - 3) / 2) if rows.shape[1] > 3 else 0
    if n < 1 or 2 + n * (n + 3) // 2 != rows.shape[1]:
        raise ValueError(f"{path}: {rows.shape[1]} columns; {row} are accepted: {_COLUMNS} columns")
    places, runs, steps = _rectangle(path, rows[:, :2], lines)
    e = np.full((len(runs), len(steps), n), np.nan)
    P = np.full((*e.shape, n), np.nan)
    e[places], triangle, upper = rows[:, 2 : 2 + n], np.empty((len(rows), n, n)), np.triu_indices(n)
    triangle[:, *upper] = triangle[:, *upper[::-1]] = rows[:, 2 + n :]
    P[places] = triangle
    titles = words(comments[0]) if comments else []
    named = len(titles) == rows.shape[1] and not comments[0].lstrip().startswith("#")
    names = {"names": titles[2 : 2 + n]} if named else {}
    arrays = {"errors": e, "covariances": P, **names}
    return arrays, tuple(f"run {x:g}" for x in runs), tuple(f"step {x:g}" for x in steps)


def _rectangle(
    path: Path, places: Float[np.ndarray, "k 2"], lines: tuple[int, ...]
) -> tuple[tuple[np.ndarray, np.ndarray], Float[np.ndarray, " r"], Float[np.ndarray, " s"]]:
    """The run and the step of every row, and the numbers of runs and of steps.

    A run need not have all steps.
    """
    (runs, run), (steps, step) = (np.unique(x, return_inverse=True) for x in places.T)
    pairs, first = np.unique(places, axis=0, return_index=True)
    if len(pairs) < len(places):
        twice = np.setdiff1d(np.arange(len(places)), first)[0]
        r, s = places[twice]
        raise ValueError(f"{path}, line {lines[twice]}: run {r:g}, step {s:g} comes twice")
    longest = int(np.bincount(run).max())
    if len(steps) > _APART * longest:
        raise ValueError(
            f"{path}: the runs have {len(steps)} different steps, and none more than {longest}; "
            "steps that are counted alike in all runs are accepted, as from the start of each"
        )
    return (run, step), runs, steps
