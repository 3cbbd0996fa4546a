"""One run for a filter: truth and measurements, and what of them is new, known or gone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.geometry import Pose
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Capacity, Features, PriorMap
from jaxslam.models.sensors import AbstractSensor


class Run(eqx.Module):
    """Truth and measurements; frame 0 is the start, `frames` = steps + 1.

    Landmarks are in slots, those of the filter: each in one of its own, or, where there is `new`,
    one after the other. There a landmark that is not seen in one frame is gone for good, and the
    next to be first seen may have its slot, in the same frame.
    """

    poses: Pose
    """T_BC of every frame; the first is the identity."""
    points: Float[Array, "*frames landmarks n"]
    """In B, in the order in which they are first seen; with `new`, those of every frame."""
    measured: Float[Array, "frames landmarks p"]
    """With noise."""
    visible: Bool[Array, "frames landmarks"]
    """Which points are measured."""
    controls: Control
    """The motion model's input of every step: seconds, or a reading."""
    sensors: AbstractSensor
    """The true sensor of every frame."""
    new: Bool[Array, "frames landmarks"] | None = None
    """Which of the visible are seen for the first time, where slots are used again."""
    identity: Int[Array, "frames landmarks"] | None = None
    """Which point each slot stands for, where one that comes back is a new landmark."""
    known: PriorMap | None = None
    """What is known of landmarks before frame 0: of surveyed beacons."""
    motion: AbstractMotion | None = None
    """The motion model with what is known of this run's start; None where all have the same."""

    @property
    def beacons(self) -> Bool[Array, " landmarks"]:
        """Which landmarks are known before frame 0."""
        none = jnp.zeros(self.visible.shape[-1], bool)
        return none if self.known is None else none.at[self.known.slots].set(True)

    @property
    def points_by_frame(self) -> Float[Array, "frames landmarks n"]:
        """The point that each slot stands for."""
        return jnp.broadcast_to(self.points, (*self.visible.shape, self.points.shape[-1]))


Count = Any
"""The type of a count: a whole number, or in a program an array of one."""


class Room(NamedTuple):
    """The capacities of a filter that hold a run, or every run of a study."""

    landmarks: Count
    """The landmarks that are ever seen, or the slots that they share."""
    first: Count
    """The landmarks of frame 0."""
    known: Count
    """The most landmarks of one frame that were seen before."""
    new: Count
    """The most landmarks of a later frame that are seen for the first time."""

    @property
    def capacity(self) -> Capacity:
        """The capacity of a filter."""
        return Capacity(self.landmarks, self.known, self.new)


def sightings(run: Run) -> Room:
    """Return the least room that holds this run."""
    known, new = _known_and_new(run)
    return Room(
        landmarks=jnp.sum(jnp.any(run.visible, axis=0) | run.beacons),
        first=jnp.sum(run.visible[0]),
        known=jnp.max(jnp.sum(known, axis=1), initial=0),
        new=jnp.max(jnp.sum(new[1:], axis=1), initial=0),
    )


def features(run: Run, capacity: Room) -> tuple[Features, Features, Features]:
    """A run's measurements for the filter: new in frame 0; known and new of every later frame.

    Slot i of the filter is point i of the run. Of what is known before frame 0, frame 0 has none.
    """
    known, new = _known_and_new(run)
    first = _picked(new[0], run.measured[0], capacity.first)
    pick = jax.vmap(_picked, in_axes=(0, 0, None))
    again = pick(known[1:], run.measured[1:], capacity.known)
    return first, again, pick(new[1:], run.measured[1:], capacity.new)


def gone(run: Run, capacity: Room) -> Bool[Array, "steps slots"] | None:
    """The filter's slots whose landmark of the frame before is not seen any more, of every frame
    after 0; None where landmarks keep their slots."""
    if run.new is None:
        return None
    left = run.visible[:-1] & (~run.visible[1:] | run.new[1:])
    count = capacity.landmarks
    return jnp.pad(left, ((0, 0), (0, max(0, count - left.shape[1]))))[:, :count]


def _known_and_new(run: Run):
    if run.new is not None:
        return run.visible & ~run.new, run.visible & run.new
    before = (jnp.cumsum(run.visible, axis=0) - run.visible > 0) | run.beacons
    return run.visible & before, run.visible & ~before


def _picked(mask, measured, count: int) -> Features:
    """The first `count` landmarks of the mask, padded with features that are not valid."""
    slots = jnp.argsort(~mask, stable=True)[:count]
    return Features(slots, measured[slots], mask[slots])


def in_order_of_appearance(run: Run) -> Run:
    """Landmarks that are never seen come last, so that a filter needs no slots for them, and those
    that are known before frame 0 first."""
    never = run.visible.shape[0]
    first = jnp.where(jnp.any(run.visible, axis=0), jnp.argmax(run.visible, axis=0), never)
    order = jnp.argsort(jnp.where(run.beacons, -1, first), stable=True)
    known = run.known
    if known is not None:
        known = replace(known, slots=jnp.argsort(order)[known.slots])
    return replace(
        run,
        known=known,
        points=run.points[order],
        measured=run.measured[:, order],
        visible=run.visible[:, order],
    )


def in_shared_slots(run: Run, count: int) -> Run:
    """The run in so many slots: a point has one for as long as it is seen, and another, as a new
    landmark, when it comes back. Where more are seen, those that come first in the run have one."""
    none = jnp.full(count, -1)

    def frame(held: Int[Array, " slots"], seen: Bool[Array, " landmarks"]):
        stays = (held >= 0) & seen[held]
        has_one = jnp.zeros_like(seen).at[jnp.where(stays, held, seen.size)].set(True, mode="drop")
        waiting = seen & ~has_one
        # The k-th free slot is for the k-th that waits.
        rank = jnp.cumsum(~stays) - 1
        order = jnp.argsort(~waiting, stable=True)
        comes = ~stays & (rank < jnp.sum(waiting))
        held = jnp.where(stays, held, jnp.where(comes, order[rank], -1))
        return held, (held, comes)

    _, (held, new) = jax.lax.scan(frame, none, run.visible)
    pick = jax.vmap(lambda values, held: values[held])
    return replace(
        run,
        points=run.points[held],
        measured=pick(run.measured, held),
        visible=held >= 0,
        new=new,
        identity=held,
    )
