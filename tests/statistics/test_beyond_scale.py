"""Tests of what of a pose's error is not one of scale: exact values, and χ² of one dof fewer."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FALSE_ALARM, Case, each_geometry, named, pose, quick_jit
from scipy import stats

from jaxslam.consistency import filter_run, sums
from jaxslam.filters.readouts import camera_pose_in_unit
from jaxslam.geometry import PLANAR, difference, identity, joined, retract, scaled
from jaxslam.statistics.bands import normalised_squared
from jaxslam.statistics.beyond_scale import (
    NOTICEABLE,
    SCALES,
    beyond_scale,
    one_scale,
    reversal,
)


def chi_square(values, dof, slack=0.0):
    """Whether a sum is χ² of so many degrees of freedom, up to a false alarm and a share."""
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], dof)
    return (1 - slack) * low < np.sum(values) < (1 + slack) * high


def covariance(t, seed=0):
    root = np.random.default_rng(seed).normal(size=(t, t))
    return jnp.asarray(root @ root.T + 0.1 * np.eye(t))


def linear_case(geometry, seed=1):
    """A truth, the derivative g of the error by its scale, and an error that is affine in it."""
    truth = pose(geometry, seed)
    A = jnp.asarray(np.random.default_rng(seed).normal(size=(geometry.tangent_dim, 3)))
    A = A[:, : geometry.point_dim]

    def error(T, noise):
        return A @ (T.translation() - truth.translation()) + noise

    return truth, A @ truth.translation(), error


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_what_is_left_of_a_linear_error_is_its_part_across_the_scale(geometry):
    truth, g, error = linear_case(geometry)
    P, noise = covariance(geometry.tangent_dim), 0.02 * jnp.arange(1.0, geometry.tangent_dim + 1)
    found = quick_jit(partial(beyond_scale, lambda T: (error(T, noise), P)))(truth)
    W = np.linalg.inv(np.asarray(P))
    away = float(g @ W @ noise / (g @ W @ g))  # s = 1 − away
    left = noise - away * g
    assert away < 0.9
    np.testing.assert_allclose(found.nees, left @ W @ left, rtol=1e-9)
    np.testing.assert_allclose(found.log_scale, np.log(1 - away), rtol=1e-9)
    np.testing.assert_allclose(found.sigma, 1 / ((1 - away) * np.sqrt(g @ W @ g)), rtol=1e-9)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_pure_error_of_scale_is_nothing_beyond_it(geometry):
    truth, P = pose(geometry, 3), covariance(geometry.tangent_dim)
    for own in (lambda T: T, lambda T: T.inverse()):  # of T_BC, and of T_CB as robocentric

        @quick_jit
        def found(factor, own=own):
            estimate = scaled(truth, factor)
            return beyond_scale(lambda T: (difference(own(T), own(estimate)), P), truth)

        for factor in (0.05, 30.0):
            assert found(factor).nees < 1e-18
            log_scale = found(factor).log_scale
            np.testing.assert_allclose(log_scale, np.log(factor), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(("dtype", "distances"), [("float32", (0.0, 1e-30)), ("float64", (1e-12,))])
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_without_a_displacement_there_is_no_scale_and_no_nan(geometry, dtype, distances):
    P = jnp.asarray(covariance(geometry.tangent_dim), dtype)
    estimate = jax.tree.map(lambda x: jnp.asarray(x, dtype), pose(geometry, 2))

    @quick_jit
    def both(distance):
        along = jnp.full(geometry.point_dim, distance)
        truth = joined(identity(geometry, dtype).rotation(), along)
        found = beyond_scale(lambda T: (difference(T, estimate), P), truth)
        return found, normalised_squared(difference(truth, estimate), P)

    for distance in distances:
        found, whole = both(jnp.asarray(distance, dtype))
        np.testing.assert_allclose(found.nees, whole, rtol=1e-4)
        assert found.sigma > 1e6
        assert np.isfinite(found.log_scale)
        assert distance or (found.log_scale, found.sigma) == (0, np.inf)


def test_a_reversed_path_is_best_explained_by_none():
    truth = joined(identity(PLANAR, jnp.float64).rotation(), jnp.array([1.0, 0.5]))
    behind = scaled(truth, jnp.asarray(-1.0))
    error = lambda T: (difference(T, behind), 0.01 * jnp.eye(3))  # noqa: E731
    found = quick_jit(partial(beyond_scale, error))(truth)
    np.testing.assert_allclose(np.exp(found.log_scale), SCALES[0])
    np.testing.assert_allclose(found.nees, 125.0, rtol=3 * SCALES[0])
    assert reversal(behind, truth) == 1
    assert reversal(truth, truth) == 0
    assert reversal(identity(PLANAR, jnp.float64), truth) == 0
    near = scaled(truth, jnp.asarray(0.99 * NOTICEABLE / np.hypot(1, 0.5)))
    assert np.isnan(reversal(behind, near))
    assert reversal(behind, scaled(near, jnp.asarray(1.02))) == 1


def test_the_noise_of_the_truth_is_of_the_scale_of_the_estimate():
    """An estimate that is right in its own unit, against truths that are not."""
    t, count = 3, 3000
    truth, sigma = pose(PLANAR, 1), 1e-3 * np.linspace(1.0, 2.0, t)
    estimate, P = scaled(truth, jnp.asarray(4.0)), 1e-6 * covariance(t)
    keys = jax.random.split(jax.random.key(0))
    noises = sigma * jax.random.normal(keys[0], (count, t))
    own_noises = jax.random.normal(keys[1], (count, t)) @ np.linalg.cholesky(P).T

    def one(noise, own_noise):
        near = retract(truth, noise)
        return beyond_scale(lambda T: (difference(T, estimate) + own_noise, P), near, sigma)

    found = quick_jit(jax.vmap(one))(noises, own_noises)
    # To first order in noise of a thousandth.
    assert chi_square(found.nees, count * (t - 1), slack=0.01)
    assert chi_square(((found.log_scale - np.log(4.0)) / found.sigma) ** 2, count, slack=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robocentric", "scale_gauge+mixture3"])
def test_of_a_filter_it_is_the_least_nees_over_all_scales(name):
    case = Case("standstill", steps=8)
    slam, sensor = case.filter(name), case.scenario.sensor
    run = case.run(0)
    records, path, state = quick_jit(partial(filter_run, slam, case.room, sensor))(run)
    truth = jax.tree.map(lambda x: x[-1], run.poses)

    def error_in_unit(T):
        seen = camera_pose_in_unit(slam, state)
        return difference(T, seen.pose), seen.covariance

    metric = partial(slam.pose_error, state)
    in_unit = metric if name == "robocentric" else error_in_unit
    for error, own in ((metric, ""), (in_unit, "unit_")):
        P = quick_jit(error)(truth)[1]

        def nees(log_scale, error=error, P=P):
            return normalised_squared(error(scaled(truth, jnp.exp(log_scale)))[0], P)

        best, sigma = (records[f"{own}log_scale{end}"][-1] for end in ("", "_sigma"))
        h = 1e-3
        around = best + np.append(np.linspace(-3.0, 3.0, 121), [h, 0, -h])
        *over_scales, more, here, less = np.asarray(quick_jit(jax.vmap(nees))(around))
        assert np.argmin(over_scales) == 60
        # σ by the curvature of what is minimised, 2/σ², by differences.
        curvature = (more - 2 * here + less) / h**2
        np.testing.assert_allclose(curvature, 2 / sigma**2, rtol=0.02)
    np.testing.assert_allclose(over_scales[60], records["beyond_scale"][-1], rtol=1e-6)
    assert records["nees"][-1] > 1.001 * over_scales[60]  # the scale is wrong by something
    t_est, t_true = (p.translation()[-1] for p in (path, run.poses))
    assert records["reversed"][-1] == float(t_est @ t_true < 0)


def constructed(steps, drift, *, common=0.0, runs=60, sigma=0.01, seed=0):
    """Per-pose scales that ramp by `drift` with independent and common errors; NEES, scale, σ."""
    rng = np.random.default_rng(seed)
    ramp = 1 + drift * np.linspace(0, 1, steps)
    away = np.sqrt(1 - common**2) * rng.normal(size=(runs, steps))
    away += common * rng.normal(size=(runs, 1))
    s = 3.0 * ramp * (1 + sigma * away)
    return rng.chisquare(5, (runs, steps)), np.log(s), np.full((runs, steps), sigma)


def test_of_independent_poses_one_degree_of_freedom_goes_once_and_not_once_a_pose():
    runs, steps = 400, 20
    found = one_scale(*constructed(steps, 0.0, runs=runs, sigma=1e-4))
    assert chi_square(found.nees, runs * (6 * steps - 1))
    assert found.nees.sum() > stats.chi2.ppf(1 - FALSE_ALARM, runs * 5 * steps)


def test_an_error_of_scale_that_the_whole_run_has_in_common_is_the_gauge():
    nees, log_scale, sigma = constructed(20, 0.0, common=1.0, sigma=0.3)
    found = one_scale(nees, log_scale, sigma)
    np.testing.assert_allclose(found.nees, nees, rtol=1e-9)
    np.testing.assert_allclose(found.drift, 0.0, atol=1e-12)


def test_a_scale_that_drifts_is_not_forgiven():
    nees, log_scale, sigma = constructed(200, 3.0)
    found = one_scale(nees, log_scale, sigma)
    assert found.nees.mean() > 100
    np.testing.assert_allclose(found.drift[:, -1] - found.drift[:, 0], np.log(4), rtol=0.1)


def test_poses_before_the_unit_is_fixed_keep_a_scale_of_their_own():
    nees, log_scale, sigma = constructed(20, 0.0)
    log_scale[:, :5] += 2.0
    fixed = np.arange(20) >= 5
    found = one_scale(nees, log_scale, sigma, np.broadcast_to(fixed, nees.shape))
    np.testing.assert_array_equal(found.nees[:, :5], nees[:, :5])
    assert np.isnan(found.drift[:, :5]).all()
    later = one_scale(nees[:, 5:], log_scale[:, 5:], sigma[:, 5:])
    np.testing.assert_allclose(found.nees[:, 5:], later.nees)
    nothing = one_scale(nees, log_scale, sigma, np.zeros_like(nees, bool))
    np.testing.assert_array_equal(nothing.nees, nees)
    assert np.isnan(nothing.log_scale).all()


def test_what_is_claimed_of_drifts_is_summed_over_poses_that_have_one():
    nees, log_scale, sigma = constructed(20, 0.0)
    sigma = sigma * np.linspace(1, 2, 20)
    fixed = np.broadcast_to(np.arange(20) >= 5, nees.shape)
    ones = np.ones_like(nees)
    records = dict.fromkeys(sums.RECORDS, ones) | {
        "nees": nees, "beyond_scale": nees, "unit_log_scale": log_scale, "reversed": np.nan * ones,
        "unit_log_scale_sigma": sigma, "unit_fixed": fixed, "status": np.zeros(nees.shape, int),
        "error": ones[..., None], "variance": ones[..., None],
    }  # fmt: skip
    found = sums.as_sums(records, 3)
    np.testing.assert_array_equal(found["sum_drift_count"], fixed.sum(axis=0))
    np.testing.assert_allclose(found["sum_drift_variance"], (fixed * sigma**2).sum(axis=0))
    np.testing.assert_array_equal(found["sum_displaced"], np.zeros(20))
