"""Every filter of the table keeps every law."""

from functools import cache

import pytest

from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.simulation import scenario
from jaxslam.testing import LAWS, FilterCase

ROWS = [
    "robocentric",
    "world",
    "keyframe",
    "robocentric+oc",
    "scale_gauge+oc+scene50",
    "invariant",
    "world+fej",
    "robocentric+iterated3",
    "scale_gauge+mixture5",
    "robocentric+submaps",
    "robocentric+checked",
    "robocentric+rest4",
    "world+particles",
    "robocentric+rays",
    "recommended",
]


@cache
def case(name):
    world = scenario("matched-tight", steps=5, landmarks=4)
    return FilterCase(make_filter(name, **scenario_pieces(world)), world)


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
@pytest.mark.parametrize("name", ROWS)
def test_a_filter_keeps_the_law(name, law):
    law(case(name))
