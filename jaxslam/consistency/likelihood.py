"""The likelihood of a filter's own numbers given the measurements.

A filter's innovations are independent if it is right, so that the measurements of a run have the
log likelihood `−½ Σ (rᵀ S⁻¹ r + log det S)`, up to a constant (Schweppe 1965). A filter is a pytree
of its numbers: this differentiates by any of them, through the whole run, and so finds its maximum
(`notebooks/gradients.py`). Both modes go through sums and submaps; a start from rest has forward
mode alone, and says so.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.consistency.runs import run_through
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.observations import Innovation
from jaxslam.simulation import Room, Run


def log_likelihood(slam: AbstractFilter, room: Room, run: Run) -> Float[Array, ""]:
    """The log likelihood of all that is measured in a run after frame 0, up to a constant.

    The constant is the same for all filters that use the same measurements.
    """
    return -jnp.sum(run_through(slam, room, run, lambda _, seen, __: cost_of(seen))[1])


def cost_of(innovation: Innovation) -> Float[Array, ""]:
    """`½ (rᵀ S⁻¹ r + log det S)`: minus the log likelihood of a frame, up to a constant."""
    assert innovation.log_det is not None, "a likelihood needs the determinant of S"
    return (innovation.nis + innovation.log_det) / 2
