"""The exact posterior of small simulated problems: the reference that filters are measured by.

Needs the extra `benchmarks`: blackjax.
"""

from exact_posterior.laplace import Laplace, laplace, map_estimate, minima, pose_gaussian, starts
from exact_posterior.mixtures import (
    PoseMixture,
    cross_entropy,
    entropy,
    filter_mixture,
    mixture_divergence,
    mixture_moments,
    mixture_of_modes,
)
from exact_posterior.modes import (
    halves,
    main_direction,
    mode_weights,
    nearest_mode,
    reversed_draws,
    second_mode,
    share_against,
    valley,
)
from exact_posterior.moments import gaussian_divergence, pose_moments, wasserstein
from exact_posterior.multimodal import Draws, pool, tempered_sample
from exact_posterior.problem import (
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
from exact_posterior.ranks import ranks, uniformity
from exact_posterior.sampler import HMC, Chains, diagnose, given_bound, sample
from exact_posterior.study import (
    Study,
    against_filter,
    converged,
    draw_runs,
    gaussian_sum,
    one_gaussian,
    pooled,
    reference,
)
from exact_posterior.tempered import SMC, Particles, tempered

__all__ = [
    "HMC",
    "SMC",
    "Chains",
    "Draws",
    "Laplace",
    "Particles",
    "PoseMixture",
    "Problem",
    "Study",
    "Unknowns",
    "against_filter",
    "check_scenario",
    "converged",
    "cross_entropy",
    "diagnose",
    "draw_runs",
    "entropy",
    "filter_mixture",
    "first_steps",
    "gaussian_divergence",
    "gaussian_sum",
    "given_bound",
    "halves",
    "laplace",
    "log_density",
    "main_direction",
    "make_problem",
    "map_estimate",
    "minima",
    "mixture_divergence",
    "mixture_moments",
    "mixture_of_modes",
    "mode_weights",
    "nearest_mode",
    "one_gaussian",
    "path",
    "pool",
    "pooled",
    "pose_gaussian",
    "pose_moments",
    "ranks",
    "reference",
    "residuals",
    "reversed_draws",
    "sample",
    "second_mode",
    "share_against",
    "starts",
    "tempered",
    "tempered_sample",
    "uniformity",
    "unknowns",
    "valley",
    "wasserstein",
]
