"""Anchored homogeneous points (Solà, Vidal-Calleja, Civera, Montiel, IJCV 2012, §4.3).

Parameters: (C, m, ρ), 2n + 1 numbers: the position C of the camera that saw the point first, a
ray m of any length, and ρ in units of that length. The point is `C + m/ρ`: Unified Inverse Depth
with the ray's coordinates for its angles, and so without a singular direction.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.inverse_depth import pack, unpack
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters


class AnchoredHomogeneous(AbstractLandmark):
    """A homogeneous point with a ray of any length from the camera that saw it first: (C, m, ρ)."""

    name: ClassVar[str] = "anchored_homogeneous"
    parameters: ClassVar[str] = "(C, m, ρ)"
    point: ClassVar[str] = "C + m/ρ"
    source: ClassVar[str] = "Solà et al., IJCV 2012"

    def size(self, n: int) -> int:
        return 2 * n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " 2*n+1"]:
        """C = 0, `m = X/|X|`, `ρ = ω/|X|`. `focal` is not used."""
        del focal
        length = jnp.linalg.norm(point)
        return pack(jnp.zeros_like(point), point / length, omega / length)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """`C' = R C + t`, `m' = R m`, `ρ' = ρ`."""
        anchor, ray, rho = unpack(landmark)
        return pack(T_ab @ anchor, T_ab.rotation() @ ray, rho)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(ρ C + m, ρ)`."""
        anchor, ray, rho = unpack(landmark)
        return rho * anchor + ray, rho

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`C' = s C`, `m' = m`, `ρ' = ρ/s`."""
        anchor, ray, rho = unpack(landmark)
        return pack(factor * anchor, ray, rho / factor)
