"""The consistency of filters: Monte Carlo runs, NEES and NIS with exact bounds, their summary."""

from jaxslam.consistency.backends import BACKENDS
from jaxslam.consistency.likelihood import log_likelihood
from jaxslam.consistency.montecarlo import CHUNK, DTYPES, check_sizes, draw, monte_carlo
from jaxslam.consistency.results import FilterResult, Results, Seconds, Summary
from jaxslam.consistency.runs import SimulatedFrame, filter_run, run_through, scale_records
from jaxslam.consistency.store import FolderStore, MemoryStore
from jaxslam.consistency.suite import read_suite, write_suite
from jaxslam.consistency.summary import Study, summarise, table, tally, treatment

__all__ = [
    "BACKENDS", "CHUNK", "DTYPES", "FilterResult", "FolderStore", "MemoryStore", "Results",
    "Seconds", "SimulatedFrame", "Study", "Summary", "check_sizes", "draw", "filter_run",
    "log_likelihood", "monte_carlo", "read_suite", "run_through", "scale_records", "summarise",
    "table", "tally", "treatment", "write_suite",
]  # fmt: skip
