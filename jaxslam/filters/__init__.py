"""Filters: the block-wise EKF, the SLAM models it runs on, and the table of their names."""

from collections.abc import Callable

from jaxslam.filters.slam import (
    CALIBRATIONS,
    ROBOCENTRIC,
    WORLD,
    Parameters,
    SlamFilter,
    SlamModel,
    inverse_depth_prior,
)
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import Geometry
from jaxslam.landmarks import Parametrization


def robocentric(geometry: Geometry, landmark: Parametrization, calibration: str) -> SlamFilter:
    """The paper's filter: landmarks in the camera frame, composition after the update."""
    return SlamFilter(SlamModel(geometry, landmark, ROBOCENTRIC), calibration)


def world(geometry: Geometry, landmark: Parametrization, calibration: str) -> SlamFilter:
    """The classical filter: landmarks in the base frame, prediction composed first."""
    return SlamFilter(SlamModel(geometry, landmark, WORLD), calibration, compose_first=True)


FILTERS: dict[str, Callable[[Geometry, Parametrization, str], SlamFilter]] = {
    "robocentric": robocentric,
    "world": world,
}

__all__ = [
    "CALIBRATIONS",
    "FILTERS",
    "Features",
    "Innovation",
    "Parameters",
    "SlamFilter",
    "SlamModel",
    "State",
    "inverse_depth_prior",
    "robocentric",
    "world",
]
