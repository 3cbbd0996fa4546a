"""Motion of the camera between two frames: constant velocity with white acceleration (P8, P9)."""

from __future__ import annotations

from jaxtyping import Array, Float

from jaxslam.geometry import Geometry, Pose, exp


def next_velocity(
    velocity: Float[Array, " t"], acceleration: Float[Array, " t"], dt: Float[Array, ""]
) -> Float[Array, " t"]:
    """`v_k = v_{k-1} + a Δt` (P8), linear then angular, in the camera's own frame."""
    return velocity + acceleration * dt


def displacement(
    geometry: Geometry,
    velocity: Float[Array, " t"],
    acceleration: Float[Array, " t"],
    dt: Float[Array, ""],
) -> Pose:
    """`T_{k-1,k} = Exp((v + a Δt) Δt)` (P9), the pose of C_k in C_{k-1}."""
    return exp(geometry.group, next_velocity(velocity, acceleration, dt) * dt)
