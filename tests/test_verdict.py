"""Tests of the verdict on one study: its rate of false alarms, its coverage, what it says."""

import json

import numpy as np
import pytest
from scipy import stats

from jaxslam.consistency import Tally, lost_threshold, not_disproved, run_verdict
from jaxslam.consistency.statistics import (
    PowerSums,
    chernoff_p_value,
    chi2_p_value,
    mean_interval,
    mean_p_value,
)
from jaxslam.consistency.verdict import sentences


def series(rng, runs, steps=20, dof=3, correlation=0.95):
    """NEES of a consistent filter, (runs, steps): χ² at every step, whatever the correlation."""
    error = rng.normal(size=(runs, dof))
    nees = np.empty((runs, steps))
    for step in range(steps):
        nees[:, step] = np.sum(error**2, axis=1)
        new = rng.normal(size=error.shape)
        error = correlation * error + np.sqrt(1 - correlation**2) * new
    return nees


def studies(count, runs, seed=0, **of):
    """The NEES of `count` studies of as many runs."""
    return series(np.random.default_rng(seed), count * runs, **of).reshape(count, runs, -1)


# --- how often it is wrong ----------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "correlation"), [(1, 0.0), (8, 0.0), (8, 0.9), (8, 0.995)])
def test_a_consistent_filter_is_called_inconsistent_once_in_a_hundred_studies(steps, correlation):
    """Half of the times on either side: of 3000 studies 15 ± 4 each, here with ± 4 σ."""
    words = [
        run_verdict(nees, 3)["word"]
        for nees in studies(3000, 100, steps=steps, correlation=correlation)
    ]
    for side in ("over-confident", "under-confident"):
        assert 3 <= words.count(side) <= 31, (side, words.count(side))
    assert 12 <= 3000 - words.count("consistent") <= 50


@pytest.mark.parametrize("dof", [3, 6])
def test_a_sigma_wrong_by_5_percent_is_found_with_1000_runs(dof):
    """In 95 of 100 studies, or more, though the steps of a run are all but one."""
    found = {"over-confident": 1.05, "under-confident": 1 / 1.05}
    for word, factor in found.items():
        verdicts = [
            run_verdict(factor**2 * nees, dof) for nees in studies(60, 1000, dof=dof, steps=10)
        ]
        assert np.mean([verdict["word"] == word for verdict in verdicts]) > 0.9
        low, high = np.array([verdict["interval99"] for verdict in verdicts]).T
        assert np.mean((low < factor) & (factor < high)) > 0.93
        assert np.mean(high - low) < 0.08


def test_the_interval_holds_the_mean_of_skewed_numbers_where_students_does_not():
    rng = np.random.default_rng(1)
    numbers = np.exp(rng.normal(size=(3000, 100)))
    mean = np.exp(0.5)
    intervals = np.array([mean_interval(PowerSums.of(row), 0.99) for row in numbers])
    missed = np.mean((intervals[:, 0] > mean) | (intervals[:, 1] < mean))
    t = (numbers.mean(axis=1) - mean) / (numbers.std(axis=1, ddof=1) / 10)
    missed_by_student = np.mean(np.abs(t) > stats.t.ppf(0.995, 99))
    assert missed < 0.02 < 0.03 < missed_by_student


def test_the_interval_is_that_of_resampled_runs():
    """The cubic is the closed form of the studentised bootstrap, to second order."""
    values = series(np.random.default_rng(2), 200).mean(axis=1)
    n, mean, deviation = len(values), values.mean(), values.std(ddof=1)
    drawn = values[np.random.default_rng(3).integers(0, n, (20000, n))]
    t = (drawn.mean(axis=1) - mean) / (drawn.std(axis=1, ddof=1) / np.sqrt(n))
    high, low = mean - np.quantile(t, [0.005, 0.995]) * deviation / np.sqrt(n)
    found = mean_interval(PowerSums.of(values), 0.99)
    np.testing.assert_allclose(found, (low, high), atol=0.05 * (high - low))


def test_the_interval_and_its_p_value_say_the_same():
    rng = np.random.default_rng(4)
    for runs in (20, 200):
        sums = PowerSums.of(rng.chisquare(3, runs))
        for limit in mean_interval(sums, 0.99):
            assert mean_p_value(sums, limit) == pytest.approx(0.01, rel=1e-6)
        assert mean_p_value(sums, sums.mean) > 0.5


def test_at_one_step_p_is_exact():
    means = np.random.default_rng(5).chisquare(3 * 20, 5000) / 20
    p = np.array([chi2_p_value(mean, 3, 20) for mean in means])
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert chi2_p_value(4.0, 3, 20) == pytest.approx(2 * stats.chi2.sf(80, 60), rel=1e-9)
    verdict = run_verdict(np.column_stack([np.full(20, 9.0), np.full(20, 4.0)]), 3)
    assert verdict["end"]["p"] == pytest.approx(chi2_p_value(4.0, 3, 20))
    assert verdict["end"]["sigma_factor"] == pytest.approx(np.sqrt(4 / 3))


@pytest.mark.parametrize("correlation", [0.0, 0.9, 1.0])
def test_the_bound_of_chernoff_is_one_for_every_correlation(correlation):
    means = studies(4000, 5, steps=5, correlation=correlation).mean(axis=(1, 2))
    p = np.array([chernoff_p_value(mean, 3, 5) for mean in means])
    for level in (0.3, 0.1, 0.03):
        assert np.mean(p < level) < level
    assert all(
        chernoff_p_value(mean, 3, 5) > chi2_p_value(mean, 3, 5) for mean in (0.5, 2.0, 4.0, 9.0)
    )


# --- lost runs ----------------------------------------------------------------------------------


def consistent(runs=1000):
    return np.minimum(series(np.random.default_rng(6), runs), lost_threshold(3))


def test_a_few_lost_runs_are_named_and_judged_apart():
    nees = consistent()
    nees[:3, -1] = 1e5
    verdict = run_verdict(nees, 3)
    assert (verdict["word"], verdict["never_lost"]["word"]) == ("over-confident", "consistent")
    assert (verdict["lost"], verdict["never_lost"]["runs"]) == (0.003, 997)
    assert verdict["nees"] == pytest.approx(nees.mean())
    assert verdict["never_lost"]["nees"] == pytest.approx(nees[3:].mean())
    # They scatter so much that the interval holds 1: only χ² tells that this is not chance.
    assert verdict["interval99"][0] < 1
    assert verdict["p"] < 1e-9
    others = sentences(verdict)[2]
    assert others.startswith("3 of 1000 runs were lost, the 997 never lost: NEES 2.98, σ right")


def test_of_runs_that_are_chosen_by_their_nees_no_verdict_is_said():
    nees = consistent()
    nees[:11, 5] = 1e3
    expected = f"11 of 1000 runs were lost, the 989 never lost: NEES {nees[11:].mean():.2f}"
    assert sentences(run_verdict(nees, 3))[2] == expected


def test_a_run_that_is_lost_and_comes_back_was_lost():
    nees = consistent()
    nees[4, 7] = 22.0
    assert run_verdict(nees, 3)["lost"] == 0.001


def test_without_lost_runs_a_consistent_filter_seems_better_by_less_than_half_a_percent():
    nees = series(np.random.default_rng(7), 20000, steps=60, correlation=0.97)
    verdict = run_verdict(nees, 3)
    assert 0.995 < verdict["never_lost"]["nees"] / verdict["nees"] < 0.9995
    assert 0.0005 < verdict["lost"] < 60e-4


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_with_a_diverged_run_there_is_no_mean(value):
    nees = consistent()
    nees[5, 3:] = value
    verdict = run_verdict(nees, 3)
    assert (verdict["word"], verdict["nees"], verdict["sigma_factor"]) == ("lost", None, None)
    assert (verdict["p"], verdict["end"]["p"], verdict["diverged"]) == (0.0, 0.0, 1)
    assert verdict["never_lost"]["word"] == "consistent"
    json.dumps(verdict, allow_nan=False)
    assert sentences(verdict)[0] == "1 of 1000 runs diverged, no mean NEES: lost"


@pytest.mark.parametrize("value", [np.nan, 1e5, 1e200])
def test_a_study_of_lost_runs_only_has_a_verdict(value):
    verdict = run_verdict(np.full((4, 3), value), 3)
    json.dumps(verdict, allow_nan=False)
    assert verdict["word"] == ("lost" if np.isnan(value) else "over-confident")
    assert verdict["never_lost"]["runs"] == 0
    assert sentences(verdict)[-1] == "4 of 4 runs were lost, all of them"


# --- degrees of freedom that a fit may have taken -------------------------------------------------


@pytest.mark.parametrize(
    ("mean", "word", "factor"),
    [
        (6 * 1.2, "over-confident", np.sqrt(1.2)),
        (5.5, "consistent", 1.0),
        (5 / 1.2, "under-confident", np.sqrt(1 / 1.2)),
    ],
)
def test_anything_between_all_and_what_a_fit_leaves_is_right(mean, word, factor):
    nees = np.random.default_rng(10).chisquare(6, (2000, 4))
    nees *= mean / nees.mean()
    found = run_verdict(nees, 6, fitted=1.0)
    assert (found["word"], found["sigma_factor"]) == (word, pytest.approx(factor))
    low, high = mean_interval(PowerSums.of(nees.mean(axis=1)), 0.99)
    assert found["interval99"] == pytest.approx([np.sqrt(low / 6), np.sqrt(high / 5)])
    assert not_disproved(found) is (word == "consistent")


@pytest.mark.parametrize("runs", [1, 300])
def test_where_all_may_be_fitted_only_over_confidence_can_be_proven(runs):
    nees = np.random.default_rng(11).chisquare(1, (runs, 4))
    for factor in (0.0, 1e-6, 1.0):
        found = run_verdict(factor * nees, 1, fitted=1)
        assert not_disproved(found)
        assert found["interval99"][1] is None
        json.dumps(found, allow_nan=False)
    assert run_verdict(40 * nees, 1, fitted=1)["word"] == "over-confident"


def test_tallies_with_a_fit_add_up_and_no_others_are_of_one_study():
    nees = np.random.default_rng(12).chisquare(3, (20, 4))
    one, other = Tally.of(nees[:5], 3, 0.5), Tally.of(nees[5:], 3, 0.5)
    assert Tally.from_dict(json.loads(json.dumps(one.asdict()))) == one
    assert Tally.of_numbers(one.numbers() + other.numbers(), 3, 0.5) == one + other
    with pytest.raises(ValueError, match=r"with 0\.5 and 0\.0 dof fitted"):
        one + Tally.of(nees, 3)
    for fitted in (-0.1, 3.1, np.nan):
        with pytest.raises(ValueError, match="fitted must be from 0 to the 3 degrees of freedom"):
            run_verdict(nees, 3, fitted)


# --- what it is made of -------------------------------------------------------------------------


def test_tallies_of_parts_and_from_a_file_are_that_of_the_whole():
    nees = series(np.random.default_rng(8), 300)
    nees[0, 2], nees[200, 3] = np.nan, 1e3
    parts = [Tally.of(part, 3) for part in (nees[:100], nees[100:])]
    stored = [Tally.from_dict(json.loads(json.dumps(part.asdict()))) for part in parts]
    assert stored == parts
    together, whole = (parts[0] + parts[1]).verdict(), Tally.of(nees, 3).verdict()
    assert (together["lost"], together["diverged"]) == (whole["lost"], whole["diverged"])
    assert together["never_lost"]["interval99"] == pytest.approx(whole["never_lost"]["interval99"])
    with pytest.raises(ValueError, match="runs of 3 and of 6 dof are not one study"):
        parts[0] + Tally.of(nees, 6)


def test_a_tally_is_numbers_that_add_up():
    draw = np.random.default_rng(3)
    both = [draw.chisquare(3, size=(n, 7)) for n in (30, 20)]
    both[1][3, 2:] = np.nan
    both[0][5, 4] = 1e3
    one, other = (Tally.of(nees, 3) for nees in both)
    assert Tally.of_numbers(one.numbers() + other.numbers(), 3) == one + other
    assert (one + other).lost == 2


def test_power_sums_have_the_moments_of_their_numbers():
    values = np.random.default_rng(9).gamma(2.0, size=50)
    sums = PowerSums.of(values)
    assert sums.mean == pytest.approx(values.mean())
    assert sums.deviation == pytest.approx(values.std(ddof=1))
    assert sums.skewness == pytest.approx(stats.skew(values))


def test_one_run_has_no_interval_and_still_a_p_value():
    verdict = run_verdict(np.full((1, 4), 100.0), 3)
    assert verdict["interval99"] == [None, None]
    assert verdict["word"] == "over-confident"
    assert (
        sentences(verdict)[0] == "NEES 100, σ too small by 5.77 [–, –]: over-confident (p < 0.0001)"
    )
    assert run_verdict(np.full((1, 4), 3.5), 3)["word"] == "consistent"


@pytest.mark.parametrize(
    ("factor", "text"),
    [
        (1.0, "σ right up to a factor 1.00 [0.98, 1.02]: consistent"),
        (1.26, "σ too small by 1.26 [1.23, 1.29]: over-confident"),
        (0.8, "σ too large by 1.25 [1.22, 1.28]: under-confident"),
    ],
)
def test_a_verdict_is_said_in_words(factor, text):
    nees = consistent()
    nees *= 3 * factor**2 / nees.mean()
    nees = np.minimum(nees, lost_threshold(3))
    found = run_verdict(nees, 3)
    said, at_the_end = sentences(found)[:2]
    p = f"p = {found['p']:.2g}" if factor == 1 else "p < 0.0001"
    assert said == f"NEES {found['nees']:.2f}, {text} ({p})"
    assert at_the_end.startswith(f"at the last step: NEES {nees[:, -1].mean():.2f}, σ ")
    assert found["end"]["word"] == found["word"]


@pytest.mark.parametrize(("shape", "dof"), [((3,), 3), ((0, 4), 3), ((4, 0), 3), ((4, 5), 0)])
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_study_is_refused(shape, dof):
    with pytest.raises(ValueError, match="NEES must be"):
        run_verdict(np.ones(shape), dof)


@pytest.mark.parametrize("size", [1e-220, 1e-120, 1e120, 1e160])
def test_runs_beyond_all_measure_have_a_verdict(size):
    """No power of their NEES may end the verdict instead."""
    nees = size * np.random.default_rng(0).chisquare(3, (20, 4))
    word = Tally.of(nees, 3).verdict()["word"]
    assert word in ({"under-confident"} if size < 1 else {"over-confident", "lost"})


# --- runs that are not equally long -------------------------------------------------------------


def test_every_run_is_averaged_over_the_steps_that_it_has():
    nees = series(np.random.default_rng(7), 40)
    logged = np.ones(nees.shape, bool)
    logged[0, 5:], logged[1, :7], logged[2, 3:9] = False, False, False
    broken = np.where(logged, nees, np.nan)
    found = run_verdict(broken, 3, logged=logged)
    averages = [row[there].mean() for row, there in zip(nees, logged, strict=True)]
    assert found["nees"] == pytest.approx(np.mean(averages), rel=1e-12)
    assert found["diverged"] == 0
    ends = np.append(nees[0, 4], nees[1:, -1])
    assert found["end"]["nees"] == pytest.approx(ends.mean(), rel=1e-12)
    assert run_verdict(nees, 3, logged=np.ones(nees.shape, bool)) == run_verdict(nees, 3)


def test_a_nees_that_is_logged_and_not_finite_is_of_a_run_that_diverged():
    nees = series(np.random.default_rng(8), 40)
    logged = np.ones(nees.shape, bool)
    logged[0, 5:] = False
    nees[0, 5:], nees[0, 2] = np.nan, np.inf
    assert run_verdict(nees, 3, logged=logged)["diverged"] == 1
    assert run_verdict(nees, 3)["diverged"] == 1
    nees[0, 2], nees[0, 3] = 1.0, 1e6
    assert run_verdict(nees, 3, logged=logged)["lost"] == 1 / 40


def test_a_run_without_a_step_is_refused():
    logged = np.ones((4, 5), bool)
    logged[2] = False
    with pytest.raises(ValueError, match="with a step of every run"):
        run_verdict(np.ones((4, 5)), 3, logged=logged)


def test_runs_of_unlike_length_keep_the_rate_of_false_alarms():
    """Of 600 studies of 30 runs, cut anywhere: 6 expected, 19 or more once in 10 000."""
    rng, words = np.random.default_rng(9), []
    for nees in studies(600, 30, seed=10, steps=12):
        logged = np.arange(12) < rng.integers(1, 13, size=(30, 1))
        words.append(run_verdict(nees, 3, logged=logged)["word"])
    assert sum(word.endswith("confident") for word in words) < 19
