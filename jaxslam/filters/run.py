"""A filter through frames, one after another in one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.filters.protocol import AbstractFilter, Belief
from jaxslam.filters.readouts import camera_pose
from jaxslam.geometry import Pose
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features, Innovation


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
