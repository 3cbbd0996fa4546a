"""Rays as sums of Gaussians (Solà, Monin, Devy, Lemaire, IROS 2005).

At first sight a landmark is several Cartesian points along its ray, at depths s_i of a geometric
series with σ_i = α s_i, all of them in the map. Measurements weigh the members by their
likelihood, the unlikely ones are pruned, and the others share the measurement: member i is
corrected with R/ρ_i, Σ ρ_i = 1 (Federated Information Sharing), so that the camera does not hear
of it more than once. The landmark is finished when one member is left.

NIS is χ² only of finished landmarks: every member of a ray counts in it, with its own R/ρ_i.
"""

from __future__ import annotations

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxslam.filters.gaussian import correct, forgotten, insert
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.covariance import removed
from jaxslam.filters.linear.state import State
from jaxslam.filters.mixture.density import log_density
from jaxslam.filters.protocol import AbstractFilter, Corrected
from jaxslam.filters.rivals.delayed import AbstractDelayed, Delayed, around, reweighted
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features


class RaySum(AbstractDelayed):
    """A filter whose new landmarks are rays of several Gaussians.

    Landmark i owns the slots i G, …, i G + G − 1 of the Gaussian, of G members, and row i of the
    weights.
    """

    slam: AbstractSlam
    """The filter around one Gaussian, of Cartesian landmarks (`with_rays`)."""
    nearest: float = eqx.field(static=True, default=0.5)
    farthest: float = eqx.field(static=True, default=50.0)
    """The range of depths that the members cover, m: from s_1 − σ_1 to s_G + σ_G at least."""
    alpha: float = eqx.field(static=True, default=0.3)
    """α = σ_i / s_i."""
    beta: float = eqx.field(static=True, default=3.0)
    """β = s_{i+1} / s_i."""
    threshold: float = eqx.field(static=True, default=0.001)
    """A member is pruned below this share of the heaviest one's weight."""
    privilege: float = eqx.field(static=True, default=1.0)
    """μ of `ρ_i = Λ_i^μ / Σ Λ_j^μ`: 0 shares a measurement equally, 1 by the weights Λ."""

    def __check_init__(self) -> None:
        if not (0 < self.alpha < 1 < self.beta):
            raise ValueError(f"rays need 0 < α < 1 < β, not {self.alpha} and {self.beta}")

    @property
    def slots_each(self) -> int:
        """`G = 1 + ⌈log_β((1 − α)/(1 + α) s_max/s_min)⌉`."""
        covered = (1 - self.alpha) / (1 + self.alpha) * self.farthest / self.nearest
        return 1 + max(0, math.ceil(math.log(covered, self.beta)))

    def depths(self, dtype: DTypeLike | None = None) -> Float[Array, " members"]:
        """`s_1 = s_min / (1 − α)`, `s_{i+1} = β s_i`, along the optical axis, m."""
        powers = self.beta ** jnp.arange(self.slots_each, dtype=dtype)
        return self.nearest / (1 - self.alpha) * powers

    def even(self, landmarks: int, dtype: DTypeLike) -> Float[Array, "landmarks members"]:
        return jnp.full((landmarks, self.slots_each), 1 / self.slots_each, dtype)

    def update(self, state: Delayed, control: Control, features: Features) -> Corrected:
        """Weigh the members, prune, and correct by those that are left."""
        likelihood = self._log_likelihood(state.gaussian, control, features)
        weights = reweighted(state.weights[features.slots], likelihood)
        weights = jnp.where(
            weights < self.threshold * jnp.max(weights, axis=1, keepdims=True), 0.0, weights
        )
        weights = weights / jnp.sum(weights, axis=1, keepdims=True)
        kept = features.places(len(state.weights))
        after = state.weights.at[kept].set(weights, mode="drop")
        one = removed(state.gaussian, after.ravel() == 0)
        share = jnp.where(weights > 0, weights**self.privilege, 0.0)
        share = share / jnp.sum(share, axis=1, keepdims=True)
        one, innovation = correct(self.slam, one, control, self._of_members(features, share))
        return Delayed(one, after), innovation

    def begin(self, state: Delayed, features: Features) -> Delayed:
        """Begin rays, with members of equal weight."""
        every = jnp.ones((features.slots.size, self.slots_each))
        depths = self.depths(features.measured.dtype)
        inverse_depth = jnp.tile(1 / depths, features.slots.size)[:, None]
        # To first order σ of 1/s is σ_s / s².
        prior = (inverse_depth, self.alpha * inverse_depth)
        one = insert(self.slam, state.gaussian, self._of_members(features, every), prior)
        slots = features.places(len(state.weights))
        weights = state.weights.at[slots].set(1 / self.slots_each, mode="drop")
        return Delayed(forgotten(self.slam, one), weights)

    def collapsed(self, state: Delayed) -> State:
        """The heaviest member of every ray."""
        one = state.gaussian
        c, d = one.core_dim, one.landmarks.shape[1]
        landmarks = jnp.arange(len(state.weights))
        slots = landmarks * self.slots_each + jnp.argmax(state.weights, axis=1)
        own = c + slots[:, None] * d + jnp.arange(d)
        index = jnp.concatenate([jnp.arange(c), own.ravel()])
        return replace(
            one,
            landmarks=one.landmarks[slots],
            active=one.active[slots],
            covariance=one.covariance[index[:, None], index],
        )

    def _log_likelihood(self, one: State, control: Control, features: Features):
        slots = self._slots_of(features)
        expected = self.slam.predict_features(one, control, slots.ravel())
        residual = features.measured[:, None] - expected.measured.reshape(*slots.shape, -1)
        covariance = expected.covariance.reshape(*residual.shape, -1)
        likelihood, _ = jax.vmap(jax.vmap(log_density))(residual, covariance)
        return jnp.where(expected.possible.reshape(slots.shape), likelihood, -jnp.inf)

    def _slots_of(self, features: Features) -> Int[Array, "m members"]:
        return features.slots[:, None] * self.slots_each + jnp.arange(self.slots_each)

    def _of_members(self, features: Features, share: Float[Array, "m members"]) -> Features:
        """The same measurement for each of a landmark's members, for a share ρ with noise R/ρ."""
        return Features(
            self._slots_of(features).ravel(),
            jnp.repeat(features.measured, self.slots_each, axis=0),
            (features.valid[:, None] & (share > 0)).ravel(),
            (features.factors[:, None] / jnp.where(share > 0, share, 1.0)).ravel(),
        )


def with_rays(slam: AbstractFilter, farthest: int | None = None) -> RaySum:
    """The filter of Cartesian landmarks with rays of Gaussians up to `farthest`, m."""
    return RaySum(around(slam)) if farthest is None else RaySum(around(slam), farthest=farthest)
