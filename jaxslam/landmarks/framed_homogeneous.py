"""Framed homogeneous points (Ceriani, Marzorati, Matteucci, Sorrenti, 2011): shared anchors.

Parameters: (x/z, y/z, 1/z) in the camera that saw the point first, then that camera's number. Its
whole pose is in the state, once for all the points that it saw first: n numbers a landmark and a
pose a frame, where an anchor of its own would cost every landmark a position.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks.image_plane import ImagePlane
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters

_SEEN = ImagePlane()


class FramedHomogeneous(AbstractLandmark):
    """A point in the camera that saw it first, whose pose the state holds for all its points."""

    name: ClassVar[str] = "framed_homogeneous"
    parameters: ClassVar[str] = "(x/z, y/z, 1/z), number of an anchor"
    point: ClassVar[str] = "T_AF (x/z, y/z, 1) z"
    source: ClassVar[str] = "Ceriani et al., 2011"
    anchored: ClassVar[bool] = True

    def size(self, n: int) -> int:
        return n + 1

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n+1"]:
        """`(x/z, y/z, ω/z, 0)`; the filter puts in the anchor's number."""
        return jnp.append(_SEEN.initialise(point, omega, focal), 0.0)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """The point as seen from another frame: not what a filter does, which moves the anchor."""
        return jnp.append(_SEEN.transform(T_ab, landmark[:-1]), landmark[-1])

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`((x/z, y/z, 1), 1/z)` in the anchor."""
        return _SEEN.homogeneous(landmark[:-1])

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`1/z' = (1/z)/s`; the filter moves the anchor."""
        return jnp.append(_SEEN.scale(factor, landmark[:-1]), landmark[-1])
