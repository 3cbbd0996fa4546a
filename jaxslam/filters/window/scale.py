"""The scale of a window, which no pixel observes.

**A gauge.** No measurement changes with λ in `(t, v, a, ω) → (e^λ t, e^λ v, e^λ a, e^−λ ω)`: with s
the derivative of all whitened unknowns u by λ, the information A = I + JᵀJ has A s = s. So
`λ = sᵀ(u − û)/|s|²` has the variance 1/|s|² and is uncorrelated with everything that does not
scale.

**The mean is not the maximum.** Along λ the density has the volume of all the rest, det A(λ)^−½,
and `½ d log det A/dλ = Σ_ω (1 − var) − Σ_a (1 − var)`: every inverse depth that the pixels give
draws the mean to smaller scales, every acceleration to larger ones.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.window.minimise import Minimum
from jaxslam.filters.window.problem import PathLayout, Reduced, X, Y, hidden
from jaxslam.filters.window.record import Record
from jaxslam.geometry import Scalar
from jaxslam.linalg import Cholesky, cholesky

MOST_SHIFT = 2.0
"""The greatest change of λ from the maximum to the mean."""
SHIFTS = 8
"""Steps of Newton's method from the one to the other."""


class Direction(NamedTuple):
    """A derivative of the whitened unknowns."""

    x: X
    y: Y

    @property
    def squared(self) -> Scalar:
        return jnp.sum(self.x**2) + jnp.sum(self.y**2)


def rescaled(slam: AbstractSlam, record: Record, at: Minimum, log_scale: Scalar) -> tuple[X, Y]:
    """The likeliest unknowns with all lengths e^λ times as large: the same pixels."""
    factor, p = jnp.exp(log_scale), slam.sensor.size
    layout = PathLayout.of(slam)
    place = slice(layout.start, layout.start + layout.common)
    there = hidden(slam, at.x[place], at.y[:, p:]) / factor
    begun = jnp.any(record.seen, axis=0)[:, None]
    common, own = _shared(slam, begun, there)
    x = enlarged(slam, at.x, factor).at[place].set(common)
    return x, at.y.at[:, p:].set(jnp.where(begun, own, at.y[:, p:]))


def _shared(
    slam: AbstractSlam, begun: Bool[Array, "m 1"], inverse_depths: Float[Array, "m o"]
) -> tuple[Float[Array, " c"], Float[Array, "m o"]]:
    """The likeliest common and own errors of inverse depths."""
    depth = slam.depth
    own = (inverse_depths - depth.mean) / depth.sigma
    if depth.common is None:
        return jnp.zeros(0, own.dtype), own
    ratio = jnp.where(begun, depth.common, 0.0)
    common = jnp.sum(ratio * own) / (1 + jnp.sum(ratio**2))
    return common[None], own - ratio * common


def enlarged(slam: AbstractSlam, x: X, factor: Scalar) -> X:
    """The path with all lengths so many times as large; −1 goes the other way."""
    layout, motion = PathLayout.of(slam), slam.motion
    mean, root = motion.start()
    steps = x[layout.whole :].reshape(-1, layout.step + layout.each)
    own = motion.noise_sigma.shape[-1]
    variables = mean + root @ x[: layout.start]
    larger, _ = motion.enlarged(variables, steps[0, :own], factor)
    start = root.T @ cholesky(root @ root.T).solve(larger - mean)
    noises = jax.vmap(lambda noise: motion.enlarged(variables, noise, factor)[1])(steps[:, :own])
    x = x.at[: layout.start].set(start)
    return x.at[layout.whole :].set(steps.at[:, :own].set(noises).ravel())


def scaling(slam: AbstractSlam, record: Record, at: Minimum) -> Direction:
    """s: of those that differ by what common and own errors of depth share, the shortest."""
    zero = jnp.zeros((), at.x.dtype)
    _, (x, y) = jax.jvp(lambda by: rescaled(slam, record, at, by), (zero,), (zero + 1,))
    return Direction(x, y)


def variances(local: Reduced, whitening: Float[Array, "N N"]) -> tuple[X, Y]:
    """Diagonals of A⁻¹: of x, and of y."""
    by_x = jnp.sum(whitening**2, axis=0)
    spread = jnp.einsum("mqn,on->mqo", local.coupling, whitening)
    own = jax.vmap(lambda factor: jnp.sum(factor.whitening**2, axis=0))(local.landmarks)
    return by_x, own + jnp.sum(spread**2, axis=2)


def shift_of_scale(
    slam: AbstractSlam, record: Record, at: Minimum, local: Reduced, factor: Cholesky
) -> Scalar:
    """λ of the mean, of a density that has its maximum at 0: where the prior and the volume of the
    rest balance, all lengths enlarged alike."""
    slope = _slope_of_volume(slam, local, scaling(slam, record, at), factor)

    def cost(log_scale):
        x, y = rescaled(slam, record, at, log_scale)
        return (jnp.sum(x**2) + jnp.sum(y**2)) / 2 - slope * log_scale

    def once(_, log_scale):
        one = jnp.ones_like(log_scale)
        gradient, curvature = jax.jvp(jax.grad(cost), (log_scale,), (one,))
        step = gradient / jnp.maximum(curvature, 1.0)
        return jnp.clip(log_scale - jnp.clip(step, -0.5, 0.5), -MOST_SHIFT, MOST_SHIFT)

    return jax.lax.fori_loop(0, SHIFTS, once, jnp.zeros_like(slope))


def _slope_of_volume(slam, local: Reduced, s: Direction, factor: Cholesky) -> Scalar:
    """`−½ d log det A/dλ`."""
    of_x, of_y = variances(local, factor.whitening)
    layout, p = PathLayout.of(slam), slam.sensor.size
    place = jnp.arange(of_x.size) - layout.start
    of_depth = (place >= 0) & (place < layout.common)
    sign = jnp.where(s.x == 0, 0.0, jnp.where(of_depth, -1.0, 1.0))
    depths = jnp.where(s.y[:, p:] != 0, 1 - of_y[:, p:], 0.0)
    return jnp.sum(sign * (1 - of_x)) - jnp.sum(depths)
