"""The consistency of filters: Monte Carlo runs, NEES and NIS with exact bounds, their summary."""

from jaxslam._runtime import imported
from jaxslam.consistency.backends import BACKENDS
from jaxslam.consistency.likelihood import log_likelihood
from jaxslam.consistency.montecarlo import CHUNK, DTYPES, check_sizes, draw, monte_carlo
from jaxslam.consistency.results import FilterResult, Results, Seconds, Summary
from jaxslam.consistency.runs import (
    SimulatedFrame,
    filter_run,
    of_simulation,
    run_through,
    scale_records,
)
from jaxslam.consistency.store import FolderStore, MemoryStore
from jaxslam.consistency.suite import read_suite, write_suite
from jaxslam.consistency.summary import Study, summarise, table, tally, treatment
from jaxslam.consistency.tuning import LogFit, Tuning, TuningSettings, fit_of, tune

__all__ = imported(globals())
