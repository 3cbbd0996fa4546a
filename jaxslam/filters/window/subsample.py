"""A window with fewer frames: a full one goes on with every other, and a search needs only some.

While a camera only turns, parallax does not come, and what the first frames leave open stays open.
So a window that is full keeps its first frame, its newest, and every other one between: two steps
become one of their whole length, driven by the mean of both accelerations. The older a part of the
window, the coarser it becomes, and it reaches back to frame 0 for ever. What no frame that stays
has seen is forgotten.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.window.minimise import Minimum
from jaxslam.filters.window.problem import PathLayout, X, Y
from jaxslam.filters.window.record import Record

TIED = 0.5
"""A frame is tied to those before it where they saw at least this share of its landmarks."""


class Kept(NamedTuple):
    """The frames of a window that stay, and the steps between them."""

    frames: Int[Array, " k"]
    """The newest is repeated where there are fewer."""
    count: Int[Array, ""]
    part: Int[Array, " steps"]
    """The step between frames that stay of which each is a part; k − 1 behind the newest."""


def every(record: Record, stride: int | Int[Array, ""], frames: int) -> Kept:
    """Frame 0, every so manieth one after it, and the newest: at most so many frames."""
    steps = jnp.arange(record.frames - 1)
    part = jnp.where(steps < record.last, steps // stride, frames - 1)
    count = 1 + (record.last + stride - 1) // stride
    return Kept(jnp.minimum(stride * jnp.arange(frames), record.last), count, part)


def tied(record: Record) -> Bool[Array, ""]:
    """Whether of what each frame that stays sees, those before it saw a share of `TIED`."""
    stay = record.seen[every(record, 2, record.frames // 2 + 1).frames]
    before, after = jnp.cumsum(stay[:-1], axis=0) > 0, stay[1:]
    return jnp.all(jnp.sum(before & after, axis=1) >= TIED * jnp.sum(after, axis=1))


def thinned(slam: AbstractSlam, record: Record, minima: Minimum) -> tuple[Record, Minimum]:
    """A full window with every other frame, and a batch of minima as its starts."""
    coarse = Coarse(slam, record, 2, record.frames)
    x, y = jax.vmap(coarse.of)(minima.x, minima.y)
    return coarse.record, replace(minima, x=x, y=y)


class Coarse(eqx.Module):
    """A window with fewer frames, in so many places."""

    slam: AbstractSlam
    whole: Record
    record: Record
    kept: Kept

    def __init__(
        self, slam: AbstractSlam, whole: Record, stride: int | Int[Array, ""], frames: int
    ):
        self.slam, self.whole, self.kept = slam, whole, every(whole, stride, frames)
        self.record = _fewer(whole, self.kept)

    def of(self, x: X, y: Y) -> tuple[Float[Array, " n"], Y]:
        """The same unknowns with fewer steps: `√(m₁ + m₂) n = √m₁ n₁ + √m₂ n₂` adds the same
        velocity; a calibration that is drawn anew is that of the frame that stays, and so is a
        velocity."""
        begun, own, drawn = self._split(x)
        kept, fewer = self.kept, self.record
        root = jnp.sqrt(self.whole.merged)[:, None]
        added = _sums(root * own, kept) / jnp.sqrt(fewer.merged)[:, None]
        anew = _sums(jnp.where(self.whole.restarted[:, None], own, 0.0), kept)
        own = jnp.where(fewer.restarted[:, None], anew, added)
        there = (jnp.arange(1, len(kept.frames)) < kept.count)[:, None]
        drawn = jnp.where(there, drawn[kept.frames[1:] - 1], 0.0)
        return jnp.append(begun, jnp.concatenate([own, drawn], axis=1)), self._begun(y)

    def back(self, x: X, y: Y) -> tuple[Float[Array, " n"], Y]:
        """The likeliest unknowns of the whole window that have these when it is coarse."""
        begun, own, drawn = self._split(x)
        whole, fewer, part = self.whole, self.record, self.kept.part

        def of_part(values):
            return jnp.concatenate([values, jnp.zeros_like(values[:1])])[part]

        shared = of_part(own / jnp.sqrt(fewer.merged)[:, None]) * jnp.sqrt(whole.merged)[:, None]
        anew = jnp.where(whole.restarted[:, None], of_part(own), 0.0)
        own = jnp.where(of_part(fewer.restarted)[:, None], anew, shared)
        last = self.kept.frames[1 + jnp.minimum(part, len(drawn) - 1)] - 1
        ends = (jnp.arange(len(part)) == last)[:, None]
        drawn = jnp.where(ends, of_part(drawn), 0.0)
        return jnp.append(begun, jnp.concatenate([own, drawn], axis=1)), self._begun(y)

    def _split(self, x: X) -> tuple[Array, Array, Array]:
        """What is of no step; and of every step its own numbers, and what is drawn anew."""
        layout = PathLayout.of(self.slam)
        steps = x[layout.whole :].reshape(-1, layout.step + layout.each)
        own, drawn = jnp.split(steps, [layout.step], axis=1)
        return x[: layout.whole], own, drawn

    def _begun(self, y: Y) -> Y:
        """A landmark that is first seen elsewhere has its error of depth, and no pixel's error."""
        same = self.kept.frames[self.record.first] == self.whole.first
        p = self.slam.sensor.size
        return y.at[:, :p].set(jnp.where(same[:, None], y[:, :p], 0.0))


def _fewer(record: Record, kept: Kept) -> Record:
    there = (jnp.arange(len(kept.frames)) < kept.count)[:, None]
    seen = record.seen[kept.frames] & there
    # Where the velocity is drawn anew within a step, it stood before.
    within = kept.part[1:] == kept.part[:-1]
    stood = jnp.append(record.restarted[1:] & within, False)
    lasting = jax.tree.map(lambda x: jnp.where(stood, 0.0, x), record.controls)
    return Record(
        kept.count - 1,
        jax.tree.map(lambda x: _sums(x, kept), lasting),
        jnp.maximum(_sums(record.merged, kept), 1.0),
        _sums(record.restarted.astype(int), kept) > 0,
        record.standing,
        record.measured[kept.frames],
        record.noise_factor[kept.frames],
        seen,
        jnp.argmax(seen, axis=0).astype(record.first.dtype),
    )


def _sums(steps: Shaped[Array, "steps ..."], kept: Kept) -> Shaped[Array, "parts ..."]:
    """Over the steps between frames that stay; zero behind."""
    return jax.ops.segment_sum(steps, kept.part, num_segments=len(kept.frames) - 1)
