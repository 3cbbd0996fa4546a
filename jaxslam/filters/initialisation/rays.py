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
from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.ekf import AbstractEntry, EkfSlam, correct, insert
from jaxslam.filters.forms.state import State
from jaxslam.filters.initialisation.alternatives import (
    check_range,
    log_density,
    reweighted,
    with_entry,
)
from jaxslam.filters.protocol import Corrected
from jaxslam.landmarks import CARTESIAN
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features


class RaySum(AbstractEntry):
    """The method's numbers; `State.memory` holds the members' weights, one row a landmark.

    Landmark i owns the slots i G, …, i G + G − 1 of the state, of G members.
    """

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
        check_range(self.nearest, self.farthest)
        if not (0 < self.alpha < 1 < self.beta):
            raise ValueError(f"rays need 0 < α < 1 < β, not {self.alpha} and {self.beta}")

    @property
    def members(self) -> int:
        """`G = 1 + ⌈log_β((1 − α)/(1 + α) s_max/s_min)⌉`."""
        covered = (1 - self.alpha) / (1 + self.alpha) * self.farthest / self.nearest
        return 1 + max(0, math.ceil(math.log(covered, self.beta)))

    def depths(self, dtype: DTypeLike | None = None) -> Float[Array, " members"]:
        """`s_1 = s_min / (1 − α)`, `s_{i+1} = β s_i`, along the optical axis, m."""
        return self.nearest / (1 - self.alpha) * self.beta ** jnp.arange(self.members, dtype=dtype)

    def slots(self, landmarks: int) -> int:
        return landmarks * self.members

    def memory(self, landmarks: int, dtype: DTypeLike) -> Float[Array, "landmarks members"]:
        return jnp.full((landmarks, self.members), 1 / self.members, dtype)

    def update(
        self, slam: EkfSlam, state: State, control: Control, features: Features
    ) -> Corrected:
        """Weigh the members, prune, and correct by those that are left."""
        likelihood = self._log_likelihood(slam, state, control, features)
        weights = reweighted(state.memory[features.slots], likelihood)
        weights = jnp.where(
            weights < self.threshold * jnp.max(weights, axis=1, keepdims=True), 0.0, weights
        )
        weights = weights / jnp.sum(weights, axis=1, keepdims=True)
        kept = features.places(state.memory.shape[0])
        memory = state.memory.at[kept].set(weights, mode="drop")
        state = slam.gaussian_form.remove(replace(state, memory=memory), memory.ravel() == 0)
        share = jnp.where(weights > 0, weights**self.privilege, 0.0)
        share = share / jnp.sum(share, axis=1, keepdims=True)
        return correct(slam, state, control, self._of_members(features, share))

    def initialise(self, slam: EkfSlam, state: State, features: Features) -> State:
        """Begin rays, with members of equal weight."""
        every = jnp.ones((features.slots.size, self.members))
        inverse_depth = jnp.tile(1 / self.depths(features.measured.dtype), features.slots.size)[
            :, None
        ]
        # To first order σ of 1/s is σ_s / s².
        prior = (inverse_depth, self.alpha * inverse_depth)
        members = self._of_members(features, every)
        state = insert(slam, state, members, prior)
        slots = features.places(state.memory.shape[0])
        return replace(state, memory=state.memory.at[slots].set(1 / self.members, mode="drop"))

    def collapsed(self, state: State) -> State:
        """The heaviest member of every ray."""
        c, d = state.core_dim, state.landmarks.shape[1]
        landmarks = jnp.arange(state.memory.shape[0])
        slots = landmarks * self.members + jnp.argmax(state.memory, axis=1)
        own = c + slots[:, None] * d + jnp.arange(d)
        index = jnp.concatenate([jnp.arange(c), own.ravel()])
        return replace(
            state,
            landmarks=state.landmarks[slots],
            active=state.active[slots],
            covariance=state.covariance[index[:, None], index],
        )

    def initialised(self, state: State) -> Bool[Array, " landmarks"]:
        return jnp.sum(state.active.reshape(-1, self.members), axis=1) == 1

    def _log_likelihood(self, slam, state, control, features):
        slots = self._slots_of(features)
        expected = slam.predict_features(state, control, slots.ravel())
        residual = features.measured[:, None] - expected.measured.reshape(*slots.shape, -1)
        covariance = expected.covariance.reshape(*residual.shape, -1)
        likelihood, _ = jax.vmap(jax.vmap(log_density))(residual, covariance)
        return jnp.where(expected.possible.reshape(slots.shape), likelihood, -jnp.inf)

    def _slots_of(self, features: Features) -> Int[Array, "m members"]:
        return features.slots[:, None] * self.members + jnp.arange(self.members)

    def _of_members(self, features: Features, share: Float[Array, "m members"]) -> Features:
        """The same measurement for each of a landmark's members, for a share ρ with noise R/ρ."""
        return Features(
            self._slots_of(features).ravel(),
            jnp.repeat(features.measured, self.members, axis=0),
            (features.valid[:, None] & (share > 0)).ravel(),
            1 / jnp.where(share > 0, share, 1.0).ravel(),
        )


def with_rays(base: EkfSlam, farthest: int | None = None) -> EkfSlam:
    """The filter with rays of Gaussians up to `farthest`, m."""
    rays = RaySum() if farthest is None else RaySum(farthest=farthest)
    return with_entry(base, rays, CARTESIAN)
