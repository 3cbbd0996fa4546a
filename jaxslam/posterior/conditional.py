"""Variables in which the posterior is nearly Gaussian although pixels tell products only.

Pixels tell the product of a landmark's inverse depth and the distance travelled: sideways the scale
of both, straight ahead also the direction of travel, is known by the priors only. In the whitened
variables y that is a bent ridge, narrow where the distance is large, and a sampler creeps along it.
But *given* the path and its pixel in frame 0 the inverse depth of a landmark is nearly Gaussian,
N(m, s²). So w has in place of each depth's y the number e of

    ω = m(path, pixel) + s(path, pixel) e.

The change is triangular: `Σ log s` is the logarithm of its Jacobian, so that no more is assumed of
m and s than that they are smooth. By w the density is nearly the product of the path's marginal and
of N(0, I).
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.posterior.laplace import covariance_root
from jaxslam.posterior.problem import (
    Problem,
    Unknowns,
    log_likelihood,
    path,
    pixel_errors,
    pixel_residuals,
    unknowns,
)


def centre(problem: Problem, mode: Float[Array, " n"]) -> Float[Array, " n"]:
    """w of the mode: its own path and pixels, and every inverse depth at its m."""
    return mode.at[-_landmarks(problem) :].set(0.0)


def conditional_unknowns(
    problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"]
) -> tuple[Unknowns, Float[Array, ""]]:
    """What w stands for, and the logarithm of the Jacobian from w, up to a constant."""
    landmarks = _landmarks(problem)
    x = unknowns(problem, w.at[-landmarks:].set(mode[-landmarks:]))
    mean, sigma = _given_path(problem, x)
    return replace(x, inverse_depths=mean + sigma * w[-landmarks:]), jnp.sum(jnp.log(sigma))


def _given_path(problem: Problem, x: Unknowns) -> tuple[Float[Array, " l"], Float[Array, " l"]]:
    """m and s of every landmark, by one step of Gauss–Newton from the inverse depths of x.

    A second step makes no sampler better, as pixels are nearly linear in an inverse depth.
    """
    mean, variance = problem.depth.mean, problem.depth.sigma**2
    poses, _ = path(problem, x)

    def errors(omega):
        errors, _ = pixel_errors(problem, replace(x, inverse_depths=omega), poses)
        return jnp.where(problem.visible[..., None], errors, 0.0)

    # A landmark's errors depend on its own inverse depth alone.
    omega = x.inverse_depths
    here, slope = jax.jvp(errors, (omega,), (jnp.ones_like(omega),))
    information = 1 / variance + jnp.sum(slope**2, axis=(0, 2))
    downhill = (mean - omega) / variance - jnp.sum(slope * here, axis=(0, 2))
    return omega + downhill / information, 1 / jnp.sqrt(information)


def conditional_log_density(
    problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"]
) -> Float[Array, ""]:
    """Log posterior density of w, up to a constant; −∞ where nothing can be."""
    x, log_jacobian = conditional_unknowns(problem, mode, w)
    prior = _prior_residuals(problem, w, x)
    value = log_likelihood(problem, x) - prior @ prior / 2 + log_jacobian
    return jnp.where(jnp.all(x.inverse_depths >= problem.least_inverse_depth), value, -jnp.inf)


def whitening_root(problem: Problem, mode: Float[Array, " n"]) -> Float[Array, "n n"]:
    """R with `R Rᵀ = (JᵀJ)⁻¹` at the mode, J of all residuals, prior and pixels, by w.

    With w = centre + R x, x is nearly N(0, I) as far as the posterior of w is nearly Gaussian.
    """

    def residuals(w):
        x, _ = conditional_unknowns(problem, mode, w)
        return jnp.concatenate([_prior_residuals(problem, w, x), pixel_residuals(problem, x)])

    return covariance_root(jax.jacfwd(residuals)(centre(problem, mode)))


def _prior_residuals(problem: Problem, w: Float[Array, " n"], x: Unknowns) -> Float[Array, " n"]:
    depths = (x.inverse_depths - problem.depth.mean) / problem.depth.sigma
    return jnp.concatenate([w[: -depths.size], depths])


def _landmarks(problem: Problem) -> int:
    return problem.measured.shape[-2]
