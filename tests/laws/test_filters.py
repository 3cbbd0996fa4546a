"""Every filter of the table keeps every law; a filter that breaks one is told which."""

import re
from functools import cache

import jax.numpy as jnp
import pytest
from cases import Around

from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.simulation import scenario
from jaxslam.testing import LAWS, FilterCase, check_filter

WORLD = scenario("matched-tight", steps=5, landmarks=4)
ALL = ["robocentric"]
"""Of which every law is tried in the quick tests."""
SOME = ["world", "keyframe", "scale_gauge+oc+scene50", "invariant", "robocentric+submaps"]
"""Of which those laws are, that need no other program than the batch of all lanes."""
OTHERS = [
    "scale_gauge+mixture3", "world+fej", "world+fej2", "world+decoupled", "world+oc",
    "robocentric+iterated3+mean", "robocentric+drift", "robocentric+checked",
    "scale_gauge+directions3", "scale_gauge+mixture3+rest4",
    "world+particles", "robocentric+rays", "robocentric+nodes", "recommended",
    "robocentric/sot_normal",
]  # fmt: skip
LONG = ("a batch is", "single precision", "its derivative")
EXCEPT = {
    "robocentric+rays": "it counts what it used",
    "world+particles": "a landmark that is",
    "robocentric+nodes": "single precision",
}
"""Kept in another way, as docstrings say: of a ray every member is counted, a landmark whose depth
is not known is not in the map, and information needs double precision."""


def row(name, told):
    slow = name in OTHERS or (name in SOME and told.startswith(LONG))
    marks = [pytest.mark.slow] * slow
    return pytest.param(name, LAWS[told], id=f"{name}: {told}", marks=marks)


ROWS = [
    row(name, told)
    for name in (*ALL, *SOME, *OTHERS)
    for told in LAWS
    if not told.startswith(EXCEPT.get(name, "?"))
]


@cache
def case(name):
    ends_in = {"particles": "cartesian", "rays": "cartesian", "nodes": "image_plane"}
    name, _, landmark = name.partition("/")
    landmark = landmark or ends_in.get(name.rpartition("+")[2], "inverse_scaling")
    return FilterCase(make_filter(name, landmark=landmark, **scenario_pieces(WORLD)), WORLD)


@pytest.mark.parametrize(("name", "law"), ROWS)
def test_a_filter_keeps_the_law(name, law):
    law(case(name))


class Forgetful(Around):
    """Removes nothing."""

    def remove(self, state, gone):
        return state


class Blind(Around):
    """Corrects by whatever is in a feature, valid or not."""

    def update(self, state, control, seen):
        after, innovation = super().update(state, control, seen)
        wrong = jnp.where(jnp.any(seen.valid), 1e-6 * jnp.sum(seen.measured), 0.0)
        return {**after, "frame": after["frame"]}, innovation.__class__(
            **{**vars(innovation), "nis": innovation.nis + wrong}
        )


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        (Forgetful, "Forgetful: it is not so that a landmark that is removed leaves its slot"),
        (Blind, "Blind: it is not so that what is not valid changes nothing: nis differs by nan"),
    ],
)
def test_a_filter_of_ones_own_is_told_which_law_it_breaks(kind, told):
    mine = kind(make_filter("robocentric", **scenario_pieces(WORLD)))
    with pytest.raises(ValueError, match="^" + re.escape(told)):
        check_filter(mine, WORLD)


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_filter_is_refused():
    with pytest.raises(ValueError, match=r"a jaxslam\.AbstractFilter is accepted, not str"):
        check_filter("robocentric", WORLD)  # ty: ignore[invalid-argument-type]


@pytest.mark.parametrize("fields", [{"landmarks": 3}, {"steps": 4}])
def test_a_world_that_is_too_small_is_refused(fields):
    small = scenario(WORLD, **fields)
    with pytest.raises(ValueError, match="a world of at least 4 landmarks and 5 steps is accepted"):
        check_filter(make_filter("robocentric", **scenario_pieces(small)), small)
