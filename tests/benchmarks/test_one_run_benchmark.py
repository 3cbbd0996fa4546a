"""Tests of benchmarks/one_run.py: its filters are right, and it counts what the library says."""

import numpy as np
import one_run as benchmark
import pytest

from jaxslam.statistics.one_run import one_run


@pytest.mark.parametrize("kind", benchmark.RIGHT)
@pytest.mark.parametrize("n", [1, 3])
def test_whitened_errors_are_standard_normal_at_every_step_and_axis(kind, n):
    z = benchmark.RIGHT[kind](np.random.default_rng(2), 60, 4000, n)
    for step in (0, 1, 29, 59):
        own = z[step]
        if np.isnan(own).any():
            assert kind == "gaps"
            continue
        np.testing.assert_allclose(own.mean(axis=0), 0, atol=0.08)
        tails = 2 if kind == "heavy tails" else 1
        np.testing.assert_allclose(own.T @ own / 4000, np.eye(n), atol=0.1 * tails)


@pytest.mark.parametrize("time", [1, 10])
def test_a_series_forgets_in_its_time(time):
    z = benchmark.autoregressive(time, np.random.default_rng(0), 2000, 50, 2)
    assert np.mean(z[time:] * z[:-time]) == pytest.approx(np.exp(-1), abs=0.03)


def test_the_two_other_tests_are_those_that_are_known():
    """As many samples as steps, or as by the correlation of NEES, exp(−2k/τ) after k steps."""
    z = np.moveaxis(benchmark.autoregressive(5, np.random.default_rng(0), 2000, 20, 3), 1, 0)
    assert all(benchmark.independent(one).samples == 2000 for one in z)
    found = np.median([benchmark.by_nees(one).samples for one in z])
    assert found == pytest.approx(2000 * np.tanh(1 / 5), rel=0.15)


def test_what_is_counted_is_what_the_library_says():
    study = benchmark.OneRunStudy(steps=(300, 400), dof=(3,), draws=8)
    *_, results = study.measure()
    assert [row["name"] for row in results["right"]] == 2 * [*benchmark.RIGHT]
    assert [row["factor"] for row in results["wrong"]] == 2 * [*benchmark.WRONG]
    rng = np.random.default_rng([0, 300, 3, 0])
    z = np.moveaxis(benchmark.RIGHT["white"](rng, 300, 8, 3), 1, 0)
    found = [one_run(one) for one in z]
    assert results["right"][0]["samples"] == np.median([one.samples for one in found])
    assert results["wrong"][2]["over_confident"]["verdict"] >= 0.5
    assert "| σ too small by 1.3 |" in benchmark.as_table(results)
