"""Points on an image plane: (x/z, y/z, 1/z) (Eade, Drummond, CVPR 2006 and ICCV 2007).

n numbers, of which the first two are the normalised image coordinates in the camera of the map
frame: that of a keyframe, or, in a robocentric filter, the current one. A point behind that
camera's image plane has no such coordinates.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar, homogeneous_apply
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters


class ImagePlane(AbstractLandmark):
    """A point on the image plane of the map frame's camera: (x/z, y/z, 1/z)."""

    name: ClassVar[str] = "image_plane"
    parameters: ClassVar[str] = "(x/z, y/z, 1/z)"
    point: ClassVar[str] = "(x/z, y/z, 1) z"
    source: ClassVar[str] = "Eade, Drummond, CVPR 2006"

    def size(self, n: int) -> int:
        return n

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n"]:
        """`(x/z, y/z, ω/z)`. `focal` is not used."""
        del focal
        return jnp.append(point[:-1], omega) / point[-1]

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """`X = R (x/z, y/z, 1) + (1/z) t`, and `(X_x/X_z, X_y/X_z, (1/z)/X_z)`."""
        point, omega = self.homogeneous(landmark)
        point = homogeneous_apply(T_ab, point, omega)
        return jnp.append(point[:-1], omega) / point[-1]

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`((x/z, y/z, 1), 1/z)`."""
        return landmark.at[-1].set(1.0), landmark[-1]

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """`1/z' = (1/z)/s`."""
        return landmark.at[-1].divide(factor)
