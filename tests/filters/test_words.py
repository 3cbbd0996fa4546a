"""Tests of the names that users give: of filters, of parametrizations, and what is refused."""

import re

import pytest

from jaxslam._runtime.lookup import lookup
from jaxslam.consistency import monte_carlo, summarise, table
from jaxslam.filters.gaussian import check_can_track
from jaxslam.filters.slam import Slam
from jaxslam.filters.words import FILTERS, make_filters
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.calibration import Known
from jaxslam.simulation import scenario

COLOURS = {"red": 1, "green": 2, "blue": 3}


def test_chosen_keeps_the_order_of_the_names():
    assert list(lookup("colour", ["blue", "red"], COLOURS).items()) == [("blue", 3), ("red", 1)]
    assert list(lookup("colour", iter(["green"]), COLOURS)) == ["green"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], r"^colour needs at least one name; known: red, green, blue$"),
        (["gren"], r"^unknown colour 'gren' \(did you mean green\?\); known: red, green, blue$"),
        (["red", "xyzzy"], r"^unknown colour 'xyzzy'; known: red, green, blue$"),
    ],
)
def test_a_name_that_is_not_known_is_refused_with_those_that_are(names, message):
    with pytest.raises(ValueError, match=message):
        lookup("colour", names, COLOURS)


def test_filters_are_made_of_every_pair_of_names():
    frames = ["robocentric", "world", "keyframe"]
    made = make_filters(scenario("matched"), frames, LANDMARKS, "known")
    assert list(made) == [f"{name}/{landmark}" for name in frames for landmark in LANDMARKS]
    for name, slam in made.items():
        assert isinstance(slam, Slam)
        assert name == f"{slam.coordinates.name}/{slam.landmark.name}"
        assert isinstance(slam.calibration, Known)
        assert slam.compose_first == (slam.coordinates.name != "robocentric")


@pytest.mark.parametrize(
    ("filters", "landmarks", "calibration", "message"),
    [
        (["wrold"], ["cartesian"], "known", r"filters 'wrold' \(did you mean world\?\); known: "),
        (["world"], ["cartesain"], "known", r"landmarks 'cartesain' \(did you mean cartesian\?\)"),
        ([], ["cartesian"], "known", "filters needs at least one name; known: robocentric, world"),
        (["world"], [], "known", "landmarks needs at least one name; known: inverse_scaling"),
        (["world"], ["cartesian"], "maybe", "unknown calibration 'maybe'; known: white, consider"),
    ],
)
def test_filters_of_unknown_names_are_refused(filters, landmarks, calibration, message):
    with pytest.raises(ValueError, match=message):
        make_filters(scenario("matched"), filters, landmarks, calibration)


def test_one_name_needs_no_list_and_a_scenario_goes_by_its_name():
    made = make_filters("matched", "robocentric", "inverse_scaling")
    assert list(made) == ["robocentric/inverse_scaling"]
    assert list(lookup("colour", "red", COLOURS)) == ["red"]
    with pytest.raises(ValueError, match=r"unknown scenario 'matcht' \(did you mean matched\?\)"):
        make_filters("matcht", "robocentric", "inverse_scaling")


@pytest.mark.parametrize(
    ("name", "landmark", "wrong"),
    [
        ("world+lag", "inverse_scaling", "FixedLag takes a frame as a whole"),
        ("world+rays", "cartesian", "RaySum begins a landmark that is not one Gaussian"),
        ("world+particles+checked", "cartesian", "DepthParticles begins a landmark"),
        *((name, "cartesian", None) for name in FILTERS),
        ("world+iterated", "inverse_scaling", None),
        ("world+iterated3+checked", "inverse_scaling", None),
        ("world+directions", "inverse_scaling", None),
        ("scale_gauge+mixture3+rest+checked", "inverse_scaling", None),
    ],
)
def test_what_takes_a_frame_in_stages_and_each_landmark_as_a_gaussian_can_track(
    name, landmark, wrong
):
    (slam,) = make_filters("matched-6dof", name, landmark).values()
    if wrong is None:
        check_can_track(slam, name)
    else:
        with pytest.raises(ValueError, match=f"filter {re.escape(name)} cannot track: {wrong}"):
            check_can_track(slam, name)


@pytest.mark.slow
def test_a_study_prints_as_its_table():
    study = monte_carlo(
        scenario("matched-tight", steps=3),
        make_filters("matched-tight", ["robocentric", "world"], "inverse_scaling"),
        runs=4,
    )
    summary = summarise(study)
    assert str(study) == repr(study) == table(summary)
    assert study.summary() == summary
    with pytest.raises(AttributeError, match=r"'plot' \(jaxslam\.plots\.plot_consistency\(study\)"):
        study.plot()
    with pytest.raises(AttributeError, match=r"no attribute 'summarry' \(did you mean summary\?\)"):
        study.summarry()
