"""What the modes of a start from rest are in one run, frame by frame, and which is which."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.consistency import SimulatedFrame, run_through
from jaxslam.filters.linear.state import State
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import landmarks_from_above
from jaxslam.filters.slam import Slam
from jaxslam.filters.window.minimise import Minimum
from jaxslam.filters.window.problem import path, residuals
from jaxslam.filters.window.start import RestState
from jaxslam.simulation import Room, Run
from jaxslam.statistics.bands import normalised_squared

ALIKE = 0.7
"""Cosine of two paths, from which on they are of one mode."""


class Modes(NamedTuple):
    """Of every frame after 0 as long as the window holds all frames; the likeliest comes first."""

    weights: Float[np.ndarray, "frames modes"]
    """0 of places without a mode."""
    paths: Float[np.ndarray, "frames modes window n"]
    """Where the camera was in every frame of the window, from frame 0 on, m; B's axes. After the
    newest frame nothing moves."""
    landmarks: Float[np.ndarray, "frames modes m 2"]
    """From the newest camera: azimuth (from z towards x, B's axes) and inverse distance, 1/m."""
    covariances: Float[np.ndarray, "frames modes m 2 2"]
    """Of these, given the scale, which no pixel tells."""
    misfits: Float[np.ndarray, "frames modes"]
    """Root mean square of all residuals so far, in σ of a pixel."""
    nees: Float[np.ndarray, " steps"]
    """Of the sum's pose, in every frame of the run."""


def modes_of_run(slam: AbstractFilter, room: Room, run: Run) -> Modes:
    """Follow the modes of a start from rest through a run.

    It ends where the sum goes on alone, or where frames of the window are merged. Raises
    ValueError for a filter without such a start.
    """
    if not isinstance(slam, Slam) or slam.start is None:
        raise ValueError("modes are those of a start from rest (+rest), and this filter has none")
    told, nees, newest, is_open = jax.device_get(_compiled(slam, room, run))
    whole = (newest == 1 + np.arange(len(newest))) & np.append(True, is_open[:-1])
    return Modes(*(numbers[: whole.sum()] for numbers in told), nees)


def _through(slam: Slam, room: Room, run: Run) -> tuple[Any, Array, Array, Array]:
    def told(state: RestState, _, frame: SimulatedFrame):
        nees = normalised_squared(*slam.pose_error(state, frame.pose))
        return _told(slam, state), nees, state.record.last, state.open

    return run_through(slam, room, run, told)[1]


_compiled = eqx.filter_jit(_through)
"""Once for all runs of a shape."""


def _told(slam: Slam, state: RestState) -> tuple[Array, ...]:
    """The fields of `Modes` that are each mode's, of one frame."""
    ekf, record, modes = slam.one, state.record, state.modes

    def one(minimum: Minimum, member: State) -> tuple[Array, ...]:
        at = path(ekf, record, minimum.x)
        r, slots = residuals(ekf, record, at, minimum.y), jnp.arange(record.first.size)
        misfit = jnp.sqrt(jnp.sum(r**2) / jnp.maximum(jnp.sum(record.compared) * r.shape[-1], 1))
        seen = landmarks_from_above(ekf, given_scale(member), slots)
        return at.frames.pose.translation(), *seen, misfit

    return jnp.exp(modes.log_weights), *jax.vmap(one)(modes.minima, state.sum.members)


def given_scale(state: State) -> State:
    """The Gaussian given λ: what is left when somebody tells the scale."""
    core: Any = state.core
    part, P = core.part("log_scale"), state.covariance
    across = P[:, part]
    left = P - across @ across.T / P[part, part]
    return replace(state, covariance=left)


def followed(modes: Modes) -> Int[np.ndarray, "frames modes"]:
    """A number for every mode, the same from frame to frame as long as it moves the same way, in
    the order in which they appear; −1 of places without a mode.

    Two paths are compared by their cosine, up to the older one's newest frame: scale and small
    bends change nothing of it.
    """
    numbers = np.full(modes.weights.shape, -1)
    last: dict[int, Float[np.ndarray, "k n"]] = {}
    for frame, (weights, paths) in enumerate(zip(modes.weights, modes.paths, strict=True)):
        here: dict[int, Float[np.ndarray, "k n"]] = {}
        for mode in np.flatnonzero(weights > 0):
            moved = paths[mode, 1 : frame + 2]
            numbers[frame, mode] = number = _number(moved, {**last, **here})
            here.setdefault(number, moved)
        last |= here
    return numbers


def _number(moved: Float[np.ndarray, "k n"], known: dict[int, Float[np.ndarray, "j n"]]) -> int:
    """Of the known path that this one is like, or a new one."""
    alike = {number: _cosine(moved[: len(other)], other) for number, other in known.items()}
    likest = max(alike, key=lambda number: alike[number], default=-1)
    return likest if alike.get(likest, 0.0) > ALIKE else len(known)


def _cosine(a: Float[np.ndarray, "k n"], b: Float[np.ndarray, "k n"]) -> float:
    return float(np.vdot(a, b) / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))
