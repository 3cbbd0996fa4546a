"""The scale of a window, which no pixel tells.

**A gauge.** No measurement changes with λ in `(t, v, a, ω) → (e^λ t, e^λ v, e^λ a, e^−λ ω)`: with s
the derivative of all whitened unknowns u by λ, the information A = I + JᵀJ has A s = s. So
`λ = sᵀ(u − û)/|s|²` has the variance 1/|s|² and is uncorrelated with everything that does not
scale.

**The mean is not the maximum.** Along λ the density has the volume of all the rest, det A(λ)^−½,
and `½ d log det A/dλ = Σ_ω (1 − var) − Σ_a (1 − var)`: every inverse depth that the pixels tell
draws the mean to smaller scales, every acceleration to larger ones.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.geometry import Scalar
from jaxslam.linalg import Cholesky, cholesky
from jaxslam.slam.filter import EkfSlam
from jaxslam.window.minimise import Minimum
from jaxslam.window.problem import Layout, Reduced, hidden
from jaxslam.window.record import Record

MOST_SHIFT = 0.5
"""Of λ, from the maximum to the mean."""


class Direction(NamedTuple):
    """A derivative of the whitened unknowns."""

    x: Float[Array, " N"]
    y: Float[Array, "m q"]

    @property
    def squared(self) -> Float[Array, ""]:
        return jnp.sum(self.x**2) + jnp.sum(self.y**2)


def rescaled(
    slam: EkfSlam, record: Record, at: Minimum, log_scale: Float[Array, ""]
) -> tuple[Float[Array, " N"], Float[Array, "m q"]]:
    """The unknowns with all lengths e^λ times as large: the same pixels."""
    factor = jnp.exp(log_scale)
    return enlarged(slam, at.x, factor), _nearer(slam, record, at, factor)


def enlarged(slam: EkfSlam, x: Float[Array, " N"], factor: Scalar) -> Float[Array, " N"]:
    """The path with all lengths so many times as large; −1 goes the other way."""
    layout, motion = Layout.of(slam), slam.motion
    mean, root = motion.start()
    steps = x[layout.whole :].reshape(-1, layout.step + layout.each)
    own = motion.noise_sigma.shape[-1]
    variables = mean + root @ x[: layout.start]
    larger, _ = motion.enlarged(variables, steps[0, :own], factor)
    start = root.T @ cholesky(root @ root.T).solve(larger - mean)
    noises = jax.vmap(lambda noise: motion.enlarged(variables, noise, factor)[1])(steps[:, :own])
    x = x.at[: layout.start].set(start)
    return x.at[layout.whole :].set(steps.at[:, :own].set(noises).ravel())


def _nearer(slam: EkfSlam, record: Record, at: Minimum, factor: Scalar) -> Float[Array, "m q"]:
    """Inverse depths divided by a factor, in their own part; the common error stays."""
    depth, layout, p = slam.depth, Layout.of(slam), slam.sensor.size
    common = at.x[layout.start : layout.start + layout.common]
    gained = (1 / factor - 1) * hidden(slam, common, at.y[:, p:])
    begun = jnp.any(record.seen, axis=0)[:, None]
    return at.y.at[:, p:].add(jnp.where(begun, gained / (depth.sigma * depth.own), 0.0))


def scaling(slam: EkfSlam, record: Record, at: Minimum) -> Direction:
    """s, the shortest of those that differ by what common and own errors of depth share."""
    zero = jnp.zeros((), at.x.dtype)
    _, (x, y) = jax.jvp(lambda by: rescaled(slam, record, at, by), (zero,), (zero + 1,))
    layout, depth = Layout.of(slam), slam.depth
    if depth.common is None:
        return Direction(x, y)
    begun, p = jnp.any(record.seen, axis=0), slam.sensor.size
    ratio = jnp.where(begun[:, None], depth.common / depth.own, 0.0)
    shared = jnp.sum(ratio * y[:, p:]) / (1 + jnp.sum(ratio**2))
    y = y.at[:, p:].add(-ratio * shared)
    return Direction(x.at[layout.start].add(shared), y)


def told(slam: EkfSlam, at: Minimum, s: Direction) -> Float[Array, ""]:
    """1/variance of λ: |s|², without the accelerations where their size is not told."""
    return s.squared - jnp.sum(_untold(slam, at.x, s) ** 2)


def _untold(slam: EkfSlam, x: Float[Array, " N"], s: Direction) -> Float[Array, " N"]:
    """Accelerations that scale and whose size is not told; zero elsewhere."""
    layout = Layout.of(slam)
    if slam.motion.noise_told:
        return jnp.zeros_like(x)
    own = slam.motion.noise_sigma.shape[-1]
    place = jnp.arange(x.size) - layout.whole
    own = (place >= 0) & (place % (layout.step + layout.each) < own)
    return jnp.where(own & (s.x != 0), x, 0.0)


def variances(
    local: Reduced, whitening: Float[Array, "N N"]
) -> tuple[Float[Array, " N"], Float[Array, "m q"]]:
    """Diagonals of A⁻¹: of x, and of y."""
    by_x = jnp.sum(whitening**2, axis=0)
    spread = jnp.einsum("mqn,on->mqo", local.coupling, whitening)
    own = jax.vmap(lambda factor: jnp.sum(factor.whitening**2, axis=0))(local.landmarks)
    return by_x, own + jnp.sum(spread**2, axis=2)


def shift_of_scale(
    slam: EkfSlam, at: Minimum, local: Reduced, s: Direction, factor: Cholesky
) -> Float[Array, ""]:
    """λ of the mean, of a density that has its maximum at 0.

    What is not told of the accelerations follows the scale: it draws as the maximum did.
    """
    of_x, of_y = variances(local, factor.whitening)
    p, untold = slam.sensor.size, _untold(slam, at.x, s)
    drawn = jnp.where(untold != 0, untold**2, 1 - of_x)
    slope = jnp.sum(jnp.where(s.x != 0, drawn, 0.0))
    slope = slope - jnp.sum(jnp.where(s.y[:, p:] != 0, 1 - of_y[:, p:], 0.0))
    return jnp.clip(slope / told(slam, at, s), -MOST_SHIFT, MOST_SHIFT)
