"""Batch MAP by Levenberg–Marquardt from several starts, and the Gaussian there (Laplace)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float

from exact_posterior.least_squares import levenberg_marquardt
from exact_posterior.problem import (
    Problem,
    last,
    log_density,
    path,
    residuals,
    size,
    unknowns,
)
from jaxslam.filters.window.problem import PathLayout
from jaxslam.geometry import Pose, difference
from jaxslam.linalg import cholesky

SOLVER = levenberg_marquardt(1e-9)
MOST_STEPS = 200
"""Levenberg–Marquardt steps of one start; what needs more counts as not converged."""


class Laplace(eqx.Module):
    """N(mode, R Rᵀ) in the whitened variables, with R Rᵀ = (JᵀJ)⁻¹ of the residuals there."""

    mode: Float[Array, " n"]
    root: Float[Array, "n n"]
    """R."""
    log_density: Float[Array, ""]
    """At the mode; −∞ if every start ended with a measured landmark behind the camera."""
    converged: Bool[Array, ""]
    """Whether the best start ended at a minimum."""


def starts(problem: Problem, key: Array, count: int) -> Float[Array, "count n"]:
    """The prior mean, then draws of velocity and depths from the prior, without accelerations."""
    n, start = size(problem), PathLayout.of(problem.slam).start
    drawn = jnp.arange(n)
    drawn = (drawn < start) | (drawn >= n - problem.landmarks)
    draws = jax.random.normal(key, (count, n), problem.record.measured.dtype)
    return jnp.where(drawn & (jnp.arange(count) > 0)[:, None], draws, 0.0)


def minima(
    problem: Problem, initial: Float[Array, "s n"]
) -> tuple[Float[Array, "s n"], Float[Array, " s"], Bool[Array, " s"]]:
    """Where Levenberg–Marquardt ends from every start, the log density there, and convergence."""

    def from_start(y):
        solution = optimistix.least_squares(
            lambda y, problem: residuals(problem, y),
            SOLVER,
            y,
            args=problem,
            max_steps=MOST_STEPS,
            throw=False,
        )
        converged = solution.result == optimistix.RESULTS.successful
        return solution.value, log_density(problem, solution.value), converged

    return jax.vmap(from_start)(initial)


def laplace(problem: Problem, mode: Float[Array, " n"], converged: Bool[Array, ""]) -> Laplace:
    """The Gaussian at a mode."""
    J = jax.jacfwd(lambda y: residuals(problem, y))(mode)
    return Laplace(mode, covariance_root(J), log_density(problem, mode), converged)


def covariance_root(J: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """R with `R Rᵀ = (JᵀJ)⁻¹`, J of whitened residuals."""
    return cholesky(J.T @ J).whitening.T


def last_pose(problem: Problem, y: Float[Array, " n"]) -> Pose:
    """T_CB after the last step."""
    T_BC, _ = last(path(problem, unknowns(problem, y).path))
    return T_BC.inverse()


def pose_gaussian(problem: Problem, at: Laplace) -> tuple[Pose, Float[Array, "t t"]]:
    """T_CB of the mode and its first-order covariance, by a right perturbation: what a
    robocentric filter's `pose_error` speaks of."""
    mean = last_pose(problem, at.mode)

    def moved(x):
        return difference(last_pose(problem, at.mode + at.root @ x), mean)

    J = jax.jacfwd(moved)(jnp.zeros_like(at.mode))
    return mean, J @ J.T
