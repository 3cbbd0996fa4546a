"""What lies between the logs is named with its number and the NEES without it; and nothing else."""

import log_faults as benchmark
import numpy as np
import pytest
from logs import logged
from scipy.spatial.transform import Rotation
from verdicts import displaced

from jaxslam.evaluation import Convention, evaluate_log, evaluate_poses
from jaxslam.evaluation.convention_search import Tried, identify
from jaxslam.evaluation.sanity_checks import Mistake
from jaxslam.geometry import PLANAR, SPATIAL

SPLIT = Convention("split", "world")
STEPS = 25


def flight(factor=1.0):
    """A filter whose σ is too small by a factor, and what faults are drawn from."""
    rng = np.random.default_rng(4)
    return benchmark.flight(rng, 10, STEPS, factor), rng


def evaluated(log, **how):
    return evaluate_poses(log.estimates, log.covariances, log.truths, log.convention, **how)


RIGHT, _ = flight()
NEES = float(evaluated(RIGHT).nees.mean())


def of_truth(rng, log):
    swapped = benchmark.w_first(rng, log._replace(estimates=log.dense)).estimates
    return log._replace(dense=swapped)


def inverse(rng, log):
    return log._replace(estimates=np.linalg.inv(log.estimates))


def of_inverse_truth(rng, log):
    return log._replace(dense=np.linalg.inv(log.dense))


def inverted(_, log):
    return log._replace(covariances=np.linalg.inv(log.covariances))


def of_degrees(_, log):
    scale = np.where([x.startswith("r") for x in log.convention.names(SPATIAL)], 180 / np.pi, 1.0)
    return log._replace(covariances=scale[:, None] * log.covariances * scale)


def in_millimetres(rng, log):
    truths = log.dense.copy()
    truths[..., :3, 3] *= 1e3
    return log._replace(dense=truths)


def of_other_axes(world, body, turns_alone=False):
    """A truth along other axes of the world and of the body, or its rotations alone."""

    def put(_, log):
        T = (
            np.array(world)
            @ log.dense[..., :3, :]
            @ np.block([[np.array(body), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
        )
        dense = log.dense.copy()
        dense[..., :3, : 3 if turns_alone else 4] = T[..., : 3 if turns_alone else 4]
        return log._replace(dense=dense)

    return put


def conjugated(_, log):
    estimates = log.estimates.copy()
    estimates[..., :3, :3] = np.swapaxes(estimates[..., :3, :3], -1, -2)
    return log._replace(estimates=estimates)


def left_handed_elsewhere(rng, log):
    return of_other_axes(MIRRORED, MIRRORED)(rng, benchmark.another_world(rng, log))


NED, FRD, MIRRORED = [[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.diag([1, -1, -1]), np.diag([1, -1, 1])
UNITY = np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]])
FAULTS = {
    name: (fault.put, fault.word)
    for name, fault in benchmark.FAULTS.items()
    if fault.word and not fault.written and fault.word != benchmark.CONVENTION
} | {
    "w first, of the truth": (of_truth, "of the truth have w first"),
    "the world in the body": (inverse, "poses of the estimate are inverse"),
    "the world in the body, of the truth": (of_inverse_truth, "poses of the truth are inverse"),
    "information matrices": (inverted, "are information matrices"),
    "covariances in degrees": (of_degrees, "are of angles in degrees"),
    "truth in millimetres": (in_millimetres, "not in one world"),
    "conjugated": (conjugated, "quaternions of the estimate are conjugated"),
    "NED and FRD": (of_other_axes(NED, FRD), "are north, east, down"),
    "NED": (of_other_axes(NED, np.eye(3)), "are north, east, down"),
    "a compass": (of_other_axes(NED, FRD, turns_alone=True), "clockwise from north"),
    "CARLA": (of_other_axes(MIRRORED, MIRRORED), "axes of the truth are left-handed"),
    "Unity": (of_other_axes(UNITY, UNITY.T), "axes of the truth are left-handed"),
    "Unity, of the estimate": (of_other_axes(UNITY.T, UNITY), "axes of the truth are left-handed"),
    "CARLA, elsewhere": (left_handed_elsewhere, "mirrored: one of both is left-handed"),
}


@pytest.mark.parametrize(("put", "word"), FAULTS.values(), ids=FAULTS)
def test_a_fault_between_the_logs_is_named_with_the_nees_without_it(put, word):
    log, rng = flight()
    found = evaluated(put(rng, log))
    (cause,) = found.mistakes
    assert word in f"{cause.what}: {cause.told}"
    without = float(cause.told.split(" instead of ")[0].rsplit("NEES is ", 1)[1])
    # What is fitted takes some of the numbers of runs that hardly change.
    assert 0.7 * NEES < without < 1.2 * NEES
    assert found.verdict["word"] == "cannot tell"
    assert found.headline.startswith("no verdict: ")


def test_another_unit_of_length_is_named_by_its_factor_in_one_run_too():
    log, rng = flight()
    one = in_millimetres(rng, log)
    one = one._replace(**{x: getattr(one, x)[:1] for x in ("estimates", "covariances", "dense")})
    for found in (evaluated(in_millimetres(rng, log)), evaluated(one)):
        (cause,) = found.mistakes
        factor = float(cause.told.partition("a factor of ")[2].partition(":")[0])
        assert factor == pytest.approx(1e3, rel=0.02)
        assert "--align sim3" in cause.told


@pytest.mark.parametrize(
    ("world", "body", "turns_alone", "word"),
    [
        ([[0, 1], [1, 0]], [1, -1], True, "headings of the truth are clockwise from north"),
        ([[0, 1], [1, 0]], [1, -1], False, "axes of the truth are north, east, down"),
        ([[1, 0], [0, -1]], [1, -1], False, "axes of the truth are left-handed"),
        (None, None, False, "poses of the truth are inverse"),
    ],
)
def test_poses_in_the_plane_may_be_read_otherwise_too(world, body, turns_alone, word):
    T, P, true = logged(Convention("split"), PLANAR, runs=8, steps=STEPS)
    other = np.linalg.inv(true)
    if world:
        other = true.copy()
        other[..., :2, : 2 if turns_alone else 3] = (
            np.array(world) @ true[..., :2, :] @ np.diag([*body, 1])
        )[..., : 2 if turns_alone else 3]
    (cause,) = evaluate_poses(T, P, other, Convention("split")).mistakes
    assert cause.what.startswith(word)


def test_a_convention_in_which_errors_are_far_too_small_explains_nothing():
    """The heading of wheel odometry is unknown, and its position too sure: rotation first, no error
    would be as large as a thousandth of σ."""
    rng = np.random.default_rng(0)
    T, drift = np.tile(np.eye(3), (1, 300, 1, 1)), 0.05 * rng.normal(size=(300, 3)).cumsum(axis=0)
    P = np.tile(np.diag([1e-3, 1e-3, 1e3]), (1, 300, 1, 1))
    true = displaced(T, drift[None] * [1, 1, 0.1], Convention("split"))
    found = evaluate_poses(T, P, true, Convention("split"))
    assert found.verdict["word"] == "over-confident"


def test_w_first_is_named_where_rotations_are_uncertain_too():
    T, P, true = logged(SPLIT, runs=8, steps=STEPS, spread=0.2, factor=3.0)
    log = benchmark.w_first(np.random.default_rng(0), RIGHT._replace(estimates=T))
    (cause,) = evaluate_poses(log.estimates, 9 * P, true, SPLIT).mistakes
    assert "w first" in cause.what


def test_a_lever_arm_as_short_as_sigma_is_named_where_all_runs_have_it():
    T, P, true = logged(SPLIT, runs=12, steps=STEPS)
    X = np.eye(4)
    X[:3, 3] = 0.012, 0.0, -0.016
    (cause,) = evaluate_poses(T, P, true @ X, SPLIT).mistakes
    assert benchmark.BODIES in cause.what
    assert "a lever arm of 0.019" in cause.told


def test_covariances_of_roll_pitch_and_yaw_are_told_from_those_of_a_rotation():
    T, P, truth = logged(Convention("split", "rpy"))
    as_stated = evaluate_poses(T, P, truth, SPLIT)
    assert "convention of the covariances" in as_stated.headline
    assert as_stated.suggested == Convention("split", "rpy")


def test_where_verticals_differ_an_alignment_by_yaw_is_named_and_where_not_it_is_right():
    T, P, true = logged(SPLIT, runs=12, steps=STEPS)
    for tilt, headline in ((0.1, "no verdict: an alignment by yaw"), (0.0, "NEES")):
        turn = Rotation.from_euler("zx", [1.0, tilt]).as_matrix()
        S = benchmark.Similarity(turn, np.ones(3), 1.0)
        found = evaluate_poses(S.moved(T), S.block @ P @ S.block.T, true, SPLIT, align="yaw")
        assert found.headline.startswith(headline)
        assert all("with --align se3 NEES is" in mistake.told for mistake in found.mistakes)
    # Four numbers of each run are aligned.
    assert found.nees.mean() == pytest.approx(6 - 4 / STEPS, abs=0.5)


def test_a_run_that_is_logged_twice_is_named_and_one_that_begins_alike_is_not():
    T, P, true = RIGHT.estimates, RIGHT.covariances, RIGHT.truths
    twice = [x[[0, 1, 2, 1]] for x in (T, P, true)]
    (cause,) = evaluate_poses(*twice, RIGHT.convention).mistakes
    assert f"run 1 and run 3 share {STEPS} of {STEPS} estimates" in cause.told
    alike = T.copy()
    alike[:, :5] = T[0, :5]
    found = evaluate_poses(alike, P, true, RIGHT.convention)
    assert not [mistake for mistake in found.mistakes if "twice" in mistake.what]


@pytest.mark.parametrize("runs", [1, 8])
@pytest.mark.parametrize(
    ("change", "word"),
    [
        (np.sqrt, "σ in place of variances"), (np.square, "variances in place of σ"),
        (np.copy, ""), (lambda P: 1e-2 * P, ""), (lambda P: 30 * P, ""),
    ],
)  # fmt: skip
def test_what_is_written_in_place_of_variances_is_named_and_a_wrong_variance_is_not(
    change, word, runs
):
    T, _, _ = logged(SPLIT, runs=runs, steps=100)
    P = np.tile(np.diag([0.05, 0.04, 0.08, 0.01, 0.02, 0.01]) ** 2, (runs, 100, 1, 1))
    noise = np.random.default_rng(0).normal(size=(runs, 100, 6)) @ np.sqrt(P[0, 0])
    found = evaluate_poses(T, change(P), displaced(T, noise, SPLIT), SPLIT)
    if word:
        (cause,) = found.mistakes
        assert word in cause.what
        assert cause.nees == pytest.approx(6, rel=0.1)
    assert word or not found.mistakes


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("align", "size", "variance"),
    [
        ("none", 1e99, 1e-120), ("yaw", 1e99, 1e-120), ("first", 1.0, 1e-300),
        ("yaw", 1e-150, 1e-300), ("none", 1e-150, 1e-300),
    ],
)  # fmt: skip
def test_numbers_at_the_limits_make_no_warning(size, variance, align):
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (2, 8, 1, 1))
    T[..., :3, 3] = rng.normal(size=(2, 8, 3))
    true, P = T.copy(), np.tile(variance * np.eye(6), (2, 8, 1, 1))
    true[..., :3, 3] += size * rng.normal(size=(2, 8, 3))
    assert str(evaluate_poses(T, P, true, align=align))


def drifting(log):
    """A filter that does not know that it drifts, in position and heading, in one run each way."""
    rng, steps = np.random.default_rng(100), np.linspace(0, 1, STEPS)[:, None]
    size = len(log.estimates), 1, 6
    e = steps * np.array([0.4, 0.4, 0.1, 0, 0, 0.1]) * rng.normal(size=size)
    return displaced(log.truths, e, SPLIT)


def turned_at_first(log):
    """A wrong heading at the start, which turns all of a run about its first pose."""
    start, turn = log.truths[:, :1], np.tile(np.eye(4), (len(log.truths), 1, 1, 1))
    heading = 0.06 * np.random.default_rng(0).normal(size=len(turn))
    turn[:, 0, :3, :3] = Rotation.from_euler("z", heading[:, None]).as_matrix()
    return start @ turn @ np.linalg.inv(start) @ log.truths


def with_an_arm(log):
    """A lever arm that leaves most of the errors."""
    X = np.eye(4)
    X[:3, 3] = 1.0, 0.0, 0.5
    return log.truths @ X


@pytest.mark.parametrize(
    ("factor", "truth"),
    [
        (1.3, lambda log: log.truths), (3.0, lambda log: log.truths), (1.0, drifting),
        (1.0, turned_at_first), (12.0, with_an_arm),
    ],
    ids=["σ", "σ, by much", "drift", "headings at the start", "σ, and another body"],
)  # fmt: skip
def test_a_filter_that_is_wrong_itself_has_no_other_cause(factor, truth):
    log, _ = flight(factor)
    for align in ("none", "yaw"):
        logs = log.estimates, log.covariances, truth(log)
        found = evaluate_poses(*logs, log.convention, align=align)
        assert not found.mistakes, found.mistakes
        assert align == "yaw" or found.verdict["word"] in ("over-confident", "lost")


@pytest.mark.parametrize("fault", ["clock", "doubled stamps", "column by column"])
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
        np.testing.assert_allclose(found.nees, evaluated(log).nees, rtol=1e-3)


MANY, ONE = benchmark.RUNS, (1, 1)
RIGHT_ONES = [
    ("roll, pitch, yaw", 46, MANY), ("roll, pitch, yaw", 60, MANY), ("half angles", 70, MANY),
    ("body, lever arm", 47, MANY), ("body, lever arm", 62, MANY), ("clock", 75, MANY),
    ("w first", 5, ONE), ("body, both", 1, ONE), ("body, both", 17, ONE), ("body, both", 20, ONE),
    ("body, turned", 6, ONE), ("body, lever arm", 6, ONE), ("half angles", 7, ONE),
    ("wrong convention", 1, ONE), ("roll, pitch, yaw", 6, ONE), ("body, both", 111, (1, 4)),
]  # fmt: skip
"""Logs of right filters, with one fault each, that were called over-confident, or of another one:
where another fault explains as much, or too few runs tell."""


@pytest.mark.parametrize(("name", "number", "runs"), RIGHT_ONES)
def test_a_right_filter_is_not_blamed_for_a_fault_that_cannot_be_told(name, number, runs):
    said, found = benchmark.judged(name, 1.0, number, runs)
    assert said in ("named", "cannot tell")
    assert found.verdict["word"] == "cannot tell"


@pytest.mark.parametrize(
    ("name", "number"), [("none, another world aligned by se3", 131), ("body, turned", 317)]
)
def test_sigma_of_rotations_that_is_wrong_by_chance_is_not_of_half_angles(
    name, number, monkeypatch
):
    monkeypatch.setattr(benchmark, "SEED", 777)
    said, _ = benchmark.judged(name, 1.0 if number == 317 else 1.5, number, (5, 14))
    assert "half angles" not in said


def test_a_convention_under_which_covariances_are_far_smaller_is_compared():
    nees, near, far = np.full((4, 3), 6.0), Convention("right"), Convention("left")
    tried = {near: Tried(nees, 6), far: Tried(nees, 6, log_determinant=-6e3)}
    assert identify(near, tried).stated == near


@pytest.mark.parametrize("runs", [1, 2, 4])
def test_a_body_that_is_off_by_sigma_makes_no_filter_over_confident(runs):
    """By a lever arm, and askew by 1.8°: of few runs these are possible, and never excluded."""
    arm, turn = np.eye(4), np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, np.radians(1.8), 0.0]).as_matrix()
    for seed in range(2):
        rng = np.random.default_rng([seed, runs])
        log = benchmark.flight(rng, runs, STEPS)
        P = benchmark.converted(log.covariances, log.estimates, log.convention, SPLIT)
        arm[:3, 3] = np.sqrt(np.diagonal(P[0, -1])[:3])
        for X in (arm, turn):
            found = evaluated(log._replace(dense=log.dense @ X))
            assert found.verdict["word"] not in ("over-confident", "lost"), found


def test_what_is_possible_is_told_with_the_nees_without_it():
    _, found = benchmark.judged("half angles", 1.0, 7, ONE)
    assert found.headline.startswith("no verdict: estimate and truth may be of two bodies, the cov")
    assert "with angle=half in their header (g2o) NEES is" in found.mistakes[1].told
    assert not any(x.certain for x in found.mistakes)


def test_a_body_that_explains_as_much_as_another_world_is_told_once(monkeypatch):
    body = Mistake("a body", "It explains all.", 1.0, certain=False)
    monkeypatch.setattr("jaxslam.evaluation.causes._mounting", lambda *_: body)
    _, found = benchmark.judged("another world", 1.0, 0, ONE)
    assert found.mistakes.count(body) == 1
