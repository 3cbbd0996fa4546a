"""Landmark parametrizations: one file each, and the table of their names."""

from jaxslam.landmarks.cartesian import CARTESIAN
from jaxslam.landmarks.inverse_depth import INVERSE_DEPTH
from jaxslam.landmarks.inverse_scaling import INVERSE_SCALING
from jaxslam.landmarks.parametrization import Parametrization

LANDMARKS: dict[str, Parametrization] = {
    parametrization.name: parametrization
    for parametrization in (INVERSE_SCALING, INVERSE_DEPTH, CARTESIAN)
}

__all__ = ["CARTESIAN", "INVERSE_DEPTH", "INVERSE_SCALING", "LANDMARKS", "Parametrization"]
