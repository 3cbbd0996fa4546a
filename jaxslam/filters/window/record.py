"""The record of a window: every measurement since its first frame, and its landmark.

Standing teaches nothing of how the camera will move. While all pixels are where they were first
seen, the newest frame takes the place of the one before, and with the first motion the velocity is
drawn anew.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import AnyArray
from jaxslam.geometry import Scalar
from jaxslam.linalg import cholesky
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Features

STILL = 5.0
"""σ of χ², above its mean, up to which pixels are where they were."""


class Record(eqx.Module):
    """Frames 0 to `last` of at most F; the motion into frame k is the control k − 1."""

    last: Int[Array, ""]
    controls: Control
    """The controls of F − 1 steps."""
    merged: Float[Array, " steps"]
    """The number of steps of the process in each; 1 until the window was thinned."""
    restarted: Bool[Array, " steps"]
    """In which the velocity is drawn anew: it stood before."""
    standing: Bool[Array, ""]
    """Whether nothing has moved since frame 0."""
    measured: Float[Array, "F m p"]
    """By slot of the landmark."""
    noise_factor: Float[Array, "F m"]
    """κ of each, as in `Features`."""
    seen: Bool[Array, "F m"]
    first: Int[Array, " m"]
    """The frame in which a slot's landmark was first seen."""

    @property
    def frames(self) -> int:
        """F."""
        return self.seen.shape[0]

    @property
    def steps(self) -> Scalar:
        """The number of steps of the process since frame 0."""
        happened = jnp.arange(self.merged.size) < self.last
        return jnp.sum(jnp.where(happened, self.merged, 0.0))

    @property
    def full(self) -> Bool[Array, ""]:
        return self.last == self.frames - 1

    @property
    def compared(self) -> Bool[Array, "F m"]:
        """Whether each measurement is of a landmark seen before."""
        k = jnp.arange(self.frames)[:, None]
        return self.seen & (k > self.first) & (k <= self.last)

    @property
    def begun_by(self) -> tuple[Float[Array, "m p"], Float[Array, " m"]]:
        """The first measurement of every slot's landmark, and its noise factor."""
        of_first = self.first, jnp.arange(self.first.size)
        return self.measured[of_first], self.noise_factor[of_first]

    def cut(self, frames: int) -> Record:
        """The first frames alone, for a smaller problem."""
        steps = self.controls, self.merged, self.restarted
        steps = jax.tree.map(lambda x: x[: frames - 1], steps)
        measured = (x[:frames] for x in (self.measured, self.noise_factor, self.seen))
        last = jnp.minimum(self.last, frames - 1)
        return Record(last, *steps, self.standing, *measured, self.first)


def empty(motion: AbstractMotion, frames: int, landmarks: int, p: int, dtype: DTypeLike) -> Record:
    """The record of a frame 0 in which nothing has been seen yet."""
    still = jax.tree.map(lambda x: jnp.tile(x, (frames - 1, *(1,) * x.ndim)), motion.still(dtype))
    ones, no = jnp.ones(frames - 1, dtype), jnp.zeros(frames - 1, bool)
    measured, alike = jnp.zeros((frames, landmarks, p), dtype), jnp.ones((frames, landmarks), dtype)
    seen, first = jnp.zeros((frames, landmarks), bool), jnp.zeros(landmarks, int)
    last, standing = jnp.zeros((), int), jnp.ones((), bool)
    return Record(last, still, ones, no, standing, measured, alike, seen, first)


def stepped(record: Record, control: Control, seen: Features, noise: Float[Array, "p p"]) -> Record:
    """The record with one frame more and its measurements of known landmarks, of such a
    covariance. A full record stays as it is."""
    stood = record.standing & (record.last == 1)
    stands = record.standing & _still(record, seen, noise)
    k = jnp.where(stood & stands, 1, record.last + 1)  # beyond the end: dropped
    controls = jax.tree.map(
        lambda all, one: all.at[k - 1].set(one, mode="drop"), record.controls, control
    )
    restarted = record.restarted.at[k - 1].set(stood & ~stands, mode="drop")
    # What the frame in this place saw is forgotten, but for where landmarks begin.
    kept = record.seen & ((jnp.arange(record.frames) != k)[:, None] | (record.first == k))
    last = jnp.minimum(k, record.frames - 1)
    stepped = replace(
        record, last=last, controls=controls, restarted=restarted, standing=stands, seen=kept
    )
    return _measured(stepped, k, seen)


def _still(record: Record, seen: Features, noise: Float[Array, "p p"]) -> Bool[Array, ""]:
    """Whether all that is seen, and that is something, is where it was first seen."""
    first, factor = (x[seen.slots] for x in record.begun_by)
    whitened = (seen.measured - first) @ cholesky(noise).whitening.T
    factor = factor + seen.factors
    squared = jnp.sum(jnp.where(seen.valid, jnp.sum(whitened**2, axis=1) / factor, 0.0))
    dof = jnp.sum(seen.valid) * first.shape[1]
    return (dof > 0) & (squared <= dof + STILL * jnp.sqrt(2 * dof))


def begun(record: Record, new: Features) -> Record:
    """The record with the landmarks that are first seen in the newest frame."""
    slots = new.places(record.first.size)
    record = replace(
        record,
        first=record.first.at[slots].set(record.last, mode="drop"),
        seen=record.seen.at[:, slots].set(False, mode="drop"),
    )
    return _measured(record, record.last, new)


def removed(record: Record, gone: Bool[AnyArray, " m"]) -> Record:
    """The record without the measurements of some landmarks."""
    return replace(record, seen=record.seen & ~gone)


def _measured(record: Record, k: Int[Array, ""], features: Features) -> Record:
    slots = features.places(record.first.size)
    return replace(
        record,
        measured=record.measured.at[k, slots].set(features.measured, mode="drop"),
        noise_factor=record.noise_factor.at[k, slots].set(features.factors, mode="drop"),
        seen=record.seen.at[k, slots].set(True, mode="drop"),
    )
