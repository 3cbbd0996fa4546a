"""Is a filter consistent? Monte Carlo runs, NEES and NIS with exact bounds, and their summary."""

from jaxslam.consistency.montecarlo import CHUNK, DTYPES, Study, monte_carlo
from jaxslam.consistency.statistics import (
    chi2_quantile,
    lost_threshold,
    mean_band,
    normalised_squared,
)
from jaxslam.consistency.store import FolderStore, MemoryStore
from jaxslam.consistency.summary import summarise, table
from jaxslam.consistency.verdict import VERDICTS, verdict

__all__ = [
    "CHUNK",
    "DTYPES",
    "VERDICTS",
    "FolderStore",
    "MemoryStore",
    "Study",
    "chi2_quantile",
    "lost_threshold",
    "mean_band",
    "monte_carlo",
    "normalised_squared",
    "summarise",
    "table",
    "verdict",
]
