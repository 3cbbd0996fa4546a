"""Mistakes of logging are named; right data, and filters that are wrong themselves, are not."""

import json

import numpy as np
import pytest
import verdicts as benchmark
from cases import quick_rows
from scipy import stats

import jaxslam
from jaxslam.evaluation import evaluate_nees

NAMES = ("x", "y", "heading")
SIGMA, DEGREES = benchmark.AXIS_SIGMA, benchmark.UNITS


def correlated(runs=20, steps=40, n=3, correlation=0.97, seed=0):
    """Standard normal numbers (runs, steps, n) whose neighbouring steps correlate so much."""
    noise = np.random.default_rng(seed).normal(size=(steps, runs, n))
    return np.swapaxes(benchmark.correlated(noise, correlation), 0, 1)


def right(**of):
    """Errors of a robot in the plane, and covariances that are theirs."""
    errors = SIGMA * correlated(**of)
    return errors, np.broadcast_to(np.diag(SIGMA**2), (*errors.shape, 3)).copy()


def said(errors, covariances, names=NAMES):
    """What is in the headline, of an evaluation that withholds its verdict everywhere."""
    found = jaxslam.evaluate(errors, covariances, names=names)
    if not found.mistakes:
        return ""
    written = json.loads(json.dumps(found.asdict(), allow_nan=False))
    assert written["verdict"]["word"] == "cannot tell"
    assert written["mistakes"] == [mistake.told for mistake in found.mistakes]
    told = str(found).splitlines()
    assert told[0] == found.headline
    assert told[1 : 1 + len(found.mistakes)] == written["mistakes"]
    assert not any(line.startswith("NEES") for line in told)
    assert not any(word in found.headline for word in ("consistent", "confident", "lost"))
    return found.headline


@pytest.mark.parametrize("numbers", quick_rows(1, [range(5), range(5, 50)]))
@pytest.mark.parametrize(("kind", "word"), benchmark.MISTAKES.items())
def test_a_mistake_is_named_and_a_filter_that_is_wrong_is_not_taken_for_one(kind, word, numbers):
    """Of 8 to 60 runs of robots whose errors correlate; the slow ones would find what is rare."""
    for number in numbers:
        for names in (NAMES, ()):
            headline = said(*benchmark.study(kind, number), names)
            assert word in headline if word else headline == "", (number, names)


@pytest.mark.parametrize(("names", "turns"), [(NAMES, 1), ((), -1), (NAMES, 2)])
def test_an_angle_that_is_not_wrapped_is_named(names, turns):
    name = names[2] if names else "3"
    e, P = right()
    e[3, 12:, 2] += turns * 2 * np.pi
    assert said(e, P, names) == f"no verdict: an angle is not wrapped ({name})"
    told = jaxslam.evaluate(e, P, names=names).mistakes[0].told
    assert f"{e[3, 12, 2]:.4g} at step 12 of run 3, and 27 more; wrap them to (−π, π]" in told
    e, P = right()
    e[5, 7, 2] += turns * 2 * np.pi
    assert "an angle is not wrapped" in said(e, P, names)
    assert " more" not in jaxslam.evaluate(e, P, names=names).mistakes[0].told
    assert "an angle is not wrapped" in said(e[5:6], P[5:6], names)
    assert "(1)" in said(e[..., 2:], P[..., 2:, 2:], ())


def test_degrees_for_radians_are_named_and_wrapped_at_360():
    """Of few runs that hardly change, of one axis alone, and of white innovations of one run."""
    for runs, correlation in ((60, 0.97), (10, 0.99)):
        e, P = right(runs=runs, correlation=correlation)
        for angle in ("heading", "rz"):  # as of poses
            told = said(e * DEGREES, P, ("x", "y", angle))
            assert told == f"no verdict: degrees instead of radians ({angle})"
    e, P = right()
    assert "degrees" in said((e * DEGREES)[..., 2:], P[..., 2:, 2:], NAMES[2:])
    e, P = e * DEGREES, P * DEGREES * DEGREES[:, None]
    assert said(e, P) == ""
    e[3, 12:, 2] -= 360
    assert said(e, P) == "no verdict: an angle is not wrapped (heading)"
    z, S = right(runs=1, steps=300, correlation=0.0)
    for names in (NAMES, ()):
        found = jaxslam.evaluate(z * DEGREES, S, names=names, quantity="NIS")
        assert "degrees instead of radians" in found.headline


@pytest.mark.parametrize("runs", [1, 3])
def test_arrays_of_steps_and_runs_are_named_of_few_runs_too(runs):
    e, P = (np.swapaxes(x, 0, 1) for x in right(runs=runs, steps=60))
    assert said(e, P) == "no verdict: runs and steps appear to be swapped"


def test_where_all_of_sigma_is_too_small_it_is_not_the_unit_of_angles():
    """Also where some runs are lost besides, and where their mean NEES is what degrees make it."""
    lost, small = np.ones((20, 1, 3)), np.full((40, 1, 3), 30.0)
    lost[:6, :, 2] = 180 / np.pi * np.sqrt(20 / 6)
    small[[3, 17]] *= 12
    for factor, names in (
        (lost, NAMES),
        (lost, ()),
        (small, ()),
        (np.full((60, 1, 1), 57.3), NAMES),
    ):
        for seed in range(2):
            e, P = right(runs=len(factor), seed=seed, correlation=0.9 if factor is lost else 0.0)
            assert 29 < jaxslam.evaluate(factor * e, P).axis_verdict(2)["sigma_factor"] < 115
            assert said(factor * e, P, names) == ""


def test_a_gate_in_front_of_innovations_is_named():
    """At a usual quantile of χ², and of so many NIS that none is beyond it by chance."""
    nis, gate = np.random.default_rng(0).chisquare(2, (1, 4000)), stats.chi2.isf(0.05, 2)
    behind = nis[nis < gate][None]
    found = evaluate_nees(behind, 2, quantity="NIS")
    assert found.headline == "no verdict: a gate in front of the NIS"
    assert f"none of {behind.size} NIS is above 5.991, where 189 should be" in str(found)
    for others in (nis, nis[nis < 1.2 * gate][None], behind[:, :100]):
        assert "gate" not in evaluate_nees(others, 2, quantity="NIS").headline


def test_positions_anywhere_are_no_angles():
    """Of a filter whose σ is 100 times too small, errors of metres, also of 6.28 m."""
    for seed in range(4):
        e = 4 * correlated(n=1, correlation=0.5, seed=seed)
        assert "wrapped" not in said(e, np.full((*e.shape, 1), 0.03**2), ())
        few = np.where(np.random.default_rng(seed).random(e.shape) < 0.02, 3 * e, 0.01 * e)
        assert "wrapped" not in said(few, np.full((*e.shape, 1), 0.04**2), ())
    e, P = right()
    e[3, 12:, 0] += 2 * np.pi  # an outlier of a length, by its name
    assert said(e, P) == ""


def test_a_bias_that_all_runs_share_or_an_order_by_scatter_does_not_make_them_steps():
    for seed in range(4):
        e, P = right(seed=seed, correlation=0.9)
        shared = correlated(1, 40, 3, 0.99, seed=1000 + seed)
        assert said(e + 3 * SIGMA * shared, P) == ""
        assert said(e * np.linspace(0.5, 2, 20)[:, None, None], P) == ""
