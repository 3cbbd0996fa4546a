"""Points in normal coordinates of SOT(n), as in the equivariant filter (van Goor, Mahony, Hamel,
Trumpf: Constructive Observer Design for Visual SLAM, Automatica 2021; van Goor, Mahony: EqVIO,
T-RO 2023).

Scaled rotations SOT(n) = SO(n) × R⁺ act on points in the camera frame. The error of one is such an
element, `p ← e^l Exp(θ) p`. Parameters: (m, λ), n + 1 numbers: a ray and the logarithm of the
range. To add δ to the ray of unit length and forget the length again turns it by `arctan |δ|`
instead of |δ|. So the robocentric filter, whose pose has the published error `Exp(ξ) T_BC`, is the
equivariant filter but for |δ|³/3 of a bearing. In the other published chart, bearing and 1/range,
that filter is the robocentric one of `ImagePlane` but for products with a bearing's error.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar, homogeneous_apply
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters


class SotNormal(AbstractLandmark):
    """A ray and the logarithm of the range: (m, λ). A point at infinity has none."""

    name: ClassVar[str] = "sot_normal"
    parameters: ClassVar[str] = "(m, λ)"
    point: ClassVar[str] = "e^λ m/‖m‖"
    source: ClassVar[str] = "van Goor et al., Automatica 2021"

    def size(self, n: int) -> int:
        return n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n+1"]:
        """`m = X/|X|`, `λ = −log(ω/|X|)`. `focal` is not used."""
        del focal
        length = jnp.linalg.norm(point)
        return jnp.append(point / length, -jnp.log(omega / length))

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """That of the homogeneous point, `X' = R X + ω t`."""
        point, omega = self.homogeneous(landmark)
        return self.initialise(homogeneous_apply(T_ab, point, omega), omega, omega)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(m/|m|, e^−λ)`."""
        ray = landmark[:-1]
        return ray / jnp.linalg.norm(ray), jnp.exp(-landmark[-1])

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`λ' = λ + log s`."""
        return landmark.at[-1].add(jnp.log(factor))
