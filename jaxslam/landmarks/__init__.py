"""Landmark parametrizations: one file each, and the table of their names."""

from jaxslam.landmarks.anchored_homogeneous import AnchoredHomogeneous
from jaxslam.landmarks.cartesian import Cartesian
from jaxslam.landmarks.check import check_landmark
from jaxslam.landmarks.framed_homogeneous import FramedHomogeneous
from jaxslam.landmarks.image_plane import ImagePlane
from jaxslam.landmarks.inverse_depth import UnifiedInverseDepth
from jaxslam.landmarks.inverse_depth_to_cartesian import InverseDepthToCartesian
from jaxslam.landmarks.inverse_scaling import InverseScaling
from jaxslam.landmarks.landmark import AbstractLandmark
from jaxslam.landmarks.parallax_angle import ParallaxAngle
from jaxslam.landmarks.sot_normal import SotNormal
from jaxslam.landmarks.unit_homogeneous import UnitHomogeneous

LANDMARKS: dict[str, AbstractLandmark] = {
    landmark.name: landmark
    for landmark in (
        InverseScaling(),
        UnifiedInverseDepth(),
        Cartesian(),
        AnchoredHomogeneous(),
        UnitHomogeneous(),
        FramedHomogeneous(),
        InverseDepthToCartesian(),
        ParallaxAngle(),
        ImagePlane(),
        SotNormal(),
    )
}
"""Every parametrization by its name."""

__all__ = [
    "LANDMARKS",
    "AbstractLandmark",
    "AnchoredHomogeneous",
    "Cartesian",
    "FramedHomogeneous",
    "ImagePlane",
    "InverseDepthToCartesian",
    "InverseScaling",
    "ParallaxAngle",
    "SotNormal",
    "UnifiedInverseDepth",
    "UnitHomogeneous",
    "check_landmark",
]
