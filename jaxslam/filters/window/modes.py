"""The modes of a window's posterior: where they are, and how much each is worth.

A camera that starts from rest leaves several: (t, v, ω) → −(t, v, ω) changes no pixel, and with
the rotation that takes up the mean flow t → −t changes them little (the Necker cube). So the
minimisation starts from rest and from translations in all directions; the distinct minima are kept,
weighed by Laplace's evidence. That is `−½ (|x|² + |y|²) − ½ log det A`, A the information of all
unknowns, and of n residuals r, whose noise is known up to a factor, `−½ (ν + n) log (1 + |r|²/ν)`:
matches are mostly better than is claimed of them, and then tell modes apart that much better.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.conditional import cond, map_where, zeros
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.window.minimise import Minimum, minimised, started, turned
from jaxslam.filters.window.problem import PathLayout, Reduced, X, Y, left_out
from jaxslam.filters.window.record import Record
from jaxslam.filters.window.scale import enlarged, rescaled, shift_of_scale
from jaxslam.filters.window.subsample import Coarse
from jaxslam.geometry import Scalar
from jaxslam.linalg import Cholesky, cholesky

SPEED = 1.2
"""Starts move with so many σ of the prior on the initial velocity."""
SEARCH_STEPS = 16
"""The most steps of Levenberg–Marquardt from every start."""
REFINEMENTS = 4
"""The most steps with every new frame."""
APART = 1.0
"""Minima nearer than this in the better one's information, squared, are one."""

WORTH = 40.0
"""ν: the claimed variance of the noise counts as much as so many residuals do."""
UNLIKE = 5.0
"""σ of all numbers but those of the worst landmark, from which on a minimum explains nothing."""
NEGLIGIBLE = 100.0
"""A mode whose log evidence is so much less than that of the likeliest is none."""


class Modes(eqx.Module):
    """A batch of minima, the likeliest first."""

    minima: Minimum
    log_weights: Float[Array, " modes"]
    """Normalised; −∞ of places without a mode."""
    shifts: Float[Array, " modes"]
    """λ of every mode's mean, of which the maximum has 0."""
    doubts: Float[Array, "modes m"]
    """By how many σ every landmark is not one point of the world, if the others are."""


def at_rest(slam: AbstractSlam, record: Record, count: int, dtype: DTypeLike) -> Modes:
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
    slam: AbstractSlam, record: Record, likeliest: Minimum, wanted: Bool[Array, " starts"]
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


def reversed_(slam: AbstractSlam, at: Minimum) -> tuple[X, Y]:
    """The other way, among points that are as much too near as they were too far."""
    layout, p = PathLayout.of(slam), slam.sensor.size
    x = enlarged(slam, at.x, jnp.asarray(-1.0, at.x.dtype))
    common = slice(layout.start, layout.start + layout.common)
    return x.at[common].multiply(-1), at.y.at[:, p:].multiply(-1)


class Found(NamedTuple):
    """Where minima may be."""

    minima: Minimum
    alive: Bool[Array, " k"]
    steps: Int[Array, " k"]
    """The most steps from there to the minimum."""


def searched(
    slam: AbstractSlam, record: Record, modes: Modes, search: Bool[Array, " starts"], frames: int
) -> Found:
    """Those `starts`; of a window of more than so many frames, the minima that are found from them
    in as many frames, spread over it: minima of the whole window are near."""
    likeliest = jax.tree.map(lambda leaf: leaf[0], modes.minima)
    directly = record.frames <= frames
    most = search.size if directly else len(modes.log_weights)
    nothing = at_rest(slam, record, most, likeliest.x.dtype).minima
    steps = jnp.full(most, SEARCH_STEPS if directly else REFINEMENTS)

    def begun(_, record, search, likeliest):
        return Found(starts(slam, record, likeliest, search), search, steps)

    def found(_, record, search, likeliest):
        coarse = Coarse(slam, record, jnp.maximum(-(-record.last // (frames - 1)), 1), frames)
        there = started(*coarse.of(likeliest.x, likeliest.y))
        minima = starts(slam, coarse.record, there, search)
        candidates = _candidates(minima, jnp.full(search.size, SEARCH_STEPS))
        modes, _ = _likeliest(partial(_minimum, slam), coarse.record, candidates, search, most)
        minima = jax.vmap(started)(*jax.vmap(coarse.back)(modes.minima.x, modes.minima.y))
        return Found(minima, jnp.isfinite(modes.log_weights), steps)

    none = Found(nothing, jnp.zeros(most, bool), steps)
    return cond(jnp.any(search), begun if directly else found, none, record, search, likeliest)


def sought(
    slam: AbstractSlam, record: Record, modes: Modes, found: Found
) -> tuple[Modes, Mean, Bool[Array, ""]]:
    """The modes with what has been measured since, each from where it is, and what there is beside
    them where that was `found`.

    Where nothing explains what was measured, the modes stay as they are, and the last is False.
    """
    alive = jnp.append(jnp.isfinite(modes.log_weights), found.alive)
    steps = jnp.append(jnp.full(len(modes.log_weights), REFINEMENTS), found.steps)
    minima = jax.tree.map(lambda *x: jnp.concatenate(x), modes.minima, found.minima)
    minima = jax.vmap(started)(minima.x, minima.y)
    nothing = jax.eval_shape(
        lambda at: minimised(slam, record, at, 1), jax.tree.map(lambda leaf: leaf[0], minima)
    )
    candidates = _candidates(minima, steps, Mean(*zeros(nothing, len(alive))))
    after, means = _likeliest(
        partial(_weighed, slam), record, candidates, alive, len(modes.log_weights)
    )
    assert means is not None
    explained = jnp.isfinite(after.log_weights[0])
    after = jax.tree.map(lambda new, old: jnp.where(explained, new, old), after, modes)
    return after, means, explained


class Mean(NamedTuple):
    """A mode where its mean is, and the quadratic there."""

    at: Minimum
    local: Reduced


class Candidate(NamedTuple):
    """A minimum, or a batch of them, or places from which one is sought."""

    minimum: Minimum
    steps: Int[Array, ""]
    """The most steps to the minimum."""
    evidence: Scalar
    """`−½ |r|² − ½ log det A`."""
    information: Float[Array, "N N"]
    """The information A of the path."""
    shift: Scalar
    """λ of its mean."""
    doubts: Float[Array, " m"]
    """How doubtful its landmarks are."""
    mean: Mean | None
    """None where it is not asked for, nor are shift and doubts."""


def _candidates(minima: Minimum, steps: Int[Array, " k"], means: Mean | None = None) -> Candidate:
    """A batch of minima of which nothing is known."""
    (k, size), m = minima.x.shape, minima.y.shape[1]
    none = jnp.full(k, -jnp.inf, minima.x.dtype)
    square, doubts = (jnp.zeros((k, *of), none.dtype) for of in ((size, size), (m,)))
    return Candidate(minima, steps, none, square, jnp.zeros_like(none), doubts, means)


def _minimum(slam: AbstractSlam, begun: Candidate, record: Record) -> Candidate:
    """The minimum near a start, and its evidence."""
    at, local = minimised(slam, record, begun.minimum, begun.steps)
    return _with_evidence(begun, record, at, local, cholesky(local.information))


def _with_evidence(
    of: Candidate, record: Record, at: Minimum, local: Reduced, factor: Cholesky
) -> Candidate:
    own = jnp.sum(jax.vmap(lambda factor: factor.log_det())(local.landmarks))
    squared = jnp.sum(local.linear.residual**2, axis=(0, 2))
    dof, whole = record.measured.shape[-1] * jnp.sum(record.compared), jnp.sum(squared)
    left = at.cost - whole + (WORTH + dof) * jnp.log1p(whole / WORTH)
    value = -(left + factor.log_det() + own) / 2
    like = at.cost - jnp.max(squared + jnp.sum(at.y**2, axis=1)) <= UNLIKE**2 * dof
    value = jnp.where(jnp.isfinite(value) & like, value, -jnp.inf)
    return of._replace(minimum=at, evidence=value, information=local.information)


def _weighed(slam: AbstractSlam, begun: Candidate, record: Record) -> Candidate:
    """The minimum near a start, weighed, and its mean.

    Of the mean only the landmarks are sought. Both are one loop, so that they are one program.
    """

    def known(of, at, local):
        factor = cholesky(local.information)
        shift = shift_of_scale(slam, record, at, local, factor)
        doubts = _doubts(record, left_out(slam, record, local, at.y, factor))
        return _with_evidence(of, record, at, local, factor)._replace(shift=shift, doubts=doubts)

    def turn(k, of):
        first = k == 0
        mean = started(*rescaled(slam, record, of.minimum, of.shift))
        start = jax.tree.map(lambda *x: jnp.where(first, *x), of.minimum, mean)
        there = minimised(slam, record, start, jnp.where(first, of.steps, 1))
        of = jax.lax.cond(first, known, lambda of, *_: of, of, *there)
        return of._replace(mean=Mean(*there))

    return jax.lax.fori_loop(0, 2, turn, begun)


def _doubts(record: Record, squared: Float[Array, " m"]) -> Float[Array, " m"]:
    """The σ that a χ² of every landmark is above its mean (Wilson, Hilferty 1931)."""
    dof = record.measured.shape[-1] * jnp.sum(record.compared, axis=0)
    some = jnp.maximum(dof, 1)
    variance = 2 / (9 * some)
    sigmas = (jnp.cbrt(squared / some) - 1 + variance) / jnp.sqrt(variance)
    return jnp.where((dof > 0) & jnp.isfinite(sigmas), sigmas, 0.0)


def _likeliest(
    weighed: Callable[[Candidate, Record], Candidate],
    record: Record,
    candidates: Candidate,
    alive: Bool[Array, " k"],
    count: int,
) -> tuple[Modes, Mean | None]:
    """The likeliest of the minima that are distinct when they are weighed."""
    found = map_where(weighed, candidates, alive, record)
    order = jnp.argsort(-found.evidence)
    x, information, value = (x[order] for x in (found.minimum.x, found.information, found.evidence))
    away = x[:, None] - x[None]
    squared = jnp.einsum("ijn,jno,ijo->ij", away, information, away)
    again = jnp.any(jnp.tril(squared < APART, -1), axis=1)
    value = jnp.where(again, -jnp.inf, value)
    value = jnp.where(value < jnp.max(value) - NEGLIGIBLE, -jnp.inf, value)
    kept = jnp.argsort(-value)[:count]
    weights = jax.nn.log_softmax(value[kept])
    found = jax.tree.map(lambda leaf: leaf[order[kept]], found)
    return Modes(found.minimum, weights, found.shift, found.doubts), found.mean
