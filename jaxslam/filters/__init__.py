"""Filters, and what they are made of: forms, corrections, wrappers; for filters of one's own."""

from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.forms.correction import AbstractCorrection, Standard, kalman_update
from jaxslam.filters.forms.covariance import Covariance
from jaxslam.filters.forms.first_estimates import FirstEstimates
from jaxslam.filters.forms.invariant import Invariant
from jaxslam.filters.forms.observability_constrained import ObservabilityConstrained
from jaxslam.filters.protocol import AbstractFilter, AbstractStaged
from jaxslam.filters.registry import MODIFIERS, RECOMMENDED, scenario_pieces
from jaxslam.filters.submaps.chain import Chain, base_poses, chain
from jaxslam.filters.submaps.closing import Loops, Posterior, agreeing, close, posterior
from jaxslam.filters.submaps.handover import Submaps, with_submaps
from jaxslam.filters.wrappers.batch_initialisation import BatchInitialisation
from jaxslam.filters.wrappers.fixed_lag import FixedLag
from jaxslam.filters.wrappers.gated import Gated
from jaxslam.filters.wrappers.gaussian_sum import GaussianSum
from jaxslam.filters.wrappers.wrapper import AbstractWrapper

__all__ = [
    "MODIFIERS",
    "RECOMMENDED",
    "AbstractCorrection",
    "AbstractFilter",
    "AbstractStaged",
    "AbstractWrapper",
    "BatchInitialisation",
    "Chain",
    "Covariance",
    "EkfSlam",
    "FirstEstimates",
    "FixedLag",
    "Gated",
    "GaussianSum",
    "Invariant",
    "Loops",
    "ObservabilityConstrained",
    "Posterior",
    "Standard",
    "Submaps",
    "agreeing",
    "base_poses",
    "chain",
    "close",
    "kalman_update",
    "posterior",
    "scenario_pieces",
    "with_submaps",
]
