"""Trajectories as text, and the errors of one where their values are known."""

from contextlib import suppress

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam._runtime.files import write_atomically
from jaxslam.io.tum import poses, read_tum, write_tum
from jaxslam.tracking.trajectory import (
    absolute_trajectory_error,
    orientation_error,
    relative_pose_error,
)

STILL = [0, 0, 0, 1]
"""A quaternion without a turn."""


def wave(n=60):
    """Times and poses of a smooth path with turning camera."""
    times = np.arange(n) / 30
    position = np.stack([np.sin(times), 0.3 * np.cos(2 * times), times**2], axis=1)
    turn = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 1, (n, 3)))
    return times, poses(position, turn.as_quat())


def similar(T_wc, scale=0.2):
    """The same trajectory in another world frame and another unit."""
    rotation = Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix()
    moved = T_wc.copy()
    moved[:, :3, 3] = scale * T_wc[:, :3, 3] @ rotation.T + [1.0, 2.0, 3.0]
    moved[:, :3, :3] = rotation @ T_wc[:, :3, :3]
    return moved


# --- files ----------------------------------------------------------------------------------------


def test_written_poses_are_read_back(tmp_path):
    times, T_wc = wave()
    write_tum(tmp_path / "t.txt", times, T_wc)
    read_times, read = read_tum(tmp_path / "t.txt")
    # Nine decimals of times and positions; of quaternions, which a matrix takes twice.
    np.testing.assert_allclose(read_times, times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(read, T_wc, rtol=0, atol=1e-8)
    quaternions = np.loadtxt(tmp_path / "t.txt")[:, 4:]
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, rtol=0, atol=1e-8)
    assert np.all(quaternions[:, 3] >= 0)
    # Of others w is last too, and they need not be normalised.
    (tmp_path / "t.txt").write_text("# comment\n\n0.5 1 2 3 0 0 2 2\n")
    times, T_wc = read_tum(tmp_path / "t.txt")
    assert times.tolist() == [0.5]
    quarter_turn = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(T_wc[0], quarter_turn, atol=1e-12)


def test_interrupted_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("old")
    with suppress(KeyboardInterrupt), write_atomically(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# --- errors ---------------------------------------------------------------------------------------


def test_a_world_behind_the_camera_or_of_anything_has_another_sign():
    """(t, v, ω) → −(t, v, ω) leaves every pixel, and here a curve in a plane that aligns."""
    times, reference = wave()
    reference[:, 2, 3] = 0
    estimate = reference.copy()
    estimate[:, :3, 3] *= -0.3
    result = absolute_trajectory_error(times, estimate, times, reference)
    assert result["rmse"] == pytest.approx(0, abs=1e-9)
    assert result["sign"] == pytest.approx(-1, abs=1e-9)
    times, reference = wave(4000)
    estimate = reference.copy()
    estimate[:, :3, 3] = np.random.default_rng(3).normal(size=(4000, 3))
    sign = absolute_trajectory_error(times, estimate, times, reference)["sign"]
    # A correlation of n independent points has σ of at most 1/√n.
    assert abs(sign) < 4 / np.sqrt(4000)


def test_orientation_error_is_the_angle_that_one_rotation_leaves():
    times, reference = wave(40)
    turn = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix()

    def error(estimate, truth):
        estimate[::2, :3, :3] = estimate[::2, :3, :3] @ turn
        estimate[1::2, :3, :3] = estimate[1::2, :3, :3] @ turn.T
        found = absolute_trajectory_error(times, estimate, times, truth)["orientation_rmse"]
        assert found == orientation_error(times, estimate, times, truth)
        return found

    # The axes differ from pose to pose, so that no rotation takes away more than a part.
    assert 4.5 < error(similar(reference), reference) <= 5
    same = reference.copy()
    same[:, :3, :3] = np.eye(3)
    assert error(same.copy(), same) == pytest.approx(5, abs=1e-6)
    # Also of a camera that only turns.
    reference[:, :3, 3] = 0
    with pytest.raises(ValueError, match="coincide"):
        error(reference.copy(), reference)
    assert orientation_error(times, similar(reference), times, reference) < 1e-5


def test_errors_are_those_of_evo():
    """Poses of unlike times, some of them without a partner, in another world and unit."""
    metrics, sync = pytest.importorskip("evo.core.metrics"), pytest.importorskip("evo.core.sync")
    trajectory = pytest.importorskip("evo.core.trajectory")
    rng = np.random.default_rng(5)
    times, reference = wave(90)
    estimate = similar(reference)
    estimate[:, :3, 3] += rng.normal(0, 0.02, (90, 3))
    turn = Rotation.from_rotvec(rng.normal(0, 0.05, (90, 3))).as_matrix()
    estimate[:, :3, :3] = estimate[:, :3, :3] @ turn
    kept = rng.permutation(90)[:60]
    ours = np.sort(times[kept] + rng.uniform(-0.02, 0.02, 60)), estimate[np.sort(kept)]

    def evos(times, T):
        return trajectory.PoseTrajectory3D(poses_se3=list(T), timestamps=times)

    theirs = sync.associate_trajectories(evos(times, reference), evos(*ours), max_diff=0.01)
    true, moved = theirs
    moved.align(true, correct_scale=True)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data(theirs)
    found = absolute_trajectory_error(*ours, times, reference)
    assert 20 < found["matched"] == moved.num_poses < 60
    assert found["rmse"] == pytest.approx(ate.get_statistic(metrics.StatisticsType.rmse), rel=1e-12)
    assert found["path_length"] == pytest.approx(true.path_length, rel=1e-12)
    extent = np.linalg.norm(np.ptp(true.positions_xyz, axis=0))
    assert found["extent"] == pytest.approx(extent, rel=1e-12)
    apart = round(0.5 / np.median(np.diff(true.timestamps)))
    found = relative_pose_error(*ours, times, reference, seconds=0.5)
    poses_of = np.array(true.poses_se3)
    way = (np.linalg.inv(poses_of[:-apart]) @ poses_of[apart:])[:, :3, 3]
    assert found["way"] == pytest.approx(np.sqrt(np.mean(np.sum(way**2, axis=1))), rel=1e-9)
    for name, relation in (
        ("translation", metrics.PoseRelation.translation_part),
        ("rotation", metrics.PoseRelation.rotation_angle_deg),
    ):
        rpe = metrics.RPE(relation, apart, metrics.Unit.frames, all_pairs=True)
        rpe.process_data(theirs)
        rmse = rpe.get_statistic(metrics.StatisticsType.rmse)
        assert found[name] == pytest.approx(rmse, rel=1e-9)


def test_straight_line_is_the_error_of_one_at_constant_speed():
    times = np.array([0.0, 1.0, 2.0, 3.5, 4.0, 6.0])
    line = poses(np.outer(times, [1.0, 2.0, -0.5]) + 3, np.tile(STILL, (6, 1)))
    curved, slowing = line.copy(), line.copy()
    curved[:, :3, 3] += np.outer(np.sin(times), [0.0, 0.3, 0.0])
    slowing[:, :3, 3] = np.outer(times**2, [1.0, 2.0, -0.5])
    of_line, of_curve, of_slowing = (
        absolute_trajectory_error(times, line, times, truth) for truth in (line, curved, slowing)
    )
    assert of_line["straight_line"] == pytest.approx(0, abs=1e-12)
    # What is left of a sine after the fit of a + b t to it.
    rest = np.sin(times) - np.polyval(np.polyfit(times, np.sin(times), 1), times)
    expected = 0.3 * np.sqrt(np.mean(rest**2))
    assert of_curve["straight_line"] == pytest.approx(expected, abs=1e-12)
    # The line itself, as an estimate, has this error or (by scale and turn) a little less.
    assert of_curve["rmse"] == pytest.approx(expected, rel=0.02)
    # The same places at another speed are not a line at constant speed.
    assert of_slowing["straight_line"] > 1
