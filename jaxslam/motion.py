"""How a camera moves between two frames: models of a displacement, driven by white noise.

A model says what a *control* makes of the velocity in the state and of this step's noise. The
control is data: the seconds of the step, or the odometry's reading.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array

from jaxslam.geometry import Geometry, Pose, exp, joined


@dataclass(frozen=True)
class Motion:
    """A motion model; t is the size of the pose's tangent."""

    name: str
    has_velocity: bool
    """Whether the state holds a velocity (t numbers) or none (0)."""
    displacement: Callable[[Geometry, Array, Array, Array], Pose]
    """`displacement(geometry, velocity, noise, control)`: T_{k-1,k}, the pose of C_k in C_{k-1}."""
    next_velocity: Callable[[Array, Array, Array], Array]
    """`next_velocity(velocity, noise, control)`."""
    control_shape: Callable[[Geometry], tuple[int, ...]]
    """Of the array that is the control; zeros stand for no time and no motion."""


def _next_velocity(velocity, acceleration, dt):
    """`v_k = v_{k-1} + a Δt` (P8), linear then angular, in the camera's own frame."""
    return velocity + acceleration * dt


def _constant_velocity(geometry, velocity, acceleration, dt):
    """`T_{k-1,k} = Exp((v + a Δt) Δt)` (P9)."""
    return exp(geometry.group, _next_velocity(velocity, acceleration, dt) * dt)


def _odometry(geometry, velocity, noise, reading):
    """`T_{k-1,k} = (R = Exp(θ), t = ρ)` with (ρ, θ) = u + w: move straight, then turn."""
    del velocity
    moved, turned = jnp.split(reading + noise, [geometry.point_dim])
    return joined(exp(geometry.rotation_group, turned), moved)


CONSTANT_VELOCITY = Motion(
    name="velocity",
    has_velocity=True,
    displacement=_constant_velocity,
    next_velocity=_next_velocity,
    control_shape=lambda geometry: (),
)
"""Constant velocity with white acceleration, m/s² and rad/s²; the control is Δt (P8, P9)."""

ODOMETRY = Motion(
    name="odometry",
    has_velocity=False,
    displacement=_odometry,
    next_velocity=lambda velocity, noise, reading: velocity,
    control_shape=lambda geometry: (geometry.tangent_dim,),
)
"""Odometry; the control is its reading u of a step, m and rad, with white error w."""

MOTIONS = {motion.name: motion for motion in (CONSTANT_VELOCITY, ODOMETRY)}
