"""Loops: which pairs are believed, and what is learnt of the chain."""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import filters
from jaxslam.consistency import run_through
from jaxslam.filters import Loops, base_poses
from jaxslam.filters.submaps import closing
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.models.frame import Submaps
from jaxslam.simulation import Room, scenario, simulate

# Op by op they are hundreds of programs.
agreeing = eqx.filter_jit(filters.agreeing)
chain = eqx.filter_jit(filters.chain)
close = eqx.filter_jit(filters.close)
LAP = scenario("laps-6dof", steps=440, in_view=12, landmarks=96)
"""Twice round, and a little more."""


@pytest.fixture(scope="module")
def lap():
    """The chain of a run, its truth where its submaps ended, and the pairs of landmarks that are
    one point: the newest in view with the first of that point."""
    base: Any = make_filter("robocentric+oc", **scenario_pieces(LAP))
    slam, run = (
        replace(base, frame=Submaps(12, 48)),
        jax.jit(partial(simulate, LAP))(jax.random.key(1)),
    )
    room = Room(12, 12, 12, 12)

    def output(state, *_):
        return state.count, jnp.append(state.numbers, -1)[state.slots]

    state, (counts, numbers) = jax.jit(lambda: run_through(slam, room, run, output))()
    ended = np.r_[np.flatnonzero(np.diff(np.r_[0, counts])) + 1, LAP.steps]
    chained = chain(slam, state, int(state.count))
    truth = jax.tree.map(lambda x: x[ended], run.poses)
    numbers, identity = np.asarray(numbers), np.asarray(run.identity)[1:]
    point_of = dict(zip(numbers.ravel().tolist(), identity.ravel().tolist(), strict=True))
    of_link, pairs = np.asarray(chained.links.numbers), []
    for new in numbers[-1][numbers[-1] >= 0].tolist():
        old = min(n for n, point in point_of.items() if point == point_of[new] and n >= 0)
        if old != new:
            pairs.append([np.argwhere(of_link == n)[-1] for n in (old, new)])
    pairs = np.array(pairs)
    loops = Loops(
        jnp.asarray(pairs[:, :, 0]), jnp.asarray(pairs[:, :, 1]), jnp.ones(len(pairs), bool)
    )
    return chained, truth, loops


def errors(posterior, truth):
    """Of the cameras' positions, and their NEES."""

    def positions(states):
        return base_poses(posterior.chain, states).translation()

    value, P = posterior.marginal(lambda states: positions(states).ravel())
    away = np.asarray(value).reshape(-1, 3) - np.asarray(truth.translation())
    P = np.asarray(P).reshape(len(away), 3, len(away), 3)
    blocks = P[np.arange(len(away)), :, np.arange(len(away))]
    whitened = np.linalg.solve(blocks, away[..., None])[..., 0]
    return np.linalg.norm(away, axis=1), np.einsum("ti,ti->t", away, whitened)


def none_of(loops):
    """No loop."""
    return Loops(loops.submaps, loops.slots, jnp.zeros_like(loops.valid))


@pytest.mark.slow
def test_a_loop_that_closes_makes_the_path_right_and_its_covariance_smaller(lap):
    chained, truth, loops = lap
    assert len(loops.valid) >= 5
    before = close(chained, none_of(loops))
    believed = agreeing(before, loops)
    assert bool(believed.valid.all())
    after = close(chained, believed)
    assert bool(after.converged)
    (drift, _), (left, nees) = errors(before, truth), errors(after, truth)
    assert left[-1] < 0.3 * drift[-1]
    assert np.sqrt(np.mean(left**2)) < 0.6 * np.sqrt(np.mean(drift**2))
    assert np.mean(nees) < 3 * 2
    # No more is unknown of any place than was.
    for k in (5, -1):
        was, now = (
            one.marginal(lambda states, k=k: base_poses(chained, states).translation()[k])[1]
            for one in (before, after)
        )
        assert np.linalg.eigvalsh(np.asarray(was - now))[0] > -1e-12
    # A loop that is taken back has never been.
    np.testing.assert_array_equal(errors(close(chained, none_of(loops)), truth)[0], drift)


@pytest.mark.slow
def test_the_covariances_of_all_cameras_are_those_of_each(lap):
    """In one pass, as `marginal` has them of all at once."""
    chained, _, loops = lap
    after = close(chained, loops)
    poses, P = after.cameras()
    expected, joint = after.marginal(lambda states: base_poses(chained, states))
    np.testing.assert_allclose(poses.parameters(), expected.parameters(), atol=1e-12)
    N, t = len(P), P.shape[1]
    blocks = np.asarray(joint).reshape(N, t, N, t)[np.arange(N), :, np.arange(N)]
    np.testing.assert_allclose(P, blocks, rtol=1e-6, atol=1e-9 * np.max(blocks))


@pytest.mark.slow
def test_wrong_pairs_are_refused_among_right_ones(lap):
    """Every third is with a neighbour of the true landmark."""
    chained, _, loops = lap
    wrong = np.arange(len(loops.valid)) % 3 == 1
    rolled = np.asarray(loops.slots).copy(), np.asarray(loops.submaps).copy()
    for array in rolled:
        array[wrong, 0] = np.roll(array[:, 0], 1)[wrong]
    pairs = Loops(jnp.asarray(rolled[1]), jnp.asarray(rolled[0]), loops.valid)
    before = close(chained, none_of(loops))
    believed = np.asarray(agreeing(before, pairs).valid)
    assert not believed[wrong].any()
    assert believed[~wrong].mean() > 0.7


@pytest.mark.slow
def test_right_pairs_are_believed_of_an_overconfident_chain(lap, monkeypatch):
    """It is off by more than its covariance says, with all pairs alike."""
    chained, _, loops = lap
    links = chained.links
    links = replace(links, root=0.3 * links.root, whitening=links.whitening / 0.3)
    before = close(replace(chained, links=links), none_of(loops))
    assert np.asarray(agreeing(before, loops).valid).all()
    monkeypatch.setattr(closing, "WIDEST", 1.0)
    assert not np.asarray(filters.agreeing(before, loops).valid).all()


@pytest.mark.slow
def test_a_batch_of_runs_has_chains_of_one_length(lap):
    """Links that stand for none change nothing."""
    chained, *_ = lap
    base: Any = make_filter("robocentric+oc", **scenario_pieces(LAP))
    slam = replace(base, frame=Submaps(12, 48))
    room, run = Room(12, 12, 12, 12), simulate(LAP, jax.random.key(1))
    state, _ = jax.jit(lambda: run_through(slam, room, run, lambda state, *_: state.count))()
    longer = chain(slam, state, 40)
    assert longer.shape[0] == 41 > chained.shape[0]
    ours, theirs = (
        base_poses(c, c.at(jnp.zeros(c.shape))).translation() for c in (chained, longer)
    )
    np.testing.assert_allclose(theirs[-len(ours) :], ours, atol=1e-12)
    with pytest.raises(ValueError, match="the state keeps 48 submaps, not 49"):
        chain(slam, state, 49)
