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

from exact_posterior.laplace import covariance_root
from exact_posterior.problem import (
    Problem,
    Unknowns,
    landmark_costs,
    path,
    path_size,
    pixel_residuals,
    unknowns,
)
from jaxslam.filters.window.problem import Path, landmark_slopes


def centre(problem: Problem, mode: Float[Array, " n"]) -> Float[Array, " n"]:
    """w of the mode: its own path and pixels, and every inverse depth at its m."""
    return mode.at[-problem.landmarks :].set(0.0)


def conditional_unknowns(
    problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"]
) -> tuple[Unknowns, Float[Array, ""]]:
    """What w stands for, and the logarithm of the Jacobian from w, up to a constant."""
    return _on_path(problem, mode, w, path(problem, w[: path_size(problem)]))


def _on_path(
    problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"], at: Path
) -> tuple[Unknowns, Float[Array, ""]]:
    depths = slice(-problem.landmarks, None)
    x = unknowns(problem, w.at[depths].set(mode[depths]))
    mean, sigma = _given_path(problem, at, x)
    landmarks = x.landmarks.at[:, -1].set(mean + sigma * w[depths])
    return replace(x, landmarks=landmarks), jnp.sum(jnp.log(sigma))


def _given_path(
    problem: Problem, at: Path, x: Unknowns
) -> tuple[Float[Array, " l"], Float[Array, " l"]]:
    """Whitened m and s of every landmark, by one step of Gauss–Newton from the inverse depths of x.

    A second step makes no sampler better, as pixels are nearly linear in an inverse depth.
    """
    information, gradient, _ = landmark_slopes(problem.slam, problem.record, at, x.landmarks)
    own = information[:, -1, -1]
    return x.landmarks[:, -1] - gradient[:, -1] / own, 1 / jnp.sqrt(own)


def conditional_log_density(
    problem: Problem, mode: Float[Array, " n"], w: Float[Array, " n"]
) -> Float[Array, ""]:
    """Log posterior density of w, up to a constant; −∞ where nothing can be."""
    at = path(problem, w[: path_size(problem)])
    x, log_jacobian = _on_path(problem, mode, w, at)
    costs = landmark_costs(problem, at, x.landmarks)
    value = log_jacobian - (jnp.sum(costs) + x.path @ x.path) / 2
    return jnp.where(jnp.all(x.landmarks[:, -1] >= problem.lowest), value, -jnp.inf)


def whitening_root(problem: Problem, mode: Float[Array, " n"]) -> Float[Array, "n n"]:
    """R with `R Rᵀ = (JᵀJ)⁻¹` at the mode, J of all residuals, prior and pixels, by w.

    With w = centre + R x, x is nearly N(0, I) as far as the posterior of w is nearly Gaussian.
    """

    def residuals(w):
        x, _ = conditional_unknowns(problem, mode, w)
        return jnp.concatenate([x.path, x.landmarks.ravel(), pixel_residuals(problem, x)])

    return covariance_root(jax.jacfwd(residuals)(centre(problem, mode)))
