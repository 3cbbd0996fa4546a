"""Landmark parametrizations: one file each, and the table of their names."""

from jaxslam.landmarks.anchored_homogeneous import ANCHORED_HOMOGENEOUS
from jaxslam.landmarks.cartesian import CARTESIAN
from jaxslam.landmarks.check import check_landmark
from jaxslam.landmarks.framed_homogeneous import FRAMED_HOMOGENEOUS
from jaxslam.landmarks.image_plane import IMAGE_PLANE
from jaxslam.landmarks.inverse_depth import INVERSE_DEPTH
from jaxslam.landmarks.inverse_depth_to_cartesian import INVERSE_DEPTH_TO_CARTESIAN
from jaxslam.landmarks.inverse_scaling import INVERSE_SCALING
from jaxslam.landmarks.parallax_angle import PARALLAX_ANGLE
from jaxslam.landmarks.parametrization import Parametrization
from jaxslam.landmarks.unit_homogeneous import UNIT_HOMOGENEOUS

LANDMARKS: dict[str, Parametrization] = {
    parametrization.name: parametrization
    for parametrization in (
        INVERSE_SCALING,
        INVERSE_DEPTH,
        CARTESIAN,
        ANCHORED_HOMOGENEOUS,
        UNIT_HOMOGENEOUS,
        FRAMED_HOMOGENEOUS,
        INVERSE_DEPTH_TO_CARTESIAN,
        PARALLAX_ANGLE,
        IMAGE_PLANE,
    )
}
"""Every parametrization by its name."""

__all__ = [
    "ANCHORED_HOMOGENEOUS",
    "CARTESIAN",
    "FRAMED_HOMOGENEOUS",
    "IMAGE_PLANE",
    "INVERSE_DEPTH",
    "INVERSE_DEPTH_TO_CARTESIAN",
    "INVERSE_SCALING",
    "LANDMARKS",
    "PARALLAX_ANGLE",
    "UNIT_HOMOGENEOUS",
    "Parametrization",
    "check_landmark",
]
