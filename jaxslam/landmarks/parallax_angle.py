"""Parallax angle (Zhao, Huang, Sun, Yan, Dissanayake, IJRR 2015): two anchors and three angles.

Parameters: (C₁, C₂, θ, φ, α, a): the positions of a main and an associate anchor, the direction
m(θ, φ) of the point from the main one, the parallax angle α between the two rays at the point,
and a constant a. With ψ the angle between m and C₂ − C₁, the law of sines gives the point
`C₁ + m |C₂ − C₁| sin(α + ψ)/sin α`: at α = 0 it is at infinity.

One view has no parallax. Until a camera has moved enough, a = 0, C₂ is C₁, and α holds Unified
Inverse Depth's ρ; then that camera becomes the associate anchor, once, and a = 1.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.inverse_depth import Angles, UnifiedInverseDepth, angles_of, ray_of, unpack
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters, ParametersCovariance

_RAY = UnifiedInverseDepth()


class ParallaxAngle(AbstractLandmark):
    """Parallax angle: two anchors, a direction, and the angle between two rays."""

    name: ClassVar[str] = "parallax_angle"
    parameters: ClassVar[str] = "(C₁, C₂, θ, φ, α), whether C₂ is set"
    point: ClassVar[str] = "C₁ + m ‖C₂ − C₁‖ sin(α + ψ)/sin α"
    source: ClassVar[str] = "Zhao et al., IJRR 2015"
    converts: ClassVar[bool] = True

    least_parallax: float = eqx.field(static=True, default=0.02)
    """Parallax at which a camera becomes the associate anchor, rad."""

    def size(self, n: int) -> int:
        return 3 * n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " 3*n+1"]:
        """Unified Inverse Depth at the main anchor."""
        anchor, angles, rho = unpack(_RAY.initialise(point, omega, focal))
        return _pack(anchor, anchor, angles, rho, 0.0)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """Both anchors and the ray move; α, between two rays, stays."""
        main, associate, angles, alpha, anchored = _unpack(landmark)
        ray = T_ab.rotation() @ ray_of(angles)
        return _pack(T_ab @ main, T_ab @ associate, angles_of(ray), alpha, anchored)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(C₁ sin α + m |C₂ − C₁| sin(α + ψ), sin α)`; with one anchor `(ρ C₁ + m, ρ)`."""
        main, associate, angles, alpha, anchored = _unpack(landmark)
        ray = ray_of(angles)
        # |C₂ − C₁| sin(α + ψ) = sin α (m·b) + cos α |b − (m·b) m|, with b = C₂ − C₁.
        along, across = _along_and_across(ray, associate - main)
        reach = jnp.sin(alpha) * along + jnp.cos(alpha) * across
        done = anchored > 0.5
        omega = jnp.where(done, jnp.sin(alpha), alpha)
        return omega * main + jnp.where(done, reach, 1.0) * ray, omega

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """Both anchors move; α, between two rays, stays, and ρ is divided."""
        main, associate, angles, alpha, anchored = _unpack(landmark)
        alpha = jnp.where(anchored > 0.5, alpha, alpha / factor)
        return _pack(factor * main, factor * associate, angles, alpha, anchored)

    def convert(
        self, camera: Point, landmark: Parameters, covariance: ParametersCovariance
    ) -> Parameters:
        """The camera as associate anchor where `tan α = ρ |b⊥| / (1 − ρ m·b)` is enough."""
        del covariance
        main, _, angles, rho, anchored = _unpack(landmark)
        along, across = _along_and_across(ray_of(angles), camera - main)
        alpha = jnp.atan2(rho * across, 1 - rho * along)
        ready = (anchored < 0.5) & (alpha > self.least_parallax)
        return jnp.where(ready, _pack(main, camera, angles, alpha, 1.0), landmark)


def _along_and_across(ray: Point, baseline: Point) -> tuple[Scalar, Scalar]:
    """The baseline's component along the ray, and the length of the rest."""
    along = ray @ baseline
    rest = baseline - along * ray
    squared = rest @ rest
    # No derivative where the camera has not moved across: nothing is converted there.
    return along, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)) * (squared > 0)


def _pack(
    main: Point, associate: Point, angles: Angles, alpha: Scalar, anchored: Scalar | float
) -> Float[Array, " 3*n+1"]:
    ends = jnp.stack([alpha, jnp.asarray(anchored, alpha.dtype)])
    return jnp.concatenate([main, associate, angles, ends])


def _unpack(landmark: Parameters) -> tuple[Point, Point, Angles, Scalar, Scalar]:
    n = landmark.size // 3  # 3n + 1 numbers
    return landmark[:n], landmark[n : 2 * n], landmark[2 * n : -2], landmark[-2], landmark[-1]
