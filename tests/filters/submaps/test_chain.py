"""A chain of submaps against the one Gaussian of everything."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_rows

from jaxslam.consistency import run_through
from jaxslam.filters.run import Frames, run
from jaxslam.filters.slam import Slam
from jaxslam.filters.submaps import chain as chains
from jaxslam.filters.submaps.chain import base_poses, chain
from jaxslam.filters.submaps.closing import posterior
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import difference
from jaxslam.landmarks import Cartesian
from jaxslam.models.frame import Submaps
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Capacity, Features
from jaxslam.models.sensors import Position
from jaxslam.simulation import Room, scenario, simulate

FRAMES, LIFE, SLOTS, DT = 60, 6, 3, 0.2
"""Landmark j is seen from frame 2 j on, so many frames; it has slot j % 3."""
LANDMARKS = FRAMES // 2
SIGMA, ACCELERATION, START = 0.1, 0.3, 0.2


class Linear:
    """A camera that does not turn, among points that it measures: everything is linear."""

    def __init__(self):
        rng = np.random.default_rng(3)
        noise = np.array([ACCELERATION, ACCELERATION, 0.0])
        start = np.array([START, START, 0.0])
        self.slam = Slam(
            motion=ConstantVelocity(noise, np.array([0.0, 1.0, 0.0]), start),
            sensor=Position(SIGMA),
            landmark=Cartesian(),
        )
        v = np.array([0.0, 1.0]) + START * rng.normal(size=2)
        positions = [np.zeros(2)]
        for _ in range(FRAMES - 1):
            v = v + ACCELERATION * DT * rng.normal(size=2)
            positions.append(positions[-1] + DT * v)
        self.points = np.array(positions)[::2] + rng.uniform(-3, 3, (LANDMARKS, 2))
        self.points[-3] = self.points[1]  # the loop
        age = np.arange(FRAMES)[:, None] - 2 * np.arange(LANDMARKS)
        self.seen = (age >= 0) & (age < LIFE)
        noise = SIGMA * rng.normal(size=(FRAMES, LANDMARKS, 2))
        self.measured = self.points - np.array(positions)[:, None] + noise

    def frames(self):
        """The frames after frame 0 for the filter, and frame 0's features."""
        rows = {"seen": [], "new": []}
        for k in range(FRAMES):
            for name, size in (("seen", SLOTS), ("new", 1)):
                first = np.arange(LANDMARKS) * 2 == k
                these = np.flatnonzero(self.seen[k] & (first if name == "new" else ~first))
                pad = size - len(these)
                rows[name].append(
                    (
                        np.pad(these % SLOTS, (0, pad)),
                        np.pad(self.measured[k, these], ((0, pad), (0, 0))),
                        np.pad(np.ones(len(these), bool), (0, pad)),
                    )
                )
        seen, new = (Features(*map(np.array, zip(*rows[name], strict=True))) for name in rows)
        gone = np.zeros((FRAMES, SLOTS), bool)
        for k in range(1, FRAMES):
            for j in np.flatnonzero(self.seen[k - 1] & ~self.seen[k]):
                gone[k, j % SLOTS] = True
        first = jax.tree.map(lambda x: x[0], new)
        frames = Frames(np.full(FRAMES, DT), seen, new, jnp.asarray(gone))
        return jax.tree.map(lambda x: jnp.asarray(x)[1:], frames), first

    def batch(self, same=()):
        """Mean and covariance of all camera positions and landmarks, given all measurements, and
        that some pairs of landmarks are one point, but for an error of this σ."""
        v, a = 2, 2 * (FRAMES - 1)
        size = v + a + 2 * LANDMARKS
        position = np.zeros((FRAMES, 2, size))
        velocity = np.zeros((2, size))
        velocity[:, :2] = np.eye(2)
        for k in range(1, FRAMES):
            velocity[:, 2 * k : 2 * k + 2] += DT * np.eye(2)
            position[k] = position[k - 1] + DT * velocity
        point = np.zeros((LANDMARKS, 2, size))
        for j in range(LANDMARKS):
            point[j, :, v + a + 2 * j : v + a + 2 * j + 2] = np.eye(2)
        prior = np.eye(v + a, size) / np.r_[np.full(2, START), np.full(a, ACCELERATION)][:, None]
        A, b = [prior], [prior @ np.r_[0, 1, np.zeros(size - 2)]]
        for k, j in zip(*np.nonzero(self.seen), strict=True):
            A.append((point[j] - position[k]) / SIGMA)
            b.append(self.measured[k, j] / SIGMA)
        for i, j, sigma in same:
            A.append((point[i] - point[j]) / sigma)
            b.append(np.zeros(2))
        A, b = np.concatenate(A), np.concatenate(b)
        x, P = np.linalg.solve(A.T @ A, A.T @ b), np.linalg.inv(A.T @ A)
        rows = np.concatenate([position.reshape(-1, size), point.reshape(-1, size)])
        return rows @ x, rows @ P @ rows.T


@pytest.fixture(scope="module")
def linear():
    return Linear()


@pytest.fixture(scope="module")
def smoothed(linear):
    """The filter with submaps at the end, its chain, and in which frames submaps ended."""
    frames, first = linear.frames()
    slam = replace(linear.slam, frame=Submaps(spare=3, history=40))

    @jax.jit
    def whole():
        state = slam.init(Capacity(SLOTS, SLOTS, 1), first)
        return run(slam, frames, state, lambda state, *_: state.count)

    state, counts = whole()
    ended = np.flatnonzero(np.diff(np.r_[0, counts])) + 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chains, "LINEARISATION", 0.0)
        return eqx.filter_jit(chain)(slam, state, int(state.count)), [*ended, FRAMES - 1]


def everything(chain):
    """A function of all states: the last camera of every submap, and all its landmarks, in B."""

    def values(states):
        poses = base_poses(chain, states)
        apply = jax.vmap(jax.vmap(lambda pose, point: pose @ point, in_axes=(None, 0)))
        points = apply(poses, states.landmarks)
        return jnp.concatenate([poses.translation().ravel(), points.ravel()])

    return values


def rows_of(chain, ended):
    """Where `everything` has what the batch solution has, and where that is there."""
    numbers, N = np.asarray(chain.links.numbers), chain.shape[0]
    submaps, slots = np.nonzero(numbers >= 0)
    mine = np.r_[
        np.arange(2 * N),
        *(
            2 * N + 2 * (s * numbers.shape[1] + i) + np.arange(2)
            for s, i in zip(submaps, slots, strict=True)
        ),
    ]
    theirs = np.r_[
        *(2 * k + np.arange(2) for k in ended),
        *(2 * (FRAMES + numbers[s, i]) + np.arange(2) for s, i in zip(submaps, slots, strict=True)),
    ]
    return mine.astype(int), theirs.astype(int)


def same(states, chain, first, second):
    """How far a landmark of one submap is from that of another, in B."""
    both = everything(chain)(states)[2 * chain.shape[0] :].reshape(chain.shape[0], -1, 2)
    return both[first] - both[second]


def place_of(chain, number):
    """The first submap with a landmark, and its slot."""
    submaps, slots = np.nonzero(np.asarray(chain.links.numbers) == number)
    return submaps[0], slots[0]


@pytest.mark.parametrize("closed", quick_rows(1, [True, False]))
def test_a_chain_is_the_one_gaussian_of_everything(linear, smoothed, closed):
    """Cameras and landmarks of long ago, what was measured since then included."""
    chained, ended = smoothed
    assert len(ended) >= 8
    sigma, pairs = 0.01, [(1, LANDMARKS - 3)] if closed else []
    places = [[place_of(chained, j) for j in pair] for pair in pairs]

    def residual(states):
        return jnp.concatenate([jnp.zeros(0), *(same(states, chained, *pair) for pair in places)])

    after = jax.jit(lambda: posterior(chained, residual, sigma))()
    value, covariance = jax.jit(lambda: after.marginal(everything(chained)))()
    mean, P = linear.batch([(*pair, sigma) for pair in pairs])
    mine, theirs = rows_of(chained, ended)
    np.testing.assert_allclose(np.asarray(value)[mine], mean[theirs], atol=1e-11)
    np.testing.assert_allclose(
        np.asarray(covariance)[np.ix_(mine, mine)], P[np.ix_(theirs, theirs)], atol=1e-11
    )
    assert after.converged


@pytest.mark.slow
def test_a_chain_ends_where_the_filter_is_however_well_some_directions_are_known():
    """A car drives straight on. The chain, of one linearisation, does not carry on what the filter
    has of others: without `LINEARISATION` its end is off by .1 in squared σ, and its σ of the
    direction by half."""
    noise = {"velocity_sigma": [0.3] * 3 + [0.05] * 3, "acceleration_sigma": [1.0] * 3 + [0.3] * 3}
    road = scenario(
        "handheld", noise, rate=10.0, steps=150, landmarks=12, depth_range=[5.0, 50.0],
        velocity=[0.0, 0.0, 8.0, 0.0, 0.0, 0.0], nearest_depth=5.0,
    )  # fmt: skip
    base: Any = make_filter("scale_gauge+oc+scene50", **scenario_pieces(road))
    slam, room = replace(base, frame=Submaps(12, 32)), Room(12, 12, 12, 12)

    def end():
        state, _ = run_through(slam, room, simulate(road, jax.random.key(2)), lambda *_: None)
        chained = chain(slam, state, slam.frame.history)
        nothing = jnp.zeros((1, *chained.shape))
        return state, chained.cameras(chained.at(nothing[0]), nothing)

    state, (poses, covariances) = jax.jit(end)()
    _, newest = slam.inner.gaussian(state.inner, None)
    last = jax.tree.map(lambda x: x[-1], poses)
    away = np.asarray(difference(last, newest.core.pose.camera_pose()))
    assert int(state.count) > 15
    assert away @ np.linalg.solve(np.asarray(covariances[-1]), away) < 0.03
