"""1-point RANSAC (Civera, Grasa, Davison, Montiel, JFR 2010), with every hypothesis tried.

One match and the prior of the filter are a complete hypothesis, so there are only as many as
matches, and nothing has to be drawn at random.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxslam.forms.state import Features
from jaxslam.linalg import cholesky
from jaxslam.slam.protocol import AbstractStaged

LOW_INNOVATION = 2.0
"""Pixels within which a match agrees with a hypothesis."""
RESCUE = 5.99
"""χ² of two degrees of freedom, 95 %: a match that fits the state after the first update."""


def inliers(
    slam: AbstractStaged,
    state: Any,
    control: Any,
    features: Features,
    low_innovation: float = LOW_INNOVATION,
    rescue: float = RESCUE,
) -> Bool[Array, " m"]:
    """Which valid features of a predicted state agree: the inliers of low and high innovation.

    Low: within `low_innovation` pixels after the update by the best single match. High: rejected
    so far, but within the χ² bound `rescue` after the update by all of low innovation.
    """
    votes = _agreement(slam, state, control, features, low_innovation)
    low = votes[jnp.argmax(jnp.sum(votes, axis=1))]
    updated, _ = slam.update(state, control, replace(features, valid=low))
    expected = slam.predict_features(updated, control, features.slots)
    residual = features.measured - expected.measured
    weighted = jax.vmap(lambda S, r: cholesky(S).solve(r))(expected.covariance, residual)
    distance = jnp.einsum("mp,mp->m", residual, weighted)
    return low | (features.valid & expected.possible & (distance < rescue))


def _agreement(slam, state, control, features, threshold) -> Bool[Array, "m m"]:
    """`[j, i]`: match i agrees with the hypothesis of match j."""

    def hypothesis(one: Features) -> Array:
        updated = slam.update_mean(state, control, one)
        expected = slam.predict_features(updated, control, features.slots)
        error = jnp.linalg.norm(features.measured - expected.measured, axis=1)
        return features.valid & expected.possible & (error < threshold) & one.valid[0]

    alone = jax.tree.map(lambda x: x[:, None], features)
    return jax.vmap(hypothesis)(alone)
