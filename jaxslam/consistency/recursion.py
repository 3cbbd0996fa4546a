"""A filter through a whole run, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Bool, Float

from jaxslam.filters.protocol import AbstractFilter
from jaxslam.geometry import Pose
from jaxslam.models.observations import Features, Innovation
from jaxslam.simulation import Room, Run, features, gone


class Frame(NamedTuple):
    """What is known of one frame of a run after frame 0; a filter is told all but the truth."""

    control: Any
    seen: Features
    new: Features
    gone: Bool[Array, " slots"] | None
    """Slots whose landmark will not be seen again; None where landmarks keep theirs."""
    pose: Pose
    """T_BC, true."""
    points: Float[Array, "slots n"]
    """In B, true: what the slots stand for now."""


def run_through(
    slam: AbstractFilter,
    room: Room,
    run: Run,
    told: Callable[[Any, Innovation, Frame], Any],
) -> tuple[Any, Any]:
    """The last state, and what is `told(state, innovation, frame)` after every frame but 0.

    Landmarks that are gone are removed before the step. Raises ValueError for a filter that
    cannot, where a run uses slots again.
    """
    first, seen, new = features(run, room)
    left = gone(run, room)
    if left is not None:
        _check_removes(slam)
    poses, points = jax.tree.map(lambda x: x[1:], (run.poses, run.points_by_frame))

    def step(state, frame: Frame):
        if frame.gone is not None:
            state = slam.remove(state, frame.gone)  # ty: ignore[missing-attribute]
        state, innovation = slam.step(state, frame.control, frame.seen, frame.new)
        return state, told(state, innovation, frame)

    frames = Frame(run.controls, seen, new, left, poses, points)
    return jax.lax.scan(step, slam.init(room.capacity, first), frames)


def _check_removes(slam: AbstractFilter) -> None:
    if not callable(getattr(slam, "remove", None)):
        raise ValueError(
            f"{type(slam).__name__} has no remove(state, gone): it cannot use slots again, as is "
            "needed where landmarks come and go"
        )
