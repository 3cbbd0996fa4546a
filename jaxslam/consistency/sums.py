"""The sums over a chunk of runs that a summary needs, which add up over chunks.

A study may keep them in place of the records (`monte_carlo(..., reduced=True)`): its memory, its
files and what travels from a cluster then do not grow with the runs of a chunk.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

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
    scale = one_scale_of(records)
    finite = good["landmark_count"] - good["landmark_not_finite"]
    return {
        "tally_nees": Tally.of(records["nees"], dof).numbers(),
        "tally_beyond_scale": Tally.of(scale.nees, dof, 1.0).numbers(),
        "tally_drift": _of_drift(scale.normalised).numbers(),
        "diverged": np.sum(~healthy),
        "nees": good["nees"].sum(axis=0),
        "kept": kept.sum(axis=0),
        "kept_nees": np.where(kept, good["nees"], 0.0).sum(axis=0),
        "lost": (~kept).sum(axis=0),
        "lost_ever": np.logical_or.accumulate(ever, axis=1).sum(axis=0),
        **_of_scale(good, OneScale(*(x[healthy] for x in scale)), lost_threshold(dof)),
        "nis": good["nis"].sum(axis=0),
        "nis_dof": good["nis_dof"].sum(axis=0),
        "squared_error": (good["error"] ** 2).sum(axis=0),
        "outside": (good["error"] ** 2 > 9 * good["variance"]).sum(axis=0),
        "variance": good["variance"].sum(axis=0),
        "landmark_nees": (good["landmark_nees"] * finite).sum(axis=0),
        "landmark_count": finite.sum(axis=0),
        "landmark_not_finite": good["landmark_not_finite"].sum(axis=0),
        **{
            f"status_{s.name}": np.any(records["status"] == s, axis=1).sum()
            for s in Status
            if s != Status.OK
        },
    }


def _of_drift(normalised: Float[np.ndarray, "runs steps"]) -> Tally:
    """The tally of drift of the runs whose unit was ever fixed, from then on."""
    told = np.isfinite(normalised)
    ever = told.any(axis=1)
    return Tally.of(normalised[ever], 1, 1.0, told[ever])


def _of_scale(good: Records, one: OneScale, threshold: float) -> Sums:
    """The sums of NEES at one scale a run and its drift, of the metric scale, and of reversals."""
    error, sigma, own = good["log_scale"], good["log_scale_sigma"], good["unit_log_scale_sigma"]
    drifts = np.isfinite(one.drift)
    with np.errstate(over="ignore"):  # no σ of a scale that nothing depends on
        variance, claimed = sigma**2, own**2
    return {
        "beyond_scale": one.nees.sum(axis=0),
        "beyond_lost": (one.nees > threshold).sum(axis=0),
        "squared_drift": np.nansum(one.drift**2, axis=0),
        "normalised_drift": np.nansum(one.normalised, axis=0),
        "drift_variance": np.where(drifts, claimed, 0.0).sum(axis=0),
        "drift_count": drifts.sum(axis=0),
        "squared_log_scale": (error**2).sum(axis=0),
        "log_scale_variance": variance.sum(axis=0),
        "normalised_log_scale": ((error / sigma) ** 2).sum(axis=0),
        "reversed": np.nansum(good["reversed"], axis=0),
        "displaced": np.isfinite(good["reversed"]).sum(axis=0),
    }
