"""Tests of benchmarks/verdicts.py: it counts what the library says, of NEES as it says."""

import numpy as np
import pytest
import verdicts as benchmark

from jaxslam.statistics import Tally


@pytest.mark.parametrize("steps", [1, 2, 12])
def test_tallies_made_at_once_are_those_of_the_library(steps):
    nees = np.random.default_rng(0).chisquare(3, (4, 9, steps))
    for one, study in zip(benchmark.tallies(nees, 3), nees, strict=True):
        expected = Tally.of(study, 3)
        np.testing.assert_allclose(one.numbers()[3:], expected.numbers()[3:], rtol=1e-12)
        assert one.decisive().word == expected.decisive().word


@pytest.mark.parametrize("name", benchmark.SERIES)
def test_nees_are_chi2_at_every_step_and_correlated_as_said(name):
    steps, correlation = benchmark.SERIES[name]
    nees = benchmark.series(np.random.default_rng(1), 20000, 3, steps, correlation)
    np.testing.assert_allclose(nees.mean(axis=0), 3, atol=0.08)
    np.testing.assert_allclose(nees.var(axis=0), 6, rtol=0.07)
    if steps > 1:
        between = np.corrcoef(nees[:, 0], nees[:, 1])[0, 1]
        assert between == pytest.approx(correlation**2, abs=0.03)


def test_the_words_of_all_studies_are_counted():
    (results,) = benchmark.Verdicts(runs=(3, 80), dof=(3,), studies=60).measure()
    cells = {(row["runs"], row["series"]): row["words"] for row in results["by_factor"]}
    assert len(cells) == 6
    for words in cells.values():
        assert all(sum(shares.values()) == pytest.approx(1) for shares in words.values())
    assert cells[80, "white"]["2"] == {"over-confident": 1.0}
    assert cells[80, "white"]["0.5"] == {"under-confident": 1.0}
    assert cells[3, "correlated"]["1"].get("consistent", 0.0) == 0.0
    assert benchmark.as_table(results).splitlines()[3].startswith("| 80 | ")
