"""The likelihood of a filter's own numbers given the measurements, and its maximum.

A filter's innovations are independent if it is right, so that the measurements of a run have the
log likelihood `−½ Σ (rᵀ S⁻¹ r + log det S)`, up to a constant (Schweppe 1965). A filter is a pytree
of its numbers: this differentiates by any of them, through the whole run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray
from jaxslam.consistency.runs import run_through
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.simulation import Room, Run

MOST = 0.7
"""The most that a number of θ changes in one step: far from the maximum its curvature misleads."""


STEP = 1e-4
"""The step of the central differences of the gradient, in θ."""


class Estimate(NamedTuple):
    """The maximum of a likelihood."""

    values: Float[np.ndarray, " k"]
    standard_errors: Float[np.ndarray, " k"]
    """Standard errors by the scatter of the runs' scores (White 1982), which hold for a wrong model
    too."""
    log_likelihood: float
    """The log likelihood of all runs."""
    iterations: int
    converged: bool


def log_likelihood(slam: AbstractFilter, room: Room, run: Run) -> Float[Array, ""]:
    """The log likelihood of all that is measured in a run after frame 0, up to a constant.

    The constant is the same for all filters that use the same measurements.
    """

    def term(state, innovation, frame):
        del state, frame
        assert innovation.log_det is not None, "the information form knows no likelihood"
        return -(innovation.nis + innovation.log_det) / 2

    return jnp.sum(run_through(slam, room, run, term)[1])


def maximum_likelihood(
    filter_of: Callable[[Float[Array, " k"]], AbstractFilter],
    start: Float[AnyArray, " k"],
    room: Room,
    runs: Run,
    *,
    tolerance: float = 0.05,
    most_iterations: int = 30,
    chunk: int = 64,
) -> Estimate:
    """Find θ for which the filters `filter_of(θ)` explain a batch of runs best.

    Newton's method with the observed information, the central differences of the gradient, runs
    until a step is below `tolerance` standard errors. Take logarithms for θ where numbers are
    positive. Raises ValueError for an empty batch of runs.
    """
    count = jax.tree.leaves(runs)[0].shape[0]
    if not count:
        raise ValueError("a likelihood needs at least one run")

    @jax.jit
    def scored(theta, part):
        def one(theta, run):
            value = log_likelihood(filter_of(theta), room, run)
            return value, value

        return jax.vmap(jax.jacfwd(one, has_aux=True), in_axes=(None, 0))(theta, part)

    def over_all(theta):
        """The scores and the values of all runs."""
        parts = [
            jax.device_get(scored(theta, jax.tree.map(lambda x, i=i: x[i : i + chunk], runs)))
            for i in range(0, count, chunk)
        ]
        return [np.concatenate(of_parts) for of_parts in zip(*parts, strict=True)]

    def slope(theta):
        return over_all(theta)[0].sum(axis=0)

    def information(theta):
        steps = STEP * np.eye(theta.size)
        fall = np.array([slope(theta - h) - slope(theta + h) for h in steps])
        return (fall + fall.T) / (4 * STEP)

    theta, converged, iteration = np.asarray(start, float), False, 0
    while not converged and iteration < most_iterations:
        iteration += 1
        (scores, values), (curvature, axes) = over_all(theta), np.linalg.eigh(information(theta))
        # Uphill even where the surface is not yet concave.
        curvature = np.maximum(np.abs(curvature), 1e-6 * np.abs(curvature).max())
        by_run = (scores @ axes) / curvature @ axes.T
        change = by_run.sum(axis=0)
        theta = theta + np.clip(change, -MOST, MOST)
        errors = np.sqrt(np.sum((by_run - by_run.mean(axis=0)) ** 2, axis=0))
        converged = bool(np.all(np.abs(change) < tolerance * errors))
    return Estimate(theta, errors, float(values.sum()), iteration, converged)
