"""Trajectories as text, and the absolute trajectory error where its value is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam._runtime.files import write_atomically
from jaxslam.evaluation import errors_beyond_scale, pose_errors, read_covariances
from jaxslam.evaluation.inputs import exactly_known
from jaxslam.io.tum import poses, read_tum, write_tum
from jaxslam.statistics.beyond_scale import one_scale
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked, trajectory_text
from jaxslam.tracking.trajectory import (
    TRACKED,
    absolute_trajectory_error,
    alignment,
    orientation_error,
    relative_pose_error,
    write_covariances,
)


def wave(n=60, seed=0):
    """Times and poses of a smooth path with turning camera."""
    times = np.arange(n) / 30
    position = np.stack([np.sin(times), 0.3 * np.cos(2 * times), times**2], axis=1)
    turn = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 1, (n, 3)))
    return times, poses(position, turn.as_quat())


def pose_nees(T_wc, P, reference):
    """`eᵀ P⁻¹ e` of poses, e the error whose covariances are written."""
    e = pose_errors(TRACKED, T_wc, reference)
    return np.sum(e * np.linalg.solve(P, e[..., None])[..., 0], axis=-1)


def similar(T_wc, scale, rotvec, shift):
    """The same trajectory in another world frame and another unit."""
    rotation = Rotation.from_rotvec(rotvec).as_matrix()
    moved = T_wc.copy()
    moved[:, :3, 3] = scale * T_wc[:, :3, 3] @ rotation.T + shift
    moved[:, :3, :3] = rotation @ T_wc[:, :3, :3]
    return moved


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


def test_quaternion_order_is_w_last_and_need_not_be_normalised(tmp_path):
    (tmp_path / "t.txt").write_text("# comment\n\n0.5 1 2 3 0 0 2 2\n")
    times, T_wc = read_tum(tmp_path / "t.txt")
    assert times.tolist() == [0.5]
    quarter_turn = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(T_wc[0], quarter_turn, atol=1e-12)


def test_interrupted_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("old")

    def interrupted():
        with write_atomically(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_error_ignores_frame_and_scale_and_measures_the_reference():
    times, reference = wave()
    estimate = similar(reference, 0.2, [0.3, -0.5, 1.0], [1.0, 2.0, 3.0])
    result = absolute_trajectory_error(times + 0.004, estimate, times, reference)
    steps = np.diff(reference[:, :3, 3], axis=0)
    box = np.ptp(reference[:, :3, 3], axis=0)
    assert result["alignment"] == "sim3"
    assert result["rmse"] == pytest.approx(0, abs=1e-9)
    assert result["path_length"] == pytest.approx(np.linalg.norm(steps, axis=1).sum())
    # Orientations give the world's turn too: to the rounding of an arc cosine near 1, 1e-8 rad.
    assert result["sign"] == pytest.approx(1, abs=1e-9)
    assert result["orientation_rmse"] == pytest.approx(0, abs=1e-5)
    assert result["extent"] == pytest.approx(np.linalg.norm(box))
    assert result["matched"] == len(times)


@pytest.mark.parametrize("straight", [False, True])
def test_alignment_is_that_of_the_error_and_can_be_undone(straight):
    times, reference = wave()
    if straight:
        reference[:, :3, 3] = np.outer(times, [1.0, 2.0, -0.5])
    estimate = similar(reference, 0.2, [0.3, -0.5, 1.0], [1.0, 2.0, 3.0])
    estimate[:, :3, 3] += np.random.default_rng(2).normal(0, 0.01, (len(times), 3))
    found = alignment(times, estimate, times, reference)
    error = found.moved(estimate)[:, :3, 3] - reference[:, :3, 3]
    rmse = absolute_trajectory_error(times, estimate, times, reference)["rmse"]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(rmse, rel=1e-9)
    assert found.scale == pytest.approx(5, rel=0.02)
    # Rounding.
    np.testing.assert_allclose(
        found.inverse().moved(found.moved(estimate)), estimate, rtol=0, atol=1e-12
    )


def test_a_reversed_world_has_sign_minus_one_though_its_error_is_zero():
    """(t, v, ω) → −(t, v, ω) leaves every pixel, and here a curve in a plane that aligns."""
    times, reference = wave()
    reference[:, 2, 3] = 0
    estimate = reference.copy()
    estimate[:, :3, 3] *= -0.3
    result = absolute_trajectory_error(times, estimate, times, reference)
    assert result["rmse"] == pytest.approx(0, abs=1e-9)
    assert result["sign"] == pytest.approx(-1, abs=1e-9)
    assert result["orientation_rmse"] == pytest.approx(0, abs=1e-5)


def test_positions_that_have_nothing_to_do_with_the_truth_have_no_sign():
    times, reference = wave(4000)
    estimate = reference.copy()
    estimate[:, :3, 3] = np.random.default_rng(3).normal(size=(4000, 3))
    sign = absolute_trajectory_error(times, estimate, times, reference)["sign"]
    # A correlation of n independent points has σ of at most 1/√n.
    assert abs(sign) < 4 / np.sqrt(4000)


def test_orientation_error_is_the_angle_that_one_rotation_leaves():
    times, reference = wave(40)
    estimate = similar(reference, 1.0, [0.3, -0.5, 1.0], [0.0, 0.0, 0.0])
    turn = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix()
    estimate[::2, :3, :3] = estimate[::2, :3, :3] @ turn
    estimate[1::2, :3, :3] = estimate[1::2, :3, :3] @ turn.T
    result = absolute_trajectory_error(times, estimate, times, reference)
    # The axes differ from pose to pose, so that no rotation takes away more than a part.
    assert 4.5 < result["orientation_rmse"] <= 5
    same = reference.copy()
    same[:, :3, :3] = np.eye(3)
    turned = same.copy()
    turned[::2, :3, :3], turned[1::2, :3, :3] = turn, turn.T
    result = absolute_trajectory_error(times, turned, times, same)
    assert result["orientation_rmse"] == pytest.approx(5, abs=1e-6)


def test_a_camera_that_only_turns_has_an_orientation_error_too():
    times, reference = wave()
    reference[:, :3, 3] = 0
    turn = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix()
    estimate = reference.copy()
    estimate[::2, :3, :3] = reference[::2, :3, :3] @ turn
    estimate[1::2, :3, :3] = reference[1::2, :3, :3] @ turn.T
    with pytest.raises(ValueError, match="coincide"):
        absolute_trajectory_error(times, estimate, times, reference)
    assert 4.5 < orientation_error(times, estimate, times, reference) <= 5


def test_relative_error_is_that_of_a_second_in_the_references_unit():
    """A gyro's bias and a scale: what they do in a second, wherever the trajectory begins."""
    times, reference = wave(400)
    estimate = similar(reference, 0.2, [0.3, -0.5, 1.0], [1.0, 2.0, 3.0])
    assert relative_pose_error(times, estimate, times, reference)["translation"] < 1e-9
    apart = round(0.5 / np.median(np.diff(times)))
    drift = Rotation.from_rotvec(np.outer(times, np.radians([0, 0, 2.0]))).as_matrix()
    estimate[:, :3, :3] = drift @ reference[:, :3, :3]
    estimate[:, :3, 3] = reference[:, :3, 3]
    result = relative_pose_error(times, estimate, times, reference, seconds=0.5)
    lasts = times[apart] - times[0]
    assert result["rotation"] == pytest.approx(2.0 * lasts, rel=1e-6)
    moved = np.linalg.norm(reference[apart:, :3, 3] - reference[:-apart, :3, 3], axis=1)
    assert result["way"] == pytest.approx(np.sqrt(np.mean(moved**2)))
    estimate = reference.copy()
    estimate[::2, 0, 3] += 0.01  # half of them, against the other half
    error = relative_pose_error(times, estimate, times, reference, seconds=np.diff(times)[0])
    assert error["translation"] == pytest.approx(0.01, rel=1e-3)


def test_errors_are_those_of_evo():
    """Poses of unlike times, some of them without a partner, in another world and unit."""
    metrics, sync = pytest.importorskip("evo.core.metrics"), pytest.importorskip("evo.core.sync")
    trajectory = pytest.importorskip("evo.core.trajectory")
    rng = np.random.default_rng(5)
    times, reference = wave(90)
    estimate = similar(reference, 0.2, [0.3, -0.5, 1.0], [1.0, 2.0, 3.0])
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
    apart = round(0.5 / np.median(np.diff(true.timestamps)))
    found = relative_pose_error(*ours, times, reference, seconds=0.5)
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
    line = poses(np.outer(times, [1.0, 2.0, -0.5]) + 3, np.tile([0, 0, 0, 1], (6, 1)))
    curved = line.copy()
    curved[:, :3, 3] += np.outer(np.sin(times), [0.0, 0.3, 0.0])
    straight = absolute_trajectory_error(times, curved, times, line)["straight_line"]
    assert straight == pytest.approx(0, abs=1e-12)
    result = absolute_trajectory_error(times, line, times, curved)
    # What is left of a sine after the fit of a + b t to it.
    design = np.column_stack([np.ones(6), times])
    rest = np.sin(times) - design @ np.linalg.lstsq(design, np.sin(times), rcond=None)[0]
    assert result["straight_line"] == pytest.approx(0.3 * np.sqrt(np.mean(rest**2)), abs=1e-12)
    # The line itself, as an estimate, has this error or (by scale and turn) a little less.
    assert result["rmse"] == pytest.approx(result["straight_line"], rel=0.02)
    # The same places at another speed are not a line at constant speed.
    slowing = line.copy()
    slowing[:, :3, 3] = np.outer(times**2, [1.0, 2.0, -0.5])
    assert absolute_trajectory_error(times, line, times, slowing)["straight_line"] > 1


def test_straight_reference_is_aligned_though_its_roll_is_open():
    times = np.arange(50) / 25
    line = poses(np.outer(times, [1.0, 2.0, -0.5]), np.tile([0, 0, 0, 1], (50, 1)))
    estimate = similar(line, 3.0, [0.1, 0.7, -0.4], [5.0, 0.0, 1.0])
    perfect = absolute_trajectory_error(times, estimate, times, line)
    assert perfect["rmse"] == pytest.approx(0, abs=1e-9)
    # Zigzag across the line, which no alignment takes away.
    across = np.array([2.0, -1.0, 0.0]) / np.sqrt(5)
    estimate = line.copy()
    estimate[:, :3, 3] += np.outer(np.where(np.arange(50) % 2, 0.1, -0.1), across)
    bent = absolute_trajectory_error(times, estimate, times, line)
    assert bent["rmse"] == pytest.approx(0.1, rel=0.02)


def test_covariances_are_read_as_they_were_written_and_are_the_errors(tmp_path):
    """Errors drawn from them, in the camera's axes, have a mean NEES of 6."""
    rng = np.random.default_rng(0)
    n = 4000
    roots = rng.normal(0, 0.01, (n, 6, 6))
    times, T_wc = wave(n)
    write_covariances(tmp_path / "covariance.txt", times, roots @ np.swapaxes(roots, 1, 2))
    read_times, P, _ = read_covariances(tmp_path / "covariance.txt")
    np.testing.assert_allclose(read_times, times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(P, roots @ np.swapaxes(roots, 1, 2), rtol=1e-8, atol=1e-12)
    errors = np.einsum("nij,nj->ni", roots, rng.normal(size=(n, 6)))
    E = poses(errors[:, :3], Rotation.from_rotvec(errors[:, 3:]).as_quat())
    # The mean of n numbers of χ² with 6 degrees of freedom: σ = √(12/n) = 0.055.
    assert abs(pose_nees(T_wc, P, T_wc @ E).mean() - 6) < 0.22


@pytest.mark.parametrize(
    ("given", "words"),
    [(True, "the unit itself is uncertain by sigma_log_scale"), (False, "takes as exactly known")],
)
def test_the_header_says_whether_scale_is_in_a_covariance(tmp_path, given, words):
    path = tmp_path / "covariance.txt"
    write_covariances(path, [0.0], np.eye(6)[None], given_scale=given)
    header, _ = path.read_text().splitlines()
    assert header.startswith("# t xx xy")
    assert words in header
    assert "in the unit of each map" in header
    assert f"scale={'given' if given else 'marginal'}" in header
    assert "length=map" in header
    write_covariances(path, [0.0], np.eye(6)[None], given_scale=given, caveat="with care")
    assert path.read_text().splitlines()[0] == header.removesuffix(")") + "; with care)"
    assert read_covariances(path).said["scale"] == ("given" if given else "marginal")
    first = Tracked(0, 0.0, PoseWithCovariance())
    assert "in the unit of each map" in trajectory_text([first]).splitlines()[0]


def test_a_pose_that_is_known_exactly_is_so_in_the_file(tmp_path):
    """Every covariance file begins with one: the first camera is the world."""
    times, _ = wave(4)
    covariances = np.tile(1e-4 * np.eye(6), (4, 1, 1))
    covariances[0] = 0
    write_covariances(tmp_path / "covariance.txt", times, covariances)
    P = read_covariances(tmp_path / "covariance.txt").covariances
    assert exactly_known(P).tolist() == [True, False, False, False]


def nees_beyond_scale(T_wc, covariances, reference, fixed=None):
    """Of tracked poses: each at its own best scale, and all at the one of those that are fixed."""
    best = errors_beyond_scale(TRACKED, T_wc, reference, covariances)
    return one_scale(*best, fixed), np.exp(best.log_scale), np.asarray(best.sigma)


def test_beyond_scale_is_the_least_nees_over_the_one_scale_of_the_reference():
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(0.5 * rng.normal(size=(5, 3))).as_matrix()
    T[:, :3, 3] = rng.normal(size=(5, 3))
    root = 0.1 * rng.normal(size=(5, 6, 6)) + 0.05 * np.eye(6)
    P = root @ np.swapaxes(root, 1, 2)
    reference = T.copy()
    reference[:, :3, 3] = 3.0 * (T[:, :3, 3] + 0.05 * rng.normal(size=(5, 3)))
    found, scale, sigma = nees_beyond_scale(T, P, reference)

    def at(s):
        scaled = reference.copy()
        scaled[:, :3, 3] *= np.reshape(s, (-1, 1))
        return pose_nees(T, P, scaled)

    # Every pose at the map's scale; what the drift adds to its own best.
    own, one = at(scale), (scale * np.exp(-found.drift))[0]
    np.testing.assert_allclose(found.nees, at(one), rtol=1e-9)
    assert own.sum() < found.nees.sum() < min(at(1.01 * one).sum(), at(0.99 * one).sum())
    assert np.all(own <= np.minimum(at(1.01 * scale), at(0.99 * scale)))
    step = scale * np.expm1(found.drift) / np.exp(found.drift)
    np.testing.assert_allclose(
        found.nees - own, (step / (scale * sigma)) ** 2, rtol=1e-6, atol=1e-9
    )
    # A pose in a unit that is not fixed has a scale of its own, and no part in that of the others.
    fixed = np.arange(5) != 2
    apart, *_ = nees_beyond_scale(T, P, reference, fixed)
    others, *_ = nees_beyond_scale(T[fixed], P[fixed], reference[fixed])
    np.testing.assert_allclose(apart.nees[fixed], others.nees, rtol=1e-9)
    assert apart.nees[2] == pytest.approx(own[2], rel=1e-9)
    assert np.isnan(apart.drift[2])


def test_a_reversed_path_is_not_explained_by_any_scale():
    T = np.tile(np.eye(4), (1, 1, 1))
    T[0, :3, 3] = [1.0, 0, 0]
    reference = T.copy()
    reference[0, :3, 3] = [-2.0, 0, 0]
    found, scale, _ = nees_beyond_scale(T, 0.01 * np.eye(6)[None], reference)
    assert scale[0] < 0.01
    np.testing.assert_allclose(found.nees, 100, rtol=0.01)
