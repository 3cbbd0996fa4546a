"""What lies between the logs is named with its number and the NEES without it; and nothing else."""

from functools import partial

import log_faults as benchmark
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from verdicts import correlated, displaced

from jaxslam.evaluation import Convention, evaluate_log, evaluate_poses

RUNS, STEPS = 12, 20
SIGMA = np.array([0.05, 0.04, 0.06, 0.01, 0.012, 0.008])
SPLIT = Convention("split", "world")


def paths(seed=0, tilt=0.3, speed=1.0):
    """True poses, which turn about all axes unless they are level."""
    rates = np.random.default_rng(seed).uniform(1, 4, (3, RUNS, 1))
    angle = rates * np.linspace(0, 3, STEPS)
    euler = np.stack([tilt * np.sin(angle[0]), tilt * np.cos(angle[1]), angle[2]], axis=-1)
    T = np.tile(np.eye(4), (RUNS, STEPS, 1, 1))
    turn = Rotation.from_euler("xyz", euler.reshape(-1, 3)).as_matrix()
    T[..., :3, :3] = turn.reshape(RUNS, STEPS, 3, 3)
    T[..., :3, 3] = speed * np.cumsum(T[..., :3, 0], axis=1)
    return T


def right(factor=1.0, correlation=0.9, seed=0, tilt=0.3, convention=SPLIT):
    """Estimates, covariances and truths of a filter whose σ is too small by a factor."""
    T, rng = paths(seed, tilt), np.random.default_rng(seed)
    white = rng.normal(size=(STEPS + 1, RUNS, 6))
    errors = factor * SIGMA * np.swapaxes(correlated(white, correlation)[:-1], 0, 1)
    P = np.broadcast_to(np.diag(SIGMA**2), (RUNS, STEPS, 6, 6))
    return T, P, displaced(T, errors, convention)


T, P, TRUTH = right()
NEES = float(evaluate_poses(T, P, TRUTH, SPLIT).nees.mean())


def body(degrees=0.0, arm=(0.0, 0.0, 0.0)):
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("xyz", np.multiply(degrees, [0.6, 0.0, 0.8])).as_matrix()
    X[:3, 3] = arm
    return X


def moved(R, t):
    """Estimates and covariances in another world."""
    S = benchmark.Similarity(np.asarray(R), np.asarray(t), 1.0)
    return S.moved(T), S.block @ P @ S.block.T


def half_angles():
    T, P, true = right(correlation=0.0)
    scale = np.where(np.arange(6) < 3, 1.0, 0.5)
    return T, scale[:, None] * P * scale, true


def w_first(poses):
    flat = poses.reshape(-1, 4, 4)
    q = benchmark.quaternions(flat[:, :3, :3])[:, [3, 0, 1, 2]]
    return benchmark.poses_of(flat[:, :3, 3], q).reshape(poses.shape)


def yaw(degrees):
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


def angles():
    """Covariances of roll, pitch and yaw, of which the truth has the errors."""
    sigma, rng = np.array([0.05, 0.05, 0.05, 0.03, 0.01, 0.02]), np.random.default_rng(0)
    T = paths(tilt=1.0)
    euler = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_euler("xyz")
    e = sigma * rng.normal(size=(RUNS * STEPS, 6))
    true = T.copy()
    true[..., :3, 3] += e[:, :3].reshape(RUNS, STEPS, 3)
    R = Rotation.from_euler("xyz", euler + e[:, 3:]).as_matrix()
    true[..., :3, :3] = R.reshape(RUNS, STEPS, 3, 3)
    return T, np.broadcast_to(np.diag(sigma**2), P.shape), true


FAULTS = {
    "w first, estimate": ((w_first(T), P, TRUTH), "of the estimate have w first", ""),
    "w first, truth": ((T, P, w_first(TRUTH)), "of the truth have w first", ""),
    "two bodies, turned": (
        (T, P, TRUTH @ body(np.radians(40))), "two bodies", "a constant rotation of 39.",
    ),
    # As large as σ: no error is large, but all runs have the same.
    "two bodies, a short arm": (
        (T, P, TRUTH @ body(0, (0.06, 0.0, -0.08))), "two bodies", "a lever arm of 0.1",
    ),
    "two bodies, both": (
        (T, P, TRUTH @ body(np.radians(120), (0.0, 0.0, 1.0))), "two bodies", "a lever arm of",
    ),
    "another world": ((*moved(yaw(70), (9.0, 2.0, 0.0)), TRUTH), "not in one world", "by 7"),
    "half angles": (half_angles(), "half angles", "angle=half"),
}  # fmt: skip


def nees_without(told):
    return float(told.split(" instead of ")[0].rsplit("NEES is ", 1)[1])


@pytest.mark.parametrize(("logs", "what", "number"), FAULTS.values(), ids=FAULTS)
def test_a_fault_between_the_logs_is_named_with_the_nees_without_it(logs, what, number):
    found = evaluate_poses(*logs, SPLIT)
    (cause,) = found.mistakes
    assert what in cause.what
    assert number in cause.told
    # What is fitted takes some of the numbers of runs that hardly change.
    assert 0.7 * NEES < nees_without(cause.told) < 1.2 * NEES
    assert found.verdict["word"] == "cannot tell"
    assert found.headline.startswith("no verdict: ")


def test_a_lever_arm_that_leaves_most_of_the_errors_is_no_cause():
    """A filter whose σ is too small by eight, of a truth with a short arm: it is over-confident."""
    T, P, true = right(factor=8.0)
    found = evaluate_poses(T, P, true @ body(0, (2.0, 0.0, 1.0)), SPLIT)
    assert not found.causes
    assert found.verdict["word"] in ("over-confident", "lost")


def test_covariances_of_roll_pitch_and_yaw_are_told_from_those_of_a_rotation():
    logs = angles()
    as_stated = evaluate_poses(*logs, Convention("split", "world"))
    assert "convention of the covariances" in as_stated.headline
    assert as_stated.suggested == Convention("split", "rpy")
    nees = evaluate_poses(*logs, Convention("split", "rpy")).nees.mean()
    assert nees == pytest.approx(6, abs=0.6)


def test_where_verticals_differ_an_alignment_by_yaw_is_named_and_where_not_it_is_right():
    T, P, true = right(correlation=0.0)
    for tilt, headline in ((0.1, "no verdict: an alignment by yaw"), (0.0, "NEES")):
        S = benchmark.Similarity(
            Rotation.from_euler("zx", [1.0, tilt]).as_matrix(), np.ones(3), 1.0
        )
        logs = S.moved(T), S.block @ P @ S.block.T, true
        found = evaluate_poses(*logs, SPLIT, align="yaw")
        assert found.headline.startswith(headline)
        assert all("with --align se3 NEES is" in mistake.told for mistake in found.mistakes)
    # Of the four that yaw aligns a run of twenty poses has 120.
    assert found.nees.mean() == pytest.approx(6 - 4 / STEPS, abs=0.5)


def test_a_run_that_is_logged_twice_is_named_and_one_that_begins_alike_is_not():
    twice = [x[[0, 1, 2, 1]] for x in (T, P, TRUTH)]
    (cause,) = evaluate_poses(*twice, SPLIT).mistakes
    assert "run 1 and run 3 share 19 of 19 estimates" in cause.told
    alike = T.copy()
    alike[:, :5] = T[0, :5]
    assert not [x for x in evaluate_poses(alike, P, TRUTH, SPLIT).mistakes if "twice" in x.what]


def drifting():
    """A filter that does not know that it drifts, in position and heading, in one run each way."""
    T, P, true = right()
    rng, steps = np.random.default_rng(100), np.linspace(0, 1, STEPS)[:, None]
    e = steps * np.array([0.4, 0.4, 0.1, 0, 0, 0.1]) * rng.normal(size=(RUNS, 1, 6))
    return T, P, displaced(true, e, SPLIT)


def turned_at_first():
    """A wrong heading at the start, which turns all of a run about its first pose."""
    T, P, true = right()
    start, turn = true[:, :1], np.tile(np.eye(4), (RUNS, 1, 1, 1))
    heading = 0.06 * np.random.default_rng(0).normal(size=RUNS)
    turn[:, 0, :3, :3] = Rotation.from_euler("z", heading[:, None]).as_matrix()
    return T, P, start @ turn @ np.linalg.inv(start) @ true


WRONG = {
    "σ of the heading": partial(right, np.array([1, 1, 1, 1.2, 1.2, 3])),
    "σ": partial(right, 1.3),
    "σ, by much": partial(right, 3.0),
    "σ of a level robot": partial(right, 1.3, tilt=0.0),
    "drift": drifting,
    "headings at the start": turned_at_first,
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_a_filter_that_is_wrong_itself_has_no_other_cause(wrong):
    logs = wrong()
    for align in ("none", "yaw"):
        found = evaluate_poses(*logs, SPLIT, align=align)
        assert not found.mistakes, found.mistakes
        assert align == "yaw" or found.verdict["word"] in ("over-confident", "lost")


@pytest.mark.parametrize("fault", ["none", "clock", "doubled stamps", "column by column"])
def test_faults_of_files_are_named(fault, tmp_path):
    """Of logs with a truth that is ten times as fast, which is interpolated."""
    rng = np.random.default_rng(4)
    log = benchmark.flight(rng, 6, 25)
    benchmark.written(tmp_path, benchmark.FAULTS[fault].put(rng, log), fault)
    found = evaluate_log(tmp_path)
    told = " ".join([found.headline, *found.notes])
    assert benchmark.FAULTS[fault].word in told
    assert found.verdict["word"] not in ("over-confident", "lost")
    if fault != "clock":
        logs = log.estimates, log.covariances, log.truths
        wanted = evaluate_poses(*logs, log.convention).nees
        np.testing.assert_allclose(found.nees, wanted, rtol=1e-3)
