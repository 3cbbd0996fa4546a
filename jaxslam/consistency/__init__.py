"""Is a filter consistent? Monte Carlo runs, NEES and NIS with exact bounds, and their summary."""

from jaxslam.consistency.innovations import innovation_verdict
from jaxslam.consistency.montecarlo import BACKENDS, CHUNK, DTYPES, monte_carlo
from jaxslam.consistency.records import write_records
from jaxslam.consistency.statistics import (
    PowerSums,
    chi2_quantile,
    lost_threshold,
    mean_band,
    normalised_squared,
)
from jaxslam.consistency.store import FolderStore, MemoryStore
from jaxslam.consistency.summary import Study, summarise, table, tally, treatment
from jaxslam.consistency.verdict import (
    VERDICTS,
    Tally,
    not_disproved,
    run_verdict,
    sentences,
    verdict,
)

__all__ = [
    "BACKENDS",
    "CHUNK",
    "DTYPES",
    "VERDICTS",
    "FolderStore",
    "MemoryStore",
    "PowerSums",
    "Study",
    "Tally",
    "chi2_quantile",
    "innovation_verdict",
    "lost_threshold",
    "mean_band",
    "monte_carlo",
    "normalised_squared",
    "not_disproved",
    "run_verdict",
    "sentences",
    "summarise",
    "table",
    "tally",
    "treatment",
    "verdict",
    "write_records",
]
