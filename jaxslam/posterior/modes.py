"""Which mode of a posterior a draw belongs to, and how much of the posterior every mode has."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.geometry import Pose
from jaxslam.linalg import eigh
from jaxslam.posterior.mixtures import PoseMixture, component_log_densities

LEAST_SHARE = 0.05
"""Of the draws, that make a mode one to speak of."""
DEEPEST_VALLEY = 0.5
"""Two sides are two modes where the density between them is this share of the lesser's at most."""


def principal(displacements: Float[Array, "s n"]) -> Float[Array, " s"]:
    """Displacements along the line through 0 that they are nearest to; most of them positive."""
    _, axes = eigh(displacements.T @ displacements / len(displacements))
    along = displacements @ axes[:, -1]
    return jnp.where(jnp.mean(along > 0) < 0.5, -along, along)


def reversed_draws(T_BC: Pose) -> Bool[Array, " s"]:
    """Which draws of a pose lie on the other side of the origin than most of them do.

    The pixels of (t, v, ω) are those of −(t, v, ω), so that the mode which rivals the best one has
    its displacement reversed.
    """
    return principal(T_BC.translation()) < 0


def valley(T_BC: Pose) -> Float[Array, ""]:
    """Density half-way between the two sides over that at the lesser side's mean; 0 for two sharp
    modes, and more than 1 where there is but one.

    Counted along the principal line, in windows of a third of the distance of the two means.
    """
    along = principal(T_BC.translation())
    other = along < 0
    low, high = (_mean(along, side) for side in (other, ~other))
    width = (high - low) / 3

    def near(centre):
        return jnp.mean(jnp.abs(along - centre) < width / 2)

    return near((low + high) / 2) / jnp.maximum(near(low), 1 / along.size)


def _mean(values: Float[Array, " s"], chosen: Bool[Array, " s"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(chosen, values, 0.0)) / jnp.maximum(jnp.sum(chosen), 1)


def second_mode(T_BC: Pose) -> Float[Array, ""]:
    """Weight of the mode with the displacement reversed; 0 where it is none of its own."""
    share = jnp.mean(reversed_draws(T_BC))
    return jnp.where(valley(T_BC) < DEEPEST_VALLEY, share, 0.0)


def nearest_mode(T_BC: Pose, modes: PoseMixture) -> Int[Array, " s"]:
    """The mode, of those given, by whose Gaussian and weight each draw is likeliest."""
    return jnp.argmax(component_log_densities(modes, T_BC), axis=1)


def mode_weights(labels: Int[Array, " s"], count: int) -> Float[Array, " count"]:
    """Share of the draws that have each of the labels 0 to count − 1."""
    return jnp.mean(labels[:, None] == jnp.arange(count), axis=0)
