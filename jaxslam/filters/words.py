"""Words for filters: what the command line, settings and tables of results call them.

A name is a filter and its modifiers in any order, `scale_gauge+scene50+mixture17`. What goes
together is decided by the record (`compatible`); here is only what each word makes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from inspect import signature
from typing import Any

from jaxslam._runtime.lookup import as_list, lookup
from jaxslam.filters.gate import Gate
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.recommended import recommended
from jaxslam.filters.remedies.decoupled import DecoupledInvariant
from jaxslam.filters.remedies.fej2 import ProjectedFirstEstimates
from jaxslam.filters.remedies.first_estimates import FirstEstimates
from jaxslam.filters.remedies.invariant import Invariant
from jaxslam.filters.remedies.observability_constrained import ObservabilityConstrained
from jaxslam.filters.remedies.random_walk import RandomWalk
from jaxslam.filters.rivals.depth_particles import with_depth_particles
from jaxslam.filters.rivals.nodes import with_nodes
from jaxslam.filters.rivals.rays import with_rays
from jaxslam.filters.slam import Piece, Slam
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.frame import Keyframe, Submaps, WorldCentric
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import World, as_scenario

FILTERS: dict[str, Callable[..., Slam]] = {
    "robocentric": Slam,
    "world": partial(Slam, frame=WorldCentric()),
    "keyframe": partial(Slam, frame=Keyframe()),
    "scale_gauge": partial(Slam, scale=ScaleGauge()),
    "world_gauge": partial(Slam, frame=WorldCentric(), scale=ScaleGauge()),
    "invariant": partial(Slam, frame=WorldCentric(), correction=Invariant()),
    "recommended": recommended,
}
"""Filters by name, made of pieces.

- `robocentric`: the paper's, with landmarks in the camera frame and composition after the update.
- `world`: the classical one, in the base frame and composed first.
- `keyframe`: one whose landmarks are in the camera of the current keyframe.
- `scale_gauge`: the paper's in a unit of length of its own, whose size is estimated.
- `world_gauge`: the classical one in such a unit; its covariance is too small in turns.
- `invariant`: the classical one with the right-invariant error, which moves landmarks' with the
  pose's.
- `recommended`: the best that was measured.
"""


def _learning(slam: Slam, **fields: float) -> Slam:
    return replace(slam, depth=replace(slam.depth, **fields))


def _updated(slam: Slam, word: str, **fields: Any) -> Slam:
    if not hasattr(slam.correction, next(iter(fields))):
        raise ValueError(f"{word} does not go with {slam.correction.name}")
    return replace(slam, correction=replace(slam.correction, **fields))


def _with_submaps(slam: Slam, spare: int = 24) -> Slam:
    if not slam.frame.moves_landmarks:
        raise ValueError(
            f"submaps are of the frame robocentric, not of the frame {slam.frame.name}"
        )
    return replace(slam, frame=Submaps(spare))


def _from_window(slam: Slam, frames: int | None = None) -> Slam:
    return replace(slam, start=FromWindow(Schedule.of(slam.motion.geometry, frames)))


MODIFIERS: dict[str, Callable[..., AbstractFilter]] = {
    "scene": lambda slam, percent=100: _learning(slam, common=percent / 100),
    "walk": lambda slam, percent=3: _learning(slam, walk=percent / 100),
    "fej": lambda slam: replace(slam, correction=FirstEstimates()),
    "fej2": lambda slam: replace(slam, correction=ProjectedFirstEstimates()),
    "decoupled": lambda slam: replace(slam, correction=DecoupledInvariant()),
    "oc": lambda slam, steps=1: replace(slam, correction=ObservabilityConstrained(steps)),
    "iterated": lambda slam, steps=5: _updated(slam, "iterated", steps=steps),
    "mean": lambda slam: _updated(slam, "mean", mean=True),
    "drift": lambda slam, percent=10: replace(
        slam, correction=RandomWalk(slam.correction, percent / 100)
    ),
    "directions": lambda slam, count=5: replace(slam, mixture=Mixture(count, split=False)),
    "mixture": lambda slam, count=9: replace(slam, mixture=Mixture(count)),
    "rest": _from_window,
    "submaps": _with_submaps,
    "checked": lambda slam, percent=150: replace(slam, gate=Gate(tolerance=percent / 100)),
    "particles": with_depth_particles,
    "rays": with_rays,
    "nodes": with_nodes,
}
"""What `+name` behind a filter's name makes of it, in the order of this table, whatever the order
of the name. Its piece takes the place of the filter's own: in `recommended+directions` that of the
recommended mixture. The number that may follow the name is

- `scene`: σ of an error that is common to all priors on depth, in percent of one landmark's;
- `walk`: σ by which that error, which it needs, changes from frame to frame, in percent of the
  same;
- `fej`, `fej2`, `decoupled`: none;
- `oc`, `iterated`: the steps of Gauss–Newton in an update; `mean`: none;
- `drift`: by how much a landmark drifts between frames, in percent of a measurement's σ;
- `directions`: the members of a Gaussian sum; `mixture`: the most members of one that is split;
- `rest`: the frames of the longest window of a start;
- `submaps`: the slots for landmarks out of view until their submap ends;
- `checked`: by how much a match may be off beyond its noise, in percent of that;
- `particles`, `rays`: the greatest depth of a delayed initialisation, m;
- `nodes`: the parallax after which a node of a map of nodes ends, %.
"""


def make_filter(name: str, **pieces: Piece) -> AbstractFilter:
    """One filter by its name, with its modifiers, of pieces as `Slam` takes them.

    The `landmark` may be named. Raises ValueError for a name that is not known, a piece that is
    missing, and what does not go together.
    """
    if missing := [piece for piece in ("motion", "sensor") if piece not in pieces]:
        raise ValueError(
            f"make_filter lacks {', '.join(missing)}; the pieces of Slam are accepted, or "
            "make_filters(scenario, filters, landmarks) makes them of a scenario"
        )
    if isinstance(named := pieces.get("landmark"), str):
        pieces["landmark"] = lookup("landmark", named, LANDMARKS)[named]
    base, *modifiers = name.split("+")
    make = lookup("filters", [base], FILTERS)[base]
    parsed = sorted(map(_parsed, modifiers), key=lambda one: list(MODIFIERS).index(one[0]))
    _check_one_of_each([base, *(word for word, _ in parsed)])
    made: AbstractFilter = make(**pieces)
    for word, given in parsed:
        made = MODIFIERS[word](made, *given)
    return made


_ONE_OF = {
    "correction": ("invariant", "fej", "fej2", "oc", "decoupled"),
    "sum of Gaussians": ("directions", "mixture"),
    "delayed initialisation": ("particles", "rays"),
}
"""Words of which a name has at most one, and what each of them is."""


def _check_one_of_each(words: list[str]) -> None:
    """Raise ValueError for a word that is there twice, or beside one that says the same piece."""
    for what, those in (*_ONE_OF.items(), *((word, (word,)) for word in MODIFIERS)):
        found = [word for word in words if word in those]
        if len(found) > 1:
            raise ValueError(f"a filter has one {what}, not {' and '.join(found)}")


def _parsed(modifier: str) -> tuple[str, list[int]]:
    """The word of a modifier, and its number where there is one. Raises ValueError."""
    word = modifier if modifier in MODIFIERS else modifier.rstrip("0123456789.,-%")
    number = modifier[len(word) :]
    if number and not (word and number.isdecimal()):
        raise ValueError(f"a modifier takes a whole number behind its name, not as {modifier!r}")
    lookup("modifiers", [word], MODIFIERS)
    if number and len(signature(MODIFIERS[word]).parameters) < 2:
        raise ValueError(f"modifier {word} takes no number, not {number}")
    return word, [int(number)] if number else []


def make_filters(
    scenario: World | str,
    filters: str | Iterable[str],
    landmarks: str | Iterable[str] = "inverse_scaling",
    calibration: str | None = None,
) -> dict[str, AbstractFilter]:
    """Every named filter on every named parametrization, keyed `filter/landmarks`; one that is
    named so, as `robocentric/inverse_depth`, on that alone.

    Their numbers are the scenario's, which may be given by name; one name may be given without a
    list. A filter may be modified: `world+oc`, `scale_gauge+mixture9`. The calibration is treated
    as the scenario says, unless another treatment is named. Raises ValueError.
    """
    scenario, names = as_scenario(scenario), [name.partition("/") for name in as_list(filters)]
    lookup("filters", [name.partition("+")[0] for name, _, _ in names], FILTERS)
    pieces = scenario_pieces(scenario, calibration)
    return {
        f"{name}/{landmark.name}": make_filter(name, landmark=landmark, **pieces)
        for name, _, own in names
        for landmark in lookup("landmarks", own or landmarks, LANDMARKS).values()
    }


def scenario_pieces(scenario: World, calibration: str | None = None) -> dict[str, Piece]:
    """The pieces of a filter that fits the scenario, as `Slam` takes them. Raises ValueError."""
    word = scenario.treatment if calibration is None else calibration
    treatment = lookup("calibration", [word], TREATMENTS)[word]
    return {
        "motion": scenario.motion,
        "sensor": scenario.sensor,
        "calibration": treatment(scenario.calibration.sigma),
        "depth": scenario.depth,
    }
