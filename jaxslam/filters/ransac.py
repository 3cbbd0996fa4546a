"""1-point RANSAC (Civera, Grasa, Davison, Montiel, JFR 2010), with every hypothesis tried.

One match and the prior of the filter are a complete hypothesis, so there are only as many as
matches, and nothing has to be drawn at random.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters.slam import Parameters, SlamFilter
from jaxslam.filters.state import Features, State
from jaxslam.linalg import cholesky

LOW_INNOVATION = 2.0
"""Pixels within which a match agrees with a hypothesis."""
RESCUE = 5.99
"""χ² of two degrees of freedom, 95 %: a match that fits the state after the first update."""


def inliers(
    slam_filter: SlamFilter,
    state: State,
    parameters: Parameters,
    dt: Float[Array, ""],
    features: Features,
    low_innovation: float = LOW_INNOVATION,
    rescue: float = RESCUE,
) -> Bool[Array, " m"]:
    """Which valid features of a predicted state agree: the inliers of low and high innovation.

    Low: within `low_innovation` pixels after the update by the best single match. High: rejected
    so far, but within the χ² bound `rescue` after the update by all of low innovation.
    """
    votes = _agreement(slam_filter, state, parameters, dt, features, low_innovation)
    low = votes[jnp.argmax(jnp.sum(votes, axis=1))]
    updated, _ = slam_filter.update(state, parameters, dt, replace(features, valid=low))
    predicted, covariance, in_front = slam_filter.predict_features(
        updated, parameters, dt, features.slots
    )
    residual = features.measured - predicted
    distance = jnp.einsum(
        "mp,mp->m", residual, jax.vmap(lambda S, r: cholesky(S).solve(r))(covariance, residual)
    )
    return low | (features.valid & in_front & (distance < rescue))


def _agreement(slam_filter, state, parameters, dt, features, threshold) -> Array:
    """`[j, i]`: match i agrees with the hypothesis of match j."""

    def hypothesis(one: Features) -> Array:
        updated = slam_filter.update_mean(state, parameters, dt, one)
        predicted, in_front = slam_filter.project(updated, parameters, dt, features.slots)
        error = jnp.linalg.norm(features.measured - predicted, axis=1)
        return features.valid & in_front & (error < threshold) & one.valid[0]

    alone = jax.tree.map(lambda x: x[:, None], features)
    return jax.vmap(hypothesis)(alone)
