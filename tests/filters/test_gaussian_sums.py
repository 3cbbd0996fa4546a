"""Gaussian sums: over the initial velocity, and divided anew in every frame."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit
from scipy.stats import norm

import jaxslam
from jaxslam.filters.mixture import split_merge
from jaxslam.filters.mixture.mixture import _division
from jaxslam.filters.mixture.split_merge import _as_late, _parts, _split_and_merged
from jaxslam.filters.mixture.sum_state import BEHIND, SumState, log_likelihoods, mixed
from jaxslam.models.observations import Innovation, Status


@cache
def case(name="matched-loose", **fields):
    return Case(name, **{"steps": 6, "landmarks": 4, **fields})


@cache
def linear():
    return case(
        "matched",
        velocity_sigma=(0.01, 0.01, 1e-6),
        acceleration_sigma=(1e-5,) * 3,
        inverse_depth=(1 / 6, 1e-7),
        pixel_sigma=0.3,
    )


@cache
def poses(of, name):
    """Every step's pose and its covariance of such a filter."""
    return of.compiled(name)(of.controls(), *of.frames(0))[1][:2]


def test_a_sum_for_a_linear_problem_is_its_filter():
    """To the error of the sum's shape: halves of a Gaussian have its moments, not its tails."""
    plain, plain_P = poses(linear(), "robocentric")
    sum_, sum_P = poses(linear(), "robocentric+mixture9")
    sigma = np.sqrt(np.diagonal(plain_P, axis1=1, axis2=2))
    away = jax.vmap(lambda a, b: (a.inverse() @ b).log())(plain, sum_)
    assert np.abs(away / sigma).max() < 0.15
    found = np.sqrt(np.diagonal(sum_P, axis1=1, axis2=2))
    np.testing.assert_allclose(found, sigma, rtol=0.15)


@pytest.mark.parametrize("name", ["robocentric+directions5", "robocentric+mixture9"])
def test_a_divided_prior_has_the_moments_of_the_whole(name):
    of = case()
    motion = of.pieces()["motion"]
    state = of.filter(name).init(of.capacity)
    weights, members = np.exp(state.log_weights), state.members
    means = np.asarray(members.core.motion)
    place = slice(3, 6)  # after the pose
    own = np.asarray(members.covariance)[:, place, place]
    mean = weights @ means
    spread = np.einsum("m,mi,mj->ij", weights, means - mean, means - mean)
    np.testing.assert_allclose(mean, motion.velocity, atol=1e-9)
    covariance = np.tensordot(weights, own, 1) + spread
    prior = np.diag(np.square(motion.velocity_sigma))
    np.testing.assert_allclose(covariance, prior, rtol=1e-9, atol=1e-12)


def test_a_member_without_weight_spoils_no_prediction():
    """Once diverged it is NaN, and of likelihood zero."""
    predicted = jnp.array([[[1.0], [2.0]], [[3.0], [6.0]], [[jnp.nan], [jnp.nan]]])
    covariance = jnp.stack([jnp.eye(2), jnp.eye(2), jnp.full((2, 2), jnp.nan)])
    used, nis = jnp.ones((3, 2), bool), jnp.array([5.0, 45.0, jnp.nan])
    status = jnp.array([Status.OK, Status.OK, Status.DIVERGED])
    innovations = jax.vmap(Innovation)(predicted, -predicted, covariance, used, nis, status)
    whole = mixed(innovations, jnp.log(jnp.array([0.75, 0.25, 0.0])), status[0])
    np.testing.assert_allclose(whole.predicted[:, 0], [1.5, 3.0])
    np.testing.assert_allclose(whole.residual, -whole.predicted)


@pytest.mark.parametrize("name", ["matched", "matched-6dof"])
def test_a_prior_is_divided_across_the_speed(name):
    """The members of a sum over directions have one speed, also where what is known of the velocity
    is skew."""
    of = case(name)
    motion = of.pieces()["motion"]
    t, n = motion.geometry.tangent_dim, motion.geometry.point_dim
    velocity = np.concatenate([np.arange(1.0, n + 1), motion.velocity[n:]])
    root = np.diag(motion.velocity_sigma) + 0.05 * np.random.default_rng(0).normal(size=(t, t))

    def members(modifier):
        begun = replace(motion, velocity=velocity, velocity_sigma=root)
        slam = replace(of.filter(f"robocentric+{modifier}"), motion=begun)
        return slam.init(of.capacity).members

    forward = velocity.copy()
    forward[n:] = 0
    across = np.asarray(quick_jit(lambda: members("directions3").core.motion)()) - velocity
    assert len(across) == 3 ** (n - 1)
    assert np.linalg.matrix_rank(across, tol=1e-6) == n - 1
    np.testing.assert_allclose(across @ forward, 0, atol=1e-12)


@cache
def some_sum():
    """A sum of nine members after some steps."""
    of = case()
    slam = of.filter("scale_gauge+mixture9")

    def whole(first, *later):
        state = slam.init(of.capacity, first)
        return jax.lax.scan(lambda s, frame: (slam.step(s, *frame)[0], None), state, later)[0]

    first, *later = of.frames(0)
    return quick_jit(whole)(first, of.controls(), *later)


def pixels(core):
    return 100 * core.motion[:2]


def moments(state):
    """Mean and covariance of velocity, scale and landmarks."""
    members, weights = state.members, np.exp(np.asarray(state.log_weights))
    parts = (members.core.motion, members.core.log_scale, members.landmarks)
    x = np.concatenate([np.asarray(part).reshape(weights.size, -1) for part in parts], axis=1)
    P = np.asarray(members.covariance)
    kept = np.r_[3:7, 10 : P.shape[-1]]  # between them the noise, which is none
    mean = weights @ x
    own = np.tensordot(weights, P[:, kept][:, :, kept], 1)
    return mean, own + np.einsum("k,ki,kj->ij", weights, x - mean, x - mean)


def test_a_sum_as_one_gaussian_has_its_moments_and_reports_its_likeliest_member():
    state, slam, control = some_sum(), case().filter("scale_gauge+mixture9"), case().controls()[0]
    one = quick_jit(lambda s: slam.gaussian(s, control)[1])(state)
    alone = SumState(jax.tree.map(lambda x: x[None], one), jnp.zeros(1))
    for whole, single in zip(moments(state), moments(alone), strict=True):
        np.testing.assert_allclose(single, whole, rtol=1e-9, atol=1e-12 * np.abs(whole).max())
    state = replace(state, log_weights=jnp.log(jnp.full(9, 0.05).at[3].set(0.6)))
    expected = jax.tree.map(lambda x: x[3], state.members)
    jax.tree.map(np.testing.assert_array_equal, state.likeliest, expected)


def test_a_sum_that_is_not_split_is_taken_in_stages_as_by_its_step():
    """And where it expects features is where its members do, by their weights."""
    of = case("matched-forward-loose")
    slam, control = of.filter("world+directions3"), of.controls()[0]
    first, known, new = of.frames(0)
    frame = jax.tree.map(lambda x: x[0], (known, new))

    def both(first):
        state = slam.init(of.capacity, first)
        staged = jaxslam.AbstractStaged.step(slam, state, control, *frame)
        predicted = slam.predict(state, control)
        slots = jnp.arange(of.capacity)
        one = slam.predict_features(predicted, control, slots).measured
        each = jax.vmap(lambda member: slam.inner.predict_features(member, control, slots).measured)
        return staged, slam.step(state, control, *frame), one, each(predicted.members), state

    staged, stepped, one, each, state = quick_jit(both)(first)
    for a, b in zip(jax.tree.leaves(staged), jax.tree.leaves(stepped), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    mean = np.tensordot(np.exp(state.log_weights), each, 1)
    np.testing.assert_allclose(one, mean, atol=0.05 * np.ptp(each, axis=0).max())
    assert np.ptp(each, axis=0).max() > 1


def split(rounds):
    """Compiled anew, as what it is to reach is a constant of the module."""
    return quick_jit(lambda state: _split_and_merged(_parts(lambda core: pixels, state), rounds))


divided = cache(split)


def cost(state):
    P = np.asarray(state.members.covariance)[:, 3:5, 3:5]
    return np.exp(np.asarray(state.log_weights)) @ np.trace(P, axis1=1, axis2=2)


def assert_same_moments(after, before):
    for now, then in zip(moments(after), moments(before), strict=True):
        np.testing.assert_allclose(now, then, rtol=1e-9, atol=1e-12 * np.abs(then).max())


def test_to_split_and_to_merge_keeps_the_moments_and_lessens_the_cost():
    state, once, after = some_sum(), divided(1)(some_sum()), divided(3)(some_sum())
    assert not np.allclose(after.log_weights, state.log_weights)
    np.testing.assert_allclose(np.exp(after.log_weights).sum(), 1, rtol=1e-12)
    assert_same_moments(after, state)
    assert cost(after) < cost(once) < cost(state)
    assert np.linalg.eigvalsh(after.members.covariance).min() > -1e-12


def test_of_a_sum_landmarks_and_the_error_of_the_pose_have_its_moments():
    state, slam, slots = some_sum(), case().filter("scale_gauge+mixture9"), jnp.arange(4)
    truth = jax.tree.map(lambda x: x[-1], case().run(0).poses)

    @quick_jit
    def told(state):
        def both(slam, state):
            return (
                slam.landmark_marginal(state, lambda view: view.point, slots),
                slam.pose_error(state, truth),
            )

        return both(slam, state), jax.vmap(lambda member: both(slam.inner, member))(state.members)

    weights = np.exp(state.log_weights)
    for (mean, covariance), (means, covariances) in zip(*told(state), strict=True):
        expected = np.tensordot(weights, means, 1)
        away = np.asarray(means) - expected
        spread = covariances + away[..., :, None] * away[..., None, :]
        np.testing.assert_allclose(mean, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(covariance, np.tensordot(weights, spread, 1), atol=1e-12)


def test_of_many_members_each_has_to_gain_more(monkeypatch):
    state = some_sum()

    def left(few):
        monkeypatch.setattr(split_merge, "FEW", few)
        return int(split(3)(state).alive.sum())

    assert left(0.1) < left(9)


def cost_as_one(state):
    """Of the whole sum, in pixels²."""
    weights, motion = np.exp(state.log_weights), np.asarray(state.members.core.motion)[:, :2]
    return 100**2 * (cost(state) + weights @ np.sum((motion - weights @ motion) ** 2, axis=1))


def cost_across(state, k):
    """Of the k-th member across its displacement, in pixels²."""
    motion = np.asarray(state.members.core.motion)[k, :2]
    across = np.array([motion[1], -motion[0]]) / np.linalg.norm(motion)
    return 100**2 * across @ np.asarray(state.members.covariance)[k, 3:5, 3:5] @ across


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_sum_ends_where_one_gaussian_costs_little_and_begins_again_where_much(monkeypatch, share):
    """Pairs are merged, three in a frame, as soon as the cost of the whole is below `ENOUGH`; one
    that has ended is split for what it costs across the displacement alone: along it is the scale,
    which nothing observes."""
    state = some_sum()
    monkeypatch.setattr(split_merge, "ENOUGH", float(share * cost_as_one(state)))
    after = split(3)(state)
    assert (state.alive.sum() - after.alive.sum() == 3) == (share > 1)
    assert_same_moments(after, state)
    one = SumState(state.members, jnp.where(jnp.arange(9) == 4, 0.0, -jnp.inf))
    monkeypatch.setattr(split_merge, "ENOUGH", 0.0)
    monkeypatch.setattr(split_merge, "ACROSS", float(share * cost_across(one, 4)))
    after = split(3)(one)
    assert (after.alive.sum() > 1) == (share < 1)
    assert_same_moments(after, one)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_late_splits_are_across_the_displacement(monkeypatch, share):
    """What is along it stays as uncertain in every member as it was."""
    state = some_sum()
    monkeypatch.setattr(split_merge, "ACROSS", float(share * cost_as_one(state)))
    parts, _ = quick_jit(
        lambda state: _as_late(_parts(lambda core: pixels, state), jnp.array(False))
    )(state)
    along = parts.values / np.linalg.norm(parts.values, axis=1)[:, None]
    reached = np.einsum("ki,kic->kc", along, parts.by_core)
    left = np.einsum("ki,kij,kj->k", along, parts.covariances, along)
    alive = np.asarray(state.alive)
    assert np.allclose(reached[alive], 0, atol=1e-12) == (share > 1)
    assert np.allclose(left[alive], 0, atol=1e-12) == (share > 1)
    assert np.abs(parts.by_core[alive]).max() > 1  # of what is across


def test_what_gains_nothing_is_not_split():
    """Members far apart, each of little variance: to merge two would cost more."""
    state = some_sum()
    members = state.members
    apart = jnp.arange(9.0)[:, None] * jnp.ones(3)

    def moved(member, by):
        return replace(member, core=replace(member.core, motion=member.core.motion + by))

    state = SumState(jax.vmap(moved)(members, apart), jnp.log(jnp.full(9, 1 / 9)))
    after = divided(1)(state)
    jax.tree.map(np.testing.assert_array_equal, after, state)


def test_members_without_weight_give_their_places():
    """Whatever is in them, such as what a diverged filter leaves."""
    state = some_sum()
    log_weights = jax.nn.log_softmax(state.log_weights.at[3:].set(-jnp.inf))
    covariance = state.members.covariance.at[3:].set(jnp.nan)
    with_covariance = jax.vmap(lambda member, P: replace(member, covariance=P))
    state = SumState(with_covariance(state.members, covariance), log_weights)
    after = divided(1)(state)
    alive = np.isfinite(after.log_weights)
    assert alive.sum() == 4
    assert np.isfinite(np.asarray(after.members.covariance)[alive]).all()


def innovations_of(residuals, variances, used):
    """Of members that see landmarks by one number each, uncorrelated."""
    residuals, used = jnp.asarray(residuals)[..., None], jnp.asarray(used)
    residuals = jnp.where(used[..., None], residuals, 0.0)
    variances = jnp.where(used, jnp.asarray(variances), 1.0)
    nis = jnp.sum(residuals[..., 0] ** 2 / variances, axis=1)
    covariance = jax.vmap(jnp.diag)(variances)
    log_det = jnp.sum(jnp.log(variances), axis=1)
    status = jnp.full(len(nis), Status.OK)
    return jax.vmap(Innovation)(residuals, residuals, covariance, used, nis, status, log_det)


def test_a_member_gains_nothing_by_a_landmark_behind_itself():
    """Two members see all their landmarks, 3σ off; a third predicts one of them behind itself."""
    used = [[True, True], [True, True], [True, False]]
    found = log_likelihoods(innovations_of(np.full((3, 2), 6.0), np.full((3, 2), 4.0), used))
    weights = jax.nn.softmax(found)
    np.testing.assert_allclose(weights[:2], 0.5, atol=1e-4)
    np.testing.assert_allclose(weights[2] / weights[0], BEHIND, rtol=1e-9)


def test_likelihoods_are_gaussian_of_what_some_member_has_in_front():
    used, wrong, variances = [[True, False]] * 2, [[1.0, 0], [2.0, 0]], [[1.0, 1], [4.0, 1]]
    found = log_likelihoods(innovations_of(wrong, variances, used))
    expected = norm.logpdf(1, scale=1) - norm.logpdf(2, scale=2)
    np.testing.assert_allclose(found[0] - found[1], expected, rtol=1e-12)
    diverged = [[1.0, 1.0], [np.nan, 1.0]]  # which has none, and spoils no other
    found = log_likelihoods(innovations_of(diverged, np.ones((2, 2)), np.ones((2, 2), bool)))
    assert np.isfinite(found).tolist() == [True, False]


@pytest.mark.parametrize(
    ("members", "farthest"), [(3, 2.5), (11, 2.5), (13, 3.0), (15, 3.5), (17, 4.0), (25, 4.0)]
)
def test_members_are_half_a_sigma_apart_between_the_least_and_the_greatest_reach(members, farthest):
    grid, log_weights, sigma = _division(members, 1)
    np.testing.assert_allclose(grid[:, 0], np.linspace(-farthest, farthest, members), atol=1e-12)
    weights = np.exp(log_weights)
    assert weights.sum() == pytest.approx(1)
    assert weights @ grid[:, 0] ** 2 + sigma**2 == pytest.approx(1)
