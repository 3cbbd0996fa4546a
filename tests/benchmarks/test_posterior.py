"""Tests of exact_posterior: the model against dense formulas, MAP, HMC, ranks, bad input."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, each_geometry, named, pose, quick_jit, simulated
from exact_posterior.conditional import (
    centre,
    conditional_log_density,
    conditional_unknowns,
)
from exact_posterior.laplace import pose_gaussian, starts
from exact_posterior.moments import (
    covariance,
    gaussian_divergence,
    in_base_axes,
    pose_moments,
    to_base_axes,
)
from exact_posterior.problem import (
    check_scenario,
    first_steps,
    log_density,
    make_problem,
    residuals,
    size,
    truncated_normal,
    unknowns,
)
from exact_posterior.ranks import ranks, uniformity
from exact_posterior.sampler import HMC, diagnose, given_bound
from exact_posterior.study import (
    Study,
    _keys,
    _modes,
    _sample,
    against_filter,
    draw_runs,
    pooled,
    reference,
)
from jaxlie import SE2
from scipy.linalg import expm
from scipy.stats import norm, truncnorm

import jaxslam
from jaxslam._runtime.watchdog import lapack_calls
from jaxslam.geometry import difference, retract

pytestmark = pytest.mark.laboratory

LOOSE = jaxslam.scenario("matched-loose", steps=3, landmarks=4)
SPATIAL = jaxslam.scenario("matched-6dof-loose", steps=2, landmarks=3)
NEARLY_LINEAR = jaxslam.scenario(
    "matched-loose",
    steps=3,
    landmarks=4,
    velocity_sigma=(1e-3,) * 3,
    acceleration_sigma=(1e-2,) * 3,
    inverse_depth=(0.2, 1e-3),
    pixel_sigma=1e-2,
)
SMALL = Study(LOOSE, 3, HMC(chains=2, warmup=100, draws=150), starts=1)


@cache
def problem_of(scenario, *, seed=0, truncated=True):
    run = simulated(scenario, seed)
    return quick_jit(partial(make_problem, scenario, truncated=truncated))(run), run


residuals_of = quick_jit(residuals)


def as_vector(x):
    """The numbers of `Unknowns` in the order of y."""
    return jnp.concatenate([x.path, x.landmarks[:, :-1].ravel(), x.landmarks[:, -1]])


def draw(problem, seed=1):
    """A y at which everything is in front of the camera: much smaller than the prior's."""
    return 0.1 * jax.random.normal(jax.random.key(seed), (size(problem),))


def dense_residuals(scenario, problem, y):
    """`residuals` by homogeneous matrices and matrix exponentials, one number at a time."""
    y, n = np.asarray(y), scenario.geometry.point_dim
    t, p, landmarks = len(scenario.velocity), n - 1, scenario.landmarks
    mean, sigma = 1 / (2 * scenario.nearest_depth), 1 / (4 * scenario.nearest_depth)
    velocity = np.add(scenario.velocity, np.multiply(scenario.velocity_sigma, y[:t]))
    pixels_at = t * (scenario.steps + 1)
    depths_at = pixels_at + landmarks * p
    focal, centre = np.array(scenario.focal), np.array(scenario.centre)
    points = []
    for i in range(landmarks):
        own = y[pixels_at + p * i : pixels_at + p * (i + 1)]
        pixel = problem.record.measured[0, i] + scenario.pixel_sigma * own
        lower = (scenario.least_inverse_depth - mean) / sigma
        omega = truncnorm.ppf(norm.cdf(y[depths_at + i]), lower, np.inf, mean, sigma)
        points.append([*(np.append((pixel - centre) / focal, 1.0) / omega), 1.0])
    T_BC, errors = np.eye(n + 1), []
    for k in range(scenario.steps):
        a = np.multiply(scenario.acceleration_sigma, y[t * (k + 1) : t * (k + 2)])
        velocity = velocity + a / scenario.rate
        T_BC = T_BC @ expm(hat(velocity / scenario.rate))
        for i, point in enumerate(points):
            seen = np.linalg.solve(T_BC, point)[:n]
            error = problem.record.measured[k + 1, i] - (focal * seen[:-1] / seen[-1] + centre)
            errors.extend(error / scenario.pixel_sigma * float(problem.record.seen[k + 1, i]))
    return np.concatenate([y, errors])


def hat(v):
    """The matrix of a twist, translation first."""
    n = 2 if len(v) == 3 else 3
    M = np.zeros((n + 1, n + 1))
    M[:n, n] = v[:n]
    if n == 2:
        M[:2, :2] = [[0, -v[2]], [v[2], 0]]
    else:
        x, y, z = v[3:]
        M[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return M


@pytest.mark.parametrize("lower", [-1.99, 0.5, -6.0])
def test_the_truncated_normal_is_scipys_and_its_slope_is_a_ratio_of_densities(lower):
    y = np.linspace(-5, 5, 21)
    # scipy's own quantile is exact in the tail that its argument is small in.
    below = truncnorm.ppf(norm.cdf(y), lower, np.inf)
    above = truncnorm.isf(norm.sf(y), lower, np.inf)
    expected = np.where(y < 0, below, above)
    got = quick_jit(truncated_normal)(y, lower)
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-9)
    slope = quick_jit(jax.vmap(jax.grad(truncated_normal), (0, None)))(y, lower)
    ratio = norm.pdf(y) * norm.sf(lower) / norm.pdf(expected)
    np.testing.assert_allclose(slope, ratio, rtol=1e-6)


def test_without_a_bound_the_truncated_normal_is_the_normal():
    y = jnp.linspace(-9, 9, 37)
    np.testing.assert_allclose(truncated_normal(y, jnp.asarray(-jnp.inf)), y, atol=1e-12)


@pytest.mark.parametrize("scenario", [LOOSE, SPATIAL], ids=["planar", "spatial"])
def test_residuals_and_their_jacobian_are_those_of_a_dense_computation(scenario):
    problem, _ = problem_of(scenario)
    assert bool(jnp.all(problem.record.seen))
    y = draw(problem)
    got = residuals_of(problem, y)
    expected = dense_residuals(scenario, problem, y)
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-7)
    J = quick_jit(jax.jacfwd(partial(residuals, problem)))(y)
    for i in (0, y.size // 2, y.size - 1):
        step = np.zeros(y.size)
        step[i] = 1e-4
        central = dense_residuals(scenario, problem, y + step)
        central = (central - dense_residuals(scenario, problem, y - step)) / 2e-4
        np.testing.assert_allclose(J[:, i], central, rtol=1e-5, atol=1e-5)
    assert quick_jit(log_density)(problem, y) == pytest.approx(-expected @ expected / 2)


def test_a_landmark_that_is_not_visible_tells_nothing_and_one_behind_is_impossible():
    problem, _ = problem_of(LOOSE)
    y = draw(problem)
    seen = problem.record.seen.at[2, 2].set(False)
    hidden = replace(problem, record=replace(problem.record, seen=seen))
    less = residuals_of(hidden, y) != residuals_of(problem, y)
    assert np.flatnonzero(less).tolist() == [y.size + LOOSE.landmarks + 2]
    # A velocity ahead of 300 σ passes every landmark within a frame.
    past = y.at[1].set(300 / LOOSE.velocity_sigma[1])
    assert quick_jit(log_density)(problem, past) == -jnp.inf


@pytest.mark.parametrize("truncated", [True, False])
def test_the_conditional_variables_have_the_jacobian_that_they_claim(truncated):
    problem, _ = problem_of(LOOSE, truncated=truncated)
    mode = draw(problem)

    def physical(w):
        return as_vector(conditional_unknowns(problem, mode, w)[0])

    a, b = mode + draw(problem, 2), mode + 5 * draw(problem, 3)
    if truncated:  # there is no density where an inverse depth is below the bound
        a, b = (w.at[-LOOSE.landmarks :].add(10.0) for w in (a, b))

    # So the density of w is that of y, by the rule for a change of variables.
    def whitened(w):
        x = physical(w)
        return jax.lax.fori_loop(0, 30, lambda _, y: y + (x - at(y)) / slope(y), mode)

    def at(y):
        return as_vector(unknowns(problem, y))

    def slope(y):
        return jax.jvp(at, (y,), (jnp.ones_like(y),))[1]

    @quick_jit
    def told(w):
        log_det, y = jnp.linalg.slogdet(jax.jacfwd(physical)(w))[1], whitened(w)
        expected = log_density(problem, y) + log_det - jnp.sum(jnp.log(slope(y)))
        claimed = conditional_unknowns(problem, mode, w)[1]
        return claimed, log_det, conditional_log_density(problem, mode, w), expected

    claimed, exact, value, expected = (float(y - x) for x, y in zip(told(a), told(b), strict=True))
    assert claimed == pytest.approx(exact, abs=1e-9)
    assert value == pytest.approx(expected, rel=1e-9)


@cache
def nearly_linear():
    """A problem, its MAP and its chains, by the programs that `small_study` needs too."""
    runs = draw_runs(replace(SMALL, scenario=NEARLY_LINEAR), 0, range(40))
    make = jax.vmap(partial(make_problem, NEARLY_LINEAR, truncated=False))
    problems = quick_jit(make)(runs)
    starts_keys, chains_keys = jax.random.split(jax.random.key(2), (2, 40))
    modes = _modes(SMALL.starts, problems, starts_keys)
    chains = _sample(SMALL.hmc, problems, modes.mode, chains_keys)
    return jax.tree.map(lambda x: x[0], (problems, runs, modes, chains))


def test_on_a_nearly_linear_problem_map_hmc_and_the_filter_agree():
    problem, run, mode, chains = nearly_linear()
    assert bool(mode.converged)
    gradient = quick_jit(jax.grad(partial(log_density, problem)))(mode.mode)
    assert np.abs(gradient @ mode.root).max() < 1e-3
    mean, P = quick_jit(pose_gaussian)(problem, mode)

    of_chains = quick_jit(lambda chains: pose_moments(pooled(chains).inverse()))
    T_CB, S, tangents = of_chains(chains)
    rhat, ess = diagnose(tangents.reshape(SMALL.hmc.chains, -1, 3))
    assert rhat.max() < 1.05
    assert ess.min() > 200
    sigma = np.sqrt(np.diagonal(P))
    error = np.abs(difference(T_CB, mean)) / sigma
    assert (error < 4 / np.sqrt(ess)).all()
    np.testing.assert_allclose(np.diagonal(S), sigma**2, rtol=float(5 * np.sqrt(2 / ess.min())))

    (slam,) = jaxslam.make_filters(NEARLY_LINEAR, ["robocentric"], ["inverse_depth"]).values()
    one = jax.tree.map(lambda x: x[None], (run, pooled(chains)))
    study = replace(SMALL, scenario=NEARLY_LINEAR)
    records = jax.tree.map(lambda x: x[0], against_filter(study, slam, *one))
    truth = jax.tree.map(lambda x: x[-1], run.poses)
    # In base axes the Laplace covariance and the filter's must be the same but for 2 % of the σ.
    adjoint = mean.adjoint()
    P_base = to_base_axes(mean.inverse(), adjoint @ P @ adjoint.T)
    base_sigma = np.sqrt(np.diagonal(P_base))
    difference_of = (records["covariance"] - P_base) / np.outer(base_sigma, base_sigma)
    assert np.abs(difference_of).max() < 0.02
    base = quick_jit(in_base_axes)(jax.tree.map(lambda x: x[None], truth), mean.inverse())[0]
    assert np.all(np.abs(records["error"] - base) < 0.02 * np.sqrt(np.diagonal(P_base)))
    assert 0 <= records["kl"] < 0.05


def test_given_the_path_the_conditional_variables_of_depth_are_standard_normal():
    """Also on a path far from the mode's, at a scale and in a direction of its own."""
    problem, _ = problem_of(LOOSE, truncated=False)
    mode = draw(problem)
    w = centre(problem, mode).at[:2].add(jnp.array([2.5, -2.0]))
    density = partial(conditional_log_density, problem, mode)

    def of_depths(e):
        return density(w.at[-LOOSE.landmarks :].set(e))

    at, H = quick_jit(lambda e: (jax.grad(of_depths)(e), jax.hessian(of_depths)(e)))(
        jnp.zeros(LOOSE.landmarks)
    )
    np.testing.assert_allclose(at, 0, atol=0.3)
    np.testing.assert_allclose(H, -np.eye(LOOSE.landmarks), atol=0.15)


def test_moments_and_distances_of_gaussian_draws_are_those_of_the_gaussian():
    rng = np.random.default_rng(0)
    mean = SE2.from_xy_theta(1.0, -2.0, 0.4)
    L = np.array([[0.02, 0, 0], [0.01, 0.03, 0], [-0.002, 0.001, 0.005]])
    draws = rng.normal(size=(20000, 3)) @ L.T
    poses = quick_jit(jax.vmap(lambda d: retract(mean, d)))(jnp.asarray(draws))
    found, P, tangents = quick_jit(pose_moments)(poses)
    np.testing.assert_allclose(difference(found, mean), draws.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(P, L @ L.T, rtol=0.05, atol=2e-5)
    np.testing.assert_allclose(tangents.mean(axis=0), 0, atol=1e-9)
    shift, wide = np.array([0.1, 0, 0]), np.diag([0.04, 0.05, 0.01]) ** 2
    S = covariance(jnp.asarray(draws))
    inverse = np.linalg.inv(wide)
    offset = draws.mean(axis=0) + shift
    expected = (
        np.trace(inverse @ S)
        + offset @ inverse @ offset
        - 3
        + np.log(np.linalg.det(wide) / np.linalg.det(S))
    ) / 2
    assert gaussian_divergence(jnp.asarray(draws) + shift, jnp.asarray(wide)) == pytest.approx(
        float(expected)
    )


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_covariance_in_base_axes_is_that_of_draws_in_base_axes(geometry):
    """Of small draws, so that the tangent at the mean and the axes of B differ by a turn alone."""
    rng, t = np.random.default_rng(0), geometry.tangent_dim
    mean = pose(geometry, 3, scale=1.0)
    draws = 1e-6 * rng.normal(size=(50, t)) @ rng.normal(size=(t, t))

    @quick_jit
    def both(draws):
        moved = jax.vmap(lambda d: retract(mean, d))(draws)
        return covariance(in_base_axes(moved, mean)), to_base_axes(mean, covariance(draws))

    close(*both(draws), 1e-5)


def test_ranks_of_the_truth_are_uniform_if_and_only_if_the_draws_are_right():
    rng = np.random.default_rng(1)
    centre = rng.normal(size=(500, 1, 2))
    truth, draws = (centre + rng.normal(size=(500, n, 2)) for n in (1, 400))
    _, p = uniformity(ranks(truth[:, 0], draws, 99), 99)
    assert (p > 1e-3).all()
    narrow = centre + 0.7 * (draws - centre)
    _, p = uniformity(ranks(truth[:, 0], narrow, 99), 99)
    assert (p < 1e-3).all()


@cache
def small_study():
    """Records of 40 small problems and their exact draws, made once."""
    records, exact = reference(SMALL, draw_runs(SMALL, 7, range(40)), 7, range(40))
    return jax.device_get(records), exact


def test_chains_and_starts_use_no_key_of_the_simulator_and_none_twice():
    """A chain that begins at the draws that made the truth knows the answer."""
    own, runs = _keys(5, range(3)), jax.random.key(5)
    runs = jax.vmap(partial(jax.random.fold_in, runs))(jnp.arange(3))
    simulated = jax.vmap(lambda key: jax.random.split(key, 16))(runs).ravel()
    found = [
        {tuple(key) for key in np.asarray(jax.random.key_data(keys)).tolist()}
        for keys in (jnp.concatenate(own), jnp.concatenate([runs, simulated]))
    ]
    assert len(found[0]) == 2 * 3
    assert not found[0] & found[1]


@pytest.mark.statistics
def test_the_posterior_is_calibrated():
    """Ranks and NEES over 40 problems; false alarms: 0.4 % by six ranks, 0.1 % by the NEES."""
    records, _ = small_study()
    assert np.mean(records["exact_rhat"] < 1.1) > 0.9
    _, p = uniformity(ranks(records["exact_truth"], records["exact_draws"], 49), 49, bins=5)
    assert (p > 7e-4).all()
    low, high = jaxslam.mean_band(3, 40, confidence=0.999)
    assert low < records["exact_nees"].mean() < high


def test_the_truncated_posterior_is_the_other_one_above_the_bound():
    records, exact = small_study()
    assert float(exact.inverse_depths.min()) >= LOOSE.least_inverse_depth
    assert (records["exact_behind_infinity"] == 0).all()
    share, behind = records["exact_share"], records["gaussian_prior_behind_infinity"]
    assert share.min() < 1
    assert (share <= 1 - behind + 1e-12).all()
    # The truncated model's own density differs by the same at all the draws of the other.
    problem, _ = problem_of(LOOSE)
    whole = replace(problem, least_inverse_depth=jnp.asarray(-jnp.inf))

    def physical_density(problem, y):
        slope = jax.jvp(lambda y: as_vector(unknowns(problem, y)), (y,), (jnp.ones_like(y),))[1]
        return log_density(problem, y) - jnp.sum(jnp.log(slope))

    lower = (LOOSE.least_inverse_depth - 1 / 6) * 12
    differences = []
    for seed in (1, 2):
        y = draw(problem, seed)
        depths = jax.vmap(lambda y: truncated_normal(y, jnp.asarray(lower)))(y[-LOOSE.landmarks :])
        same = y.at[-LOOSE.landmarks :].set(depths)
        differences.append(physical_density(problem, y) - physical_density(whole, same))
    assert differences[0] == pytest.approx(float(differences[1]), abs=1e-8)


def test_draws_below_the_bound_are_replaced_evenly_by_those_above():
    chains = small_study()[1]
    one = jax.tree.map(lambda x: x[0], chains)
    omega = one.inverse_depths.at[0, ::2, 1].set(-1.0).at[1, :, 0].set(-1.0)
    kept, share = given_bound(0.0, replace(one, inverse_depths=omega))
    draws = omega.shape[1]
    expected = np.repeat(np.arange(1, draws, 2), 2)
    np.testing.assert_array_equal(kept.log_density[0], one.log_density[0, expected])
    assert share == 0


@pytest.mark.parametrize(
    ("name", "fields", "match"),
    [
        ("circle", {}, "placement"),
        ("positions", {}, "placement"),
        ("matched", {"calibration": "white"}, "calibration"),
        ("matched", {"known_landmarks": 5}, "known_landmarks"),
        ("matched", {"first_frame": 1}, "first_frame"),
        ("matched", {"first_pixels": [[-5.0, 600.0]]}, "first_pixels"),
    ],
)
def test_a_scenario_of_another_kind_is_refused(name, fields, match):
    with pytest.raises(ValueError, match=match):
        check_scenario(jaxslam.scenario(name, **fields))


def test_starts_are_the_mean_of_the_prior_and_draws_of_it_without_accelerations():
    problem, _ = problem_of(LOOSE)
    first, *others = starts(problem, jax.random.key(0), 400)
    assert not np.any(first)
    others = np.array(others)
    drawn = np.r_[:3, size(problem) - LOOSE.landmarks : size(problem)]  # velocity and depths
    assert not np.any(np.delete(others, drawn, axis=1))
    # 399 draws of 7 numbers: each mean within 5 σ of 0, each σ within 5 of its own of 1.
    assert np.abs(others[:, drawn].mean(axis=0)).max() < 5 / np.sqrt(399)
    assert np.abs(others[:, drawn].std(axis=0) - 1).max() < 5 / np.sqrt(2 * 399)


def test_sizes_that_make_no_sense_are_refused():
    _, run = problem_of(LOOSE)
    for steps in (0, 4):
        with pytest.raises(ValueError, match="steps must be 1 to"):
            first_steps(run, steps)
        with pytest.raises(ValueError, match="steps must be 1 to"):
            Study(LOOSE, steps)
    with pytest.raises(ValueError, match="starts"):
        Study(LOOSE, 2, starts=0)
    for field, value in (("chains", 1), ("warmup", 5), ("draws", 0), ("acceptance", 1.0)):
        wrong: dict[str, Any] = {field: value}
        with pytest.raises(ValueError, match=field):
            HMC(**wrong)
    with pytest.raises(ValueError, match="kept"):
        ranks(np.zeros((2, 1)), np.zeros((2, 5, 1)), 6)
    with pytest.raises(ValueError, match="bins"):
        uniformity(np.zeros((2, 1), int), 98)


def test_no_posterior_calls_lapack():
    chosen = jaxslam.scenario("matched", landmarks=3)
    study = Study(chosen, steps=2, hmc=HMC(chains=2))
    runs = draw_runs(study, 0, range(2))
    traced = jax.make_jaxpr(lambda runs: reference(study, runs, 0, range(2)))(runs)
    assert lapack_calls(traced.jaxpr) == set()
