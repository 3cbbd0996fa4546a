"""Tests of the names that users give: of filters, of parametrizations, and what is refused."""

import itertools
import operator
import pickle
import re
from dataclasses import replace
from typing import Any

import cloudpickle
import jax
import pytest
from cases import a_filter, each_geometry, named

from jaxslam.filters.gate import Gate
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.recommended import recommended
from jaxslam.filters.remedies.observability_constrained import ObservabilityConstrained
from jaxslam.filters.remedies.random_walk import RandomWalk
from jaxslam.filters.slam import Slam
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.filters.words import FILTERS, MODIFIERS, make_filter, make_filters, scenario_pieces
from jaxslam.geometry import PLANAR
from jaxslam.landmarks import LANDMARKS, InverseScaling
from jaxslam.models.calibration import Known
from jaxslam.models.frame import Keyframe, Submaps, WorldCentric
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import scenario


def test_filters_are_made_of_every_pair_of_names():
    frames = ["robocentric", "world", "keyframe"]
    made: Any = make_filters("matched", frames, LANDMARKS, "known")
    assert list(made) == [f"{name}/{landmark}" for name in frames for landmark in LANDMARKS]
    for name, slam in made.items():
        assert name == f"{slam.frame.name}/{slam.landmark.name}"
        assert slam.calibration == Known()
    (one,) = make_filters("matched", "robocentric", "inverse_scaling", "known").items()
    assert one == ("robocentric/inverse_scaling", made["robocentric/inverse_scaling"])
    own = make_filters("matched", ["robocentric/cartesian", "world"], ["inverse_depth"])
    assert [*own] == ["robocentric/cartesian", "world/inverse_depth"]
    with pytest.raises(ValueError, match=r"unknown landmarks 'cartesion'.*did you mean cartesian"):
        make_filters("matched", "world/cartesion")


@pytest.mark.parametrize(
    ("filters", "landmarks", "calibration", "message"),
    [
        (["wrold"], ["cartesian"], "known", r"unknown filters 'wrold' \(did you mean world\?\); k"),
        (["world"], ["cartesain"], "known", r"landmarks 'cartesain' \(did you mean cartesian\?\)"),
        ([], ["cartesian"], "known", "filters needs at least one name; known: robocentric, world"),
        (["world"], [], "known", "landmarks needs at least one name; known: inverse_scaling"),
        (["world"], ["cartesian"], "maybe", "unknown calibration 'maybe'; known: white, consider"),
        ("world+particle", "cartesian", None, r"modifiers 'particle' \(did you mean particles\?\)"),
        ("world+", "cartesian", None, "unknown modifiers ''"),
        ("world+lag", "cartesian", None, "unknown modifiers 'lag'"),
        *(
            (f"robocentric+mixture+scene{number}", "cartesian", None, f"not as 'scene{number}'")
            for number in ("3.5", "-5")
        ),
        ("world+mixture+5", "cartesian", None, "a whole number behind its name, not as '5'"),
        ("world+mean2", "cartesian", None, "modifier mean takes no number, not 2"),
        ("world+oc0", "cartesian", None, "at least 1 step of Gauss–Newton, not 0"),
        ("world+directions2", "cartesian", None, "at least 3 members, not 2"),
        ("world+rays0", "cartesian", None, "depths need 0 < nearest < farthest"),
        ("world+rays", "inverse_scaling", None, "cartesian"),
        ("world+particles", "inverse_scaling", None, "cartesian"),
        ("world+scene+scene50", "cartesian", None, "a filter has one scene, not scene and scene"),
        ("world+fej", "framed_homogeneous", None, "written in one form, in themselves"),
        ("world+fej", "parallax_angle", None, "written in one form, in themselves"),
        ("world_gauge+fej", "cartesian", None, "fej is for filters in metres, without a scale"),
        ("robocentric+fej", "cartesian", None, "fej is for world-centric filters: a robocentric"),
        ("world+fej3", "cartesian", None, "modifier fej takes no number, not 3"),
        ("world+decoupled2", "cartesian", None, "modifier decoupled takes no number, not 2"),
        ("invariant+fej2", "cartesian", None, "one correction, not invariant and fej2"),
        ("keyframe+oc", "cartesian", None, "oc is not for keyframe filters, whose unobservable"),
        ("invariant+oc", "cartesian", None, "one correction, not invariant and oc"),
        ("world+mixture", "parallax_angle", None, "is split cannot switch the form of parallax"),
        ("robocentric+submaps", "framed_homogeneous", None, "submaps are of landmarks without an"),
        ("world+mixture+rest", "framed_homogeneous", None, "start from a window is without anch"),
        ("world+mixture+rest1", "cartesian", None, r"windows of 3 frames and more .*not \(2,\)"),
    ],
)
def test_what_is_not_known_or_does_not_go_together_is_refused(
    filters, landmarks, calibration, message
):
    with pytest.raises(ValueError, match=message):
        make_filters("matched", filters, landmarks, calibration)


ODOMETRY = {"motion": "odometry", "odometry_sigma": [0.1] * 3}


@pytest.mark.parametrize(
    ("scenario_fields", "name", "message"),
    [
        (ODOMETRY, "scale_gauge", "a scale gauge is for a camera whose velocity is estimated"),
        (ODOMETRY, "world+mixture", "a mixture divides a velocity: Odometry has none"),
        ({"sensor": "position"}, "world+mixture+rest", "is for a camera; Position measures metres"),
        ({"sensor": "position"}, "world+particles", "finds a depth, which Position measures"),
    ],
)
def test_what_the_motion_or_the_sensor_excludes_is_refused(scenario_fields, name, message):
    with pytest.raises(ValueError, match=message):
        make_filters(scenario("matched", scenario_fields), name, "cartesian")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("piece", "wanted"),
    [("calibration", "AbstractCalibration"), ("scale", "AbstractScale"), ("gate", "Gate")],
)
def test_what_is_no_piece_is_refused(piece, wanted):
    with pytest.raises(ValueError, match=f"{piece} is an instance of {wanted}, not 'feet'"):
        a_filter(PLANAR, **{piece: "feet"})


DELAYED = "delayed initialisation|switch the form of ray|needs landmarks that are written"
ONE = ("fej", "fej2", "decoupled", "oc")
IN_WORLD = (
    ({"submaps"}, "submaps are of the frame robocentric, not of the frame world"),
    *(({*pair}, "a filter has one correction, not ") for pair in itertools.combinations(ONE, 2)),
    *(
        pair
        for word in ("fej", "fej2", "decoupled")
        for pair in (
            ({word, "iterated"}, f"iterated does not go with {word}"),
            ({word, "mixture"}, f"a mixture that is split does not go with {word}"),
        )
    ),
    *(({word, "mean"}, f"mean does not go with {word}") for word in ONE),
    ({"directions", "mixture"}, "a filter has one sum of Gaussians, not directions and mixture"),
    *(
        ({word, late}, DELAYED)
        for late in ("particles", "rays")
        for word in MODIFIERS
        if word != late
    ),
    ({"nodes"}, "nodes take the place of all pieces but these: robocentric"),
)
"""What a world-centric filter of Cartesian landmarks cannot be, and what it is told; and a start
from a window is of a mixture."""


def made_or_told(name, landmark="cartesian"):
    """The filter, or why there is none."""
    try:
        return make_filter(name, landmark=landmark, **scenario_pieces(scenario("matched")))
    except ValueError as error:
        return str(error)


@pytest.mark.parametrize("base", ["world", "scale_gauge", "recommended"])
def test_words_in_any_order_are_the_same_filter(base):
    """Or the same refusal: of every pair; and by which, in a world-centric filter."""
    for words in itertools.combinations(MODIFIERS, 2):
        one, other = (made_or_told("+".join([base, *p])) for p in itertools.permutations(words))
        assert bool(one == other), (base, words, one, other)
        assert isinstance(one, str | AbstractFilter)
        if base == "world":
            told = [why for which, why in IN_WORLD if which <= {*words}]
            if "rest" in words and "mixture" not in words:
                told.append("a start from a window is of a mixture that is split")
            if "walk" in words and "scene" not in words:
                told.append("walk is that of a common error of depths: give its σ, common, too")
            assert isinstance(one, str) == bool(told), (words, one)
            assert not told or re.search("|".join(told), one), (words, one)


def test_words_are_pieces():
    pieces = scenario_pieces(scenario("matched"))
    slam = Slam(**pieces, frame=WorldCentric(), correction=ObservabilityConstrained(3))
    assert made_or_told("world+oc+iterated3", InverseScaling()) == slam
    assert made_or_told("world+iterated3+oc", InverseScaling()) == slam
    submaps = Slam(**pieces, frame=Submaps(spare=8, history=1, turn=0.5, parallax=0.5))
    assert made_or_told("robocentric+submaps8", InverseScaling()) == submaps
    assert submaps.frame == Submaps(8, 1)
    assert getattr(made_or_told("world+particles20"), "farthest", None) == 20
    nodes = made_or_told("robocentric+nodes30", "image_plane")
    assert getattr(nodes, "left", None) == Keyframe(0.5, 0.3)
    drifting = RandomWalk(ObservabilityConstrained(), 0.3)
    names = ["scale_gauge", "drift30", "mixture3", "oc", "checked", "rest8", "scene50"]
    slam = Slam(
        **pieces | {"depth": replace(pieces["depth"], common=0.5)},
        scale=ScaleGauge(), correction=drifting, mixture=Mixture(3),
        start=FromWindow(Schedule.of(PLANAR, 8)), gate=Gate(),
    )  # fmt: skip
    assert made_or_told("+".join(names), InverseScaling()) == slam
    walks = replace(slam, depth=replace(slam.depth, walk=0.03))
    assert made_or_told("+".join([*names, "walk"]), InverseScaling()) == walks
    assert slam != replace(slam, gate=None) != replace(slam, gate=None, mixture=Mixture(5))


@pytest.mark.parametrize("told", [True, False], ids=["told", "from rest"])
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_recommended_is_a_record(geometry, told):
    """Another one where the velocity is not told, and in space."""
    planar = geometry is PLANAR
    chosen = ("matched" if told else "standstill") + ("" if planar else "-6dof")
    spelt = {
        (True, True): "scale_gauge+oc+scene50+walk3+mixture17",
        (True, False): "scale_gauge+oc+scene50+walk3+mixture9",
        (False, True): "scale_gauge+oc+scene50+mixture5+rest",
        (False, False): "scale_gauge+oc+scene50+mixture3+rest8",
    }[told, planar]
    one, other = make_filters(chosen, ["recommended", spelt]).values()
    assert one == other
    drifting = make_filters(chosen, ["recommended+drift", f"{spelt}+drift"]).values()
    assert operator.eq(*drifting)


ODOMETRY = "robocentric+scene50+walk3+iterated6+mean"


@pytest.mark.parametrize(
    ("name", "spelt"),
    [("room", ODOMETRY), ("laps-6dof", ODOMETRY), ("positions", "robocentric")],
)
def test_recommended_has_no_sum_where_metres_are_known(name, spelt):
    landmark = "cartesian" if name == "positions" else "inverse_scaling"
    one, other = make_filters(name, ["recommended", spelt], landmark).values()
    assert one == other
    assert recommended(**scenario_pieces(scenario(name))).landmark.name == landmark


def test_a_velocity_is_told_that_is_3_sigma_from_rest():
    """√3 σ, along itself: across it the direction is known the less, the speed not."""
    sensor = scenario_pieces(scenario("matched"))["sensor"]

    def start(sigma):
        return recommended(ConstantVelocity([0.1] * 3, [0.0, 1.0, 0.0], sigma), sensor).start

    assert start([5.0, 0.33, 5.0]) is None
    assert start([0.0, 0.34, 0.0]) == FromWindow(Schedule.of(PLANAR))


def journeys(slam):
    """The filter after a pickle, and after one of cloudpickle."""
    return [library.loads(library.dumps(slam)) for library in (pickle, cloudpickle)]


def test_every_filter_survives_a_pickle():
    """With an equal value and an equal tree, so that it is the same to a compiled program."""
    names = [*FILTERS, *(f"{base}+{word}" for base in FILTERS for word in MODIFIERS)]
    names += ["scale_gauge+oc+scene50+drift+mixture3+rest8+submaps+checked"]
    filters = [slam for name in names if not isinstance(slam := made_or_told(name), str)]
    filters += [made_or_told("robocentric", landmark) for landmark in LANDMARKS]
    filters += [made_or_told("robocentric+nodes", "image_plane")]
    assert len(filters) > 60
    for slam in filters:
        for again in journeys(slam):
            assert again == slam
            assert jax.tree.structure(again) == jax.tree.structure(slam)
            assert hash(jax.tree.structure(again)) == hash(jax.tree.structure(slam))
