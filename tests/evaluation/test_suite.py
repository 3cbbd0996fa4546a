"""The suite: plain files that any filter can read, its logs, and the filters here beside them."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3

import jaxslam
from jaxslam.cli import main
from jaxslam.consistency import read_suite, write_suite
from jaxslam.consistency import suite as suite_module
from jaxslam.evaluation import read_pose_log

RUNS, STEPS = 6, 8
SMALL = jaxslam.scenario("matched", {"name": "small"}, steps=STEPS, landmarks=5)
ROBOCENTRIC = "robocentric/inverse_scaling"


def table(path):
    return np.genfromtxt(path, delimiter=",", names=True)


def filter_of(told):
    """The paper's filter, of the numbers in `scenario.json` alone."""
    s = told["scenario"]
    return jaxslam.make_filter(
        "robocentric",
        landmark="inverse_scaling",
        motion=jaxslam.ConstantVelocity(
            *(tuple(s[name]) for name in ("acceleration_sigma", "velocity", "velocity_sigma"))
        ),
        sensor=jaxslam.Pinhole(
            jaxslam.Camera(tuple(s["focal"]), tuple(s["centre"])), s["pixel_sigma"]
        ),
        calibration=jaxslam.Known(),
        depth=jaxslam.InverseDepth(**told["depth_prior"]),
    )


def frames_of(rows, told, count):
    """The features of a run's rows: of frame 0, and known ones of every later frame."""
    steps = told["scenario"]["steps"]
    pixels, valid = np.zeros((steps + 1, count, 1)), np.zeros((steps + 1, count), bool)
    at = rows["step"].astype(int), rows["landmark"].astype(int)
    pixels[at], valid[at] = rows["u"][:, None], True
    assert not (valid & ~valid[0]).any()  # all are seen in frame 0
    slots = np.tile(np.arange(count), (steps + 1, 1))
    first = jaxslam.Features(slots[0], pixels[0], valid[0])
    seconds = jnp.full(steps, 1 / told["scenario"]["rate"])
    seen, none = (jaxslam.Features(slots[1:], pixels[1:], x[1:]) for x in (valid, 0 * valid > 0))
    return first, jaxslam.Frames(seconds, seen, none)


def log_of(folder):
    """The log that the paper's filter makes of the files in the folder of a scenario."""
    told = json.loads((folder / "scenario.json").read_text())
    slam, measured = filter_of(told), table(folder / "measurements.csv")
    count = int(measured["landmark"].max()) + 1
    runs = [frames_of(measured[measured["run"] == i], told, count) for i in range(told["runs"])]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *runs)
    through = jax.vmap(lambda first, frames: jaxslam.run(slam, frames, slam.init(count, first))[1])
    found = jax.jit(through)(*batch)
    place = np.indices(found.nis.shape) + np.array([0, 1])[:, None, None]
    pose = found.pose.translation(), found.pose.rotation().log()
    P = found.covariance[..., *np.triu_indices(3)]
    return np.dstack([*place, *pose, P]).reshape(-1, 11)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A suite with the truth, one without, and the log of our filter on their measurements."""
    place = tmp_path_factory.mktemp("suite")
    write_suite(place / "open", [SMALL], runs=RUNS, seed=3)
    write_suite(place / "hidden", [SMALL], runs=RUNS, seed=3, truth=False)
    (place / "logs").mkdir()
    np.savetxt(place / "logs" / "small.csv", log_of(place / "open" / "small"), delimiter=",")
    return place


def judged(place, suite, out, *more):
    """What the command writes of the logs."""
    command = ["evaluate", str(place / "logs"), "--suite", str(place / suite), "--out", str(out)]
    main([*command, "--filters", "robocentric", *more])
    return json.loads((out / "suite.json").read_text())["scenarios"]["small"]


@pytest.mark.slow
def test_a_filter_that_reads_the_files_has_the_numbers_of_its_study(written, tmp_path, capsys):
    found = judged(written, "open", tmp_path)
    yours, ours = found["yours"], found[ROBOCENTRIC]
    filters = jaxslam.make_filters(SMALL, "robocentric", "inverse_scaling")
    study = jaxslam.monte_carlo(SMALL, filters, runs=RUNS, seed=3).summary()["filters"]
    np.testing.assert_allclose(ours["nees"], study[ROBOCENTRIC]["nees"], rtol=1e-9)
    np.testing.assert_allclose(yours["nees"], ours["nees"], rtol=1e-6)
    for name in ("nees", "sigma_factor", "p", "lost"):
        np.testing.assert_allclose(yours["verdict"][name], ours["verdict"][name], rtol=1e-6)
    assert yours["verdict"]["word"] == ours["verdict"]["word"]
    assert yours["band95"] == ours["band95"]
    np.testing.assert_allclose(yours["rmse"]["position"], ours["rmse"]["position"], rtol=1e-6)
    lines = capsys.readouterr().out.splitlines()
    own, of_filter = (next(x for x in lines if x.startswith(name)) for name in ("yours ", "robo"))
    assert own.split()[1:] == of_filter.split()[1:]
    assert float(own.split()[1]) == pytest.approx(ours["nees"][-1] / 3, rel=5e-3)
    assert f"yours: NEES {yours['verdict']['nees']:.2f}" in "\n".join(lines)


def test_what_was_run_is_kept(written, tmp_path):
    judged(written, "open", tmp_path)
    (kept,) = tmp_path.glob("small/runs/*/*.npz")
    before = kept.stat().st_mtime_ns
    judged(written, "open", tmp_path)
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
        with pytest.raises(SystemExit) as stop:
            judged(written, "hidden", tmp_path, *more)
        assert stop.value.code == 2
        assert message in capsys.readouterr().err


def changed(log, place, value):
    log = log.copy()
    log[place] = value
    return log


NAMES = ("x", "z", "rotation")


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


def test_a_bad_log_ends_the_command_in_one_line(written, tmp_path, capsys):
    log = np.loadtxt(written / "logs" / "small.csv", delimiter=",")
    (tmp_path / "logs").mkdir()
    np.savetxt(tmp_path / "logs" / "small.csv", changed(log, np.s_[:, 5], -1), delimiter=",")
    (tmp_path / "open").symlink_to(written / "open")
    with pytest.raises(SystemExit) as stop:
        judged(tmp_path, "open", tmp_path / "out")
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "small.csv" in line
    assert "run 0, step 1 has vari" in line
    assert not (tmp_path / "out").exists()


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


@pytest.mark.parametrize(
    ("name", "message"),
    [("log.txt", "has no log: expected small.csv"), ("circle.csv", "'circle'; known: small")],
)
def test_logs_are_of_scenarios_of_the_suite(name, message, written, tmp_path, capsys):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / name).touch()
    (tmp_path / "open").symlink_to(written / "open")
    with pytest.raises(SystemExit):
        judged(tmp_path, "open", tmp_path)
    assert message in capsys.readouterr().err


def test_a_suite_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    """An interruption leaves nothing; a folder that is there stays as it is."""
    whole = np.savetxt

    def interrupted(path, *args, **options):
        whole(path, *args, **options)
        if Path(path).name == "truth.csv":
            raise KeyboardInterrupt

    monkeypatch.setattr(suite_module.np, "savetxt", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_suite(tmp_path / "suite", [SMALL], runs=2)
    assert not list(tmp_path.iterdir())
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "mine.csv").touch()
    with pytest.raises(ValueError, match="already exists; name a new folder"):
        write_suite(tmp_path / "suite", [SMALL], runs=2)
    assert [path.name for path in (tmp_path / "suite").iterdir()] == ["mine.csv"]


def test_a_pose_in_space_is_a_rotation_vector(tmp_path):
    """The truth, displaced by errors that are drawn: NEES is theirs."""
    scenario = jaxslam.scenario("matched-6dof", steps=3, landmarks=4)
    write_suite(tmp_path / "suite", [scenario], runs=4)
    truth = table(tmp_path / "suite" / "matched-6dof" / "truth.csv")
    axes = truth.dtype.names[3:]
    assert axes == ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
    rows = np.array(truth[truth["step"] > 0].tolist())
    errors = 0.1 * np.random.default_rng(0).normal(size=(len(rows), 6))
    log = []
    for row, error in zip(rows, errors, strict=True):
        turn = SO3.exp(row[6:])
        true = SE3.from_rotation_and_translation(turn, row[3:6])
        estimate = true @ SE3.exp(error).inverse()
        pose = np.concatenate([estimate.translation(), estimate.rotation().log()])
        log.append([*row[:2], *pose, *(0.01 * np.eye(6)).ravel()])
    (tmp_path / "logs").mkdir()
    np.savetxt(tmp_path / "logs" / "matched-6dof.csv", log, delimiter=",")
    one = read_suite(tmp_path / "suite", ["matched-6dof"])["matched-6dof"]
    poses, P = read_pose_log(tmp_path / "logs" / "matched-6dof.csv", 4, 3, axes)
    truths = one.tables["truth.csv"][1].reshape(4, 4, -1)[:, 1:, 3:]
    found = jaxslam.evaluate_poses(poses, P, truths)
    expected = (100 * np.sum(errors**2, axis=1)).reshape(4, 3)
    np.testing.assert_allclose(found.nees, expected, rtol=1e-9)


def test_controls_are_the_motion_with_its_noise(tmp_path):
    scenario = jaxslam.scenario("room", steps=20)
    write_suite(tmp_path / "suite", [scenario], runs=10)
    controls = table(tmp_path / "suite" / "room" / "controls.csv")
    truth = table(tmp_path / "suite" / "room" / "truth.csv")
    assert len(controls) == 200
    truth = np.array(truth.tolist()).reshape(10, 21, -1)[..., 3:]
    read = np.array(controls.tolist()).reshape(10, 20, -1)[..., 2:]

    def motion(before, after):
        before, after = (
            SE3.from_rotation_and_translation(SO3.exp(x[3:]), x[:3]) for x in (before, after)
        )
        step = before.inverse() @ after
        return jnp.concatenate([step.translation(), step.rotation().log()])

    steps = jax.vmap(jax.vmap(motion))(truth[:, :-1], truth[:, 1:])
    normalised = (steps - read) / np.array(scenario.odometry_sigma)
    assert np.std(normalised) == pytest.approx(1, abs=4 / np.sqrt(2 * 1200))
    assert abs(np.mean(normalised)) < 4 / np.sqrt(1200)


def test_the_measurements_are_the_projections_of_fixed_points(tmp_path):
    """With the equations of the README: of two views of a landmark follows the third."""
    scenario = jaxslam.scenario("matched", steps=60, landmarks=8, pixel_sigma=1e-6)
    write_suite(tmp_path / "suite", [scenario], runs=2)
    pixels = table(tmp_path / "suite" / "matched" / "measurements.csv")
    truth = np.array(table(tmp_path / "suite" / "matched" / "truth.csv").tolist())
    truth = truth.reshape(2, 61, -1)[..., 3:]
    f, c = scenario.focal[0], scenario.centre[0]
    checked = 0
    for run in range(2):
        for landmark in range(8):
            rows = pixels[(pixels["run"] == run) & (pixels["landmark"] == landmark)]
            x, z, turn = truth[run, rows["step"].astype(int)].T
            # u = f px/pz + c, p = Rᵀ (X − t), is linear in X.
            b = (rows["u"] - c) / f
            row = np.stack([np.cos(turn) + b * np.sin(turn), np.sin(turn) - b * np.cos(turn)], 1)
            side = row[:, 0] * x + row[:, 1] * z
            point, *_ = np.linalg.lstsq(row, side, rcond=None)
            np.testing.assert_allclose(row @ point, side, atol=1e-5)
            checked += len(rows)
    assert checked > 200


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"placement": "rays", "depth_range": (1.0, 6.0)},
            "share slots, .* a placement other than rays",
        ),
        ({"in_view": 9}, "its landmarks share slots, .* --suite needs in_view=0"),
        (
            {"sensor": "position", "calibration": "known"},
            "has a Position sensor; --suite supports cameras only",
        ),
    ],
)
def test_a_scenario_that_no_suite_has_is_refused(changes, message, tmp_path):
    """Landmarks need a number of their own, and measurements are pixels."""
    with pytest.raises(ValueError, match=f"^small:? .*{message}"):
        write_suite(tmp_path / "suite", [jaxslam.scenario(SMALL, **changes)], runs=1)


def test_a_suite_has_a_scenario(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--suite", str(tmp_path / "suite"), "--scenario"])
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "jaxslam: a suite needs at least one scenario; by default it has matched"
    )
    assert not list(tmp_path.iterdir())


def test_runs_are_drawn_once(written, tmp_path, monkeypatch):
    """Those that the log is compared with are those that were compared with the suite's."""
    drawn = []

    def counted(scenario, runs, *, seed):
        drawn.append(scenario.name)
        return draw(scenario, runs, seed=seed)

    draw = suite_module.draw
    monkeypatch.setattr(suite_module, "draw", counted)
    judged(written, "open", tmp_path)
    assert drawn == ["small"]


@pytest.mark.parametrize("told", [[1], {"scenario": {}, "runs": 3}])
def test_a_file_that_tells_no_scenario_of_a_suite_is_named(told, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "scenario.json").write_text(json.dumps(told))
    with pytest.raises(ValueError, match=r"mine.scenario\.json.*no scenario of a suite, with its"):
        read_suite(tmp_path, ["mine"])
