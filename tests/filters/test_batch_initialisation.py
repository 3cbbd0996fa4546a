"""Tests of the sum that sets out from rest: what it finds, and what it refuses."""

from dataclasses import replace
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

from jaxslam.filters.window.record import empty
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.geometry import PLANAR, SPATIAL
from jaxslam.models.observations import Features
from jaxslam.statistics.bands import lost_threshold

SUM = "scale_gauge+mixture3"
STARTED = f"{SUM}+rest8"
"""Eight frames are one window, and are over within the run."""


@cache
def case(runs=3, landmarks=6, steps=9):
    """As few as show what is to hold for each."""
    return Case("standstill-6dof", runs, landmarks=landmarks, steps=steps)


def one_by_one(function):
    """`jax.vmap` by a program of one run, which takes half the time to compile."""
    compiled = quick_jit(function)

    def mapped(*batch):
        batch = jax.device_get(batch)
        count = len(jax.tree.leaves(batch)[0])
        found = [compiled(*jax.tree.map(lambda x, i=i: x[i], batch)) for i in range(count)]
        return jax.tree.map(lambda *x: np.stack(x), *jax.device_get(found))

    return mapped


@cache
def stages(name, of):
    """`init` and `step` of the filter, of a batch of runs."""
    slam = of.filter(name)
    init = one_by_one(lambda first: slam.init(of.capacity, first))
    return init, one_by_one(lambda *x: slam.step(*x))


def frame(k, of):
    """Controls, known and new features of step k, of all runs."""
    _, known, new = of.features
    return jax.tree.map(lambda x: np.asarray(x)[:, k], (of.runs.controls, known, new))


@cache
def followed(name, of):
    """The state after every frame, a batch of runs."""
    init, step = stages(name, of)
    states = [init(of.features[0])]
    for k in range(of.scenario.steps):
        states.append(step(states[-1], *frame(k, of))[0])
    return states


@pytest.mark.slow
def test_from_rest_no_run_is_lost_and_none_goes_backwards():
    """Of those in which the sum alone loses some, which no quick run is long enough to show."""
    of = case(6, 12, 12)

    def at_end(name):
        slam = of.filter(name)

        @one_by_one
        def one(state, run):
            truth = jax.tree.map(lambda x: x[-1], run.poses)
            pose, _ = slam.marginal(state, lambda view: view.pose)
            return *slam.pose_error(state, truth), pose.translation() @ truth.translation()

        error, P, along = (np.asarray(x) for x in one(followed(name, of)[-1], of.runs))
        return np.einsum("ri,ri->r", error, np.linalg.solve(P, error[..., None])[..., 0]), along

    nees, along = at_end(STARTED)
    assert nees.max() < lost_threshold(6)
    assert nees.mean() < 12  # of six degrees of freedom: 6 ± 1.4
    assert (along > 0).all()
    alone, _ = at_end(SUM)
    assert not (alone < lost_threshold(6)).all()


def poses_of(state):
    return state.sum.members.core.pose.wxyz_xyz


def covariances_of(state):
    return state.sum.members.covariance


def test_a_window_may_close_where_one_translation_is_known_to_three_hundredths():
    slam: Any = case().filter(STARTED)

    @quick_jit
    def ready(sigma, log_weights):
        state = slam.init(case().capacity)
        none = slam.start._ready(slam, state)  # of no frame yet
        place = state.sum.likeliest.core.part("pose").start
        part = jnp.arange(place, place + 3)
        pose, P = (x(state) for x in (poses_of, covariances_of))
        P = P.at[:, part[:, None], part].set(sigma**2 / 3 * jnp.eye(3))
        pose = pose.at[:, -3:].set(jnp.asarray([0.0, 0.6, -0.8]))
        state = eqx.tree_at(lambda x: (poses_of(x), covariances_of(x)), state, (pose, P))
        merged = jnp.full_like(state.record.merged, 2.0)
        record = replace(state.record, last=jnp.full_like(state.record.last, 4), merged=merged)
        state = replace(state, sum=replace(state.sum, log_weights=log_weights))
        return none, slam.start._ready(slam, replace(state, record=record))

    one, two = [0.0, -np.inf, -np.inf], [np.log(0.99), np.log(0.01), -np.inf]
    for sigma, weights, closes in ((0.029, one, True), (0.031, one, False), (0.029, two, False)):
        assert list(map(bool, ready(sigma, np.array(weights)))) == [False, closes]


@pytest.mark.parametrize("around", ["", "+checked"])
def test_what_stands_around_a_start_from_rest_says_what_it_says(around):
    slam: Any = case().filter(f"{STARTED}{around}")
    assert slam.ambiguous_start
    state = slam.init(case().capacity)
    for is_open in (False, True):
        state = eqx.tree_at(lambda s: s.open, state, jnp.asarray(is_open))
        assert slam.unit_fixed(state) == (not is_open)
    slam = case().filter(f"{SUM}{around}")
    assert not slam.ambiguous_start


def test_the_first_frames_leave_several_modes_and_the_last_ones_one():
    """So that the search is needed, and ends: the window closes where the camera has moved enough,
    and goes on with every other frame where it has not."""
    states = followed(STARTED, case())
    early, late = (states[k].modes.log_weights for k in (3, 8))
    assert (np.isfinite(early).sum(axis=1) > 1).any()
    assert (np.exp(late).max(axis=1) > 0.9).mean() > 0.5
    still_open = np.array([state.open for state in states])
    assert still_open[:8].all()
    closed = ~still_open[8]
    assert 0 < closed.mean() < 1
    assert not still_open[8:, closed].any()
    before, after = states[8], states[9]
    jax.tree.map(
        lambda one, other: np.testing.assert_array_equal(one[closed], other[closed]),
        before.modes,
        after.modes,
    )
    covariances = (state.sum.members.covariance[closed] for state in (before, after))
    assert not np.array_equal(*covariances)
    assert (before.record.last[~closed] == 4).all()
    assert (jax.vmap(lambda record: record.steps)(before.record) == 8).all()


def test_landmarks_are_removed_in_the_midst_of_a_window():
    of, slam = case(), case().filter(STARTED)
    _, step = stages(STARTED, of)
    before, every = followed(STARTED, of)[4:6]
    gone = jnp.arange(of.capacity) < 2
    less = one_by_one(lambda state: slam.remove(state, gone))(before)
    assert not less.record.seen[..., :2].any()
    np.testing.assert_array_equal(less.record.seen[..., 2:], before.record.seen[..., 2:])
    controls, known, new = frame(4, of)
    rest = Features(known.slots, known.measured, known.valid & ~gone[known.slots])
    after, innovation = step(less, controls, rest, new)
    for state in (less, after):
        assert (jax.vmap(slam.in_map)(state) == ~gone).all()
    assert (innovation.status == 0).all()
    known_less, known_more = (
        np.linalg.slogdet(state.sum.members.covariance[:, 0, :6, :6])[1] for state in (after, every)
    )
    assert (known_less > known_more).all()


def test_a_landmark_that_slides_is_given_up_and_no_other_one():
    """By two pixels more in every frame, which no point of the world does."""
    of, slides_in = case(), 2
    slam, (init, step) = of.filter(STARTED), stages(STARTED, of)
    state = init(of.features[0])
    for k in range(6):
        control, known, new = frame(k, of)
        there = jax.vmap(lambda state, slots: slam.in_map(state)[slots])(state, known.slots)
        slides = (known.slots == slides_in)[..., None] & (jnp.arange(2) == 1)
        measured = known.measured + jnp.where(slides, (k + 1) ** 2, 0.0)
        known = Features(known.slots, measured, known.valid & there)
        state, _ = step(state, control, known, new)
    kept = np.asarray(jax.vmap(slam.in_map)(state))
    assert (kept == (np.arange(of.capacity) != slides_in)).all()
    assert not state.record.seen[..., slides_in].any()


def test_windows_grow_up_to_the_frames_that_are_named_and_others_are_refused():
    frames = (None, 8, 20, 40)
    assert [Schedule.of(SPATIAL, n).sizes for n in frames] == [(31,), (9,), (21,), (31, 41)]
    for sizes in ((9, 9), (17, 9), ()):
        with pytest.raises(ValueError, match="each larger than the one before"):
            replace(Schedule.of(SPATIAL), sizes=sizes)
    with pytest.raises(ValueError, match="1 direction at least, not 0"):
        replace(Schedule.of(SPATIAL), directions=0)


def due(start, motion, last, standing=False, steps=None, moved=False):
    """From which starts is sought after frame `last`, `steps` frames since the first."""
    frames = max(last, 8) + 1
    merged = jnp.ones(frames - 1).at[0].add((last if steps is None else steps) - last)
    record = empty(motion, frames, 4, 2, jnp.float64)
    stood = jnp.asarray(standing)
    record = replace(record, last=jnp.asarray(last), merged=merged, standing=stood)
    return start._due(record, jnp.asarray(moved))


def test_a_search_is_from_all_starts_at_first_and_then_from_some_in_turn():
    schedule = Schedule.of(SPATIAL, 8)
    starts, together, early = 2 + schedule.directions, schedule.in_turn, schedule.searches
    slam = FromWindow(schedule), case().pieces()["motion"]
    for last in early:
        assert due(*slam, last).shape == (starts,)
        assert due(*slam, last).all()
        assert not due(*slam, last, standing=True).any()
    later = [np.asarray(due(*slam, 8, steps=max(early) + 1 + k)) for k in range(starts)]
    assert {int(x.sum()) for x in later} == {together}
    # A camera that has moved is asked in every frame whether the reversed world is likelier.
    for k, quiet in enumerate(later):
        asked = np.asarray(due(*slam, 8, steps=max(early) + 1 + k, moved=True))
        assert asked[1]
        np.testing.assert_array_equal(np.delete(asked, 1), np.delete(quiet, 1))
    # The reversal of the likeliest first, and none twice before all had their turn.
    assert later[0][1]
    np.testing.assert_array_equal(np.sum(later, axis=0), together)
    assert not np.logical_and(later[0], later[1]).any()
    planar = FromWindow(Schedule.of(PLANAR)), Case("standstill", 1, landmarks=4, steps=2).pieces()
    for last in (*range(1, 9), 40):  # in the plane from all or from none
        found = due(planar[0], planar[1]["motion"], last)
        assert found.all() if last in planar[0].schedule.searches else not found.any()
