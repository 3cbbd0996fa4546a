"""A filter through frames, one after another in one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray, check_numbers
from jaxslam.filters.protocol import AbstractFilter, Belief
from jaxslam.filters.readouts import camera_pose
from jaxslam.geometry import Pose
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Capacity, Features, Innovation, PriorMap


class Frames(NamedTuple):
    """The inputs of a filter in the frames after frame 0: every array begins with their axis."""

    control: Control
    """The motion model's inputs, such as seconds or the odometry's readings."""
    seen: Features
    """Measurements of landmarks in the map."""
    new: Features
    """Measurements of landmarks to insert."""
    gone: Bool[Array, "*frames slots"] | None = None
    """Slots whose landmark is removed before the frame; None where all stay."""


class Estimates(NamedTuple):
    """The estimates of a filter after every frame."""

    pose: Pose
    """T_BC."""
    covariance: Float[Array, "frames t t"]
    """In the right tangent of the pose: position in camera axes, orientation."""
    nis: Float[Array, " frames"]
    nis_dof: Int[Array, " frames"]
    status: Int[Array, " frames"]
    """A `Status`."""


def run(
    slam: AbstractFilter,
    frames: PyTree,
    state: Belief,
    output: Callable[[Belief, Innovation, PyTree], PyTree] | None = None,
) -> tuple[Belief, PyTree]:
    """Return the last state, and the `Estimates` of every frame.

    `frames` are `Frames`, or a pytree with these fields and others; `state` is that of `init`.
    With an `output(state, innovation, frame)` its values are returned in place of the estimates.
    Raises ValueError for slots to free and a filter that cannot remove landmarks.
    """
    if frames.gone is not None and not callable(getattr(slam, "remove", None)):
        raise ValueError(
            f"{type(slam).__name__} has no remove(state, gone): it cannot use slots again, as is "
            "needed where landmarks come and go"
        )

    def estimates(state: Belief, innovation: Innovation, _: PyTree) -> Estimates:
        seen = innovation.nis, innovation.nis_dof, innovation.status
        return Estimates(*camera_pose(slam, state), *seen)

    collect = estimates if output is None else output

    def step(state: Belief, frame: PyTree) -> tuple[Belief, PyTree]:
        if frame.gone is not None:
            state = slam.remove(state, frame.gone)  # ty: ignore[missing-attribute]
        state, innovation = slam.step(state, frame.control, frame.seen, frame.new)
        return state, collect(state, innovation, frame)

    # In a batch the whole state is the batch's at once: else `vmap` transforms all steps twice.
    some = jnp.sum(frames.seen.measured) == 0
    state = jax.tree.map(lambda x: jax.lax.select(some, x, x), state)
    return jax.lax.scan(step, state, frames)


class MeasuredRun(eqx.Module):
    """What a filter is given of one run: of a log, or of a simulation."""

    frames: PyTree
    """The inputs of the frames after frame 0: `Frames`, or a pytree with its fields."""
    capacity: Capacity = eqx.field(static=True)
    """The capacity of the filter."""
    first: Features | None = None
    """The landmarks of frame 0."""
    known: PriorMap | None = None
    """The landmarks that are known before it."""
    truth: Pose | None = None
    """T_BC of the frames after frame 0, where it is known."""
    motion: AbstractMotion | None = None
    """The motion model with what is known of this run's start; None where that is the filter's."""

    def start(self, slam: AbstractFilter) -> Belief:
        """The state of a filter after frame 0. Raises ValueError for a filter without a motion,
        where a run has a start of its own."""
        known = {} if self.known is None else {"known": self.known}
        if self.motion is not None:
            if not hasattr(slam, "motion"):
                raise ValueError(f"{type(slam).__name__} has no motion: it cannot begin as told")
            slam = replace(slam, motion=self.motion)
        return slam.init(self.capacity, self.first, **known)


def measured_run(
    control: Control,
    frame: Int[AnyArray, " n"],
    landmark: Int[AnyArray, " n"],
    measured: Float[AnyArray, "n p"],
    known: PriorMap | None = None,
    truth: Pose | None = None,
) -> MeasuredRun:
    """Return what a filter is given of a log of n measurements, packed into frames.

    Measurement i is of the landmark with the number `landmark[i]`, in frame `frame[i]`, from 0 on;
    `control` holds the motion's inputs of frames 1, 2, …: its arrays begin with their axis. A
    landmark is new where it is first seen (of several measurements of it in that frame the first
    counts), unless `known` has it, whose slots are numbers of landmarks here. `truth` is T_BC of
    frames 1, 2, …. Raises ValueError for arrays that do not go together.
    """
    if np.any(np.asarray(frame) != np.asarray(frame, int)):
        raise ValueError(f"frame holds whole numbers, not {np.ravel(frame).tolist()[:5]}")
    frame, landmark = np.asarray(frame, int), np.asarray(landmark, int)
    control = np.asarray(control, float) if isinstance(control, list) else control
    steps, measured = len(jax.tree.leaves(control)[0]), np.asarray(measured, float)
    if not len(frame) == len(landmark) == len(measured):
        raise ValueError(
            "frame, landmark and measured need one entry of each measurement, not "
            f"{len(frame)}, {len(landmark)} and {len(measured)}"
        )
    check_numbers("measured", measured)
    check_numbers("control", tuple(jax.tree.leaves(control)))
    if len(frame) and not 0 <= frame.min() <= frame.max() <= steps:
        raise ValueError(
            f"frames are those before and after {steps} controls, 0 to {steps}, not "
            f"{frame.min()} to {frame.max()}"
        )
    numbers = np.unique(landmark)
    if known is not None:
        numbers = np.union1d(numbers, known.slots)
        known = replace(known, slots=np.searchsorted(numbers, known.slots))
    slots = np.searchsorted(numbers, landmark)
    began = np.full(len(numbers), steps + 1)
    np.minimum.at(began, slots, frame)
    if known is not None:
        began[known.slots] = -1
    _, firsts = np.unique(np.stack([frame, slots], axis=1), axis=0, return_index=True)
    new = (frame == began[slots]) & np.isin(np.arange(len(frame)), firsts)
    seen = frame > began[slots]
    first, created = _packed(new, frame, slots, measured, steps)
    _, again = _packed(seen, frame, slots, measured, steps)
    capacity = Capacity(max(len(numbers), 1), *(x.valid.shape[1] for x in (again, created)))
    return MeasuredRun(Frames(control, again, created), capacity, first, known, truth)


def _packed(chosen, frame, slots, measured, steps: int) -> tuple[Features, Features]:
    """The chosen measurements of frame 0, and of every later one, padded."""
    rows = np.flatnonzero(chosen)
    rows = rows[np.argsort(frame[rows], kind="stable")]
    counts = np.bincount(frame[rows], minlength=steps + 1)
    column = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)

    def features(of: np.ndarray, shape: tuple[int, ...]) -> Features:
        place = (frame[rows][of], column[of])
        parts = []
        for values in (slots[rows][of], measured[rows][of], np.ones(of.sum(), bool)):
            part = np.zeros((*shape, *values.shape[1:]), values.dtype)
            part[place] = values
            parts.append(jnp.asarray(part))
        return Features(*parts)

    later = frame[rows] > 0
    first = features(~later, (1, int(counts[0])))
    rest = features(later, (steps + 1, int(counts[1:].max(initial=0))))
    return jax.tree.map(lambda x: x[0], first), jax.tree.map(lambda x: x[1:], rest)
