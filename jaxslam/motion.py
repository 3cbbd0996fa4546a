"""How a camera moves between two frames: models of a displacement, driven by white noise.

A model says what a *control* makes of the velocity in the state and of this step's noise. The
control is data: the seconds of the step, the odometry's reading, or the rates of a vehicle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.geometry import Geometry, Pose, exp, identity, joined


@dataclass(frozen=True)
class Motion:
    """A motion model; t is the size of the pose's tangent."""

    name: str
    has_velocity: bool
    """Whether the state holds a velocity (t numbers) or none (0)."""
    displacement: Callable[[Geometry, Array, Array, Any], Pose]
    """`displacement(geometry, velocity, noise, control)`: T_{k-1,k}, the pose of C_k in C_{k-1}."""
    next_velocity: Callable[[Array, Array, Any], Array]
    """`next_velocity(velocity, noise, control)`."""
    no_control: Callable[[Geometry, Any], Any]
    """`no_control(geometry, dtype)`: the control with which nothing moves."""


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BodyRates:
    """The control of `BODY_RATES`: what a vehicle V measures of its motion, and its camera."""

    rates: Float[Array, " t"]
    """Linear and angular velocity in the axes of V at k−1, m/s and rad/s."""
    seconds: Float[Array, ""]
    camera: Pose
    """T_VC, the camera on the vehicle."""


def _body_rates(geometry, velocity, noise, control: BodyRates):
    """`T_{k-1,k} = T_VC⁻¹ (R = Exp(ω Δt), t = v Δt) T_VC` with (v, ω) = rates + w."""
    del velocity
    displaced = (control.rates + noise) * control.seconds
    moved, turned = jnp.split(displaced, [geometry.point_dim])
    step = joined(exp(geometry.rotation_group, turned), moved)
    return control.camera.inverse() @ step @ control.camera


CONSTANT_VELOCITY = Motion(
    name="velocity",
    has_velocity=True,
    displacement=_constant_velocity,
    next_velocity=_next_velocity,
    no_control=lambda geometry, dtype: jnp.zeros((), dtype),
)
"""Constant velocity with white acceleration, m/s² and rad/s²; the control is Δt (P8, P9)."""

ODOMETRY = Motion(
    name="odometry",
    has_velocity=False,
    displacement=_odometry,
    next_velocity=lambda velocity, noise, reading: velocity,
    no_control=lambda geometry, dtype: jnp.zeros(geometry.tangent_dim, dtype),
)
"""Odometry; the control is its reading u of a step, m and rad, with white error w."""

BODY_RATES = Motion(
    name="body_rates",
    has_velocity=False,
    displacement=_body_rates,
    next_velocity=lambda velocity, noise, control: velocity,
    no_control=lambda geometry, dtype: BodyRates(
        jnp.zeros(geometry.tangent_dim, dtype), jnp.zeros((), dtype), identity(geometry, dtype)
    ),
)
"""Odometry of a vehicle that carries the camera off its centre; the control is `BodyRates`, the
noise w the white error of its rates, m/s and rad/s: the lever arm correlates what the camera sees
of it. Not for scenarios, whose camera moves by itself."""

MOTIONS = {motion.name: motion for motion in (CONSTANT_VELOCITY, ODOMETRY)}
