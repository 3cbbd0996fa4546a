"""Mistakes of logging are named; right data, and filters that are wrong themselves, are not."""

import json

import numpy as np
import pytest
from cases import quick_rows
from logs import write_runs
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.evaluation import Convention

NAMES = ("x", "y", "heading")
SIGMA = np.array([0.1, 0.1, 0.02])
DEGREES = np.array([1, 1, 180 / np.pi])


def correlated(runs=20, steps=40, n=3, correlation=0.97, seed=0):
    """Standard normal numbers (runs, steps, n) whose neighbouring steps correlate so much."""
    rng = np.random.default_rng(seed)
    now, result = rng.normal(size=(runs, n)), np.empty((runs, steps, n))
    for step in range(steps):
        result[:, step] = now
        now = correlation * now + np.sqrt(1 - correlation**2) * rng.normal(size=now.shape)
    return result


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


# --- they are named -----------------------------------------------------------------------------


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
    assert "an angle is not wrapped" in said(e[5:6], P[5:6], names)
    assert "(1)" in said(e[..., 2:], P[..., 2:, 2:], ())
    e, P = (right()[0] * DEGREES, right()[1] * DEGREES * DEGREES[:, None])
    assert said(e, P) == ""
    e[3, 12:, 2] -= 360
    assert said(e, P) == "no verdict: an angle is not wrapped (heading)"


@pytest.mark.parametrize(("names", "name"), [(NAMES, "heading"), ((), "3")])
@pytest.mark.parametrize(("runs", "correlation"), [(60, 0.97), (10, 0.99)])
def test_degrees_for_radians_are_named(names, name, runs, correlation):
    """Of few runs that hardly change, too: the interval of their scatter has no lower end."""
    e, P = right(runs=runs, correlation=correlation)
    expected = f"no verdict: degrees instead of radians ({name})"
    assert said(e * DEGREES, P, names) == expected
    assert said(e, P * DEGREES * DEGREES[:, None], names) == expected
    if runs == 60:
        only = slice(2, 3)
        assert "degrees" in said((e * DEGREES)[..., only], P[..., only, only], names[2:])


def test_degrees_are_named_of_innovations():
    """Every step of white ones is a sample: those of one run are enough."""
    z, S = right(runs=1, steps=300, correlation=0.0)
    for names in (NAMES, ()):
        found = jaxslam.evaluate(z * DEGREES, S, names=names, quantity="NIS")
        assert "degrees instead of radians" in found.headline


def test_degrees_are_named_in_poses_too(tmp_path):
    """A covariance file in degrees that does not say so."""
    steps, sigma = 60, np.array([0.1, 0.1, 0.1, 0.01, 0.02, 0.01])
    truth = np.tile(np.eye(4), (12, steps, 1, 1))
    truth[..., 0, 3] = np.arange(steps) / 10
    e = sigma * np.random.default_rng(0).normal(size=(12, steps, 6))
    estimate = truth.copy()
    estimate[..., :3, 3] -= e[..., :3]
    back = Rotation.from_rotvec(-e[..., 3:].reshape(-1, 3)).as_matrix()
    estimate[..., :3, :3] = back.reshape(12, steps, 3, 3)
    P = np.tile(np.diag(sigma * np.repeat([1, 180 / np.pi], 3)) ** 2, (12, steps, 1, 1))
    write_runs(tmp_path, estimate, P, truth, Convention("split", "mixed"))
    found = jaxslam.evaluate_log(tmp_path)
    assert found.headline == "no verdict: degrees instead of radians (rx, ry, rz)"
    assert "covariances in degrees" in str(found)
    assert found.asdict()["verdict"]["word"] == "cannot tell"


@pytest.mark.parametrize("runs", [1, 3, 20])
def test_arrays_of_steps_and_runs_are_named(runs):
    e, P = (np.swapaxes(x, 0, 1) for x in right(runs=runs, steps=60))
    for names in (NAMES, ()):
        assert said(e, P, names) == "no verdict: runs and steps appear to be swapped"


# --- and nothing else is ------------------------------------------------------------------------

SIZES = [(1, 1), (1, 50), (2, 50), (3, 3), (5, 30), (8, 1), (10, 10), (20, 2), (30, 1), (30, 30)]
SEEDS = pytest.mark.parametrize("seeds", quick_rows(1, [range(2), range(2, 20)]))
"""The first are quick: the others would find what is rare."""


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.01, 1.0, 30.0])
@pytest.mark.parametrize("correlation", [0.0, 0.97])
def test_right_data_raise_no_false_alarm(size, correlation):
    """Of 500 studies .05 are expected to look interchanged, where each is allowed 1 in 10 000."""
    for runs, steps in SIZES:
        for seed in range(50):
            n = 1 + seed % 3
            e = size * correlated(runs, steps, n, correlation, seed)
            P = np.broadcast_to(size**2 * np.eye(n), (*e.shape, n))
            assert said(e, P, NAMES[3 - n :] if seed % 2 else ()) == "", (runs, steps, seed)


@SEEDS
@pytest.mark.parametrize("factor", quick_rows(3, [0.3, 10.0, 57.3, 0.1, 3.0, 20.0]))
def test_a_filter_whose_sigma_is_wrong_is_not_taken_for_a_log_that_is(factor, seeds):
    for seed in seeds:
        e, P = right(seed=seed)
        assert said(factor * e, P) == ""
        assert said(factor * e, P, ()) == ""
        assert said(e * [factor, factor, 1], P) == ""


@SEEDS
def test_lost_runs_are_not_taken_for_ones_in_degrees(seeds):
    """Where the mean NEES of all runs is just what degrees would make it; and where all of σ is
    too small besides, of axes without names."""
    lost = np.ones((20, 1, 3))
    lost[:6, :, 2] = 180 / np.pi * np.sqrt(20 / 6)
    small = np.full((40, 1, 3), 30.0)
    small[[3, 17]] *= 12
    for seed in seeds:
        for factor, names, correlation in ((lost, NAMES, 0.97), (lost, (), 0.97), (small, (), 0.0)):
            e, P = right(runs=len(factor), seed=seed, correlation=correlation)
            assert 29 < jaxslam.evaluate(factor * e, P).axis_verdict(2)["sigma_factor"] < 115
            assert said(factor * e, P, names) == ""


@SEEDS
def test_positions_anywhere_are_no_angles(seeds):
    """Of a filter whose σ is 100 times too small, errors of metres, also of 6.28 m."""
    for seed in seeds:
        e = 4 * correlated(n=1, correlation=0.5, seed=seed)
        assert "wrapped" not in said(e, np.full((*e.shape, 1), 0.03**2), ())
        few = np.where(np.random.default_rng(seed).random(e.shape) < 0.02, 3 * e, 0.01 * e)
        assert "wrapped" not in said(few, np.full((*e.shape, 1), 0.04**2), ())
    e, P = right()
    e[3, 12:, 0] += 2 * np.pi  # an outlier of a length, by its name
    assert said(e, P) == ""


@SEEDS
def test_a_bias_that_all_runs_share_or_an_order_by_scatter_does_not_make_them_steps(seeds):
    for seed in seeds:
        e, P = right(seed=seed, correlation=0.9)
        shared = correlated(1, 40, 3, 0.99, seed=1000 + seed)
        assert said(e + 3 * SIGMA * shared, P) == ""
        assert said(e * np.linspace(0.5, 2, 20)[:, None, None], P) == ""
