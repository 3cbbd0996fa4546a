"""What a window remembers: every measurement since its first frame, and which landmark it is of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.arrays import AnyArray
from jaxslam.forms.state import Features
from jaxslam.models.motion import AbstractMotion


class Record(eqx.Module):
    """Frames 0 to `last` of at most F; the motion into frame k is the control k − 1."""

    last: Int[Array, ""]
    controls: Any
    """Of F − 1 steps."""
    merged: Float[Array, " steps"]
    """Of how many steps of the process each is made; 1 until the window was thinned."""
    measured: Float[Array, "F m p"]
    """By slot of the landmark."""
    seen: Bool[Array, "F m"]
    first: Int[Array, " m"]
    """The frame in which a slot's landmark was first seen."""

    @property
    def frames(self) -> int:
        """F."""
        return self.seen.shape[0]

    @property
    def steps(self) -> Float[Array, ""]:
        """Of the process, since frame 0."""
        happened = jnp.arange(self.merged.size) < self.last
        return jnp.sum(jnp.where(happened, self.merged, 0.0))

    @property
    def full(self) -> Bool[Array, ""]:
        return self.last == self.frames - 1

    @property
    def compared(self) -> Bool[Array, "F m"]:
        """Where a measurement is of a landmark seen before."""
        k = jnp.arange(self.frames)[:, None]
        return self.seen & (k > self.first) & (k <= self.last)

    @property
    def first_measured(self) -> Float[Array, "m p"]:
        """What every slot's landmark was first measured at."""
        return self.measured[self.first, jnp.arange(self.first.size)]

    def cut(self, frames: int) -> Record:
        """The first frames alone, for a smaller problem."""
        return Record(
            jnp.minimum(self.last, frames - 1),
            jax.tree.map(lambda x: x[: frames - 1], self.controls),
            self.merged[: frames - 1],
            self.measured[:frames],
            self.seen[:frames],
            self.first,
        )


def empty(motion: AbstractMotion, frames: int, landmarks: int, p: int, dtype: Any) -> Record:
    """Of frame 0 in which nothing has been seen yet."""
    still = motion.still(dtype)
    return Record(
        jnp.zeros((), int),
        jax.tree.map(lambda x: jnp.tile(x, (frames - 1, *(1,) * x.ndim)), still),
        jnp.ones(frames - 1, dtype),
        jnp.zeros((frames, landmarks, p), dtype),
        jnp.zeros((frames, landmarks), bool),
        jnp.zeros(landmarks, int),
    )


def stepped(record: Record, control: Any, seen: Features) -> Record:
    """With one frame more and what it measured of known landmarks. A full record stays as it is."""
    k = jnp.where(record.full, record.frames, record.last + 1)  # beyond the end: dropped
    controls = jax.tree.map(
        lambda all, one: all.at[k - 1].set(one, mode="drop"), record.controls, control
    )
    stepped = replace(record, last=jnp.minimum(k, record.frames - 1), controls=controls)
    return _measured(stepped, k, seen)


def begun(record: Record, new: Features) -> Record:
    """With the landmarks that are first seen in the newest frame."""
    slots = jnp.where(new.valid, new.slots, record.first.size)
    record = replace(
        record,
        first=record.first.at[slots].set(record.last, mode="drop"),
        seen=record.seen.at[:, slots].set(False, mode="drop"),
    )
    return _measured(record, record.last, new)


def removed(record: Record, gone: Bool[AnyArray, " m"]) -> Record:
    """Without what was measured of some landmarks."""
    return replace(record, seen=record.seen & ~gone)


def _measured(record: Record, k: Int[Array, ""], features: Features) -> Record:
    slots = jnp.where(features.valid, features.slots, record.first.size)
    return replace(
        record,
        measured=record.measured.at[k, slots].set(features.measured, mode="drop"),
        seen=record.seen.at[k, slots].set(True, mode="drop"),
    )
