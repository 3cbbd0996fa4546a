"""A chain of submaps against the one Gaussian of everything."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.filters.run import Frames, run
from jaxslam.filters.slam import Slam
from jaxslam.filters.submaps import chain as chains
from jaxslam.filters.submaps import closing
from jaxslam.filters.submaps.chain import base_poses, chain
from jaxslam.filters.submaps.closing import Loops, agreeing, close, posterior
from jaxslam.landmarks import Cartesian
from jaxslam.models.frame import Submaps
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Capacity, Features
from jaxslam.models.sensors import Position

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
        self.points[[-3, -4]] = self.points[[1, 2]]  # the loops
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


def read(posterior):
    """All cameras, their covariances, and the variance of a unit."""
    return *posterior.cameras(), posterior.unit_variance()


def test_a_chain_is_the_one_gaussian_of_everything(linear, smoothed):
    """Cameras and landmarks of long ago, what was measured since then included; and a loop."""
    chained, ended = smoothed
    assert len(ended) >= 8
    sigma, pairs = 0.01, [(1, LANDMARKS - 3)]
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
    # The covariances of all cameras, in one pass, are those of each.
    poses, P, _ = eqx.filter_jit(read)(after)
    np.testing.assert_allclose(poses.translation().ravel(), value[: 2 * len(P)], atol=1e-12)
    each = [covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(P))]
    np.testing.assert_allclose(P[:, :2, :2], each, atol=1e-12)


def test_loops_are_believed_among_wrong_pairs_and_close_the_chain(linear, smoothed, monkeypatch):
    """And of a chain that is over-confident, as all its pairs are alike; but within `WIDEST`."""
    chained, ended = smoothed
    pairs = np.array([(1, LANDMARKS - 3), (2, LANDMARKS - 4), (3, LANDMARKS - 2)])
    places = np.array([[place_of(chained, j) for j in pair] for pair in pairs])
    loops = Loops(jnp.asarray(places[..., 0]), jnp.asarray(places[..., 1]), jnp.ones(3, bool))
    none, right = jnp.zeros(3, bool), jnp.arange(3) < 2
    before = eqx.filter_jit(close)(chained, replace(loops, valid=none))
    believed = eqx.filter_jit(agreeing)(before, loops)
    assert believed.valid.tolist() == [True, True, False]
    after = eqx.filter_jit(close)(chained, believed)
    assert after.converged
    poses, P, unit_variance = eqx.filter_jit(read)(after)
    mean, covariance = linear.batch([(*pair, 1e-5) for pair in pairs[:2]])
    np.testing.assert_allclose(poses.translation(), mean.reshape(-1, 2)[ended], atol=1e-6)
    own = [covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in ended]
    np.testing.assert_allclose(P[:, :2, :2] / unit_variance, own, atol=1e-6)
    links = chained.links
    links = replace(links, root=0.3 * links.root, whitening=links.whitening / 0.3)
    narrow = eqx.filter_jit(close)(replace(chained, links=links), replace(loops, valid=none))
    given = narrow, replace(loops, valid=right)
    assert eqx.filter_jit(agreeing)(*given).valid[:2].all()
    monkeypatch.setattr(closing, "WIDEST", 1.0)
    assert not eqx.filter_jit(lambda *x: agreeing(*x))(*given).valid[:2].all()
