"""Conditionally independent submaps of a filter, the chain that they are, and loops in it."""

from jaxslam.filters.submaps.chain import Chain, base_poses, chain
from jaxslam.filters.submaps.closing import Loops, Posterior, agreeing, close, posterior
from jaxslam.filters.submaps.handover import Frozen, Submaps, SubmapsState, with_submaps

__all__ = [
    "Chain",
    "Frozen",
    "Loops",
    "Posterior",
    "Submaps",
    "SubmapsState",
    "agreeing",
    "base_poses",
    "chain",
    "close",
    "posterior",
    "with_submaps",
]
