"""Tests of the names that users give: of filters, of parametrizations, and what is refused."""

import pytest

from jaxslam.landmarks import LANDMARKS
from jaxslam.lookup import chosen
from jaxslam.models.calibration import Known
from jaxslam.names import make_filters
from jaxslam.simulation import scenario
from jaxslam.slam.filter import EkfSlam

COLOURS = {"red": 1, "green": 2, "blue": 3}


def test_chosen_keeps_the_order_of_the_names():
    assert list(chosen("colour", ["blue", "red"], COLOURS).items()) == [("blue", 3), ("red", 1)]
    assert list(chosen("colour", iter(["green"]), COLOURS)) == ["green"]


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
        chosen("colour", names, COLOURS)


def test_filters_are_made_of_every_pair_of_names():
    frames = ["robocentric", "world", "keyframe"]
    made = make_filters(scenario("matched"), frames, LANDMARKS, "known")
    assert list(made) == [f"{name}/{landmark}" for name in frames for landmark in LANDMARKS]
    for name, slam in made.items():
        assert isinstance(slam, EkfSlam)
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
