"""The exact posterior of small simulated problems: the reference that filters are measured by.

Needs the extra `posterior`: blackjax and optimistix.
"""

from jaxslam.posterior.laplace import Laplace, laplace, map_estimate, minima, pose_gaussian, starts
from jaxslam.posterior.moments import gaussian_divergence, pose_moments, wasserstein
from jaxslam.posterior.problem import (
    Problem,
    Unknowns,
    check_scenario,
    first_steps,
    log_density,
    make_problem,
    path,
    residuals,
    unknowns,
)
from jaxslam.posterior.ranks import ranks, uniformity
from jaxslam.posterior.sampler import HMC, Chains, diagnose, given_bound, sample
from jaxslam.posterior.study import (
    Study,
    against_filter,
    converged,
    draw_runs,
    pooled,
    reference,
)

__all__ = [
    "HMC",
    "Chains",
    "Laplace",
    "Problem",
    "Study",
    "Unknowns",
    "against_filter",
    "check_scenario",
    "converged",
    "diagnose",
    "draw_runs",
    "first_steps",
    "gaussian_divergence",
    "given_bound",
    "laplace",
    "log_density",
    "make_problem",
    "map_estimate",
    "minima",
    "path",
    "pooled",
    "pose_gaussian",
    "pose_moments",
    "ranks",
    "reference",
    "residuals",
    "sample",
    "starts",
    "uniformity",
    "unknowns",
    "wasserstein",
]
