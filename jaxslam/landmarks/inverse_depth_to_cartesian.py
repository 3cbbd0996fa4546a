"""Inverse depth that becomes Cartesian when that is linear (Civera, Davison, Montiel, ICRA 2007).

Parameters: Unified Inverse Depth's, then a constant that is 0 until the point is converted to
(X, 0, …, 0) and 1 after it. The constant and the zeros have no variance: nothing corrects them.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.inverse_depth import UnifiedInverseDepth
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters, ParametersCovariance

_RAY = UnifiedInverseDepth()


class InverseDepthToCartesian(AbstractLandmark):
    """Unified Inverse Depth that becomes a Cartesian point where that is nearly linear."""

    name: ClassVar[str] = "inverse_depth_to_cartesian"
    parameters: ClassVar[str] = "(C, θ, φ, ρ) or (X, Y, Z), which"
    point: ClassVar[str] = "C + m(θ, φ)/ρ or (X, Y, Z)"
    source: ClassVar[str] = "Civera, Davison, Montiel, ICRA 2007"
    converts: ClassVar[bool] = True

    linearity: float = eqx.field(static=True, default=0.1)
    """The linearity index L_d below which a point is converted."""

    def size(self, n: int) -> int:
        return 2 * n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " 2*n+1"]:
        """The landmark of Unified Inverse Depth, not converted."""
        return jnp.append(_RAY.initialise(point, omega, focal), 0.0)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """That of the form the point is in."""
        moved = T_ab @ _position(landmark)
        return jnp.where(
            _converted(landmark),
            _cartesian(moved),
            jnp.append(_RAY.transform(T_ab, landmark[:-1]), 0.0),
        )

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(X, 1)` once converted; before that `(ρ C + m, ρ)`."""
        point, omega = _RAY.homogeneous(landmark[:-1])
        converted = _converted(landmark)
        position = _position(landmark)
        return jnp.where(converted, position, point), jnp.where(converted, 1.0, omega)

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """That of inverse depth; once converted, ρ = 0 and the position is scaled."""
        return jnp.append(_RAY.scale(factor, landmark[:-1]), landmark[-1])

    def convert(
        self, camera: Point, landmark: Parameters, covariance: ParametersCovariance
    ) -> Parameters:
        """Cartesian where `L_d = 4 σ_d |cos α| / d` is small: σ_d = σ_ρ/ρ², α the parallax, d the
        distance."""
        point, rho = _RAY.homogeneous(landmark[:-1])
        safe = jnp.where(rho > 0, rho, 1.0)
        position = point / safe
        from_anchor, from_camera = position - _position(landmark), position - camera
        distance = jnp.linalg.norm(from_camera)
        cosine = (from_anchor @ from_camera) / (jnp.linalg.norm(from_anchor) * distance)
        sigma = jnp.sqrt(covariance[-2, -2]) / safe**2
        index = 4 * sigma * jnp.abs(cosine) / distance
        ready = (rho > 0) & (index < self.linearity)
        return jnp.where(ready & ~_converted(landmark), _cartesian(position), landmark)


def _position(landmark: Parameters) -> Point:
    """X once converted, and the anchor C before."""
    return landmark[: (landmark.size - 1) // 2]


def _converted(landmark: Parameters) -> Bool[Array, ""]:
    return landmark[-1] > 0.5


def _cartesian(position: Point) -> Float[Array, " 2*n+1"]:
    return jnp.concatenate([position, jnp.zeros_like(position), jnp.ones(1, position.dtype)])
