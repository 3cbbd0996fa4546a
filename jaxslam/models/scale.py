"""The unit of length in the state: the metre, or one of its own whose size is estimated."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxslam.geometry import Scalar
from jaxslam.models.motion import AbstractMotion, Variables


class AbstractScale(eqx.Module):
    """The unit of length in the state."""

    free: ClassVar[bool] = False
    """Whether its size is estimated, as λ."""

    @abstractmethod
    def start(
        self, motion: AbstractMotion
    ) -> tuple[Variables, Float[Array, " 1"] | None, Float[Array, "k k"]]:
        """Means of the motion's variables and of λ, where it is `free`, and their covariance."""

    def prior(
        self, mean: Float[Array, " q"], sigma: Float[Array, " q"], variance: Scalar | None
    ) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
        """Mean and σ of 1/z as `e^λ/z` is to have them, given the variance of λ."""
        del variance
        return mean, sigma


class Metre(AbstractScale):
    """Lengths in the state are metres: there is no λ."""

    def start(self, motion):
        variables, root = motion.start()
        return variables, None, root @ root.T


class ScaleGauge(AbstractScale):
    """Lengths in the state are in units of `e^λ` m: what no bearing observes, the scale, stays out
    of the products of velocity and inverse depth."""

    free: ClassVar[bool] = True

    def start(self, motion):
        variables, root = motion.start()
        start, as_variables = ravel_pytree(variables)
        mean, covariance = velocity_in_gauge(start, root, motion.geometry.point_dim)
        return as_variables(mean[:-1]), mean[-1:], covariance

    def prior(self, mean, sigma, variance):
        """The exact first two moments of `e^λ/z`, linear in λ.

        `E e^λ ρ = ρ0 e^(λ + P/2)` for a ρ ~ N(ρ0, σ²) and λ of variance P; the slope by λ is the
        mean, and the variance that it leaves is `e^2λ ((ρ0² + σ²) e^2P − ρ0² e^P (1 + P))`.
        """
        P = variance
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
