"""Is a filter consistent? Monte Carlo runs, NEES and NIS with exact bounds, and their summary."""

from jaxslam.consistency.montecarlo import BACKENDS, CHUNK, DTYPES, monte_carlo
from jaxslam.consistency.records import write_records
from jaxslam.consistency.store import FolderStore, MemoryStore
from jaxslam.consistency.summary import Study, summarise, table, tally, treatment

__all__ = [
    "BACKENDS",
    "CHUNK",
    "DTYPES",
    "FolderStore",
    "MemoryStore",
    "Study",
    "monte_carlo",
    "summarise",
    "table",
    "tally",
    "treatment",
    "write_records",
]
