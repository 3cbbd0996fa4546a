"""What the modes of a start from rest are in one run, frame by frame, and which is which."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.consistency.recursion import run_through
from jaxslam.forms.state import State
from jaxslam.simulation import Room, Run
from jaxslam.slam.readouts import landmarks_from_above
from jaxslam.window.minimise import Minimum
from jaxslam.window.problem import path, residuals
from jaxslam.wrappers.from_rest import FromRest, RestState

ALIKE = 0.7
"""Cosine of two paths, from which on they are of one mode."""


class Modes(NamedTuple):
    """Of every frame after 0 until the sum goes on alone; the likeliest mode comes first."""

    weights: Float[Array, "frames modes"]
    """0 of places without a mode."""
    paths: Float[Array, "frames modes window n"]
    """Where the camera was in every frame of the window, from frame 0 on, m; B's axes. After the
    newest frame nothing moves."""
    landmarks: Float[Array, "frames modes m 2"]
    """From the newest camera: azimuth (from z towards x, B's axes) and inverse distance, 1/m."""
    covariances: Float[Array, "frames modes m 2 2"]
    """Of these, given the scale, which no pixel tells."""
    misfits: Float[Array, "frames modes"]
    """Root mean square of all residuals so far, in σ of a pixel."""


def modes_of_run(slam: FromRest, room: Room, run: Run) -> Modes:
    """Follow the modes of a start from rest through a run, on the machine's processor."""

    @jax.jit
    def followed(slam, run):
        return run_through(slam, room, run, lambda state, *_: (_told(slam, state), state.open))[1]

    told, is_open = jax.device_get(followed(slam, run))
    count = min(int(is_open.sum()) + 1, len(is_open))
    return Modes(*(np.asarray(numbers)[:count] for numbers in told))


def _told(slam: FromRest, state: RestState) -> Modes:
    ekf, record, modes = slam.base.base, state.record, state.modes

    def one(minimum: Minimum, member: State) -> tuple[Array, ...]:
        at = path(ekf, record, minimum.x)
        r, slots = residuals(ekf, record, at, minimum.y), jnp.arange(record.first.size)
        misfit = jnp.sqrt(jnp.sum(r**2) / jnp.maximum(jnp.sum(record.compared) * r.shape[-1], 1))
        seen = landmarks_from_above(ekf, given_scale(member), slots)
        return at.frames.pose.translation(), *seen, misfit

    return Modes(jnp.exp(modes.log_weights), *jax.vmap(one)(modes.minima, state.sum.members))


def given_scale(state: State) -> State:
    """The Gaussian given λ: what is left when somebody tells the scale."""
    core: Any = state.core
    part, P = core.part("log_scale"), state.covariance
    across = P[:, part]
    left = P - across @ across.T / P[part, part]
    return State(core, state.landmarks, state.active, left, state.memory)


def followed(modes: Modes) -> Int[np.ndarray, "frames modes"]:
    """A number for every mode, the same from frame to frame as long as it moves the same way, in
    the order in which they appear; −1 of places without a mode.

    Two paths are compared by their cosine, up to the older one's newest frame: scale and small
    bends change nothing of it.
    """
    last: list[Float[np.ndarray, "k n"]] = []
    numbers = np.full(modes.weights.shape, -1)
    for frame, (weights, paths) in enumerate(zip(modes.weights, modes.paths, strict=True)):
        here = {}
        for mode in np.flatnonzero(weights > 0):
            moved = paths[mode, 1 : frame + 2]
            alike = [_cosine(moved[: len(other)], other) for other in last]
            likest = int(np.argmax(alike)) if alike else -1
            known = likest >= 0 and alike[likest] > ALIKE
            number = likest if known else len(last)
            numbers[frame, mode] = number
            here.setdefault(number, moved)
            if not known:
                last.append(moved)
        for number, moved in here.items():
            last[number] = moved
    return numbers


def _cosine(a: Float[np.ndarray, "k n"], b: Float[np.ndarray, "k n"]) -> float:
    return float(np.vdot(a, b) / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))
