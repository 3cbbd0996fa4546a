"""Tests of recorded trajectories as truths: smoothed, without gaps, from starts drawn at random."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FALSE_ALARM, quick_jit, simulated
from recordings import path_at, write
from scipy import stats
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.io.tum import poses
from jaxslam.simulation import RecordedMotion, scenario, simulate, trajectory_of
from jaxslam.simulation.trajectories import GAP, find, sampled


def with_a_gap(rate=50.0):
    """Times of 4 s, a gap, and 3 s more."""
    return np.concatenate([np.arange(0, 4, 1 / rate), np.arange(4 + 3 * GAP, 8, 1 / rate)])


def matrices(trajectory):
    return poses(trajectory.poses[:, 4:], np.roll(trajectory.poses[:, :4], -1, axis=1))


def test_a_path_is_sampled_at_the_rate_and_not_across_its_gap(tmp_path):
    times = with_a_gap()
    found = sampled(write(tmp_path / "a.txt", times), 30.0, 45)
    first = np.arange(int(times[times < 4].max() * 30) + 1) / 30
    second = 4 + 3 * GAP + np.arange(len(found.poses) - first.size) / 30
    assert second[-1] <= times[-1] < second[-1] + 1 / 30
    position, turn = path_at(np.concatenate([first, second]))
    T = matrices(found)
    angle = (Rotation.from_matrix(T[:, :3, :3]).inv() * turn).magnitude()
    # A spline that smooths bends less than its data at the ends of its pieces, and only there.
    np.testing.assert_allclose(T[:, :3, 3], position, rtol=0, atol=5e-4)
    assert angle.max() < 5e-4
    inner = np.concatenate([np.arange(8, first.size - 8), np.arange(first.size + 8, len(T) - 8)])
    np.testing.assert_allclose(T[inner, :3, 3], position[inner], rtol=0, atol=1e-5)
    assert angle[inner].max() < 1e-5
    # A run of 45 steps starts where 45 poses follow in the same piece.
    ends = np.repeat([first.size, len(T)], [first.size, second.size])
    np.testing.assert_array_equal(found.starts, np.flatnonzero(np.arange(len(T)) + 45 < ends))


def test_a_run_is_relative_to_its_first_camera_and_starts_anywhere(tmp_path):
    found = sampled(write(tmp_path / "a.txt", with_a_gap()), 30.0, 45)
    keys = jax.random.split(jax.random.key(0), 300)
    runs = np.asarray(quick_jit(jax.vmap(lambda key: found.run(key).as_matrix()))(keys))
    np.testing.assert_allclose(runs[:, 0], np.broadcast_to(np.eye(4), (300, 4, 4)), atol=1e-12)
    T = matrices(found)
    expected = np.stack([np.linalg.inv(T[i]) @ T[i : i + 46] for i in found.starts])
    distance = np.abs(runs[:, None] - expected).max(axis=(2, 3, 4))
    assert distance.min(axis=1).max() < 1e-9
    drawn = distance.argmin(axis=1)
    counts = np.bincount(drawn * 6 // found.starts.size, minlength=6)
    assert stats.chisquare(counts).pvalue > FALSE_ALARM


def test_what_trembles_goes_and_what_moves_stays(tmp_path):
    times = np.arange(0, 8, 0.01)
    found = sampled(write(tmp_path / "a.txt", times, jitter=1e-3), 30.0, 45)
    error = matrices(found)[:, :3, 3] - path_at(np.arange(len(found.poses)) / 30)[0]
    # A millimetre of 100 poses a second, of which what is below the cutoff of 6 Hz stays.
    assert np.sqrt(np.mean(error**2)) < 1.2e-3 * np.sqrt(6 / 50)


def test_signs_of_quaternions_and_repeated_times_do_not_matter(tmp_path):
    times = with_a_gap()
    plain = sampled(write(tmp_path / "a.txt", times), 30.0, 45)
    flipped = sampled(write(tmp_path / "b.txt", times, flip=True), 30.0, 45)
    repeated = sampled(write(tmp_path / "c.txt", np.repeat(times, 2)), 30.0, 45)
    for other in (flipped, repeated):
        np.testing.assert_allclose(matrices(other), matrices(plain), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(other.starts, plain.starts)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A data folder with one trajectory."""
    (tmp_path / "trajectories").mkdir()
    write(tmp_path / "trajectories" / "walk.txt", with_a_gap())
    monkeypatch.setenv("JAXSLAM_DATA", str(tmp_path))
    return tmp_path / "trajectories" / "walk.txt"


def test_no_folder_of_data_is_looked_into_unless_it_is_said(data, tmp_path, monkeypatch):
    for name in ("clone", "shared"):
        (tmp_path / name).mkdir()
    (tmp_path / "shared" / "data").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path / "clone")
    scenario("handheld-walk", steps=5)
    monkeypatch.delenv("JAXSLAM_DATA")
    with pytest.raises(ValueError, match="JAXSLAM_DATA, a folder of data, is not set"):
        scenario("handheld-walk", steps=5)


def test_a_scenario_is_named_after_its_trajectory(data, tmp_path):
    chosen = scenario("handheld-walk", steps=30)
    assert chosen == scenario("handheld", name="handheld-walk", trajectory="walk", steps=30)
    by_file = scenario("handheld", trajectory=str(data), steps=30)
    for other in (chosen, by_file):
        found = trajectory_of(other)
        assert found is not None
        np.testing.assert_array_equal(found.poses, sampled(data, 30.0, 30).poses)
    (tmp_path / "mine.toml").write_text('base = "handheld-walk"\nlandmarks = 7\n')
    assert scenario(tmp_path / "mine.toml").trajectory == "walk"
    assert trajectory_of(scenario("matched")) is None


def test_a_car_sees_far(data):
    data.rename(data.with_name("kitti_00.txt"))
    car = scenario("handheld-kitti_00")
    assert (car.depth_range, car.nearest_depth) == ((5.0, 50.0), 5.0)
    assert car.velocity_sigma[0] == 10


@pytest.mark.usefixtures("data")
def test_the_truth_moves_along_it_and_the_filter_is_told_the_seconds_only():
    chosen = scenario("handheld-walk", steps=20, landmarks=4)
    keys = jax.vmap(jax.random.key)(jnp.array([2, 3]))
    both = quick_jit(jax.vmap(partial(simulate, chosen)))(keys)
    run = jax.tree.map(lambda x: x[0], both)
    np.testing.assert_allclose(run.controls, np.full(20, 1 / 30), rtol=1e-12)
    T = np.asarray(run.poses.as_matrix())
    speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) * 30
    assert (speed > 0.1).all()
    assert (speed < 2.0).all()
    waiting = simulated(scenario(chosen, still_frames=5), 2).poses.as_matrix()
    np.testing.assert_array_equal(waiting[:6], np.broadcast_to(np.eye(4), (6, 4, 4)))
    assert np.linalg.norm(waiting[6, :3, 3]) > 0.1 / 30
    # Others start elsewhere.
    assert np.abs(both.poses.as_matrix()[1] - T).max() > 1e-3


@pytest.mark.slow
@pytest.mark.usefixtures("data")
def test_a_study_may_go_along_a_trajectory_of_ones_own(tmp_path):
    """The way of a motion through a study."""
    own = sampled(write(tmp_path / "own.txt", np.arange(0, 3, 0.02)), 30.0, 4)
    chosen = scenario("handheld-walk", steps=4, landmarks=6)
    filters = jaxslam.make_filters(chosen, ["robocentric"], ["inverse_scaling"])
    (name,) = filters
    paths = []
    for motion in (own, None):
        study = jaxslam.monte_carlo(chosen, filters, runs=1, motion=motion)
        paths.append(study.store.load(name, study.chunks[0])["sample_true_path"])
    assert np.abs(paths[0] - paths[1]).max() > 1e-4
    with pytest.raises(ValueError, match="a trajectory for 4 steps, not 5"):
        simulate(scenario(chosen, steps=5), jax.random.key(0), motion=own)


def test_what_is_no_trajectory_is_refused(data, tmp_path):
    assert find(str(data)) == data
    short, other = tmp_path / "short.txt", tmp_path / "other.txt"
    short.write_text("0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n")
    other.write_text("1 2 3\n")
    long = scenario("handheld-walk", steps=300)
    for call, message in (
        (lambda: scenario("handheld-wakl"), r"no trajectory 'wakl' \(did you mean walk\?\)"),
        (lambda: trajectory_of(long), "has no 10 s without a gap: its longest piece has 4"),
        (lambda: sampled(short, 30.0, 1), "its longest piece has 0"),
        (lambda: sampled(other, 30.0, 1), "eight finite numbers"),
        (lambda: scenario("matched", trajectory="walk"), "trajectory is for a spatial world"),
        (lambda: scenario("room", trajectory="walk"), "trajectory: odometry has the nominal mot"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert isinstance(trajectory_of(scenario("handheld-walk", steps=5)), RecordedMotion)


@pytest.mark.slow
def test_every_trajectory_of_the_shared_data_is_one(shared_data, monkeypatch):
    """Gaps and rates of recordings that no made-up path has."""
    monkeypatch.setenv("JAXSLAM_DATA", str(shared_data))
    names = [path.stem for path in sorted((shared_data / "trajectories").glob("*.txt"))]
    for name in set(names) - {"kitti_00_kitti_format"}:
        found = trajectory_of(scenario(f"handheld-{name}"))
        assert found is not None
        assert found.starts.size > 500
        norms = np.linalg.norm(found.poses[:, :4], axis=1)
        np.testing.assert_allclose(norms, 1, rtol=1e-9)
        position = np.asarray(found.poses)[:, 4:]
        steps = np.linalg.norm(position[found.starts + 1] - position[found.starts], axis=1)
        assert steps.max() * 30 < (20 if name == "kitti_00" else 5)
