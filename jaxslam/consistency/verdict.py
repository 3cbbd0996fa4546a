"""What a mean NEES says of a filter, alone and as one of many comparisons."""

from __future__ import annotations

import math

from jaxslam.consistency.statistics import CONFIDENCE, mean_band

VERDICTS = ("consistent", "under-confident", "over-confident", "lost")
LOST_BOUND = 0.01
"""More lost runs than this share make a filter lost: 100 times what a consistent one loses."""


def verdict(
    nees: float | None,
    lost: float,
    *,
    dof: int,
    runs: int,
    comparisons: int = 1,
    lost_bound: float = LOST_BOUND,
) -> str:
    """One of `VERDICTS` for a mean NEES over `runs` independent runs, `lost` a share of runs.

    `lost` comes first; then a mean NEES below the 95 % band is under-confident (σ too large), one
    above it over-confident. With m comparisons the band is Bonferroni's, at 1 − 0.05/m: it holds
    all means of m consistent filters together in 95 % of cases, however they are correlated. A
    mean that does not exist (None or NaN: every run diverged) is lost.

    Raises ValueError for numbers that make no sense.
    """
    if comparisons < 1:
        raise ValueError(f"comparisons must be at least 1, not {comparisons}")
    for name, share in (("lost", lost), ("lost_bound", lost_bound)):
        if not 0 <= share <= 1:
            raise ValueError(f"{name} must be a share from 0 to 1, not {share}")
    if lost > lost_bound or nees is None or math.isnan(nees):
        return "lost"
    low, high = mean_band(dof, runs, together(comparisons))
    if nees < low:
        return "under-confident"
    return "over-confident" if nees > high else "consistent"


def together(comparisons: int) -> float:
    """Confidence of each of m bands that hold together with 95 %, by Bonferroni."""
    return 1 - (1 - CONFIDENCE) / comparisons
