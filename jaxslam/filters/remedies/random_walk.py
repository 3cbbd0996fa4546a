"""Landmarks that are not quite fixed to the world, as patches of surfaces that turn.

A patch whose surface turns, or that shows two depths, is not found at the same point of the world
in every frame. Its error stays from one frame to the next. A filter takes it for a place of the
landmark, and, its noise being white, is surer of it with every frame.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxslam._numerics.arrays import AnyArray, number_field
from jaxslam.filters.linear.blocks import indices, residuals
from jaxslam.filters.linear.kalman import AbstractCorrection, Kalman
from jaxslam.linalg import inverse


class RandomWalk(AbstractCorrection):
    """An update before which every landmark that is seen has moved at random since it was seen
    last.

    In the picture with the covariance `share² R`, R being that of its measurement, by the least
    change of the landmark's own numbers: `Q = share² H⁺ R H⁺ᵀ`, H the Jacobian of the measurement
    by the landmark, is added to their covariance.
    """

    of: AbstractCorrection = Kalman()
    """The correction that follows."""
    share: Float[AnyArray, ""] = number_field(default=0.1)
    """σ of what a landmark drifts between two frames, in σ of its measurement."""

    @property
    def base(self) -> AbstractCorrection:
        return self.of.base

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        _, _, used, H = residuals(model, state, features, context)
        H, H_T = H.by_landmark, jnp.swapaxes(H.by_landmark, 1, 2)
        square = jnp.where(used[:, None, None], H @ H_T, jnp.eye(H.shape[1], dtype=H.dtype))
        back = H_T @ jax.vmap(inverse)(square)
        drift = self.share**2 * back @ noise @ jnp.swapaxes(back, 1, 2)
        index = indices(features.slots, state)
        P = state.covariance.at[index[:, :, None], index[:, None, :]].add(drift, mode="drop")
        moved = replace(state, covariance=P)
        return self.of.update(model, moved, features, noise, context, considered)

    def remember(self, state, slots):
        return self.of.remember(state, slots)
