"""The sums over a chunk of runs that a summary needs, which add up over chunks.

A study may keep them in place of the records (`monte_carlo(..., reduced=True)`): its memory, its
files and what travels from a cluster then do not grow with the runs of a chunk.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxslam.consistency.store import SUM, Records
from jaxslam.models.observations import Status
from jaxslam.statistics.bands import lost_threshold
from jaxslam.statistics.beyond_scale import SCALE, OneScale, one_scale_of
from jaxslam.statistics.verdict import Tally

RECORDS = (
    "nees", "log_scale", "log_scale_sigma", *SCALE, "reversed", "nis", "nis_dof", "status",
    "error", "variance", "landmark_nees", "landmark_count", "landmark_not_finite",
)  # fmt: skip
"""The records of a run that a summary reads."""

Sums = dict[str, Any]


def keeps_records(chunk: range, reduced: bool) -> bool:
    """Whether a study keeps the chunk whole: of a reduced one the first, for its medians."""
    return not reduced or chunk.start == 0


def as_sums(records: Records, dof: int) -> Records:
    """Return the sums that a store keeps in place of a chunk's records, their names after `sum_`.

    `dof` is that of a pose. Sums are of the runs that did not diverge, but for `diverged`, the
    numbers of updates by status, and the tallies of the verdicts.
    """
    return {f"{SUM}{name}": np.asarray(value) for name, value in _sums(records, dof).items()}


def sums_of(kept: Records, dof: int) -> Sums:
    """The sums of a chunk, of which a store has kept either sums or records."""
    own = {name.removeprefix(SUM): x for name, x in kept.items() if name.startswith(SUM)}
    return own or _sums(kept, dof)


def added(each: Iterable[Sums]) -> Sums:
    """Add the sums of all chunks. Raises ValueError for chunks with other sums than the first."""
    total: Sums = {}
    for part in each:
        if total and total.keys() != part.keys():
            raise ValueError(f"a chunk has other sums: {', '.join(total.keys() ^ part.keys())}")
        total = {name: total.get(name, 0) + value for name, value in part.items()}
    return total


def tally_of(sums: Sums, record: str, dof: int) -> Tally:
    """The tally for a verdict; `dof` is that of a pose.

    It is of `nees`, of the part that is `beyond_scale`, at one scale a run, or of the `drift` of
    that scale.
    """
    own, fitted = {"nees": (dof, 0.0), "beyond_scale": (dof, 1.0), "drift": (1, 1.0)}[record]
    return Tally.of_numbers(sums[f"tally_{record}"], own, fitted)


def survived(records: Records) -> Bool[np.ndarray, " runs"]:
    """A mask of the runs that did not diverge."""
    return np.asarray(np.isfinite(records["nees"]).all(axis=1))


@np.errstate(over="ignore", invalid="ignore")  # of estimates that are beyond all measure
def _sums(records: Records, dof: int) -> Sums:
    healthy = survived(records)
    good = {name: records[name][healthy] for name in RECORDS}
    kept = good["nees"] <= lost_threshold(dof)
    ever = ~(good["nees"] <= lost_threshold(dof, good["nees"].shape[1]))
    of_all = one_scale_of(records)
    one = OneScale(*(x[healthy] for x in of_all))
    told = np.isfinite(of_all.normalised)
    fixed = told.any(axis=1)  # the runs whose unit ever was: drift is tallied from then on
    drifts, displaced = np.isfinite(one.drift), np.isfinite(good["reversed"])
    finite = good["landmark_count"] - good["landmark_not_finite"]
    sigma = good["log_scale_sigma"]
    of_runs = {
        **{name: good[name] for name in ("nees", "nis", "nis_dof", "variance")},
        "kept": kept,
        "kept_nees": np.where(kept, good["nees"], 0.0),
        "lost": ~kept,
        "lost_ever": np.logical_or.accumulate(ever, axis=1),
        "squared_error": good["error"] ** 2,
        "outside": good["error"] ** 2 > 9 * good["variance"],
        "landmark_nees": good["landmark_nees"] * finite,
        "landmark_count": finite,
        "landmark_not_finite": good["landmark_not_finite"],
        "beyond_scale": one.nees,
        "beyond_lost": one.nees > lost_threshold(dof),
        "squared_drift": _or_zero(one.drift) ** 2,
        "normalised_drift": _or_zero(one.normalised),
        "drift_variance": np.where(drifts, good["unit_log_scale_sigma"] ** 2, 0.0),
        "drift_count": drifts,
        "squared_log_scale": good["log_scale"] ** 2,
        "log_scale_variance": sigma**2,  # infinite of a scale that nothing depends on
        "normalised_log_scale": (good["log_scale"] / sigma) ** 2,
        "reversed": _or_zero(good["reversed"]),
        "displaced": displaced,
    }
    faults = [status for status in Status if status != Status.OK]
    return {
        "tally_nees": Tally.of(records["nees"], dof).numbers(),
        "tally_beyond_scale": Tally.of(of_all.nees, dof, 1.0).numbers(),
        "tally_drift": Tally.of(of_all.normalised[fixed], 1, 1.0, told[fixed]).numbers(),
        "diverged": np.sum(~healthy),
        **{name: value.sum(axis=0) for name, value in of_runs.items()},
        **{f"status_{s.name}": np.any(records["status"] == s, axis=1).sum() for s in faults},
    }


def _or_zero(x: np.ndarray) -> np.ndarray:
    """The numbers, and 0 where there is none."""
    return np.where(np.isnan(x), 0.0, x)
