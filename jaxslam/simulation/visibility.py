"""The part of what is visible that is measured, where a world limits it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxslam.simulation.world import Limits


def limited(limits: Limits, key: Array, visible: Bool[Array, "frames l"]):
    """No more landmarks in a frame than the limits allow, drawn at random."""
    frames, count = visible.shape
    first, new = limits.first_landmarks or count, limits.new_landmarks or count
    known = limits.known_landmarks or count
    if min(first, new, known) >= count:
        return visible

    def frame(before, data):
        visible, order, most_new = data
        again = _at_most(visible & before, order, known)
        fresh = _at_most(visible & ~before, order, most_new)
        return before | fresh, again | fresh

    orders = jax.random.uniform(key, (frames, count))
    most_new = jnp.full(frames, new).at[0].set(first)
    return jax.lax.scan(frame, jnp.zeros(count, bool), (visible, orders, most_new))[1]


def _at_most(mask, order, count) -> Bool[Array, " l"]:
    """The `count` of the mask that come first in the order."""
    rank = jnp.argsort(jnp.argsort(jnp.where(mask, order, jnp.inf)))
    return mask & (rank < count)
