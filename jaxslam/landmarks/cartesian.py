"""Cartesian points (X, Y, Z): the classical Gaussian, undelayed by a prior on depth."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.parametrization import Parameters, Parametrization


def initialise(point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n"]:
    """`X/ω`. `focal` is not used."""
    del focal
    return point / omega


def transform(T_ab: Pose, landmark: Parameters) -> Parameters:
    """`X' = R X + t`."""
    return T_ab @ landmark


def homogeneous(landmark: Parameters) -> Homogeneous:
    """`(X, 1)`: never at infinity."""
    return landmark, jnp.ones((), landmark.dtype)


def scale(factor: Number, landmark: Parameters) -> Parameters:
    """`X' = s X`."""
    return factor * landmark


CARTESIAN = Parametrization(
    name="cartesian",
    parameters="(X, Y, Z)",
    point="(X, Y, Z)",
    source="the classical Gaussian (the paper's Fig. 1)",
    size=lambda n: n,
    initialise=initialise,
    transform=transform,
    homogeneous=homogeneous,
    scale=scale,
)
