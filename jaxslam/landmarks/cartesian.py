"""Cartesian points (X, Y, Z): the classical Gaussian, undelayed by a prior on depth."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters


class Cartesian(AbstractLandmark):
    """A Cartesian point (X, Y, Z)."""

    name: ClassVar[str] = "cartesian"
    parameters: ClassVar[str] = "(X, Y, Z)"
    point: ClassVar[str] = "(X, Y, Z)"
    source: ClassVar[str] = "the classical Gaussian (the paper's Fig. 1)"

    def size(self, n: int) -> int:
        return n

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n"]:
        """`X/ω`. `focal` is not used."""
        del focal
        return point / omega

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """`X' = R X + t`."""
        return T_ab @ landmark

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(X, 1)`: never at infinity."""
        return landmark, jnp.ones((), landmark.dtype)

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`X' = s X`."""
        return factor * landmark
