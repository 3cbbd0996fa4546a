"""Unified Inverse Depth (Montiel, Civera, Davison, RSS 2006): a ray from its first camera.

Parameters: (C, θ, φ, ρ), spatial, or (C, θ, ρ), planar (P1–P4): the position C of the camera
that saw the point first, the ray's azimuth θ and elevation φ, and the inverse distance ρ along
the ray. The point is `C + m(θ, φ)/ρ`.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters

Angles = Float[Array, " a"]
"""(θ, φ), or θ."""


class UnifiedInverseDepth(AbstractLandmark):
    """Unified Inverse Depth: a ray from its first camera and the inverse distance along it."""

    name: ClassVar[str] = "inverse_depth"
    parameters: ClassVar[str] = "(C, θ, φ, ρ)"
    point: ClassVar[str] = "C + m(θ, φ)/ρ"
    source: ClassVar[str] = "Montiel, Civera, Davison, RSS 2006 (P1–P4)"

    def size(self, n: int) -> int:
        return 2 * n

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " 2*n"]:
        """C = 0, the ray of X, and `ρ = ω/|X|`.

        The prior speaks of inverse depth 1/z, the same for every parametrization; ρ is the inverse
        distance that belongs to it. `focal` is not used.
        """
        del focal
        inverse_distance = omega / jnp.linalg.norm(point)
        return pack(jnp.zeros_like(point), angles_of(point), inverse_distance)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """`C' = R C + t`, `m(θ', φ') = R m(θ, φ)`, `ρ' = ρ`. Singular where the ray is vertical."""
        anchor, angles, inverse_distance = unpack(landmark)
        ray = T_ab.rotation() @ ray_of(angles)
        return pack(T_ab @ anchor, angles_of(ray), inverse_distance)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(ρ C + m(θ, φ), ρ)` (P4)."""
        anchor, angles, inverse_distance = unpack(landmark)
        return inverse_distance * anchor + ray_of(angles), inverse_distance

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`C' = s C`, `ρ' = ρ/s`."""
        anchor, angles, inverse_distance = unpack(landmark)
        return pack(factor * anchor, angles, inverse_distance / factor)


def pack(anchor: Point, angles: Angles, inverse_distance: Scalar) -> Parameters:
    """(C, ray, ρ), the ray by its angles or otherwise, as one vector."""
    return jnp.concatenate([anchor, angles, inverse_distance[None]])


def unpack(landmark: Parameters) -> tuple[Point, Angles, Scalar]:
    """The inverse of `pack`."""
    n = landmark.size // 2
    return landmark[:n], landmark[n:-1], landmark[-1]


def ray_of(angles: Angles) -> Point:
    """`m = (cos φ sin θ, −sin φ, cos φ cos θ)`; planar `(sin θ, cos θ)`."""
    if angles.size == 1:
        return jnp.stack([jnp.sin(angles[0]), jnp.cos(angles[0])])
    theta, phi = angles
    return jnp.stack([jnp.cos(phi) * jnp.sin(theta), -jnp.sin(phi), jnp.cos(phi) * jnp.cos(theta)])


def angles_of(ray: Point) -> Angles:
    """`θ = atan2(x, z)`, `φ = atan2(−y, √(x² + z²))`, the inverse of `ray_of`."""
    theta = jnp.atan2(ray[0], ray[-1])
    if ray.size == 2:
        return theta[None]
    return jnp.stack([theta, jnp.atan2(-ray[1], jnp.hypot(ray[0], ray[-1]))])
