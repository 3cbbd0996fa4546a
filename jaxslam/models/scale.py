"""The unit of length in the state: the metre, or one of its own whose size is estimated."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.geometry import Scalar
from jaxslam.models.motion import AbstractMotion, Variables


class Metre(eqx.Module):
    """Lengths in the state are metres: there is no λ."""

    def start(self, motion: AbstractMotion) -> tuple[Variables, None, Float[Array, "v v"]]:
        """Mean of the motion's variables, no λ, and their covariance."""
        variables, root = motion.start()
        return variables, None, root @ root.T


class ScaleGauge(eqx.Module):
    """Lengths in the state are in units of `e^λ` m: what no bearing observes, the scale, stays out
    of the products of velocity and inverse depth."""

    def start(
        self, motion: AbstractMotion
    ) -> tuple[Float[Array, " v"], Float[Array, " 1"], Float[Array, "v+1 v+1"]]:
        """Means of the velocity and of λ, and their joint covariance."""
        velocity, root = motion.start()
        mean, covariance = velocity_in_gauge(velocity, root, motion.geometry.point_dim)
        return mean[:-1], mean[-1:], covariance


def noise_in_gauge(
    motion: AbstractMotion,
    variables: Float[Array, " v"],
    noise: Float[Array, " q"],
    log_scale: Float[Array, " u"],
) -> Float[Array, " q"]:
    """The step's noise in the units of the state.

    λ is frozen at its estimate: the noise's amplitude says nothing about scale, but its
    derivative by λ would pretend so.
    """
    unit = jnp.exp(-jax.lax.stop_gradient(log_scale[0]))
    return motion.enlarged(variables, noise, unit)[1]


def prior_in_gauge(
    mean: Float[Array, " q"], sigma: Float[Array, " q"], P: Scalar
) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
    """Mean and σ of 1/z such that `e^λ/z`, linear in λ, has its exact first two moments.

    `E e^λ ρ = ρ0 e^(λ + P/2)` for a ρ ~ N(ρ0, σ²) and λ of variance P; the slope by λ is the
    mean, and the variance that it leaves is `e^2λ ((ρ0² + σ²) e^2P − ρ0² e^P (1 + P))`.
    """
    left = (mean**2 + sigma**2) * jnp.exp(2 * P) - mean**2 * jnp.exp(P) * (1 + P)
    return mean * jnp.exp(P / 2), jnp.sqrt(left)


def velocity_in_gauge(
    velocity: Float[Array, " v"], root: Float[Array, "v v"], n: int
) -> tuple[Float[Array, " v+1"], Float[Array, "v+1 v+1"]]:
    """(ṽ, λ) for `(e^λ ṽ[:n], ṽ[n:])` to have the velocity's mean v̄ and covariance `Σ = R Rᵀ`.

    The first n numbers are linear, the only lengths. λ takes the relative speed `sᵀδv`,
    `s = v̄/|v̄|²`, of variance q: `λ ~ N(−P/2, P)` with `e^P = 1 + q`; given λ, nothing is left of
    it in ṽ. The moments are exact but for `O(q²)` of what is correlated with the speed. From
    standstill the scale is known, and 1.
    """
    linear = jnp.arange(velocity.size) < n
    along_mean = jnp.where(linear, velocity, 0.0)
    squared = along_mean @ along_mean
    s = along_mean / jnp.where(squared > 0, squared, 1.0)
    speed = root.T @ s
    with_speed, q = root @ speed, speed @ speed
    P = jnp.log1p(q)
    shrunk = jnp.where(linear, 1 / (1 + q), 1.0)
    by_scale = shrunk * (with_speed - q * along_mean)  # Cov(ṽ, λ)
    rest = root - jnp.outer(with_speed, speed) / jnp.where(q > 0, q, 1.0)
    rest = jnp.sqrt(shrunk)[:, None] * rest
    own = rest @ rest.T + jnp.outer(by_scale, by_scale) / jnp.where(q > 0, P, 1.0)
    mean = velocity - jnp.where(linear, by_scale, 0.0)
    joint = jnp.block([[own, by_scale[:, None]], [by_scale, P]])
    return jnp.append(mean, -P / 2), joint
