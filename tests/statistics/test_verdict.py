"""Tests of the verdict on one study; `benchmarks/verdicts.py` counts how often it is wrong."""

import json

import numpy as np
import pytest
import verdicts as benchmark
from scipy import stats

from jaxslam.statistics import Tally, lost_threshold, not_disproved, run_verdict
from jaxslam.statistics.bands import (
    PowerSums,
    mean_p_value,
    shortfall_limit,
    shortfall_p_value,
    skewed_limit,
)
from jaxslam.statistics.looks import VERDICT_CONFIDENCE, Look
from jaxslam.statistics.verdict import brief, sentences


def shortfalls(dof, level):
    return tuple(shortfall_limit(dof, level, above=above) for above in (False, True))


def series(rng, runs, steps=20, dof=3, correlation=0.95):
    """NEES of a consistent filter, (runs, steps): χ² at every step, whatever the correlation."""
    return benchmark.series(rng, runs, dof, steps, correlation)


def studies(count, runs, seed=0, **of):
    """The NEES of `count` studies of as many runs."""
    return series(np.random.default_rng(seed), count * runs, **of).reshape(count, runs, -1)


# --- how often it is wrong ----------------------------------------------------------------------


def words(many, dof=3):
    return [Tally.of(nees, dof).decisive().word for nees in many]


@pytest.mark.parametrize("runs", [1, 10, 200])
@pytest.mark.parametrize("factor", [1.3, 1 / 1.3])
def test_a_sigma_wrong_by_30_percent_is_not_called_consistent(runs, factor):
    """Of 100 studies one is allowed, and 7 or more have a chance of 1 in 10 000."""
    for correlation in (0.0, 0.98):
        many = factor**2 * studies(100, runs, steps=6, correlation=correlation)
        assert words(many).count("consistent") < 7


def test_of_next_to_no_degrees_of_freedom_runs_are_counted_too():
    found = run_verdict(np.full((1, 50), 1e-6), 1, fitted=1 - 1e-6)
    assert found["word"] == "cannot tell"
    assert found["enough"] > 1e6


def test_with_runs_enough_a_right_filter_is_consistent_and_with_fewer_nobody_can_tell():
    for runs, word in ((100, "consistent"), (10, "cannot tell")):
        found = words(studies(200, runs))
        assert found.count(word) > 185, (runs, found)
    few = run_verdict(studies(1, 10)[0], 3)
    assert few["word"] == "cannot tell"
    told = words(studies(200, few["enough"], seed=1))
    assert told.count("consistent") > 0.6 * 200
    assert f"; about {few['enough']} runs would tell" in sentences(few)[0]


def test_a_sigma_wrong_by_5_percent_is_found_with_2000_runs():
    """In 95 of 100 studies, or more, though the steps of a run are all but one."""
    for word, factor in {"over-confident": 1.05, "under-confident": 1 / 1.05}.items():
        found = [run_verdict(factor**2 * nees, 3) for nees in studies(30, 2000, steps=10)]
        assert np.mean([verdict["word"] == word for verdict in found]) > 0.9
        low, high = np.array([verdict["interval99"] for verdict in found]).T
        assert np.mean((low < factor) & (factor < high)) > 0.93
        assert np.mean(high - low) < 0.08


def test_the_limit_of_skewed_numbers_is_where_their_p_value_is_the_level():
    sums = PowerSums.of(np.exp(np.random.default_rng(2).normal(size=50)))
    t = float(stats.t.ppf(0.995, 49))
    limit = sums.mean + skewed_limit(sums, t) * sums.deviation / np.sqrt(50)
    assert mean_p_value(sums, limit) == pytest.approx(0.01)
    even = PowerSums.of(np.array([1.0, 2.0, 3.0]))
    assert skewed_limit(even, t) == t


@pytest.mark.parametrize("runs", [1, 3, 200])
def test_word_interval_and_p_value_say_the_same(runs):
    for scale in np.geomspace(0.2, 6, 20):
        nees = scale * studies(1, runs, steps=6, seed=runs)[0]
        found = run_verdict(nees, 3)
        for each in (found, found["mean"], found["end"], *found["thirds"]):
            low, high = (np.inf if x is None else x for x in each["interval99"])
            assert (low <= 1 <= high) == (each["p"] >= 0.01) == not_disproved(each)
            assert low <= each["sigma_factor"] <= high
        looks = (found["mean"], found["end"], *found["thirds"])
        assert found["p"] == min(each["p"] for each in looks)


def test_the_limits_are_the_expected_shortfall():
    drawn = np.sort(np.random.default_rng(5).chisquare(6, 10**6))
    low, high = shortfalls(6, 0.02)
    assert drawn[: 10**4].mean() == pytest.approx(low, rel=0.01)
    assert drawn[-(10**4) :].mean() == pytest.approx(high, rel=0.01)
    for limit in (low, high):
        assert shortfall_p_value(limit / 2, 3, 2) == pytest.approx(0.02, rel=1e-9)


def test_the_interval_of_chi2_is_what_is_left_of_few_runs_and_that_of_scatter_of_many_steps():
    three = Look("", PowerSums.of(np.array([3.0, 3.0, 3.0])), (3.0, 3.0), 0.01).interval
    low, high = shortfalls(9, 0.01)
    # Upwards as if there were three more runs that are just lost.
    unseen = 3 * (lost_threshold(3) - 3) / (3 + 3) / 3
    assert three == pytest.approx((9 / high, 9 / low + unseen))
    wide = np.array([0.1, 0.1, 12.0, 0.1, 0.1])
    t = stats.t.ppf(0.995, 4) * wide.std(ddof=1) / wide.mean() / np.sqrt(5)
    assert t > 1
    assert Look("", PowerSums.of(wide), (3.0, 3.0), 0.01).interval == (0.0, np.inf)
    # Twenty runs of very many steps do not scatter: what they all have is proven.
    alike = Look("", PowerSums.of(3.3 + 0.01 * np.arange(20)), (3.0, 3.0), 0.01)
    assert alike.word == "over-confident"


# --- opposite faults ----------------------------------------------------------------------------


def test_faults_that_cancel_in_the_mean_are_found_in_the_parts():
    nees = np.linspace(0.7, 1.3, 30) * studies(1, 400, seed=4, steps=30, correlation=0.98)[0]
    found = run_verdict(nees, 3)
    assert found["mean"]["word"] == "consistent"
    assert found["word"] in ("over-confident", "under-confident")
    first, middle, last = (third["sigma_factor"] for third in found["thirds"])
    assert first < 0.95 < middle < 1.05 < last
    words = [third["word"] for third in found["thirds"]]
    assert words[::2] == ["under-confident", "over-confident"]
    where = {"last step": "at the last step"}.get(found["of"], f"in the {found['of']}")
    assert sentences(found)[0].startswith(f"{where} NEES {found['nees']:.2f}, σ too ")
    assert sentences(found)[1].startswith("over all steps: NEES ")


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_short_runs_have_the_parts_that_they_have_and_all_may_fail_one_time_in_a_hundred(steps):
    """Bonferroni: half for the mean over all steps, the other half shared by the parts."""
    nees = studies(1, 100, steps=steps, correlation=0.5)[0]
    levels = [look.level for look in Tally.of(nees, 3).looks()]
    assert sum(levels) == pytest.approx(1 - VERDICT_CONFIDENCE)
    assert steps == 1 or levels[0] == pytest.approx(sum(levels[1:]))
    assert len(set(levels[1:])) == min(len(levels) - 1, 1)
    found = run_verdict(nees, 3)
    assert found["word"] == "consistent"
    assert found["end"]["nees"] == pytest.approx(nees[:, -1].mean())
    thirds = [third["nees"] for third in found["thirds"]]
    assert thirds == pytest.approx(nees.mean(axis=0).tolist() if steps == 3 else [])


def test_thirds_are_of_the_steps_that_each_run_has():
    nees = np.arange(24.0).reshape(2, 12) + 1
    logged = np.ones((2, 12), bool)
    logged[1, [0, 3, 4, 5, 6, 7]] = False  # 2, 3; 9, 10; 11, 12 of the second run are left
    thirds = run_verdict(nees, 3, logged=logged)["thirds"]
    means = [(nees[0, 4 * i : 4 * i + 4].mean() + nees[1, at].mean()) / 2
             for i, at in enumerate(([1, 2], [8, 9], [10, 11]))]  # fmt: skip
    assert [third["nees"] for third in thirds] == pytest.approx(means)


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
    # They scatter so much that they may be worth nothing: only χ² tells that this is not chance.
    assert 1 < verdict["interval99"][0] < 1.001
    assert verdict["p"] < 1e-9
    assert verdict["lost_runs"] == [0, 1, 2]
    others = sentences(verdict)[2]
    assert others.startswith(
        "3 of 1000 runs were lost (runs 0, 1, 2), the 997 never lost: NEES 2.98, σ right"
    )


def test_a_run_that_is_lost_and_comes_back_was_lost():
    """By the quantile of its own number of steps."""
    nees = consistent()
    nees[:11, 7] = 1.001 * lost_threshold(3, 20)
    found = run_verdict(nees, 3)
    assert (found["lost"], found["lost_runs"]) == (0.011, list(range(11)))
    named = "runs 0, 1, 2, 3, 4, 5, 6, 7 and 3 more"
    rest = f"the 989 never lost: NEES {nees[11:].mean():.2f}"
    assert sentences(found)[2].startswith(f"11 of 1000 runs were lost ({named}), {rest}")
    nees = np.full((2, 1000), 3.0)
    nees[:, 0] = 22.0
    logged = np.ones(nees.shape, bool)
    logged[1, 1:] = False
    assert run_verdict(nees, 3, logged=logged)["lost_runs"] == [1]


def test_of_right_runs_one_in_10000_is_lost_however_many_steps_they_have():
    """With independent steps exactly; the quantile of one step would lose 10 % of long runs."""
    assert lost_threshold(3) == pytest.approx(21.1, abs=0.05)
    for steps in (1, 1000):
        limit = lost_threshold(3, steps)
        assert 1 - stats.chi2.cdf(limit, 3) ** steps == pytest.approx(1e-4, rel=1e-3)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_with_a_diverged_run_there_is_no_mean(value):
    nees = consistent()
    nees[5, 3:] = value
    verdict = run_verdict(nees, 3)
    assert (verdict["word"], verdict["nees"], verdict["sigma_factor"]) == ("lost", None, None)
    assert (verdict["p"], verdict["end"]["p"], verdict["diverged"]) == (0.0, 0.0, 1)
    assert verdict["never_lost"]["word"] == "consistent"
    assert sentences(verdict)[0] == "1 of 1000 runs diverged, no mean NEES: lost"
    none_left = run_verdict(np.full((4, 3), value), 3)
    json.dumps([verdict, none_left], allow_nan=False)
    assert none_left["never_lost"]["runs"] == 0
    assert sentences(none_left)[-1] == "all 4 runs were lost"


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
    total = nees.mean(axis=1).sum()
    most, least = shortfalls(2000 * 6, 0.005)[1], shortfalls(2000 * 5, 0.005)[0]
    expected = np.sqrt([total / most, total / least])
    assert found["interval99"] == pytest.approx(list(expected), rel=0.02)
    assert not_disproved(found) is (word == "consistent")


@pytest.mark.parametrize("runs", [1, 3, 400])
def test_where_all_may_be_fitted_only_over_confidence_can_be_proven(runs):
    """Of a drift of one dof: with few runs that σ is not too small cannot be proven either."""
    nees = np.random.default_rng(11).chisquare(1, (runs, 4))
    assert run_verdict(nees, 1, fitted=1)["word"] == ("consistent" if runs > 3 else "cannot tell")
    for factor in (0.0, 1e-6, 1.0):
        found = run_verdict(factor * nees, 1, fitted=1)
        assert not_disproved(found)
        assert found["interval99"][1] is None
        json.dumps(found, allow_nan=False)
    assert run_verdict(40 * nees, 1, fitted=1)["word"] == "over-confident"


# --- what it is made of -------------------------------------------------------------------------


@pytest.mark.parametrize("fitted", [0.0, 0.5])
def test_tallies_of_parts_and_from_a_file_are_that_of_the_whole(fitted):
    nees = series(np.random.default_rng(8), 300)
    nees[0, 2], nees[200, 3] = np.nan, 1e3
    parts = [Tally.of(part, 3, fitted) for part in (nees[:100], nees[100:])]
    assert [Tally.from_dict(json.loads(json.dumps(part.asdict()))) for part in parts] == parts
    whole, both = Tally.of(nees, 3, fitted).verdict(), parts[0] + parts[1]
    assert Tally.of_numbers(parts[0].numbers() + parts[1].numbers(), 3, fitted) == both
    together = both.verdict()
    assert (together["lost"], together["diverged"]) == (whole["lost"], whole["diverged"])
    assert together["never_lost"]["interval99"] == pytest.approx(whole["never_lost"]["interval99"])


@pytest.mark.parametrize(
    ("factor", "text"),
    [
        (1.0, "σ right up to a factor 1.00 [0.96, 1.05]: consistent"),
        (1.26, "σ too small by 1.26 [1.23, 1.29]: over-confident (p < 0.0001)"),
        (0.8, "σ too large by 1.25 [1.22, 1.28]: under-confident (p < 0.0001)"),
    ],
)
def test_a_verdict_is_said_in_words(factor, text):
    nees = consistent()
    nees = np.minimum(nees * 3 * factor**2 / nees.mean(), lost_threshold(3))
    found = run_verdict(nees, 3)
    said, at_the_end = sentences(found)[:2]
    assert said.startswith(f"NEES {found['nees']:.2f}, {text}")
    assert brief(found).startswith(f"{found['word']}, σ × {found['sigma_factor']:.2f} [")
    assert at_the_end.startswith(f"at the last step: NEES {nees[:, -1].mean():.2f}, σ ")


TALLY = Tally.of(np.ones((5, 4)), 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: run_verdict(np.ones(3), 3), "NEES must be"),
        (lambda: run_verdict(np.ones((4, 0)), 3), "NEES must be"),
        (lambda: run_verdict(np.ones((4, 5)), 0), "NEES must be"),
        (lambda: run_verdict(np.ones((4, 5)), 3, logged=np.arange(20).reshape(4, 5) < 15),
         "at least one step per run"),
        (lambda: run_verdict(np.ones((4, 5)), 3, -0.1), "fitted must be from 0 to the 3 degrees"),
        (lambda: TALLY + Tally.of(np.ones((5, 4)), 6), "runs with 3 and 6 degrees of freedom cann"),
        (lambda: TALLY + Tally.of(np.ones((5, 4)), 3, 0.5), r"with 0\.0 and 0\.5 fitted degrees"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_study_or_not_of_one_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("size", [1e-220, 1e160])
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
    broken[0, 2] = np.inf
    assert run_verdict(broken, 3, logged=logged)["diverged"] == 1
    broken[0, 2] = 1e6
    assert run_verdict(broken, 3, logged=logged)["lost"] == 1 / 40
