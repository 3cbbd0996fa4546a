"""Framed homogeneous points (Ceriani, Marzorati, Matteucci, Sorrenti, 2011): shared anchors.

Parameters: (x/z, y/z, 1/z) in the camera that saw the point first, then that camera's number. Its
whole pose is in the state, once for all the points that it saw first: n numbers a landmark and a
pose a frame, where an anchor of its own would cost every landmark a position.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks import image_plane
from jaxslam.landmarks.parametrization import Parameters, Parametrization


def initialise(point: Point, omega: Scalar, focal: Scalar) -> Float[Array, " n+1"]:
    """`(x/z, y/z, ω/z, 0)`; the filter puts in the anchor's number."""
    return jnp.append(image_plane.initialise(point, omega, focal), 0.0)


def transform(T_ab: Pose, landmark: Parameters) -> Parameters:
    """The point as seen from another frame: not what a filter does, which moves the anchor."""
    return jnp.append(image_plane.transform(T_ab, landmark[:-1]), landmark[-1])


def homogeneous(landmark: Parameters) -> Homogeneous:
    """`((x/z, y/z, 1), 1/z)` in the anchor."""
    return image_plane.homogeneous(landmark[:-1])


def scale(factor: Number, landmark: Parameters) -> Parameters:
    """`1/z' = (1/z)/s`; the filter moves the anchor."""
    return jnp.append(image_plane.scale(factor, landmark[:-1]), landmark[-1])


FRAMED_HOMOGENEOUS = Parametrization(
    name="framed_homogeneous",
    parameters="(x/z, y/z, 1/z), number of an anchor",
    point="T_AF (x/z, y/z, 1) z",
    source="Ceriani et al., 2011",
    size=lambda n: n + 1,
    initialise=initialise,
    transform=transform,
    homogeneous=homogeneous,
    scale=scale,
    anchored=True,
)
