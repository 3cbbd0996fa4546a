"""Homogeneous points with a unit ray, without an anchor (Solà et al., IJCV 2012, §4.2).

Parameters: (m, ρ), n + 1 numbers; the point is m/ρ. Inverse Scaling with another length of its
vector: in the frame of a first camera m has unit length, where Inverse Scaling has the focal one.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.inverse_scaling import InverseScaling
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters

_SCALED = InverseScaling()


class UnitHomogeneous(AbstractLandmark):
    """A homogeneous point (m, ρ) whose ray has unit length in its first camera."""

    name: ClassVar[str] = "unit_homogeneous"
    parameters: ClassVar[str] = "(m, ρ)"
    point: ClassVar[str] = "m/ρ"
    source: ClassVar[str] = "Solà et al., IJCV 2012, without an anchor"

    def size(self, n: int) -> int:
        return n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n+1"]:
        """`(m, ρ) = (X, ω)/|X|`. `focal` is not used."""
        del focal
        return jnp.append(point, omega) / jnp.linalg.norm(point)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """That of Inverse Scaling."""
        return _SCALED.transform(T_ab, landmark)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """The parameters themselves."""
        return _SCALED.homogeneous(landmark)

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """That of Inverse Scaling."""
        return _SCALED.scale(factor, landmark)
