"""The likelihood of a path with the landmarks integrated out, and landmarks drawn given the path.

Given the path every landmark is a problem of its own, and nearly a linear one: of its true pixel in
frame 0 and its inverse depth, `θ = (e, u)` in whitened numbers, the pixels are nearly linear
functions. So a sampler need only move in the path's variables, the first of y: the velocity and the
accelerations. Where pixels bend, the linear model is a proposal, and `landmark_draws` says by which
weights draws of path and landmarks become those of the exact posterior.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, Bool, Float

from jaxslam.geometry import Pose
from jaxslam.linalg import cholesky
from jaxslam.posterior.problem import (
    Problem,
    Unknowns,
    path,
    pixel_errors,
    size,
    truncated_normal,
    unknowns,
)


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


def path_size(problem: Problem) -> int:
    """How many of the whitened variables are the path's."""
    landmarks, p = problem.measured.shape[-2:]
    return size(problem) - landmarks * (p + 1)


def path_unknowns(problem: Problem, y: Float[Array, " n"]) -> Unknowns:
    """What the path's variables stand for; pixels and depths at the centre of their priors."""
    return unknowns(problem, jnp.zeros(size(problem), y.dtype).at[: y.size].set(y))


def marginal_log_likelihood(problem: Problem, y: Float[Array, " n"]) -> Float[Array, ""]:
    """Log of the likelihood of a path, landmarks integrated out by a linear model of each.

    Up to the constant that `log_likelihood` leaves out; −∞ if one is behind the camera.
    """
    x = path_unknowns(problem, y)
    found = landmarks_given(problem, x, path(problem, x)[0])
    return jnp.where(jnp.all(found.possible), jnp.sum(found.log_evidence), -jnp.inf)


def landmarks_given(problem: Problem, x: Unknowns, poses: Pose) -> Landmarks:
    """The linear model of every landmark at the end of one step of Gauss–Newton.

    One is enough while the camera has moved by less than its distance from the landmarks; after
    more the weights of `landmark_draws` differ much, and few draws count.
    No derivative is taken through that step: a Hamiltonian trajectory is reversible whatever its
    forces are.
    """
    start = jnp.concatenate(
        [jnp.zeros_like(x.pixels), _whitened(problem, x.inverse_depths)[:, None]], axis=1
    )
    fixed = jax.lax.stop_gradient(poses)
    first, _ = _linearised(problem, x, fixed, start)
    bound = _whitened(problem, problem.least_inverse_depth)
    around = first.mean.at[:, -1].max(bound)
    found, possible = _linearised(problem, x, poses, jax.lax.stop_gradient(around))
    sigma = found.whitening[:, -1, -1]
    # Where there is no bound the slope by σ would be that of ∞/σ.
    some = jnp.isfinite(bound)
    lowest = jnp.where(some, (jnp.where(some, bound, 0.0) - found.mean[:, -1]) / sigma, -jnp.inf)
    above = _log_above(lowest) - _log_above(bound)
    log_det = jnp.sum(jnp.log(jnp.diagonal(found.whitening, axis1=1, axis2=2)), axis=1)
    return Landmarks(
        found.mean, found.whitening, found.cost, log_det - found.cost + above, lowest, possible
    )


class _Quadratic(NamedTuple):
    mean: Float[Array, "l k"]
    whitening: Float[Array, "l k k"]
    cost: Float[Array, " l"]


def _linearised(
    problem: Problem, x: Unknowns, poses: Pose, around: Float[Array, "l k"]
) -> tuple[_Quadratic, Bool[Array, " l"]]:
    """`½ |θ|² + ½ |r + J (θ − θ₀)|²` as a quadratic form of each landmark's θ."""

    def errors(theta):
        return _errors(problem, x, poses, theta)

    def along(axis):
        # A landmark's errors depend on its own numbers alone.
        tangent = jnp.zeros_like(around).at[:, axis].set(1.0)
        return jax.jvp(errors, (around,), (tangent,))[1][0]

    here, possible = errors(around)
    J = jnp.stack([along(axis) for axis in range(around.shape[1])], axis=-1)
    information = jnp.eye(around.shape[1]) + jnp.einsum("klpi,klpj->lij", J, J)
    uphill = around + jnp.einsum("klpi,klp->li", J, here)
    factor = jax.vmap(cholesky)(information)
    down = jnp.einsum("lij,lj->li", factor.whitening, uphill)
    mean = around - jnp.einsum("lji,lj->li", factor.whitening, down)
    squared = jnp.sum(around**2, axis=1) + jnp.sum(here**2, axis=(0, 2))
    return _Quadratic(mean, factor.whitening, (squared - jnp.sum(down**2, axis=1)) / 2), possible


def _placed(problem: Problem, x: Unknowns, theta: Float[Array, "l k"]) -> Unknowns:
    """The unknowns with landmarks of these whitened numbers."""
    return replace(
        x,
        pixels=problem.first + problem.sensor.sigma * theta[:, :-1],
        inverse_depths=problem.depth.mean + problem.depth.sigma * theta[:, -1],
    )


def _errors(
    problem: Problem, x: Unknowns, poses: Pose, theta: Float[Array, "l k"]
) -> tuple[Float[Array, "steps l p"], Bool[Array, " l"]]:
    """`(z − h(θ))/σ_px`, zero where nothing was measured, and whether what was is possible."""
    errors, possible = pixel_errors(problem, _placed(problem, x, theta), poses)
    seen = problem.visible
    return jnp.where(seen[..., None], errors, 0.0), jnp.all(possible | ~seen, axis=0)


def _whitened(problem: Problem, omega: Float[Array, "*l"]) -> Float[Array, "*l"]:
    return (omega - problem.depth.mean) / problem.depth.sigma


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
    x = path_unknowns(problem, y)
    poses, _ = path(problem, x)
    found = landmarks_given(problem, x, poses)
    draw_key, choice_key = jax.random.split(key)
    normal = jax.random.normal(draw_key, (count, *found.mean.shape), y.dtype)
    white = normal.at[..., -1].set(truncated_normal(normal[..., -1], found.lowest))
    theta = found.mean + jnp.einsum("lji,clj->cli", found.whitening, white)
    log_weights = jax.vmap(partial(_log_weights, problem, x, poses, found))(theta, white)
    chosen = jax.random.categorical(choice_key, log_weights, axis=0)
    kept = jnp.take_along_axis(theta, chosen[None, :, None], axis=0)[0]
    means = logsumexp(log_weights, axis=0) - jnp.log(count)
    return _placed(problem, x, kept), jnp.sum(means)


def _log_weights(
    problem: Problem,
    x: Unknowns,
    poses: Pose,
    found: Landmarks,
    theta: Float[Array, "l k"],
    white: Float[Array, "l k"],
) -> Float[Array, " l"]:
    """Of every landmark, the log of its exact density over that of its linear model."""
    errors, possible = _errors(problem, x, poses, theta)
    exact = -(jnp.sum(theta**2, axis=1) + jnp.sum(errors**2, axis=(0, 2))) / 2
    linear = -found.cost - jnp.sum(white**2, axis=1) / 2
    return jnp.where(possible, exact - linear, -jnp.inf)
