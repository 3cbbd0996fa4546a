"""The modes of a window's posterior: where they are, and how much each is worth.

A camera that starts from rest leaves several: (t, v, ω) → −(t, v, ω) changes no pixel, and with
the rotation that takes up the mean flow t → −t changes them little (the Necker cube). So the
minimisation starts from rest and from translations in all directions; the distinct minima are kept,
weighed by Laplace's `−½ |r|² − ½ log det A`, A the information of all unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.conditional import map_where
from jaxslam._numerics.linalg import Cholesky, cholesky
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.window.minimise import Minimum, minimised, started, turned
from jaxslam.filters.window.problem import PathLayout, Reduced, X, Y, left_out
from jaxslam.filters.window.record import Record
from jaxslam.filters.window.scale import enlarged, shift_of_scale
from jaxslam.filters.window.subsample import Coarse
from jaxslam.geometry import Scalar

SPEED = 1.2
"""Starts move with so many σ of the prior on the initial velocity."""
SEARCH_STEPS = 16
"""Of Levenberg–Marquardt, from every start."""
APART = 1.0
"""Minima nearer than this in the better one's information, squared, are one."""

NEGLIGIBLE = 100.0
"""Of log evidence: a mode so much less likely than the likeliest is none."""


class Modes(eqx.Module):
    """A batch of minima, the likeliest first."""

    minima: Minimum
    log_weights: Float[Array, " modes"]
    """Normalised; −∞ of places without a mode."""
    shifts: Float[Array, " modes"]
    """λ of every mode's mean, of which the maximum has 0."""
    doubts: Float[Array, "modes m"]
    """By how many σ every landmark is not one point of the world, if the others are."""


def at_rest(slam: EkfSlam, record: Record, count: int, dtype: DTypeLike) -> Modes:
    """The modes before anything is known: one, the prior's mean."""
    size, m = PathLayout.of(slam).size(record.frames), record.first.size
    q = slam.sensor.size + slam.sensor.hidden
    x, y = jnp.zeros((count, size), dtype), jnp.zeros((count, m, q), dtype)
    alone = jnp.where(jnp.arange(count) == 0, 0.0, -jnp.inf).astype(dtype)
    none = jnp.zeros((count, m), dtype)
    return Modes(jax.vmap(started)(x, y), alone, jnp.zeros(count, dtype), none)


def directions(n: int, count: int) -> np.ndarray:
    """Unit vectors, evenly spread on a circle or (Fibonacci's lattice) on a sphere."""
    index = np.arange(count) + 0.5
    if n == 2:
        angle = 2 * np.pi * index / count
        return np.column_stack([np.cos(angle), np.sin(angle)])
    height, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])


def starts(
    slam: EkfSlam, record: Record, likeliest: Minimum, wanted: Bool[Array, " starts"]
) -> Minimum:
    """The prior's mean, the reversal of what is likeliest, and translations in all directions,
    those that are wanted with the rotations that fit them."""
    n, dtype = slam.motion.geometry.point_dim, likeliest.x.dtype
    rest = at_rest(slam, record, wanted.size, dtype).minima
    away = np.concatenate([np.zeros((2, n)), SPEED * directions(n, wanted.size - 2)])
    x, y = reversed_(slam, likeliest)
    x, y = rest.x.at[:, :n].set(jnp.asarray(away, dtype)).at[1].set(x), rest.y.at[1].set(y)

    def fitted(start, record):
        x, y = start
        return turned(slam, record, x, y), y

    return jax.vmap(started)(*map_where(fitted, (x, y), wanted, record))


def reversed_(slam: EkfSlam, at: Minimum) -> tuple[X, Y]:
    """The other way, among points that are as much too near as they were too far."""
    layout, p = PathLayout.of(slam), slam.sensor.size
    x = enlarged(slam, at.x, jnp.asarray(-1.0, at.x.dtype))
    common = slice(layout.start, layout.start + layout.common)
    return x.at[common].multiply(-1), at.y.at[:, p:].multiply(-1)


def searched(
    slam: EkfSlam, record: Record, modes: Modes, search: Bool[Array, " starts"], frames: int
) -> Modes:
    """The modes that are found from those `starts`, in a window of at most so many frames, spread
    over the whole one. They are where minima of the whole one are near, and neither shifts nor
    doubts are told of them."""
    coarse = Coarse(slam, record, jnp.maximum(-(-record.last // (frames - 1)), 1), frames)
    likeliest = started(*coarse.of(modes.minima.x[0], modes.minima.y[0]))
    minima = starts(slam, coarse.record, likeliest, search)

    def weighed(begun, record):
        return _weighed(slam, begun, record, SEARCH_STEPS)[0]

    found = _likeliest(weighed, coarse.record, minima, search, len(modes.log_weights))
    x, y = jax.vmap(coarse.back)(found.minima.x, found.minima.y)
    return replace(found, minima=replace(found.minima, x=x, y=y))


def sought(
    slam: EkfSlam, record: Record, modes: Modes, found: Modes, steps: int
) -> tuple[Modes, Bool[Array, ""]]:
    """The modes with what has been measured since, each from where it is, and those that were
    `found` beside them, after so many steps.

    Where nothing explains what was measured, the modes stay as they are, and the second is False.
    """
    both = jax.tree.map(lambda *x: jnp.concatenate(x), modes, found)
    minima = jax.vmap(started)(both.minima.x, both.minima.y)

    def weighed(begun, record):
        weighed, local, factor = _weighed(slam, begun, record, steps)
        at = weighed.minimum
        shift = shift_of_scale(slam, record, at, local, factor)
        doubts = _doubts(record, left_out(slam, record, local, at.y, factor))
        return weighed._replace(shift=shift, doubts=doubts)

    alive = jnp.isfinite(both.log_weights)
    after = _likeliest(weighed, record, minima, alive, len(modes.log_weights))
    explained = jnp.isfinite(after.log_weights[0])
    return jax.tree.map(lambda new, old: jnp.where(explained, new, old), after, modes), explained


class Weighed(NamedTuple):
    """A minimum, its log evidence `−½ |r|² − ½ log det A`, what λ its mean has, how doubtful its
    landmarks are, and the information of its path."""

    minimum: Minimum
    evidence: Scalar
    shift: Scalar
    doubts: Float[Array, " m"]
    information: Float[Array, "N N"]


def _weighed(
    slam: EkfSlam, begun: Weighed, record: Record, steps: int
) -> tuple[Weighed, Reduced, Cholesky]:
    """What has become of a minimum after so many steps; the quadratic there, and its factor."""
    at, local = minimised(slam, record, begun.minimum, steps)
    factor = cholesky(local.information)
    own = jnp.sum(jax.vmap(lambda factor: factor.log_det())(local.landmarks))
    value = -(at.cost + factor.log_det() + own) / 2
    value = jnp.where(jnp.isfinite(value), value, -jnp.inf)
    known = begun._replace(minimum=at, evidence=value, information=local.information)
    return known, local, factor


def _doubts(record: Record, squared: Float[Array, " m"]) -> Float[Array, " m"]:
    """The σ that a χ² of every landmark is above its mean (Wilson, Hilferty 1931)."""
    dof = record.measured.shape[-1] * jnp.sum(record.compared, axis=0)
    some = jnp.maximum(dof, 1)
    variance = 2 / (9 * some)
    sigmas = (jnp.cbrt(squared / some) - 1 + variance) / jnp.sqrt(variance)
    return jnp.where((dof > 0) & jnp.isfinite(sigmas), sigmas, 0.0)


def _likeliest(
    weighed: Callable[[Weighed, Record], Weighed],
    record: Record,
    minima: Minimum,
    alive: Bool[Array, " k"],
    count: int,
) -> Modes:
    """The likeliest of the minima that are distinct when they are weighed."""
    k, size = minima.x.shape
    none = jnp.full(k, -jnp.inf, minima.x.dtype)
    doubts, square = (jnp.zeros((k, *of), none.dtype) for of in (minima.y.shape[1:2], (size, size)))
    begun = Weighed(minima, none, jnp.zeros_like(none), doubts, square)
    minima, value, shift, doubts, information = map_where(weighed, begun, alive, record)
    best_first = jnp.argsort(-value)
    value = value[best_first]
    x, information = minima.x[best_first], information[best_first]
    away = x[:, None] - x[None]
    squared = jnp.einsum("ijn,jno,ijo->ij", away, information, away)
    index = jnp.arange(k)
    again = jnp.any((squared < APART) & (index < index[:, None]), axis=1)
    value = jnp.where(again, -jnp.inf, value)
    value = jnp.where(value < jnp.max(value) - NEGLIGIBLE, -jnp.inf, value)
    kept = jnp.argsort(-value)[:count]
    return Modes(
        jax.tree.map(lambda leaf: leaf[best_first][kept], minima),
        jax.nn.log_softmax(value[kept]),
        shift[best_first][kept],
        doubts[best_first][kept],
    )
