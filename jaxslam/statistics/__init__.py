"""Exact statistics of errors and their covariances: NEES and NIS, χ² bands, verdicts."""

from jaxslam._runtime import imported
from jaxslam.statistics.bands import (
    PowerSums,
    chi2_quantile,
    lost_threshold,
    mean_band,
    normalised_squared,
)
from jaxslam.statistics.beyond_scale import one_scale
from jaxslam.statistics.verdict import (
    Tally,
    Verdict,
    innovation_verdict,
    lost_runs,
    not_disproved,
    run_verdict,
    sentences,
)

__all__ = imported(globals())
