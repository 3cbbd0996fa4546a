"""The suite: plain files that any filter can read, its logs, and the filters here beside them.

That a filter of those files has its numbers is a test of `docs/suite.md`.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from refusals import ended
from scipy.spatial.transform import Rotation
from verdicts import displaced

import jaxslam
from jaxslam.cli import main
from jaxslam.consistency import read_suite, write_suite
from jaxslam.consistency import suite as suite_module
from jaxslam.evaluation import Convention, read_pose_log
from jaxslam.io.tum import of_xytheta

RUNS, STEPS = 6, 8
SMALL = jaxslam.scenario("matched", {"name": "small"}, steps=STEPS, landmarks=5)
NAMES = ("x", "z", "rotation")


def table(path):
    return np.genfromtxt(path, delimiter=",", names=True)


def poses_of(rows):
    """Rigid motions of numbers as the files have them."""
    if rows.shape[-1] == 3:
        return of_xytheta(rows)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, 3], T[:, :3, :3] = rows[:, :3], Rotation.from_rotvec(rows[:, 3:]).as_matrix()
    return T


def log_of(folder):
    """A log of poses that are off by errors drawn with a σ of .1, and their NEES."""
    truth = np.array(table(folder / "truth.csv").tolist())
    truth = truth[truth[:, 1] > 0]
    errors = 0.1 * np.random.default_rng(0).normal(size=truth[:, 3:].shape)
    T = displaced(poses_of(truth[:, 3:]), -errors, Convention())
    P, nees = 0.01 * np.eye(errors.shape[1]), 100 * np.sum(errors**2, axis=1)
    if len(P) == 3:  # as a triangle; in space whole
        pose = T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])
        P = P[np.triu_indices(3)]
    else:
        pose = T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    return np.column_stack([truth[:, :2], *pose, np.tile(P.ravel(), (len(T), 1))]), nees


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A suite with the truth, one without, and a log."""
    place = tmp_path_factory.mktemp("suite")
    write_suite(place / "open", [SMALL], runs=RUNS, seed=3)
    write_suite(place / "hidden", [SMALL], runs=RUNS, seed=3, truth=False)
    (place / "logs").mkdir()
    np.savetxt(place / "logs" / "small.csv", log_of(place / "open" / "small")[0], delimiter=",")
    return place


def command(place, suite, *more):
    """That judges the logs."""
    words = ["evaluate", str(place / "logs"), "--suite", str(place / suite)]
    return [*words, "--filters", "robocentric", *more]


def judged(place, suite, out, *more):
    """What the command writes of them."""
    main([*command(place, suite, *more), "--out", str(out)])
    return json.loads((out / "suite.json").read_text())["scenarios"]["small"]


def test_a_log_is_judged_beside_a_filter_on_the_same_runs(written, tmp_path, monkeypatch, capsys):
    """They are drawn once, and what was run is kept."""
    drawn, draw = [], suite_module.draw

    def counted(scenario, runs, *, seed):
        drawn.append(scenario.name)
        return draw(scenario, runs, seed=seed)

    monkeypatch.setattr(suite_module, "draw", counted)
    found = judged(written, "open", tmp_path)
    assert drawn == ["small"]
    yours, ours = found["yours"], found["robocentric/inverse_scaling"]
    nees = log_of(written / "open" / "small")[1].reshape(RUNS, STEPS)
    np.testing.assert_allclose(yours["nees"], nees.mean(axis=0), rtol=1e-9)
    study = jaxslam.monte_carlo(SMALL, "robocentric", runs=RUNS, seed=3).summary()
    np.testing.assert_allclose(ours["nees"], study["robocentric"]["nees"], rtol=1e-9)
    assert yours["band95"] == ours["band95"]
    lines = capsys.readouterr().out.splitlines()
    own, of_filter = (next(x for x in lines if x.startswith(name)) for name in ("yours ", "robo"))
    for line, numbers in ((own, yours), (of_filter, ours)):
        assert float(line.split()[1]) == pytest.approx(numbers["nees"][-1] / 3, rel=5e-3)
    assert f"yours: NEES {yours['verdict']['nees']:.2f}" in "\n".join(lines)
    (kept,) = tmp_path.glob("small/runs/*/*.npz")
    before = kept.stat().st_mtime_ns
    assert judged(written, "open", tmp_path)["yours"] == yours
    assert kept.stat().st_mtime_ns == before


def test_a_hidden_truth_comes_of_its_seed(written, tmp_path, capsys):
    files = {path.name for path in (written / "hidden" / "small").iterdir()}
    assert files == {"scenario.json", "measurements.csv"}
    told = json.loads((written / "hidden" / "small" / "scenario.json").read_text())
    assert told["seed"] is None
    shown, drawn = (table(written / x / "small" / "measurements.csv") for x in ("open", "hidden"))
    np.testing.assert_array_equal(shown, drawn)
    by_seed = judged(written, "hidden", tmp_path / "hidden", "--seed", "3")
    assert by_seed["yours"] == judged(written, "open", tmp_path / "open")["yours"]
    for more, message in (
        ((), "its seed is hidden with the truth; --seed is needed"),
        (("--seed", "4"), "seed 4 draws other runs"),
    ):
        ended(message, command(written, "hidden", *more), tmp_path / "out", capsys)


def changed(log, place, value):
    log = log.copy()
    log[place] = value
    return log


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda log: log[log[:, 0] != 2], "run 2 is missing"),
        (lambda log: np.delete(log, STEPS + 3, 0), "run 1, step 4 is missing"),
        (lambda log: log[log[:, 1] < STEPS], f"step {STEPS} is missing"),
        (lambda log: np.vstack([log, [RUNS, *log[-1, 1:]]]), f"run {RUNS} is missing"),
        (lambda log: log - [0, 1, *[0] * 9], "step 8 is missing"),
        (lambda log: np.vstack([log, log[:1]]), "run 0, step 1 appears twice"),
        (lambda log: log[:, :-2], "9 columns"),
        (lambda log: log[:, :7], "run, step, x, z, rotation and their covariance"),
        (lambda log: changed(log, (7, 4), np.nan), "line 8"),
    ],
)
def test_a_bad_log_is_named(spoil, message, written, tmp_path):
    log = np.loadtxt(written / "logs" / "small.csv", delimiter=",")
    np.savetxt(tmp_path / "small.csv", spoil(log), delimiter=",")
    with pytest.raises(ValueError, match=rf"small\.csv.*{message}"):
        read_pose_log(tmp_path / "small.csv", RUNS, STEPS, NAMES)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("small.csv", "small.csv: the covariance of run 0, step 1 has vari"),
        ("log.txt", "has no log: expected small.csv"),
        ("circle.csv", "'circle'; known: small"),
    ],
)
def test_logs_that_are_not_of_the_suite_end_the_command_in_one_line(
    name, message, written, tmp_path, capsys
):
    log = np.loadtxt(written / "logs" / "small.csv", delimiter=",")
    (tmp_path / "logs").mkdir()
    np.savetxt(tmp_path / "logs" / name, changed(log, np.s_[:, 5], -1), delimiter=",")
    (tmp_path / "open").symlink_to(written / "open")
    words = command(tmp_path, "open")
    ended(message.split(":")[-1], words, tmp_path / "out", capsys)


def test_columns_are_those_of_the_truth_and_rows_in_any_order(written, tmp_path):
    log = np.loadtxt(written / "logs" / "small.csv", delimiter=",")
    plain = read_pose_log(written / "logs" / "small.csv", RUNS, STEPS, NAMES)

    def read(titles, rows):
        header = ",".join(["run", "step", *titles, *(f"p{i}" for i in range(6))])
        np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=header, comments="")
        return read_pose_log(tmp_path / "log.csv", RUNS, STEPS, NAMES)

    for x, y in zip(read(NAMES, log[::-1]), plain, strict=True):
        np.testing.assert_array_equal(x, y)
    with pytest.raises(ValueError, match="run, step, x, z, rotation and their"):
        read(("z", "x", "rotation"), log)


def test_a_suite_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    """An interruption leaves nothing; a folder that is there stays as it is."""
    whole = np.savetxt

    def interrupted(path, *args, **options):
        whole(path, *args, **options)
        if Path(path).name == "truth.csv":
            raise KeyboardInterrupt

    monkeypatch.setattr(suite_module.np, "savetxt", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_suite(tmp_path / "suite", [SMALL], runs=RUNS)
    assert not list(tmp_path.iterdir())
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "mine.csv").touch()
    with pytest.raises(ValueError, match="already exists; name a new folder"):
        write_suite(tmp_path / "suite", [SMALL], runs=RUNS)
    assert [path.name for path in (tmp_path / "suite").iterdir()] == ["mine.csv"]


def test_a_pose_in_space_is_a_rotation_vector(tmp_path):
    scenario = jaxslam.scenario("matched-6dof", steps=3, landmarks=4)
    write_suite(tmp_path / "suite", [scenario], runs=4)
    axes = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
    log, nees = log_of(tmp_path / "suite" / "matched-6dof")
    np.savetxt(tmp_path / "log.csv", log, delimiter=",")
    truth = read_suite(tmp_path / "suite", ["matched-6dof"])["matched-6dof"].tables["truth.csv"]
    assert tuple(truth[0][3:]) == axes
    poses, P = read_pose_log(tmp_path / "log.csv", 4, 3, axes)
    found = jaxslam.evaluate_poses(poses, P, truth[1].reshape(4, 4, -1)[:, 1:, 3:])
    np.testing.assert_allclose(found.nees, nees.reshape(4, 3), rtol=1e-9)


def test_controls_are_the_motion_with_its_noise(tmp_path):
    scenario = jaxslam.scenario("room", steps=20)
    write_suite(tmp_path / "suite", [scenario], runs=10)
    controls, truth = (
        np.array(table(tmp_path / "suite" / "room" / f"{name}.csv").tolist())
        for name in ("controls", "truth")
    )
    assert len(controls) == 200
    T = poses_of(truth[:, 3:]).reshape(10, 21, 4, 4)
    moved = (np.linalg.inv(T[:, :-1]) @ T[:, 1:]).reshape(-1, 4, 4)
    turned = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()
    off = np.hstack([moved[:, :3, 3], turned]) - controls[:, 2:]
    normalised = off / np.array(scenario.odometry_sigma)
    assert np.std(normalised) == pytest.approx(1, abs=4 / np.sqrt(2 * 1200))
    assert abs(np.mean(normalised)) < 4 / np.sqrt(1200)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"placement": "rays", "depth_range": (1.0, 6.0)},
            "share slots, .* a placement other than rays",
        ),
        ({"in_view": 9}, "its landmarks share slots, .* --suite needs in_view=0"),
        ({"sensor": "position", "calibration": "known"}, "has a Position sensor; --suite supports"),
    ],
)
def test_a_scenario_that_no_suite_has_is_refused(changes, message, tmp_path):
    """Landmarks need a number of their own, and measurements are pixels."""
    with pytest.raises(ValueError, match=f"^small:? .*{message}"):
        write_suite(tmp_path / "suite", [jaxslam.scenario(SMALL, **changes)], runs=1)
    with pytest.raises(ValueError, match="a suite needs at least one scenario; by default it has"):
        write_suite(tmp_path / "suite", [], runs=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("told", [[1], {"scenario": {}, "runs": 3}])
def test_a_file_that_tells_no_scenario_of_a_suite_is_named(told, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "scenario.json").write_text(json.dumps(told))
    with pytest.raises(ValueError, match=r"mine.scenario\.json.*no scenario of a suite, with its"):
        read_suite(tmp_path, ["mine"])
