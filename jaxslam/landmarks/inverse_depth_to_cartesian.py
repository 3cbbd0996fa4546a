"""Inverse depth that becomes Cartesian when that is linear (Civera, Davison, Montiel, ICRA 2007).

Parameters: Unified Inverse Depth's, then a constant that is 0 until the point is converted to
(X, 0, …, 0) and 1 after it. The constant and the zeros have no variance: nothing corrects them.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks import inverse_depth
from jaxslam.landmarks.parametrization import Parameters, ParametersCovariance, Parametrization

LINEARITY = 0.1
"""A point is converted below this linearity index `L_d = 4 σ_d |cos α| / d`."""


def initialise(point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " 2*n+1"]:
    """The landmark of Unified Inverse Depth, not converted."""
    return jnp.append(inverse_depth.initialise(point, omega, focal), 0.0)


def transform(T_ab: Pose, landmark: Parameters) -> Parameters:
    """That of the form the point is in."""
    moved = T_ab @ _position(landmark)
    return jnp.where(
        _converted(landmark),
        _cartesian(moved),
        jnp.append(inverse_depth.transform(T_ab, landmark[:-1]), 0.0),
    )


def homogeneous(landmark: Parameters) -> Homogeneous:
    """`(X, 1)` once converted; before that `(ρ C + m, ρ)`."""
    point, omega = inverse_depth.homogeneous(landmark[:-1])
    converted = _converted(landmark)
    position = _position(landmark)
    return jnp.where(converted, position, point), jnp.where(converted, 1.0, omega)


def scale(factor: Number, landmark: Parameters) -> Parameters:
    """That of inverse depth; once converted, ρ = 0 and the position is scaled."""
    return jnp.append(inverse_depth.scale(factor, landmark[:-1]), landmark[-1])


def convert(camera: Point, landmark: Parameters, covariance: ParametersCovariance) -> Parameters:
    """Convert to Cartesian where `L_d < 0.1`: σ_d = σ_ρ/ρ², α the parallax, d the distance."""
    point, rho = inverse_depth.homogeneous(landmark[:-1])
    safe = jnp.where(rho > 0, rho, 1.0)
    position = point / safe
    from_anchor, from_camera = position - _position(landmark), position - camera
    distance = jnp.linalg.norm(from_camera)
    cosine = (from_anchor @ from_camera) / (jnp.linalg.norm(from_anchor) * distance)
    sigma = jnp.sqrt(covariance[-2, -2]) / safe**2
    index = 4 * sigma * jnp.abs(cosine) / distance
    ready = (rho > 0) & (index < LINEARITY)
    return jnp.where(ready & ~_converted(landmark), _cartesian(position), landmark)


def _position(landmark: Parameters) -> Point:
    """X once converted, and the anchor C before."""
    return landmark[: (landmark.size - 1) // 2]


def _converted(landmark: Parameters) -> Bool[Array, ""]:
    return landmark[-1] > 0.5


def _cartesian(position: Point) -> Float[Array, " 2*n+1"]:
    return jnp.concatenate([position, jnp.zeros_like(position), jnp.ones(1, position.dtype)])


INVERSE_DEPTH_TO_CARTESIAN = Parametrization(
    name="inverse_depth_to_cartesian",
    parameters="(C, θ, φ, ρ) or (X, Y, Z), which",
    point="C + m(θ, φ)/ρ or (X, Y, Z)",
    source="Civera, Davison, Montiel, ICRA 2007",
    size=lambda n: 2 * n + 1,
    initialise=initialise,
    transform=transform,
    homogeneous=homogeneous,
    scale=scale,
    convert=convert,
)
