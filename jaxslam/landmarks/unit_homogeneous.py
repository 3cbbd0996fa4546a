"""Homogeneous points with a unit ray, without an anchor (Solà et al., IJCV 2012, §4.2).

Parameters: (m, ρ), n + 1 numbers; the point is m/ρ. Inverse Scaling with another length of its
vector: in the frame of a first camera m has unit length, where Inverse Scaling has the focal one.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.geometry import Point, Scalar
from jaxslam.landmarks import inverse_scaling
from jaxslam.landmarks.parametrization import Parametrization


def initialise(point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n+1"]:
    """`(m, ρ) = (X, ω)/|X|`. `focal` is not used."""
    del focal
    return jnp.append(point, omega) / jnp.linalg.norm(point)


UNIT_HOMOGENEOUS = Parametrization(
    name="unit_homogeneous",
    parameters="(m, ρ)",
    point="m/ρ",
    source="Solà et al., IJCV 2012, without an anchor",
    size=lambda n: n + 1,
    initialise=initialise,
    transform=inverse_scaling.transform,
    homogeneous=inverse_scaling.homogeneous,
    scale=inverse_scaling.scale,
)
