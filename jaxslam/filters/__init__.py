"""Filters, and what they are made of: the record and its pieces, for filters of your own."""

from jaxslam._runtime import imported
from jaxslam.filters.gate import Gate
from jaxslam.filters.linear.kalman import AbstractCorrection, Kalman, kalman_update
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.protocol import AbstractFilter, AbstractStaged
from jaxslam.filters.recommended import paper, recommended
from jaxslam.filters.remedies.first_estimates import FirstEstimates
from jaxslam.filters.remedies.invariant import Invariant
from jaxslam.filters.remedies.observability_constrained import ObservabilityConstrained
from jaxslam.filters.remedies.random_walk import RandomWalk
from jaxslam.filters.slam import Slam, compatible
from jaxslam.filters.submaps.chain import Chain, base_poses, chain
from jaxslam.filters.submaps.closing import Loops, Posterior, agreeing, close, posterior
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.filters.words import FILTERS, MODIFIERS, make_filter, make_filters, scenario_pieces

__all__ = imported(globals())
