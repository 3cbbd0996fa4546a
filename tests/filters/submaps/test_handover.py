"""A filter that hands its map over: the same estimates, and slots that are used again."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit

from jaxslam.consistency import run_through
from jaxslam.filters.readouts import camera_pose, landmarks_in_world
from jaxslam.filters.submaps import chain
from jaxslam.filters.submaps.handover import Handover
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import difference
from jaxslam.models.frame import Robocentric, Submaps
from jaxslam.simulation import Room, scenario, simulate

LAPS = scenario("laps-6dof", steps=70, in_view=6, landmarks=60)
ROOM = Room(6, 6, 6, 6)


def through(slam, run):
    """Poses, their covariances and the number of submaps, and the last state."""

    def output(state, *_):
        return *camera_pose(slam, state), getattr(state, "count", 0)

    return run_through(slam, ROOM, run, output)


@cache
def with_submaps(name):
    """A filter of submaps, a run, its last state, and what it says in every frame."""
    base: Any = make_filter(name, **scenario_pieces(LAPS))
    slam, run = replace(base, frame=Submaps(8)), jax.jit(partial(simulate, LAPS))(jax.random.key(3))
    return slam, run, *jax.jit(partial(through, slam))(run)


def test_a_filter_with_submaps_estimates_what_it_does_without():
    """Landmarks that left are marginalised in the one, and wait for that in the other."""
    slam, run, state, (mine, mine_covariance, count) = with_submaps("robocentric")
    base = replace(slam, frame=Robocentric())
    pose, covariance, _ = jax.jit(partial(through, base))(run)[1]
    assert int(count[-1]) >= 3
    # T_BK T_KC and T_CB have other tangents: they differ in what is of second order.
    apart = jax.vmap(difference)(mine, pose)
    sigma = jnp.sqrt(jnp.einsum("tii->ti", covariance))
    assert float(jnp.max(jnp.abs(apart) / sigma)) < 0.03
    widest = float(sigma[-1].max() ** 2)
    np.testing.assert_allclose(mine_covariance[-1], covariance[-1], atol=0.02 * widest)
    assert int(state.created) > 2 * ROOM.landmarks


def test_a_landmark_is_where_its_user_put_it():
    """By its own slot, whichever the base has for it; one that left is in the frozen submap."""
    slam, run, state, _ = with_submaps("robocentric")
    points, P = quick_jit(partial(landmarks_in_world, slam))(state, jnp.arange(6))
    seen = np.asarray(run.visible[-1] & slam.in_map(state))
    assert seen.sum() >= 4
    error = np.asarray(points - run.points[-1])[seen]
    sigma = np.sqrt(np.asarray(jnp.einsum("mii->mi", P))[seen])
    assert np.all(np.abs(error) < 5 * sigma)
    frozen = state.frozen
    assert set(np.asarray(frozen.numbers[0])) - set(np.asarray(state.numbers)) - {-1}


def test_a_frozen_submap_is_factored_with_the_error_of_its_linearisation_and_no_more():
    slam, _, state, _ = with_submaps("robocentric")
    frozen = jax.tree.map(lambda x: x[0], state.frozen)
    no = jnp.zeros((), bool)
    one = quick_jit(partial(chain.link, slam.one))(frozen, ~no, no, no)
    again, P = one.root @ one.root.T, frozen.state.covariance[one.order][:, one.order]
    there = np.diag(P) > 0
    more = np.diag(again)[there] / np.diag(P)[there] - 1
    np.testing.assert_allclose(more, 1e-3, rtol=1e-6)


def test_what_goes_on_of_a_submap_is_all_that_is_constant_and_the_landmarks_in_view():
    pieces = scenario_pieces(scenario("matched-loose"), "estimated")
    slam: Any = make_filter("scale_gauge+scene50+submaps", **pieces)
    state = quick_jit(partial(slam.init, 2))()
    frozen = jax.tree.map(lambda x: x[0], state.frozen)
    active = jnp.arange(len(frozen.carried)) < 3
    frozen = replace(frozen, carried=frozen.carried.at[1].set(True))
    frozen = replace(frozen, state=replace(frozen.state, active=active))
    own = np.asarray(chain._separator(slam, frozen))
    core, c = frozen.state.core, frozen.state.core_dim
    parts = {x: own[core.part(x)] for x in ("pose", "motion", "log_scale", "noise", "calibration")}
    parts["depth_error"] = own[core.part("depth_error")]
    assert {name: set(held.tolist()) for name, held in parts.items() if held.size} == {
        "pose": {False}, "motion": {True}, "log_scale": {True}, "calibration": {True},
        "depth_error": {True},
    } | ({"noise": {False}} if parts["noise"].size else {})  # fmt: skip
    d = frozen.state.landmarks.shape[1]
    assert np.flatnonzero(own[c:]).tolist() == list(range(d, 2 * d))


class Undecided(Handover):
    """Of a filter that has not found its start yet."""

    def unit_fixed(self, slam, state):
        return jnp.zeros((), bool)


@pytest.mark.parametrize("kind", [Handover, Undecided])
def test_a_full_map_is_frozen_or_while_a_start_is_found_out_forgotten(kind):
    slam, _, state, _ = with_submaps("robocentric")
    layer = kind(slam.frame)
    free = np.asarray(state.numbers) < 0
    after = quick_jit(partial(layer._handed_over, slam))(state, jnp.ones((), bool))
    carried = np.zeros(free.size, bool)
    carried[np.asarray(state.slots)[np.asarray(slam.in_map(state))]] = True
    assert int(after.count - state.count) == (kind is Handover)
    for before, now in ((~free, np.asarray(after.numbers) >= 0), (~free, after.inner.active)):
        np.testing.assert_array_equal(now, before & carried)
    assert (~free & ~carried).any()


@pytest.mark.parametrize("numbers", [{"spare": -1}, {"history": 0}])
def test_submaps_without_room_are_refused(numbers):
    with pytest.raises(ValueError, match="submaps have 0 spare slots and a history of 1"):
        Submaps(**numbers)
