"""Variables in which the posterior is nearly Gaussian although no pixel observes the scale.

Pixels tell the product of a landmark's inverse depth and the distance travelled to about a
hundredth; the scale of both only by their priors. So the posterior is a thin ridge `v ω = const`,
bent in the whitened variables y, and a sampler creeps along it. Here λ, the logarithm of the
scale, is one of the variables w: with v* and a* of a mode y*,

    v = e^λ v* + (the rest),  a = a(w) + (e^λ − 1) a*,  ω = ω₀ + e^−λ (ω(w) − ω₀),

so that a change of w along λ moves pixels only to second order. At the mode w is y*. It is a change
of variables and nothing more: the density accounts for its Jacobian.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaxslam.posterior.problem import (
    Problem,
    Unknowns,
    log_likelihood,
    pixel_residuals,
    unknowns,
)
from jaxslam.rig import Rig


def scaled_unknowns(
    rig: Rig, problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"]
) -> tuple[Unknowns, Float[Array, ""]]:
    """What w stands for, and the logarithm of the Jacobian from w, up to a constant."""
    n, prior = rig.geometry.point_dim, problem.prior
    here, moved = unknowns(problem, mode), unknowns(problem, w)
    v, delta = here.velocity[:n], (moved.velocity - here.velocity)[:n]
    log_scale = delta @ v / (v @ v)
    scale = jnp.exp(log_scale)
    # ω stays above the truncation; the whole Gaussian has none, and 0 is scaled to 0.
    least = problem.least_inverse_depth
    pivot = jnp.where(jnp.isfinite(least), least, 0.0)
    x = Unknowns(
        velocity=moved.velocity.at[:n].add((scale - 1 - log_scale) * v),
        accelerations=moved.accelerations.at[:, :n].add((scale - 1) * here.accelerations[:, :n]),
        pixels=moved.pixels,
        inverse_depths=pivot + (moved.inverse_depths - pivot) / scale,
    )
    landmarks = x.inverse_depths.size
    w_depth = w[-landmarks:]
    # dω/dw of the truncated Gaussian's quantile is φ(w)/φ(t), t = (ω − mean)/σ.
    t = (
        moved.inverse_depths - prior.parameters.inverse_depth
    ) / prior.parameters.inverse_depth_sigma
    quantile = (t @ t - w_depth @ w_depth) / 2
    return x, (1 - landmarks) * log_scale + quantile


def log_prior(problem: Problem, x: Unknowns) -> Float[Array, ""]:
    """Log density of the physical quantities, up to a constant."""
    prior, parameters = problem.prior, problem.prior.parameters
    parts = (
        (x.velocity - prior.velocity) / prior.velocity_sigma,
        x.accelerations / parameters.motion_sigma,
        (x.pixels - problem.first) / parameters.measurement_sigma,
        (x.inverse_depths - parameters.inverse_depth) / parameters.inverse_depth_sigma,
    )
    return -jnp.asarray(sum(jnp.sum(part**2) for part in parts)) / 2


def scaled_log_density(
    rig: Rig, problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"]
) -> Float[Array, ""]:
    """Log posterior density of w, up to a constant."""
    x, log_jacobian = scaled_unknowns(rig, problem, mode, w)
    return log_likelihood(rig, problem, x) + log_prior(problem, x) + log_jacobian


def whitening_root(rig: Rig, problem: Problem, mode: Float[Array, " n"]) -> Float[Array, "n n"]:
    """R with `R Rᵀ = (JᵀJ)⁻¹` at the mode, J of the residuals [y; (z − h)/σ_px] by w.

    With w = mode + R x, x is nearly N(0, I) as far as the posterior of w is nearly Gaussian.
    """

    def physical(w):
        return scaled_unknowns(rig, problem, mode, w)[0]

    # Every physical quantity depends on its own y alone.
    _, slope = jax.jvp(lambda y: unknowns(problem, y), (mode,), (jnp.ones_like(mode),))
    by_w = jax.jacfwd(lambda w: ravel_pytree(physical(w))[0])(mode)
    J_prior = by_w / ravel_pytree(slope)[0][:, None]
    J = jnp.concatenate(
        [J_prior, jax.jacfwd(lambda w: pixel_residuals(rig, problem, physical(w)))(mode)]
    )
    lower = jnp.linalg.cholesky(J.T @ J)
    return solve_triangular(lower, jnp.eye(mode.size, dtype=mode.dtype), lower=True).T
