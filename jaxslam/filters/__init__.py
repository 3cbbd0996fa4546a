"""Filters: the block-wise EKF, the SLAM models it runs on, and the table of their names."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from jaxslam.filters import information
from jaxslam.filters.bank import Bank, with_directions, with_scales
from jaxslam.filters.depth_particles import DepthParticles, with_depth_particles
from jaxslam.filters.filter import Filter, StagedFilter
from jaxslam.filters.first_estimates import with_first_estimates
from jaxslam.filters.fixed_lag import FixedLag, iterated, with_lag
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
from jaxslam.filters.split_and_merge import SplitAndMerge, with_mixture
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


def scale_gauge(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """The paper's filter in a unit of length of its own, whose size is estimated.

    State `(b̃, θ, ṽ, v_θ, λ, landmarks)`, with lengths `e^λ` metres: what no bearing observes, the
    scale, stays out of the products of velocity and inverse depth.
    """
    return replace(robocentric(rig, landmark, calibration), scale_gauge=True)


def iterated_filter(rig: Rig, landmark: Parametrization, calibration: str) -> FixedLag:
    """The paper's filter, iterated: linearised at the maximum of the posterior of every frame."""
    return iterated(robocentric(rig, landmark, calibration))


def invariant_filter(rig: Rig, landmark: Parametrization, calibration: str) -> SlamFilter:
    """`world` with the right-invariant error: landmarks' errors move with the pose's."""
    return replace(world(rig, landmark, calibration), engine=INVARIANT)


FILTERS: dict[str, Callable[[Rig, Parametrization, str], Filter]] = {
    "robocentric": robocentric,
    "world": world,
    "keyframe": keyframe,
    "information": information_filter,
    "scale_gauge": scale_gauge,
    "iterated": iterated_filter,
    "invariant": invariant_filter,
}


def with_common_depth(base: SlamFilter, percent: int | None) -> SlamFilter:
    """The filter with priors on 1/z that are correlated, in percent; 50 by default.

    Raises ValueError for a correlation of 1, with which all landmarks are as far away as the first.
    """
    correlation = 0.5 if percent is None else percent / 100
    if correlation >= 1:
        raise ValueError(f"a correlation of depths is from 0 to below 1, not {correlation}")
    return replace(base, own_depth=math.sqrt(1 - correlation), common_depth=math.sqrt(correlation))


def with_scene_depth(base: SlamFilter, percent: int | None) -> SlamFilter:
    """The filter that does not know how far away its scene is.

    On top of the prior on 1/z of each landmark stands an error that is common to all, with a σ of
    so many percent of one prior's; 100 by default. The first landmarks teach it to those that
    follow.
    """
    return replace(base, common_depth=1.0 if percent is None else percent / 100)


MODIFIERS: dict[str, Callable[[Any, int | None], Filter]] = {
    "particles": with_depth_particles,
    "rays": with_rays,
    "common": with_common_depth,
    "scene": with_scene_depth,
    "lag": with_lag,
    "iterated": iterated,
    "scales": with_scales,
    "directions": with_directions,
    "mixture": with_mixture,
    "oc": with_observability_constraint,
    "fej": with_first_estimates,
}
"""What `+name` behind a filter's name makes of it, with the number that may follow the name: the
greatest depth of a delayed initialisation, m (`particles`, `rays`); the correlation of depths in
percent (`common`); σ of the scene's depth in percent of one landmark's (`scene`); frames (`lag`);
steps of Gauss–Newton instead of convergence (`iterated`); members of a Gaussian sum (`scales`,
`directions`, `mixture`); none for the remedies `oc`, `fej`."""

_OF_ANY_FILTER = ("iterated", "scales", "directions", "mixture")

RECOMMENDED = {"planar": "scale_gauge+scene50+mixture17", "spatial": "scale_gauge+scene50+mixture9"}
"""The filter called `recommended`, by geometry: of those of docs/consistency.md the one to take
where nothing is known of the motion."""


def make_filters(
    rig: Rig, filters: Iterable[str], landmarks: Iterable[str], calibration: str
) -> dict[str, Filter]:
    """Every named filter on every named parametrization, keyed `filter/landmarks`.

    A filter may be modified: `world+oc`, `world+particles`, `scale_gauge+lag10`. `recommended`
    stands for `RECOMMENDED`. Raises ValueError for a name that is not known, and for a filter and
    a parametrization that do not go together.
    """
    recommended = RECOMMENDED[rig.geometry.name]
    filters = [recommended if name == "recommended" else name for name in filters]
    chosen("filters", [name.partition("+")[0] for name in filters], FILTERS)
    return {
        f"{name}/{landmark.name}": make_filter(rig, name, landmark, calibration)
        for name in filters
        for landmark in chosen("landmarks", landmarks, LANDMARKS).values()
    }


def make_filter(rig: Rig, name: str, landmark: Parametrization, calibration: str) -> Filter:
    """One filter by its name, with its modifiers. Raises ValueError."""
    base, *modifiers = name.split("+")
    made: Any = chosen("filters", [base], FILTERS)[base](rig, landmark, calibration)
    for modifier in modifiers:
        word = modifier.rstrip("0123456789")
        number = modifier[len(word) :]
        modify = chosen("modifiers", [word], MODIFIERS)[word]
        if not isinstance(made, SlamFilter) and word not in _OF_ANY_FILTER:
            raise ValueError(f"in {name} the modifier {word} must stand before those of windows")
        made = modify(made, int(number) if number else None)
    return made


__all__ = [
    "CALIBRATIONS",
    "FILTERS",
    "MODIFIERS",
    "RECOMMENDED",
    "Bank",
    "DepthParticles",
    "Features",
    "Filter",
    "FixedLag",
    "GaussianSum",
    "Innovation",
    "Parameters",
    "SlamFilter",
    "SlamModel",
    "SplitAndMerge",
    "StagedFilter",
    "State",
    "information_filter",
    "invariant_filter",
    "inverse_depth_prior",
    "keyframe",
    "make_filter",
    "make_filters",
    "robocentric",
    "scale_gauge",
    "world",
]
