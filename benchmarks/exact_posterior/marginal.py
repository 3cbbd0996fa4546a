"""The likelihood of a path with the landmarks integrated out, and landmarks drawn given the path.

Given the path every landmark is a problem of its own, and nearly a linear one: of its true pixel in
frame 0 and its inverse depth, `θ = (e, u)` in whitened numbers, the pixels are nearly linear
functions. So a sampler need only move in the path's variables, the first of y: the velocity and the
accelerations. Where pixels bend, the linear model is a proposal, and `landmark_draws` says by which
weights draws of path and landmarks become those of the exact posterior.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, Bool, Float

from exact_posterior.problem import (
    Problem,
    Unknowns,
    landmark_costs,
    path,
    size,
    truncated_normal,
    unknowns,
)
from jaxslam.filters.window.problem import Path, cholesky_each, landmark_slopes


class Landmarks(NamedTuple):
    """What a path says of every landmark: θ is N(mean, Wᵀ W) with its last number above a bound.

    `½ |θ|² + ½ |r(θ)|²` is nearly `½ |ε|² + cost` for `θ = mean + Wᵀ ε`.
    """

    mean: Float[Array, "l k"]
    whitening: Float[Array, "l k k"]
    """W, lower triangular, so that the last of ε is that of the inverse depth alone."""
    cost: Float[Array, " l"]
    log_evidence: Float[Array, " l"]
    """Of its pixels, up to the constant that `log_likelihood` leaves out."""
    lowest: Float[Array, " l"]
    """Bound on the last of ε; −∞ for a prior that is not truncated."""
    possible: Bool[Array, " l"]
    """Whether it is in front of the camera wherever it is measured."""


def path_unknowns(problem: Problem, y: Float[Array, " n"]) -> Unknowns:
    """What the path's variables stand for; pixels and depths at the centre of their priors."""
    return unknowns(problem, jnp.zeros(size(problem), y.dtype).at[: y.size].set(y))


def marginal_log_likelihood(problem: Problem, y: Float[Array, " n"]) -> Float[Array, ""]:
    """Log of the likelihood of a path, landmarks integrated out by a linear model of each.

    Up to the constant that `log_likelihood` leaves out; −∞ if one is behind the camera.
    """
    found = landmarks_given(problem, path_unknowns(problem, y), path(problem, y))
    return jnp.where(jnp.all(found.possible), jnp.sum(found.log_evidence), -jnp.inf)


def landmarks_given(problem: Problem, x: Unknowns, at: Path) -> Landmarks:
    """The linear model of every landmark at the end of one step of Gauss–Newton.

    One is enough while the camera has moved by less than its distance from the landmarks; after
    more the weights of `landmark_draws` differ much, and few draws count.
    No derivative is taken through that step: a Hamiltonian trajectory is reversible whatever its
    forces are.
    """
    first = _linearised(problem, jax.lax.stop_gradient(at), x.landmarks)
    bound = problem.lowest
    around = first.mean.at[:, -1].max(bound)
    found = _linearised(problem, at, jax.lax.stop_gradient(around))
    sigma = found.whitening[:, -1, -1]
    # Where there is no bound the slope by σ would be that of ∞/σ.
    some = jnp.isfinite(bound)
    lowest = jnp.where(some, (jnp.where(some, bound, 0.0) - found.mean[:, -1]) / sigma, -jnp.inf)
    above = _log_above(lowest) - _log_above(bound)
    log_det = jnp.sum(jnp.log(jnp.diagonal(found.whitening, axis1=1, axis2=2)), axis=1)
    evidence = log_det - found.cost + above
    return Landmarks(
        found.mean, found.whitening, found.cost, evidence, lowest, jnp.isfinite(found.cost)
    )


class _Quadratic(NamedTuple):
    mean: Float[Array, "l k"]
    whitening: Float[Array, "l k k"]
    cost: Float[Array, " l"]


def _linearised(problem: Problem, at: Path, around: Float[Array, "l k"]) -> _Quadratic:
    """`½ |θ|² + ½ |r + J (θ − θ₀)|²` as a quadratic form of each landmark's θ; of one that cannot
    be seen at θ₀ the cost is ∞."""
    information, uphill, cost = landmark_slopes(problem.slam, problem.record, at, around)
    whitening = cholesky_each(information).whitening
    down = jnp.einsum("lij,lj->li", whitening, uphill)
    mean = around - jnp.einsum("lji,lj->li", whitening, down)
    return _Quadratic(mean, whitening, (cost - jnp.sum(down**2, axis=1)) / 2)


def _log_above(lower: Float[Array, "*l"]) -> Float[Array, "*l"]:
    """Log of the share of N(0, 1) above a bound; its slope is 0 where there is none."""
    none = jnp.isneginf(lower)
    return jnp.where(none, 0.0, log_ndtr(-jnp.where(none, 0.0, lower)))


def landmark_draws(
    problem: Problem, y: Float[Array, " n"], key: Array, count: int
) -> tuple[Unknowns, Float[Array, ""]]:
    """Landmarks of a path: of every one `count` draws by its linear model, one of them chosen.

    A draw's weight is its exact density over that of the linear model; the one that is kept is
    chosen by the weights. The path's own log weight, the second of what is returned, is that of the
    product of their means: an unbiased estimate of its likelihood over `marginal_log_likelihood`.
    So weighted, path and landmarks together are draws of the exact posterior (Andrieu and Roberts
    2009).
    """
    at = path(problem, y)
    found = landmarks_given(problem, path_unknowns(problem, y), at)
    draw_key, choice_key = jax.random.split(key)
    normal = jax.random.normal(draw_key, (count, *found.mean.shape), y.dtype)
    white = normal.at[..., -1].set(truncated_normal(normal[..., -1], found.lowest))
    theta = found.mean + jnp.einsum("lji,clj->cli", found.whitening, white)
    log_weights = jax.vmap(partial(_log_weights, problem, at, found))(theta, white)
    chosen = jax.random.categorical(choice_key, log_weights, axis=0)
    kept = jnp.take_along_axis(theta, chosen[None, :, None], axis=0)[0]
    means = logsumexp(log_weights, axis=0) - jnp.log(count)
    return Unknowns(y, kept), jnp.sum(means)


def _log_weights(
    problem: Problem,
    at: Path,
    found: Landmarks,
    theta: Float[Array, "l k"],
    white: Float[Array, "l k"],
) -> Float[Array, " l"]:
    """Of every landmark, the log of its exact density over that of its linear model."""
    exact = -landmark_costs(problem, at, theta) / 2
    linear = -found.cost - jnp.sum(white**2, axis=1) / 2
    return jnp.where(found.possible & jnp.isfinite(exact), exact - linear, -jnp.inf)
