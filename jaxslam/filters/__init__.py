"""Filters: the block-wise EKF, the SLAM models it runs on, and the table of their names."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from jaxslam.filters import information
from jaxslam.filters.frames import KEYFRAME, ROBOCENTRIC, WORLD
from jaxslam.filters.slam import (
    CALIBRATIONS,
    Parameters,
    SlamFilter,
    SlamModel,
    inverse_depth_prior,
)
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.landmarks import LANDMARKS, Parametrization
from jaxslam.names import chosen
from jaxslam.rig import Rig


def robocentric(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """The paper's filter: landmarks in the camera frame, composition after the update."""
    return SlamFilter(SlamModel(rig, landmark, ROBOCENTRIC), calibration)


def world(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """The classical filter: landmarks in the base frame, prediction composed first."""
    return SlamFilter(SlamModel(rig, landmark, WORLD), calibration, compose_first=True)


def keyframe(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """Landmarks in the camera of the current keyframe, prediction composed first."""
    return SlamFilter(SlamModel(rig, landmark, KEYFRAME), calibration, compose_first=True)


def information_filter(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """`keyframe` in information form: the same estimates by sparse, additive updates.

    Raises ValueError for landmarks with redundant parameters, whose covariance has no inverse,
    and for a calibration to `consider`.
    """
    n = rig.geometry.point_dim
    if landmark.size(n) != n:
        minimal = ", ".join(p.name for p in LANDMARKS.values() if p.size(n) == n)
        raise ValueError(
            f"filter information needs landmarks of {n} parameters ({minimal}), not {landmark.name}"
        )
    if calibration == "consider":
        raise ValueError("filter information cannot consider its calibration: estimate it")
    return replace(keyframe(rig, landmark, calibration), engine=information)


FILTERS: dict[str, Callable[[Rig, Parametrization, str], SlamFilter]] = {
    "robocentric": robocentric,
    "world": world,
    "keyframe": keyframe,
    "information": information_filter,
}


def make_filters(
    rig: Rig, filters: Iterable[str], landmarks: Iterable[str], calibration: str
) -> dict[str, SlamFilter]:
    """Every named filter on every named parametrization, keyed `filter/landmarks`.

    Raises ValueError for a name that is not known.
    """
    return {
        f"{name}/{landmark.name}": make(rig, landmark, calibration)
        for name, make in chosen("filters", filters, FILTERS).items()
        for landmark in chosen("landmarks", landmarks, LANDMARKS).values()
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
    "information_filter",
    "inverse_depth_prior",
    "keyframe",
    "make_filters",
    "robocentric",
    "world",
]
