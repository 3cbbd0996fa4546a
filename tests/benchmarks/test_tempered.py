"""Tests of the exact posterior with several modes: tempered particles, marginal likelihood, modes,
and sums of Gaussians against draws."""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit, simulated
from exact_posterior.laplace import minima, starts
from exact_posterior.marginal import (
    landmark_draws,
    marginal_log_likelihood,
    path_unknowns,
)
from exact_posterior.mixtures import (
    PoseMixture,
    cross_entropy,
    filter_mixture,
    mixture_divergence,
    mixture_of_modes,
)
from exact_posterior.modes import (
    halves,
    reversed_draws,
    second_mode,
    share_against,
    valley,
)
from exact_posterior.moments import mean_pose, pose_moments
from exact_posterior.multimodal import pool, tempered_sample
from exact_posterior.problem import (
    Unknowns,
    inverse_depths,
    log_likelihood,
    make_problem,
    path_size,
)
from exact_posterior.sampler import HMC, sample
from exact_posterior.study import Study, draw_runs, gaussian_sum, pooled
from exact_posterior.tempered import SMC, mean_information, tempered
from jaxlie import SE2
from scipy.special import logsumexp
from scipy.stats import norm

import jaxslam
from jaxslam._runtime.watchdog import lapack_calls
from jaxslam.filters.mixture.sum_state import moments
from jaxslam.filters.readouts import camera_pose
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.geometry import difference, log, retract

pytestmark = pytest.mark.laboratory

FEW = SMC(particles=800, moves=3)
LOOSE = jaxslam.scenario("matched-loose", steps=3, landmarks=4)
BENT = jaxslam.scenario(
    "matched-loose",
    steps=4,
    landmarks=2,
    velocity=(5.0, 10.0, 0.0),
    inverse_depth=(0.15, 0.1),
    pixel_sigma=10.0,
)
"""Few pixels, of landmarks so near that they are no linear functions of inverse depth."""
REST = jaxslam.scenario(
    "matched-loose", steps=2, landmarks=3, velocity=(0.0,) * 3, velocity_sigma=(0.5, 0.5, 0.2)
)


def gaussian(A, z):
    """`−½ |A y − z|²`, and evidence, mean and information of its posterior."""
    n = A.shape[1]
    information = np.eye(n) + A.T @ A
    mean = np.linalg.solve(information, A.T @ z)
    evidence = -(z @ z - z @ A @ mean + np.linalg.slogdet(information)[1]) / 2
    return (lambda y: -jnp.sum((A @ y - z) ** 2) / 2), evidence, mean, information


@cache
def linear():
    rng = np.random.default_rng(0)
    A, z = rng.normal(size=(5, 3)) * [1.0, 5.0, 30.0], rng.normal(size=5) * 5
    target, *expected = gaussian(A, z)
    found = quick_jit(lambda key: tempered(FEW, target, jnp.zeros(3), key))(jax.random.key(1))
    return found, expected


def test_of_a_linear_problem_evidence_and_moments_are_exact():
    """Bounds are 5 standard errors of 800 draws; evidence by the weights of about ten powers."""
    found, (evidence, mean, information) = linear()
    assert found.reached
    assert found.log_evidence == pytest.approx(evidence, abs=0.4)
    white = np.linalg.cholesky(information).T @ (np.asarray(found.position) - mean).T
    np.testing.assert_allclose(white.mean(axis=1), 0, atol=5 / np.sqrt(800))
    np.testing.assert_allclose(np.cov(white), np.eye(3), atol=5 * np.sqrt(2 / 800))


@pytest.mark.parametrize(("first", "expected"), [(0.5, 0.5), (0.1, 0.1)])
def test_modes_have_their_weights(first, expected):
    """Two modes of σ 0.05 at ±1 in three dimensions: no chain would ever cross. The particles part
    when their modes do, at a power when few of them are effective; five repeats, 5 σ."""
    at = jnp.array([1.0, 0.5, -0.5])

    def target(y):
        apart = jnp.stack([jnp.sum((y - s * at) ** 2) for s in (1, -1)]) / 0.05**2
        return jax.nn.logsumexp(jnp.log(jnp.array([first, 1 - first])) - apart / 2)

    keys = jax.random.split(jax.random.key(3), 5)
    found = quick_jit(jax.vmap(lambda key: tempered(FEW, target, jnp.zeros(3), key)))(keys)
    weights = np.mean(np.asarray(found.position) @ np.asarray(at) > 0, axis=1)
    error = np.sqrt(expected * (1 - expected) / 300 / 5)
    assert np.mean(weights) == pytest.approx(expected, abs=5 * error)
    # By symmetry the evidence is that of one mode with all of the weight.
    _, evidence, _, _ = gaussian(np.eye(3) / 0.05, np.asarray(at) / 0.05)
    np.testing.assert_allclose(found.log_evidence, evidence, atol=0.5)


class Weighted(NamedTuple):
    particles: jax.Array
    weights: jax.Array
    tempering_param: float


def test_the_metric_is_the_information_of_the_tempered_density():
    """Of 40 000 exact draws; one without a likelihood says nothing."""
    rng, power = np.random.default_rng(1), 0.3
    A, z = rng.normal(size=(4, 3)) * [1.0, 3.0, 9.0], rng.normal(size=4)
    _, _, mean, information = gaussian(np.sqrt(power) * A, np.sqrt(power) * z)
    draws = rng.multivariate_normal(mean, np.linalg.inv(information), 40000)
    draws[0] = 1e3
    whole, *_ = gaussian(A, z)

    def target(y):
        return jnp.where(y[0] > 500, -jnp.inf, whole(y))

    weights = jnp.full(40000, 1 / 39999).at[0].set(0.0)
    found = quick_jit(partial(mean_information, target))(
        Weighted(jnp.asarray(draws), weights, power)
    )
    whitening = np.linalg.inv(np.linalg.cholesky(information))
    product = whitening @ np.asarray(found.root @ found.root.T) @ whitening.T
    np.testing.assert_allclose(product, np.eye(3), atol=0.05)


def test_particles_that_do_not_get_to_the_whole_likelihood_say_so():
    target, *_ = gaussian(np.eye(3) * 100, np.ones(3))
    few = replace(FEW, particles=50, most_rounds=4)
    found = quick_jit(lambda key: tempered(few, target, jnp.zeros(3), key))(jax.random.key(0))
    assert not found.reached
    assert found.trace.power[-1] < 1


@cache
def problem_of(scenario, *, truncated=True):
    make = quick_jit(partial(make_problem, scenario, truncated=truncated))
    return make(simulated(scenario))


def of_landmark(problem, i):
    """The problem with this landmark alone."""
    own, record = slice(i, i + 1), problem.record
    alone = replace(
        record,
        measured=record.measured[:, own],
        seen=record.seen[:, own],
        first=record.first[own],
    )
    return replace(problem, record=alone)


def by_quadrature(problem, y):
    """Log of the likelihood of a path, and mean and variance of every landmark's inverse depth."""
    x = path_unknowns(problem, y)
    depth, lower = problem.slam.depth, float(problem.least_inverse_depth)
    low = max(lower, float(depth.mean - 7 * depth.sigma))
    omega = np.linspace(low, float(depth.mean + 7 * depth.sigma), 4001)
    white = np.linspace(-7, 7, 141)
    log_prior = norm.logpdf(omega, depth.mean, depth.sigma)
    log_prior = log_prior - norm.logsf(lower, depth.mean, depth.sigma)
    total, moments = 0.0, []

    @quick_jit
    def over_grid(own):
        def value(e, w):
            numbers = jnp.stack([e, (w - depth.mean) / depth.sigma])[None]
            return log_likelihood(own, Unknowns(x.path, numbers))

        return jax.vmap(jax.vmap(value, (None, 0)), (0, None))(white, omega)

    for i in range(problem.landmarks):
        grid = over_grid(of_landmark(problem, i))
        steps = (white[1] - white[0]) * (omega[1] - omega[0])
        values = grid + norm.logpdf(white)[:, None] + log_prior + np.log(steps)
        total += logsumexp(values)
        share = np.exp(logsumexp(values, axis=0) - logsumexp(values))
        mean = share @ omega
        moments.append((mean, share @ (omega - mean) ** 2))
    return total, np.array(moments)


def true_path(scenario):
    """y of the path that `problem_of` was made with, as if its first step had no acceleration."""
    return quick_jit(partial(_true_path, scenario))(simulated(scenario))


def _true_path(scenario, run):
    steps = jax.tree.map(lambda x: x[:-1], run.poses).inverse() @ jax.tree.map(
        lambda x: x[1:], run.poses
    )
    velocities = jax.vmap(log)(steps) * scenario.rate
    first = (velocities[0] - jnp.array(scenario.velocity)) / jnp.array(scenario.velocity_sigma)
    changes = jnp.diff(velocities, axis=0, prepend=velocities[:1]) * scenario.rate
    accelerations = changes / jnp.array(scenario.acceleration_sigma)
    return jnp.concatenate([first, accelerations.ravel()])


@pytest.mark.parametrize("truncated", [True, False])
def test_the_likelihood_of_a_path_is_the_integral_over_its_landmarks(truncated):
    problem, y = problem_of(REST, truncated=truncated), true_path(REST)
    expected, _ = by_quadrature(problem, y)
    value, slope = quick_jit(jax.value_and_grad(partial(marginal_log_likelihood, problem)))(y)
    assert value == pytest.approx(expected, abs=2e-3)
    assert np.isfinite(slope).all()


@cache
def bent():
    """A path with bent pixels, its exact likelihood and moments, and landmarks drawn of it."""
    problem, y = problem_of(BENT), true_path(BENT)
    keys = jax.random.split(jax.random.key(0), 20000)
    draws = quick_jit(jax.vmap(lambda key: landmark_draws(problem, y, key, 8)))(keys)
    return quick_jit(marginal_log_likelihood)(problem, y), by_quadrature(problem, y), draws


def test_the_weight_of_a_path_makes_its_likelihood_exact_where_pixels_are_bent():
    """Bounds: 5 standard errors of 20 000 draws."""
    value, (expected, _), (_, log_weights) = bent()
    assert abs(value - expected) > 0.1  # the linear model's own is wrong here
    weights = np.exp(log_weights)
    error = 5 * weights.std() / np.sqrt(20000)
    assert np.exp(expected - value) == pytest.approx(weights.mean(), abs=error)
    assert error < 0.03


def test_weighted_landmarks_have_their_exact_moments():
    _, (_, moments), (x, log_weights) = bent()
    weights = np.exp(log_weights) / np.sum(np.exp(log_weights))
    omega = np.asarray(jax.vmap(partial(inverse_depths, problem_of(BENT)))(x))
    mean = weights @ omega
    sigma = np.sqrt(moments[:, 1])
    np.testing.assert_allclose((mean - moments[:, 0]) / sigma, 0, atol=5 / np.sqrt(10000))
    variance = weights @ (omega - mean) ** 2
    np.testing.assert_allclose(variance / moments[:, 1], 1, atol=0.1)
    assert omega.min() > BENT.least_inverse_depth


def test_a_path_with_a_landmark_behind_the_camera_is_impossible():
    problem = problem_of(REST)
    y, likelihood = jnp.zeros(path_size(problem)), quick_jit(marginal_log_likelihood)
    assert np.isfinite(likelihood(problem, y))
    past = y.at[1].set(1000 / REST.velocity_sigma[1])
    assert likelihood(problem, past) == -jnp.inf
    drawn = quick_jit(lambda problem, y, key: landmark_draws(problem, y, key, 3))
    assert drawn(problem, past, jax.random.key(0))[1] == -jnp.inf
    unseen = replace(problem.record, seen=jnp.zeros_like(problem.record.seen))
    hidden = replace(problem, record=unseen)
    assert likelihood(hidden, past) == pytest.approx(0, abs=1e-12)


@cache
def on_one_mode():
    """The same posterior by tempered particles and by Hamiltonian chains."""
    study = Study(LOOSE, 3, HMC(chains=4, warmup=100, draws=400))
    run = jax.tree.map(lambda x: x[0], draw_runs(study, 7, range(1)))
    problem = make_problem(LOOSE, run)
    modes_key, chains_key, key = jax.random.split(jax.random.key(0), 3)

    @quick_jit
    def chains(problem):
        modes, _, _ = minima(problem, starts(problem, modes_key, 1))
        return sample(study.hmc, problem, modes[0], chains_key)

    particles = replace(FEW, particles=1500)
    return quick_jit(partial(tempered_sample, particles))(problem, key), chains(problem)


def depths_of(draws):
    """Inverse depths of draws of `on_one_mode`, 1/m."""
    return jax.vmap(partial(inverse_depths, problem_of(LOOSE)))(draws.unknowns)


def test_on_a_problem_of_one_mode_particles_and_chains_agree():
    """In the last pose, the velocity and the depths; bounds are 5 of what 400 draws would err."""
    draws, chains = on_one_mode()
    assert draws.reached
    assert draws.effective > 0.9
    mean, P, _ = pose_moments(pooled(chains))
    found, S, _ = pose_moments(draws.last)
    sigma = np.sqrt(np.diagonal(P))
    np.testing.assert_allclose(difference(found, mean) / sigma, 0, atol=5 / 20)
    np.testing.assert_allclose(np.diagonal(S) / sigma**2, 1, atol=5 * np.sqrt(2 / 400))
    for own, other in (
        (draws.velocity, chains.velocity),
        (depths_of(draws), chains.inverse_depths),
    ):
        expected = np.asarray(other).reshape(-1, own.shape[1])
        apart = (own.mean(axis=0) - expected.mean(axis=0)) / expected.std(axis=0)
        np.testing.assert_allclose(apart, 0, atol=5 / 20)
        np.testing.assert_allclose(own.std(axis=0) / expected.std(axis=0), 1, atol=5 / 28)


def test_repeats_are_pooled_by_their_evidence():
    draws, _ = on_one_mode()
    shifted = jax.tree.map(lambda x: x + 100.0, draws.velocity)
    one, two = draws, replace(draws, velocity=shifted, log_evidence=draws.log_evidence + np.log(3))
    both = pool(jax.tree.map(lambda *x: jnp.stack(x), one, two), jax.random.key(0))
    assert both.velocity.shape == (3000, 3)
    assert np.mean(both.velocity[:, 0] > 50) == pytest.approx(0.75, abs=1e-3)
    assert both.log_evidence - draws.log_evidence == pytest.approx(np.log(2))
    # A draw is taken as a whole.
    depths = np.asarray(both.unknowns.landmarks[..., -1])
    order = [
        int(np.flatnonzero((draws.unknowns.landmarks[..., -1] == w).all(axis=1))[0])
        for w in depths[[0, 1700, 2999]]
    ]
    velocities = both.velocity[jnp.array([0, 1700, 2999])] % 100.0
    np.testing.assert_allclose(velocities, draws.velocity[jnp.array(order)] % 100.0, atol=1e-9)


def test_no_tempered_posterior_calls_lapack():
    problem = problem_of(LOOSE)
    one = partial(tempered_sample, replace(FEW, particles=8))
    traced = jax.make_jaxpr(one)(problem, jax.random.key(0))
    assert lapack_calls(traced.jaxpr) == set()


def two_sided(share, apart, count=2000, sigma=0.1):
    """Poses at ± `apart` along a slanted line, a share of them on the other side."""
    rng = np.random.default_rng(0)
    other = np.arange(count) < share * count
    line = np.where(other, -1.0, 1.0)[:, None] * apart * np.array([-0.8, 0.6])
    xy = line + sigma * rng.normal(size=(count, 2))
    theta = 0.01 * rng.normal(size=count)
    return SE2.from_xy_theta(*jnp.asarray(xy).T, jnp.asarray(theta)), other


@pytest.mark.parametrize("share", [0.2, 0.45])
def test_reversed_draws_are_those_beyond_the_origin_from_most(share):
    poses, other = two_sided(share, 0.5)
    group = quick_jit(reversed_draws)(poses)
    np.testing.assert_array_equal(group, other)
    assert valley(poses.translation(), group) < 0.1
    assert second_mode(poses.translation(), group) == pytest.approx(share)


def test_one_mode_around_the_origin_has_no_second():
    poses, _ = two_sided(0.5, 0.0)
    _, _, tangents = pose_moments(poses)
    behind, group = reversed_draws(poses), quick_jit(halves)(tangents)
    for points, lesser in ((poses.translation(), behind), (tangents, group)):
        assert 0.4 < np.mean(lesser) <= 0.5
        assert valley(points, lesser) > 1
        assert second_mode(points, lesser) == 0


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_halves_are_the_modes_whatever_units_and_correlations_hide_them(share):
    """Two sharp sides in one of three numbers, which a linear map mixes with the others."""
    rng = np.random.default_rng(0)
    other = np.arange(1000) < share * 1000
    points = rng.normal(size=(1000, 3)) * [0.05, 1.0, 1.0]
    points[:, 0] += np.where(other, -0.5, 0.5)
    mixed = points @ np.array([[1.0, 2.0, 1e-3], [30.0, 1.0, 0.0], [0.0, 0.0, 1e-3]]).T + 7.0
    group = quick_jit(halves)(jnp.asarray(mixed))
    np.testing.assert_array_equal(group, other)
    assert second_mode(jnp.asarray(mixed), group) == pytest.approx(share)


def modes_of(share, apart, sigma=0.1):
    means = SE2.from_xy_theta(
        jnp.array([-0.8, 0.8]) * apart, jnp.array([0.6, -0.6]) * apart, jnp.zeros(2)
    )
    P = jnp.diag(jnp.array([sigma, sigma, 0.01]) ** 2)
    return PoseMixture(means, jnp.stack([P, P]), jnp.array([1 - share, share]))


def test_the_divergence_from_a_sum_of_gaussians_is_that_of_its_weights_where_modes_are_apart():
    poses, _ = two_sided(0.2, 1.0)
    divergence = quick_jit(mixture_divergence)
    assert divergence(poses, modes_of(0.2, 1.0)) == pytest.approx(0, abs=0.1)
    # KL of the weights (0.8, 0.2) against (0.5, 0.5).
    expected = 0.8 * np.log(0.8 / 0.5) + 0.2 * np.log(0.2 / 0.5)
    more = divergence(poses, modes_of(0.5, 1.0)) - divergence(poses, modes_of(0.2, 1.0))
    assert more == pytest.approx(expected, abs=1e-6)
    # Without the second mode all of its draws are as unlikely as they are far away.
    alone = cross_entropy(poses, modes_of(0.0, 1.0))
    assert alone - cross_entropy(poses, modes_of(0.2, 1.0)) > 0.2 * 100


def mixture_moments(mixture):
    """Mean and covariance of a sum, in the right tangent at that mean."""
    mean, away = mean_pose(mixture.means, mixture.weights)
    return mean, moments(jnp.log(mixture.weights), away, mixture.covariances)[1]


def test_the_sum_of_the_modes_of_the_draws_has_their_moments():
    poses, other = two_sided(0.3, 0.5)
    labels = jnp.asarray(other).astype(int)
    found = quick_jit(lambda poses: mixture_of_modes(poses, labels, 2))(poses)
    np.testing.assert_allclose(found.weights, [0.7, 0.3])
    expected = modes_of(0.3, 0.5)
    apart = jax.vmap(difference)(found.means, expected.means)
    np.testing.assert_allclose(apart, 0, atol=0.02)
    np.testing.assert_allclose(found.covariances, expected.covariances, atol=1e-3)
    mean, P = mixture_moments(found)
    direct, S, _ = pose_moments(poses)
    np.testing.assert_allclose(difference(mean, direct), 0, atol=1e-3)
    np.testing.assert_allclose(P, S, rtol=0.02, atol=1e-4)


def test_the_share_against_a_direction_is_that_of_draws_of_the_sum():
    """Of turned means: a Gaussian's axes are its mean's."""
    means = SE2.from_xy_theta(*jnp.array([[0.1, -0.2, 5.0], [0.05, 0.1, 5.0], [0.3, 1.5, 0.0]]))
    P = jnp.diag(jnp.array([0.3, 0.05, 0.01]) ** 2)
    mixture = PoseMixture(means, jnp.stack([P, P, P * jnp.nan]), jnp.array([0.6, 0.4, 0.0]))
    direction = jnp.array([0.8, -0.6])
    rng = np.random.default_rng(0)
    expected = 0.0
    for k, weight in enumerate((0.6, 0.4)):
        mean = jax.tree.map(lambda x, k=k: x[k], means)
        moved = rng.normal(size=(40000, 2)) @ np.diag([0.3, 0.05])
        t = mean.translation() + moved @ np.asarray(mean.rotation().as_matrix()).T
        expected += weight * np.mean(t @ direction < 0)
    found = quick_jit(share_against)(mixture, direction)
    assert found == pytest.approx(expected, abs=5 * 0.5 / np.sqrt(40000))
    assert share_against(mixture, -direction) == pytest.approx(float(1 - found))


@cache
def a_sum():
    """A Gaussian sum of five members, each with a pose and a covariance of its own, its filter,
    and a true pose."""
    (slam,) = jaxslam.make_filters(LOOSE, ["scale_gauge+mixture5"], ["inverse_scaling"]).values()
    state, rng = quick_jit(lambda: slam.init(4))(), np.random.default_rng(0)
    away = rng.normal([0.1, 0.05, 0.0], 0.03, (5, 3))
    roots = rng.normal(0.0, 0.03, state.members.covariance.shape)

    def moved(member, away, root):
        core = replace(member.core, pose=retract(member.core.pose, away))
        return replace(member, core=core, covariance=root @ root.T)

    members = quick_jit(jax.vmap(moved))(state.members, away, roots)
    return slam, replace(state, members=members), SE2.from_xy_theta(-0.1, -0.1, 0.02)


def test_the_gaussians_of_a_filter_have_its_moments():
    slam, state, _ = a_sum()

    @quick_jit
    def told(state):
        found = filter_mixture(slam, state)
        return found, mixture_moments(found), camera_pose(slam, state)

    found, (mean, P), (expected, S) = told(state)
    assert np.sum(found.weights) == pytest.approx(1)
    assert np.sum(np.asarray(found.weights) > 1e-3) > 1
    sigma = np.sqrt(np.diagonal(S))
    np.testing.assert_allclose(difference(mean, expected) / sigma, 0, atol=1e-2)
    np.testing.assert_allclose(P / np.outer(sigma, sigma), S / np.outer(sigma, sigma), atol=2e-2)


def test_a_start_from_rest_has_the_gaussians_of_its_sum_and_a_plain_filter_has_one():
    slam, state, _ = a_sum()
    start = replace(slam, start=FromWindow(Schedule.of(slam.motion.geometry, 3)))
    begun = replace(quick_jit(lambda: start.init(4))(), sum=state)
    jax.tree.map(
        np.testing.assert_array_equal, filter_mixture(start, begun), filter_mixture(slam, state)
    )
    member = state.likeliest
    mean, P = camera_pose(slam.one, member)
    one = filter_mixture(slam.one, member)
    assert one.weights.tolist() == [1.0]
    np.testing.assert_array_equal(one.means.parameters()[0], mean.parameters())
    np.testing.assert_array_equal(one.covariances[0], P)


def drawn_from(mixture, count):
    """Poses of a sum of Gaussians."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(mixture.weights), count, p=np.asarray(mixture.weights))
    roots = np.linalg.cholesky(np.asarray(mixture.covariances))
    away = np.einsum("sij,sj->si", roots[chosen], rng.normal(size=(count, 3)))
    means = jax.tree.map(lambda x: x[chosen], mixture.means)
    return jax.vmap(retract)(means, jnp.asarray(away))


def test_of_its_own_draws_a_sum_of_gaussians_is_the_exact_one():
    """Shifted by σ of its first number, it is not."""
    slam, state, truth = a_sum()
    mixture = filter_mixture(slam, state)
    draws = drawn_from(mixture, 2000)
    against = quick_jit(partial(gaussian_sum, slam))
    found = against(state, truth, draws)
    assert found["kl_of_sum"] == pytest.approx(0, abs=0.1)
    assert found["reversed"] == pytest.approx(float(found["exact_reversed"]), abs=0.03)
    far = jnp.array([np.sqrt(found["covariance"][0, 0]), 0.0, 0.0])
    moved = jax.vmap(retract, in_axes=(0, None))(draws, far)
    assert against(state, truth, moved)["kl_of_sum"] > 0.3
    error, P = slam.pose_error(state, truth)
    assert found["nees"] == pytest.approx(float(error @ np.linalg.solve(P, error)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("particles", 4),
        ("moves", 0),
        ("leapfrogs", 0),
        ("last", 0),
        ("most_rounds", 1),
        ("landmark_draws", 0),
        ("survivors", 1.0),
        ("acceptance", 0.0),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(field, value):
    wrong: dict[str, Any] = {field: value}
    with pytest.raises(ValueError, match=field):
        SMC(**wrong)
