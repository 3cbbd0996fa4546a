"""A full window goes on with every other frame.

While a camera only turns, parallax does not come, and what the first frames leave open stays open.
So a window that is full keeps its first frame, its newest, and every other one between: two steps
become one of their whole length, driven by the mean of both accelerations. The older a part of the
window, the coarser it becomes, and it reaches back to frame 0 for ever. What no frame that stays
has seen is forgotten.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Shaped

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.window.minimise import Minimum
from jaxslam.filters.window.problem import PathLayout, X
from jaxslam.filters.window.record import Record

TIED = 0.5
"""Of a frame's landmarks: if those before saw fewer, it is hardly known how it stands to them."""


def kept(frames: int) -> Int[AnyArray, " k"]:
    """Frames of a full window that stay: the first, and every other one back from the newest."""
    return np.unique([0, *range(frames - 1, 0, -2)])


def tied(record: Record) -> Bool[Array, ""]:
    """Whether of what each frame that stays sees, those before it saw a share of `TIED`."""
    stay = record.seen[kept(record.frames)]
    before, after = jnp.cumsum(stay[:-1], axis=0) > 0, stay[1:]
    return jnp.all(jnp.sum(before & after, axis=1) >= TIED * jnp.sum(after, axis=1))


def thinned(slam: EkfSlam, record: Record, minima: Minimum) -> tuple[Record, Minimum]:
    """A full window with every other frame, and a batch of minima as its starts."""
    fewer = _fewer(record)
    same = jnp.asarray(kept(record.frames))[fewer.first] == record.first
    x = jax.vmap(lambda x: _noises(slam, record, fewer, x))(minima.x)
    # What is first seen later than it was has its error of depth, and another pixel's error.
    p = slam.sensor.size
    y = minima.y.at[..., :p].set(jnp.where(same[:, None], minima.y[..., :p], 0.0))
    return fewer, replace(minima, x=x, y=y)


def _fewer(record: Record) -> Record:
    stay, frames = kept(record.frames), record.frames
    seen = _padded(record.seen[stay], frames)
    # Where the velocity is drawn anew, it stood before.
    stood = jnp.append(record.restarted[1:], False)
    lasting = jax.tree.map(lambda x: jnp.where(stood, 0.0, x), record.controls)
    return Record(
        jnp.asarray(len(stay) - 1, record.last.dtype),
        jax.tree.map(lambda x: _sums(x, frames), lasting),
        jnp.maximum(_sums(record.merged, frames), 1.0),
        _sums(record.restarted.astype(int), frames) > 0,
        record.standing,
        _padded(record.measured[stay], frames),
        seen,
        jnp.argmax(seen, axis=0).astype(record.first.dtype),
    )


def _noises(slam: EkfSlam, record: Record, fewer: Record, x: X) -> X:
    """PathLayout of the merged steps: `√(m₁ + m₂) n = √m₁ n₁ + √m₂ n₂` adds the same velocity; a
    calibration that is drawn anew is that of the frame that stays, and so is a velocity."""
    layout, frames = PathLayout.of(slam), record.frames
    steps = x[layout.whole :].reshape(frames - 1, -1)
    own, drawn = jnp.split(steps, [layout.step], axis=1)
    roots = jnp.sqrt(jnp.stack([record.merged, fewer.merged]))[..., None]
    added = _sums(roots[0] * own, frames) / roots[1]
    anew = _sums(jnp.where(record.restarted[:, None], own, 0.0), frames)
    own = jnp.where(fewer.restarted[:, None], anew, added)
    drawn = _padded(drawn[kept(frames)[1:] - 1], frames - 1)
    return x.at[layout.whole :].set(jnp.concatenate([own, drawn], axis=1).ravel())


def _sums(steps: Shaped[Array, "steps ..."], frames: int) -> Shaped[Array, "steps ..."]:
    """Over the steps between frames that stay; zero behind."""
    segment = np.searchsorted(kept(frames), np.arange(frames - 1), side="right") - 1
    return jax.ops.segment_sum(steps, segment, num_segments=frames - 1)


def _padded(values: Array, frames: int) -> Array:
    """The values, padded with zeros to so many frames."""
    return jnp.zeros((frames, *values.shape[1:]), values.dtype).at[: len(values)].set(values)
