"""Words for filters: what the command line, settings and tables of results call them.

A name is a filter and its modifiers, `scale_gauge+scene50+mixture17`. What goes together is decided
by the objects; here is only what each word makes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from jaxslam._runtime.lookup import as_list, lookup
from jaxslam.filters.association import TOLERANCE
from jaxslam.filters.ekf import EkfSlam, check_one_gaussian
from jaxslam.filters.forms.correction import AbstractCorrection, Standard
from jaxslam.filters.forms.covariance import Covariance
from jaxslam.filters.forms.drift import Drifting
from jaxslam.filters.forms.first_estimates import FirstEstimates
from jaxslam.filters.forms.invariant import Invariant
from jaxslam.filters.forms.observability_constrained import ObservabilityConstrained
from jaxslam.filters.initialisation.depth_particles import with_depth_particles
from jaxslam.filters.initialisation.rays import with_rays
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.submaps.handover import SPARE, with_submaps
from jaxslam.filters.wrappers.batch_initialisation import from_rest
from jaxslam.filters.wrappers.fixed_lag import LAG, FixedLag
from jaxslam.filters.wrappers.gated import Gated
from jaxslam.filters.wrappers.gaussian_sum import GaussianSum
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.coordinates import KEYFRAME, WORLD
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import World, as_scenario

Piece = Any
"""Of a filter, as `EkfSlam` takes it: `motion`, `sensor`, `landmark`, `calibration`, `depth`."""


FILTERS: dict[str, Callable[..., AbstractFilter]] = {
    "robocentric": EkfSlam,
    "world": partial(EkfSlam, coordinates=WORLD),
    "keyframe": partial(EkfSlam, coordinates=KEYFRAME),
    "scale_gauge": partial(EkfSlam, scale=ScaleGauge()),
    "world_gauge": partial(EkfSlam, coordinates=WORLD, scale=ScaleGauge()),
    "invariant": partial(EkfSlam, coordinates=WORLD, form=Covariance(Invariant())),
}
"""By name, of pieces: the paper's filter, with landmarks in the camera frame and composition after
the update (`robocentric`); the classical one, in the base frame and composed first (`world`); one
in the camera of the current keyframe (`keyframe`); the paper's in a unit of length of its own,
whose size is estimated (`scale_gauge`), and the classical one so, whose covariance is too small
where the camera turns (`world_gauge`); the classical one with the right-invariant error: landmarks'
errors move with the pose's (`invariant`)."""


def with_scene_depth(slam: EkfSlam, percent: int | None) -> EkfSlam:
    """The filter that does not know how far away its scene is.

    On top of the prior on 1/z of each landmark stands an error that is common to all, with a σ of
    so many percent of one prior's; 100 by default. The first landmarks teach it to those that
    follow.
    """
    common = 1.0 if percent is None else percent / 100
    return replace(slam, depth=replace(slam.depth, common=common))


def with_observability_constraint(slam: EkfSlam, steps: int | None) -> EkfSlam:
    """The filter whose covariance is carried along the gauge, after each of so many steps of
    Gauss–Newton in an update; 1 by default, as an EKF has. Raises ValueError."""
    oc = ObservabilityConstrained() if steps is None else ObservabilityConstrained(steps)
    return _with_correction("oc", oc)(slam, None)


def with_drift(slam: EkfSlam, percent: int | None) -> EkfSlam:
    """The filter that knows its landmarks to drift, between two frames by so many percent of the σ
    of a measurement; 10 by default."""
    share = 0.1 if percent is None else percent / 100
    return replace(slam, form=Covariance(Drifting(slam.gaussian_form.correction, share)))


def _with_correction(
    word: str, correction: AbstractCorrection
) -> Callable[[EkfSlam, int | None], EkfSlam]:
    def corrected(slam: EkfSlam, number: int | None) -> EkfSlam:
        if number is not None:
            raise ValueError(f"modifier {word} takes no number, not {number}")
        if not slam.form.plain:
            raise ValueError(f"{word} is for the plain EKF in covariance form")
        return replace(slam, form=Covariance(correction))

    return corrected


def iterated(slam: EkfSlam, steps: int | None) -> EkfSlam:
    """The iterated EKF, of so many steps of Gauss–Newton in an update; 5 by default. Raises
    ValueError."""
    check_one_gaussian(slam, "an iterated filter")
    return replace(slam, form=Covariance(Standard(5 if steps is None else steps)))


_OF_ONE_FILTER: dict[str, Callable[[EkfSlam, int | None], EkfSlam]] = {
    "particles": with_depth_particles,
    "rays": with_rays,
    "scene": with_scene_depth,
    "oc": with_observability_constraint,
    "fej": _with_correction("fej", FirstEstimates()),
    "iterated": iterated,
    "drift": with_drift,
}
_AROUND_ANY_FILTER: dict[str, Callable[..., AbstractFilter]] = {
    "lag": lambda slam, frames: FixedLag(slam, LAG if frames is None else frames),
    "directions": lambda slam, count: GaussianSum(slam, 5 if count is None else count, split=False),
    "mixture": lambda slam, count: GaussianSum(slam, 9 if count is None else count),
    "rest": from_rest,
    "submaps": lambda slam, spare: with_submaps(slam, SPARE if spare is None else spare),
    "checked": lambda slam, percent: Gated(
        slam, tolerance=TOLERANCE if percent is None else percent / 100
    ),
}
MODIFIERS: dict[str, Callable[..., AbstractFilter]] = {**_OF_ONE_FILTER, **_AROUND_ANY_FILTER}
"""What `+name` behind a filter's name makes of it, with the number that may follow the name: the
greatest depth of a delayed initialisation, m (`particles`, `rays`); σ of the scene's depth in
percent of one landmark's (`scene`); frames (`lag`); steps of Gauss–Newton in an update (`iterated`,
`oc`); members of a Gaussian sum (`directions`, of a `mixture` at the most); frames of the longest
window of a start (`rest`); slots for landmarks out of view until their submap ends (`submaps`); by
how much a match may be off beyond its noise, in percent of that (`checked`); by how much a landmark
drifts between frames, in percent of the same (`drift`); none for the remedy `fej`."""

RECOMMENDED = {"planar": "scale_gauge+scene50+mixture17", "spatial": "scale_gauge+scene50+mixture9"}
"""The filter called `recommended`, by geometry, where the velocity is given."""
FROM_REST = {
    "planar": "scale_gauge+scene50+mixture5+rest",
    "spatial": "scale_gauge+oc+scene50+mixture3+rest8",
}
"""The one where it is not: the camera starts from rest, or its velocity is unknown."""
ON_VIDEO = FROM_REST["spatial"].replace("+mixture", "+drift+mixture")
"""The one of the tracker: what is measured are patches."""


def recommended_name(motion: AbstractMotion) -> str:
    """The filter called `recommended`, one of docs/consistency.md and docs/from-rest.md: for a
    velocity whose mean is less than 3 σ of it, a filter that looks for itself."""
    geometry = motion.geometry
    if not motion.has_velocity:
        return RECOMMENDED[geometry.name]
    mean, root = (np.asarray(x)[: geometry.point_dim] for x in motion.start())
    told = mean @ mean > 3 * np.linalg.norm(mean @ root)
    return (RECOMMENDED if told else FROM_REST)[geometry.name]


def make_filter(name: str, **pieces: Piece) -> AbstractFilter:
    """One filter by its name, with its modifiers, of pieces as `EkfSlam` takes them.

    The `landmark` may be named. Raises ValueError for a name that is not known, a piece that is
    missing, and what does not go together.
    """
    if missing := [piece for piece in ("motion", "sensor") if piece not in pieces]:
        raise ValueError(
            f"make_filter lacks {', '.join(missing)}; the pieces of EkfSlam are accepted, or "
            "make_filters(scenario, filters, landmarks) makes them of a scenario"
        )
    if isinstance(named := pieces.get("landmark"), str):
        pieces["landmark"] = lookup("landmark", named, LANDMARKS)[named]
    base, *modifiers = _spelt_out(name, pieces["motion"]).split("+")
    made: AbstractFilter = lookup("filters", [base], FILTERS)[base](**pieces)
    for modifier in modifiers:
        word = modifier.rstrip("0123456789")
        number = modifier[len(word) :]
        modify = lookup("modifiers", [word], MODIFIERS)[word]
        if word in _OF_ONE_FILTER and not isinstance(made, EkfSlam):
            raise ValueError(f"in {name} the modifier {word} must stand before those of windows")
        made = modify(made, int(number) if number else None)
    return made


def _spelt_out(name: str, motion: AbstractMotion) -> str:
    """The name with `recommended_name` in the place of `recommended`."""
    base, plus, modifiers = name.partition("+")
    return (recommended_name(motion) if base == "recommended" else base) + plus + modifiers


def make_filters(
    scenario: World | str,
    filters: str | Iterable[str],
    landmarks: str | Iterable[str],
    calibration: str | None = None,
) -> dict[str, AbstractFilter]:
    """Every named filter on every named parametrization, keyed `filter/landmarks`.

    Their numbers are the scenario's, which may be given by name; one name may be given without a
    list. A filter may be modified: `world+oc`, `scale_gauge+lag10`;
    `recommended` stands for `recommended_name`. The calibration is treated as the scenario says,
    unless another treatment is named. Raises ValueError.
    """
    scenario = as_scenario(scenario)
    names = [_spelt_out(name, scenario.motion) for name in as_list(filters)]
    lookup("filters", [name.partition("+")[0] for name in names], FILTERS)
    return {
        f"{name}/{landmark.name}": make_filter(
            name, landmark=landmark, **scenario_pieces(scenario, calibration)
        )
        for name in names
        for landmark in lookup("landmarks", landmarks, LANDMARKS).values()
    }


def scenario_pieces(scenario: World, calibration: str | None = None) -> dict[str, Piece]:
    """The pieces of a filter that fits the scenario, as `EkfSlam` takes them. Raises ValueError."""
    word = scenario.treatment if calibration is None else calibration
    treatment = lookup("calibration", [word], TREATMENTS)[word]
    return {
        "motion": scenario.motion,
        "sensor": scenario.sensor,
        "calibration": treatment(scenario.calibration.sigma),
        "depth": scenario.depth,
    }
