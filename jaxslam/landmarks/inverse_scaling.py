"""Inverse Scaling (Marzorati et al., BMVC 2008): a homogeneous point (x, y, z, ω) in pixels."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar, homogeneous_apply
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters


class InverseScaling(AbstractLandmark):
    """The paper's landmark: a homogeneous point (x, y, z, ω) in pixels (P5)."""

    name: ClassVar[str] = "inverse_scaling"
    parameters: ClassVar[str] = "(x, y, z, ω)"
    point: ClassVar[str] = "(x, y, z)/ω"
    source: ClassVar[str] = "Marzorati et al., BMVC 2008 (P5)"

    def size(self, n: int) -> int:
        return n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n+1"]:
        """`(x, y, z, ω) = f (K⁻¹(u, v, 1), 1/d)` (P22–P26), that is (u − cx, v − cy, f, f/d).

        ω is written with the same f as (x, y, z), so that the depth z/ω = d that the prior speaks
        of does not depend on the focal length.
        """
        return focal * jnp.append(point, omega)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """`X' = R X + ω t`, `ω' = ω`: linear in the landmark; the paper does not number it."""
        point, omega = self.homogeneous(landmark)
        return jnp.append(homogeneous_apply(T_ab, point, omega), omega)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """The parameters themselves (P5)."""
        return landmark[:-1], landmark[-1]

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`X' = X`, `ω' = ω/s`: the length of (x, y, z), which is a convention, stays."""
        return landmark.at[-1].divide(factor)
