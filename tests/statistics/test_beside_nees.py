"""Tests of what NEES does not show: they hold for right filters, and find one fault each."""

import numpy as np
import pytest
from one_run import RIGHT
from scipy import stats

from jaxslam.statistics.calibration import SETS, bias, correlation, coverage


def every(values):
    return np.ones(values.shape[:2], bool)


def drawn(kind, runs, steps, n=3, seed=0):
    """Whitened errors (runs, steps, n) of a right filter."""
    return np.moveaxis(RIGHT[kind](np.random.default_rng(seed), steps, runs, n), 1, 0)


@pytest.mark.parametrize("dof", [1, 3, 6])
def test_a_right_filter_covers_what_its_sets_say(dof):
    nees = np.random.default_rng(dof).chisquare(dof, (100, 200))
    found = coverage(nees, dof, every(nees))
    np.testing.assert_allclose(found, SETS, atol=0.012)
    assert found == tuple(float(np.mean(nees <= stats.chi2.ppf(share, dof))) for share in SETS)


def test_steps_that_were_not_logged_count_nowhere():
    z = drawn("white", 20, 50)
    there = every(z)
    there[3:7, 20:] = False
    holes = np.where(there[..., None], z, np.nan)
    filled = np.where(there[..., None], z, 1e9)
    nees = np.sum(filled**2, axis=2)
    assert coverage(nees, 3, there)[-1] > 0.97
    for measured in (bias, correlation):
        for a, b in zip(measured(holes, there), measured(filled, there), strict=True):
            np.testing.assert_array_equal(a, b)
    means = np.array([run[own].mean(axis=0) for run, own in zip(z, there, strict=True)])
    np.testing.assert_allclose(bias(holes, there).mean, means.mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("kind", ["white", "AR(1), τ = 300", "a third constant"])
@pytest.mark.parametrize(("runs", "steps"), [(1, 200), (3, 50), (30, 20)])
def test_of_right_filters_few_have_a_bias_or_a_correlation(kind, runs, steps):
    """More than 10 of 200 are, with a rate of 1 % each, one test of 10 million."""
    studies = drawn(kind, 200 * runs, steps).reshape(200, runs, steps, 3)
    assert sum(3 * np.min(bias(z, every(z)).p) < 0.01 for z in studies) <= 10
    assert sum(correlation(z, every(z)).p < 0.01 for z in studies) <= 10


@pytest.mark.parametrize("runs", [1, 30])
def test_a_mean_error_is_found(runs):
    z = drawn("AR(1), τ = 10", runs, 100)
    z[..., 1] += 4 if runs == 1 else 0.5
    found = bias(z, every(z))
    assert int(np.argmin(found.p)) == 1
    assert found.p[1] < 1e-3
    assert found.mean[1] == pytest.approx(4 if runs == 1 else 0.5, abs=0.3)
    p = 2 * stats.norm.sf(abs(found.mean[0]))
    if runs == 1:
        assert found.p[0] == pytest.approx(p, rel=1e-9)


@pytest.mark.parametrize(("runs", "steps"), [(1, 400), (2, 200), (30, 20)])
def test_the_clearest_correlation_is_found(runs, steps):
    z = drawn("AR(1), τ = 3", runs, steps, n=4)
    z[..., 3] = -0.8 * z[..., 1] + 0.6 * z[..., 3]
    found = correlation(1e120 * z, every(z))
    assert (found.axes, found.p < 1e-4) == ((1, 3), True)
    assert found.matrix[1, 3] == found.matrix[3, 1] == pytest.approx(-0.8, abs=0.12)
    np.testing.assert_allclose(np.diag(found.matrix), 1, rtol=1e-12)


def test_an_error_of_one_axis_or_of_none_has_no_correlation():
    z = drawn("white", 4, 30)
    assert correlation(z[..., :1], every(z)).p == 1
    assert correlation(0 * z, every(z)).p == 1
    assert bias(0 * z, every(z)).p.tolist() == [1, 1, 1]
