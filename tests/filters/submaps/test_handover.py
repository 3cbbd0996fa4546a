"""A filter that hands its map over: the same estimates, and slots that are used again."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.consistency import run_through
from jaxslam.filters.readouts import camera_pose, landmarks_in_world
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import difference
from jaxslam.models.frame import Submaps
from jaxslam.models.observations import Features
from jaxslam.simulation import Room, scenario, simulate

LAPS = scenario("laps-6dof", steps=70, in_view=6, landmarks=60)
ROOM = Room(6, 6, 6, 6)


def through(slam, run):
    """Poses, their covariances and the number of submaps, and the last state."""

    def output(state, *_):
        return *camera_pose(slam, state), getattr(state, "count", 0)

    return run_through(slam, ROOM, run, output)


@pytest.mark.parametrize("name", ["robocentric", "robocentric+oc"])
def test_a_filter_with_submaps_estimates_what_it_does_without(name):
    """Landmarks that left are marginalised in the one, and wait for that in the other."""
    base: Any = make_filter(name, **scenario_pieces(LAPS))
    slam, run = replace(base, frame=Submaps(8)), simulate(LAPS, jax.random.key(3))
    _, (pose, covariance, _) = jax.jit(lambda: through(base, run))()
    state, (mine, mine_covariance, count) = jax.jit(lambda: through(slam, run))()
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
    base: Any = make_filter("robocentric", **scenario_pieces(LAPS))
    slam, run = replace(base, frame=Submaps(8)), simulate(LAPS, jax.random.key(3))
    state, _ = jax.jit(lambda: through(slam, run))()
    points, P = landmarks_in_world(slam, state, jnp.arange(6))
    seen = np.asarray(run.visible[-1] & slam.in_map(state))
    assert seen.sum() >= 4
    error = np.asarray(points - run.points[-1])[seen]
    sigma = np.sqrt(np.asarray(jnp.einsum("mii->mi", P))[seen])
    assert np.all(np.abs(error) < 5 * sigma)
    frozen = state.frozen
    assert set(np.asarray(frozen.numbers[0])) - set(np.asarray(state.numbers)) - {-1}


@pytest.mark.slow
def test_a_slot_that_is_filled_again_without_being_freed_is_a_new_landmark():
    base: Any = make_filter("robocentric", **scenario_pieces(LAPS))
    slam = replace(base, frame=Submaps(1))
    one = Features(np.array([0]), np.array([[300.0, 200.0]]), np.array([True]))
    state = slam.init(2, one)
    for k in range(1, 5):
        state = slam.close(state, one)
        assert int(state.created) == k + 1
        assert int(state.numbers[state.slots[0]]) == k
    assert not bool(slam.in_map(state)[1])


@pytest.mark.parametrize("numbers", [{"spare": -1}, {"history": 0}])
def test_submaps_without_room_are_refused(numbers):
    with pytest.raises(ValueError, match="submaps have 0 spare slots and a history of 1"):
        Submaps(**numbers)
