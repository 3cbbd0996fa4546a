"""Tests of one run: what its steps are worth, and how often a right filter is accused by it."""

import numpy as np
import pytest
from one_run import RIGHT, autoregressive
from scipy import integrate, stats

from jaxslam.statistics import run_verdict
from jaxslam.statistics.one_run import (
    FEWEST,
    SELF_NORMALISED,
    _self_normalised_p,
    effective_samples,
    one_run,
    one_run_of_nees,
)
from jaxslam.statistics.verdict import sentences


def drawn(kind, runs=200, steps=500, n=3, seed=0):
    """Whitened errors (runs, steps, n) of a right filter."""
    return np.moveaxis(RIGHT[kind](np.random.default_rng(seed), steps, runs, n), 1, 0)


def forgetting(time, runs=200, steps=1000, n=3, seed=0):
    errors = autoregressive(time, np.random.default_rng(seed), steps, runs, n)
    return np.moveaxis(errors, 1, 0)


# --- how many steps are worth something -----------------------------------------------------------


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("time", [0, 1, 5])
def test_the_number_of_independent_steps_is_nearly_that_of_the_model_and_seldom_more(time, n):
    """Squares of exp(−k/τ) over all lags k sum to coth(1/τ)."""
    truth = 1000 * (np.tanh(1 / time) if time else 1.0)
    found = [effective_samples(z) for z in forgetting(time, runs=50, n=n)]
    assert 0.75 * truth < np.median(found) < truth
    assert np.quantile(found, 0.9) < (1.1 if n > 1 else 1.25) * truth


def test_axes_that_share_their_error_are_worth_no_more_than_one():
    rng = np.random.default_rng(1)
    alone = rng.normal(size=(2000, 1))
    assert effective_samples(np.repeat(alone, 3, axis=1)) < 0.4 * effective_samples(alone)


def test_tails_that_are_heavier_make_a_run_worth_less():
    z = drawn("heavy tails", runs=20, steps=2000)
    assert np.median([effective_samples(one) for one in z]) < 800


def test_an_error_that_never_changes_is_worth_few_steps():
    assert effective_samples(np.ones((400, 3))) < FEWEST
    assert one_run_of_nees(np.full(400, 30.0), 3).samples == 1
    slow = 2 + np.linspace(0, 0.3, 400)
    assert not one_run(slow[:, None] * np.ones(3)).over_confident
    assert not one_run_of_nees(3 * slow**2, 3).over_confident


def test_units_do_not_matter():
    z = forgetting(5, runs=1)[0]
    for factor in (1e-100, 1e100):
        assert effective_samples(factor * z) == pytest.approx(effective_samples(z), rel=1e-9)


def test_gaps_neither_break_a_correlation_nor_add_to_it():
    """Every second step of one that forgets in 20 is one that forgets in 10, of half the steps."""
    z = forgetting(20, runs=30, steps=4000)
    holes = z.copy()
    holes[:, 1::2] = np.nan
    ratios = [
        effective_samples(a) / effective_samples(b[::2]) for a, b in zip(holes, z, strict=True)
    ]
    assert np.median(ratios) == pytest.approx(1, abs=0.05)


# --- how often it is wrong, and how often right ---------------------------------------------------


# More than four of 200 are, with a rate of .5 %, one test of 300; `benchmarks/one_run.py` has more.


@pytest.mark.parametrize("kind", RIGHT)
def test_a_right_filter_is_seldom_called_over_confident(kind):
    """Nor by NEES alone, where at most a tenth never changes."""
    many = drawn(kind)
    assert sum(one_run(z).over_confident for z in many) <= 4
    by_nees = (one_run_of_nees(np.sum(z**2, axis=1), 3).over_confident for z in many)
    assert kind == "a third constant" or sum(by_nees) <= 4


def test_a_sigma_that_is_too_small_is_shown_by_thirty_independent_steps_and_by_nees_alone():
    for factor, share in ((1.3, 0.6), (1.6, 0.95)):
        z = factor * forgetting(1000 / 30, runs=100)
        assert np.mean([one_run(one).over_confident for one in z]) > share
    z = 2 * forgetting(10, runs=50)
    found = [one_run_of_nees(np.sum(one**2, axis=1), 3) for one in z]
    assert np.mean([one.over_confident for one in found]) > 0.9
    held = [one.interval99[0] < 2 < one.interval99[1] for one in found]
    assert np.mean(held) > 0.95


def test_the_interval_holds_the_factor_and_excludes_one_where_it_is_proven():
    for z in 1.5 * forgetting(3, runs=50):
        found = one_run(z)
        low, high = found.interval99
        assert found.over_confident == (low > 1) == (found.p < 0.01)
        assert low < found.sigma_factor < high
        assert low < 1.5 < high


def test_white_gaussian_errors_are_tested_by_the_chi2_of_all_steps():
    z = np.random.default_rng(0).normal(size=(500, 2))
    found = one_run(z)
    total = found.samples * np.mean(np.sum(z**2, axis=1))
    tail = stats.chi2.sf(total, 2 * found.samples)
    assert found.p == pytest.approx(min(1.0, 2 * tail), rel=1e-9)


def test_the_law_of_the_self_normalised_mean_is_that_of_its_definition():
    """Against the quantiles of Lobato (2001)."""
    for square, level in ((28.31, 0.1), (45.40, 0.05), (99.76, 0.01)):
        assert _self_normalised_p(np.sqrt(square)) == pytest.approx(level, rel=0.03)
    assert _self_normalised_p(SELF_NORMALISED) == pytest.approx(0.01, rel=1e-4)

    def of(angle):
        u = 3 / np.sin(angle)
        return np.sqrt(u / np.sinh(u))

    whole = 2 / np.pi * integrate.quad(of, 0.005, np.pi / 2)[0]
    assert _self_normalised_p(3.0) == pytest.approx(whole, rel=1e-9)


# --- the verdict ----------------------------------------------------------------------------------


def judged(z, **of):
    nees = np.sum(z**2, axis=1)[None]
    return run_verdict(nees, z.shape[1], whitened=z[None], **of)


def test_the_verdict_on_one_run_says_what_its_steps_are_worth():
    z = forgetting(10, runs=1)[0]
    found = judged(1.6 * z)
    assert (found.word, found["samples"], found.enough) == ("over-confident", "effective", None)
    assert found.effective == one_run(1.6 * z).samples
    assert tuple(found.interval99) == one_run(1.6 * z).interval99
    said = f"its steps are worth {found.effective:.0f} independent ones"
    assert said in sentences(found)
    assert sentences(found)[0].startswith(f"NEES {found.nees:.2f}, σ too small by ")
    assert "1.6" not in sentences(judged(z))[0]
    assert f"{said}, which do not show that σ is too small" in sentences(judged(z))


def test_one_run_never_shows_that_sigma_is_right_or_too_large():
    for factor in (1.0, 0.4):
        z = factor * forgetting(0, runs=1, steps=4000)[0]
        found, before = judged(z), run_verdict(np.sum(z**2, axis=1)[None], 3)
        assert found.word == "cannot tell"
        assert "samples" not in found
        assert {name: found[name] for name in before} == before
    two = 1.6 * forgetting(10, runs=2)
    nees = np.sum(two**2, axis=2)
    assert run_verdict(nees, 3, whitened=two) == run_verdict(nees, 3)


def test_few_independent_steps_tell_no_more_than_before():
    z = 1.2 * forgetting(300, runs=1)[0]
    found = judged(z)
    assert found.effective < FEWEST
    assert found.word == "cannot tell"
    assert any("too few to tell" in said for said in sentences(found))


def test_where_nees_alone_is_known_it_is_tested_by_itself():
    nees = np.sum((2 * forgetting(3, runs=1)) ** 2, axis=2)
    found = run_verdict(nees, 3, whitened=np.empty((1, 1000, 0)))
    expected = one_run_of_nees(nees[0], 3)
    assert expected.over_confident
    assert (found.word, found.p, found["samples"]) == ("over-confident", expected.p, "effective")


def test_steps_that_were_not_logged_have_no_part():
    z = 1.6 * forgetting(3, runs=1)[0]
    there = np.ones((1, 1000), bool)
    there[0, 400:600] = False
    holes = np.where(there[0, :, None], z, np.nan)
    assert judged(np.where(there[0, :, None], z, 1e6), logged=there).p == one_run(holes).p
    z[500] = np.inf
    assert judged(z).word == "lost"


@pytest.mark.parametrize(
    "test", [effective_samples, one_run, lambda z: one_run_of_nees(z[:, 0], 3)]
)
def test_a_run_without_a_step_is_refused(test):
    with pytest.raises(ValueError, match="needs at least one step that was logged"):
        test(np.full((5, 3), np.nan))


@pytest.mark.parametrize("steps", [1, 2, 9, 10, 20])
def test_a_run_of_any_length_has_a_verdict(steps):
    for z in (np.zeros((steps, 3)), np.ones((steps, 3)), forgetting(0, 1, steps)[0]):
        assert not judged(z)["effective"] < 1
        assert not one_run_of_nees(np.sum(z**2, axis=1), 3).samples < 1
