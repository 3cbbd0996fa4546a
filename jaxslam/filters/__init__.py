"""Filters: the block-wise EKF, the SLAM models it runs on, and the table of their names."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from jaxslam.filters import information
from jaxslam.filters.depth_particles import DepthParticles, with_depth_particles
from jaxslam.filters.first_estimates import with_first_estimates
from jaxslam.filters.frames import KEYFRAME, ROBOCENTRIC, WORLD
from jaxslam.filters.gaussian_sum import GaussianSum, with_rays
from jaxslam.filters.invariant import INVARIANT
from jaxslam.filters.observability_constrained import with_observability_constraint
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


def invariant_filter(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """`world` with the right-invariant error: landmarks' errors move with the pose's."""
    return replace(world(rig, landmark, calibration), engine=INVARIANT)


FILTERS: dict[str, Callable[[Rig, Parametrization, str], SlamFilter]] = {
    "robocentric": robocentric,
    "world": world,
    "keyframe": keyframe,
    "information": information_filter,
    "invariant": invariant_filter,
}


MODIFIERS: dict[str, Callable[[SlamFilter, int | None], SlamFilter]] = {
    "particles": with_depth_particles,
    "rays": with_rays,
    "oc": with_observability_constraint,
    "fej": with_first_estimates,
}
"""What `+name` behind a filter's name makes of it, with the number that may follow the name:
the greatest depth of a delayed initialisation, m; none for the consistency remedies."""


def make_filters(
    rig: Rig, filters: Iterable[str], landmarks: Iterable[str], calibration: str
) -> dict[str, SlamFilter]:
    """Every named filter on every named parametrization, keyed `filter/landmarks`.

    A filter may be modified: `world+oc`, `world+particles`, `robocentric+rays100`. Raises
    ValueError for a name that is not known, and for a filter and a parametrization that do not go
    together.
    """
    filters = list(filters)
    chosen("filters", [name.partition("+")[0] for name in filters], FILTERS)
    return {
        f"{name}/{landmark.name}": make_filter(rig, name, landmark, calibration)
        for name in filters
        for landmark in chosen("landmarks", landmarks, LANDMARKS).values()
    }


def make_filter(rig: Rig, name: str, landmark: Parametrization, calibration: str) -> SlamFilter:
    """One filter by its name, with its modifiers. Raises ValueError."""
    base, *modifiers = name.split("+")
    made = chosen("filters", [base], FILTERS)[base](rig, landmark, calibration)
    for modifier in modifiers:
        word = modifier.rstrip("0123456789")
        number = modifier[len(word) :]
        modify = chosen("modifiers", [word], MODIFIERS)[word]
        made = modify(made, int(number) if number else None)
    return made


__all__ = [
    "CALIBRATIONS",
    "FILTERS",
    "MODIFIERS",
    "DepthParticles",
    "Features",
    "GaussianSum",
    "Innovation",
    "Parameters",
    "SlamFilter",
    "SlamModel",
    "State",
    "information_filter",
    "invariant_filter",
    "inverse_depth_prior",
    "keyframe",
    "make_filter",
    "make_filters",
    "robocentric",
    "world",
]
