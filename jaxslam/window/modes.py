"""The modes of a window's posterior: where they are, and how much each is worth.

A camera that sets out from rest leaves several: (t, v, ω) → −(t, v, ω) changes no pixel, and with
the rotation that takes up the mean flow t → −t changes them little (the Necker cube). So the
minimisation starts from rest and from translations in all directions; the distinct minima are kept,
weighed by Laplace's `−½ |r|² − ½ log det A`, A the information of all unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam.linalg import cholesky
from jaxslam.slam.filter import EkfSlam
from jaxslam.window.minimise import Minimum, minimised, started, turned
from jaxslam.window.problem import Layout, Reduced, reduced
from jaxslam.window.record import Record

Value = TypeVar("Value")

SPEED = 1.2
"""Starts move with so many σ of the prior on the initial velocity."""
SEARCH_STEPS = 30
"""Of Levenberg–Marquardt, from every start."""
APART = 1.0
"""Minima nearer than this in the better one's information, squared, are one."""


class Modes(eqx.Module):
    """A batch of minima, the likeliest first."""

    minima: Minimum
    log_weights: Float[Array, " modes"]
    """Normalised; −∞ of places without a mode."""


def when(wanted: Bool[Array, ""], function: Callable[[Value], Value], value: Value) -> Value:
    """`function(value)` if it is wanted, else the value.

    In a batch `lax.cond` computes both sides of every member; this computes nothing where no
    member wants it.
    """

    def once(carry):
        return jnp.zeros((), bool), function(carry[1])

    return jax.lax.while_loop(lambda carry: carry[0], once, (jnp.asarray(wanted), value))[1]


def at_rest(slam: EkfSlam, record: Record, count: int, dtype: Any) -> Modes:
    """Before anything is known: one mode, the prior's mean."""
    size, m = Layout.of(slam).size(record.frames), record.first.size
    q = slam.sensor.size + slam.sensor.hidden
    x, y = jnp.zeros((count, size), dtype), jnp.zeros((count, m, q), dtype)
    alone = jnp.where(jnp.arange(count) == 0, 0.0, -jnp.inf).astype(dtype)
    return Modes(jax.vmap(started)(x, y), alone)


def directions(n: int, count: int) -> np.ndarray:
    """Unit vectors, evenly spread on a circle or (Fibonacci's lattice) on a sphere."""
    index = np.arange(count) + 0.5
    if n == 2:
        angle = 2 * np.pi * index / count
        return np.column_stack([np.cos(angle), np.sin(angle)])
    height, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])


def starts(slam: EkfSlam, record: Record, count: int, dtype: Any) -> Minimum:
    """The prior's mean, and translations in all directions with the rotations that fit them."""
    n = slam.motion.geometry.point_dim
    rest = at_rest(slam, record, 1 + count, dtype).minima
    away = np.concatenate([np.zeros((1, n)), SPEED * directions(n, count)])
    x = rest.x.at[:, :n].set(jnp.asarray(away, dtype))
    return jax.vmap(started)(jax.vmap(lambda x, y: turned(slam, record, x, y))(x, rest.y), rest.y)


def evidence(at: Minimum, local: Reduced) -> Float[Array, ""]:
    """Laplace's `−½ |r|² − ½ log det A`."""
    own = jnp.sum(jax.vmap(lambda factor: factor.log_det())(local.landmarks))
    value = -(at.cost + cholesky(local.information).log_det() + own) / 2
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


def refined(
    slam: EkfSlam, record: Record, modes: Modes, steps: int, wanted: Bool[Array, ""]
) -> Modes:
    """The modes with what has been measured since: each from where it is."""
    alive = wanted & jnp.isfinite(modes.log_weights)
    begun = jax.vmap(lambda m: started(m.x, m.y))(modes.minima)

    def one(minimum, alive):
        return minimised(slam, record, minimum, steps, alive)

    minima = jax.vmap(one)(begun, alive)
    return when(wanted, lambda old: _chosen(slam, record, minima, alive, len(alive)), modes)


def searched(
    slam: EkfSlam, record: Record, modes: Modes, count: int, wanted: Bool[Array, ""]
) -> Modes:
    """The modes, and what is found beside them from `count` directions and from rest."""

    def with_others(modes):
        found = starts(slam, record, count, modes.log_weights.dtype)
        found = jax.vmap(lambda m: minimised(slam, record, m, SEARCH_STEPS))(found)
        both = jax.tree.map(lambda *x: jnp.concatenate(x), modes.minima, found)
        alive = jnp.concatenate([jnp.isfinite(modes.log_weights), jnp.ones(1 + count, bool)])
        return _chosen(slam, record, both, alive, len(modes.log_weights))

    return when(wanted, with_others, modes)


def _chosen(slam, record, minima: Minimum, alive: Bool[Array, " k"], count: int) -> Modes:
    """The likeliest of the minima that are distinct, weighed."""
    local = jax.vmap(lambda m: reduced(slam, record, m.x, m.y))(minima)
    value = jnp.where(alive, jax.vmap(evidence)(minima, local), -jnp.inf)
    best_first = jnp.argsort(-value)
    value = value[best_first]
    x, information = minima.x[best_first], local.information[best_first]
    away = x[:, None] - x[None]
    squared = jnp.einsum("ijn,jno,ijo->ij", away, information, away)
    index = jnp.arange(len(value))
    again = jnp.any((squared < APART) & (index < index[:, None]), axis=1)
    value = jnp.where(again, -jnp.inf, value)
    kept = jnp.argsort(-value)[:count]
    return Modes(
        jax.tree.map(lambda leaf: leaf[best_first][kept], minima),
        jax.nn.log_softmax(value[kept]),
    )
