"""Logs of other programs and shapes: each gives the verdict of the same numbers as arrays."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.evaluation import evaluate_log, evaluate_nees, evaluate_poses, read_covariances
from jaxslam.evaluation.convention import MIXED, Convention
from jaxslam.io.tum import quaternions, write_tum

STEPS = 30
TIMES = 1e9 + np.arange(STEPS) / 10
UPPER = np.triu_indices(6)
RNG = np.random.default_rng(0)


def drawn_poses():
    """Truths, estimates and covariances (split, mixed) of a run in space; σ differ by axis."""
    T = np.tile(np.eye(4), (STEPS, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(STEPS), [0.1, 0.2, -0.05])).as_matrix()
    T[:, 0, 3] = np.arange(STEPS)
    sigma = np.array([0.1, 0.3, 0.05, 0.01, 0.03, 0.02])
    noise = sigma * RNG.normal(size=(STEPS, 6))
    estimate = T.copy()
    estimate[:, :3, 3] -= noise[:, :3]
    turn = Rotation.from_rotvec(-noise[:, 3:]).as_matrix()
    estimate[:, :3, :3] = T[:, :3, :3] @ turn
    return T, estimate, np.tile(np.diag(sigma**2), (STEPS, 1, 1))


TRUTH, ESTIMATE, P = drawn_poses()
SIGMA = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
WANTED = evaluate_poses(ESTIMATE[None], P[None], TRUTH[None], Convention(**MIXED))


def lines(path, *columns, header=""):
    rows = np.column_stack([np.asarray(x, float).reshape(len(columns[0]), -1) for x in columns])
    text = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in rows)
    path.write_text(f"{header}{text}\n")
    return path


def same(found, wanted=WANTED):
    np.testing.assert_allclose(found.nees, wanted.nees, rtol=1e-5)
    assert found.verdict["word"] == wanted.verdict["word"]
    return found


def states(path, T, cameras=1):
    """OpenVINS's `t q p v bg ba dt cameras …`."""
    more = np.zeros((len(T), 9 + 1 + 1 + 15 * cameras))
    header = "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot ...\n"
    return lines(path, TIMES, quaternions(T[:, :3, :3]), T[:, :3, 3], more, header=header)


@pytest.mark.parametrize("cameras", [0, 1, 2])
def test_states_of_openvins_and_their_deviations(tmp_path, cameras):
    states(tmp_path / "state_estimate.txt", ESTIMATE, cameras)
    states(tmp_path / "state_groundtruth.txt", TRUTH, cameras)
    deviations = SIGMA[:, 3:], SIGMA[:, :3], np.zeros((STEPS, 9 + 1 + 1 + 14 * cameras))
    lines(tmp_path / "state_deviation.txt", TIMES, *deviations, header="# timestamp(s) q p v …\n")
    found = same(evaluate_log(tmp_path))
    assert found.convention == Convention("split", "mixed")
    assert not any("does not state its convention" in note for note in found.notes)


def test_poses_of_openvins_with_their_covariances(tmp_path):
    blocks = P[:, 3:, 3:][:, *np.triu_indices(3)], P[:, :3, :3][:, *np.triu_indices(3)]
    q = quaternions(ESTIMATE[:, :3, :3])
    path = lines(tmp_path / "run.txt", TIMES, ESTIMATE[:, :3, 3], q, *blocks)
    write_tum(tmp_path / "truth.txt", TIMES, TRUTH)
    same(evaluate_log(path, truth=tmp_path / "truth.txt"))
    (tmp_path / "one").mkdir()
    path.rename(tmp_path / "one" / "estimate.txt")
    (tmp_path / "truth.txt").rename(tmp_path / "one" / "truth.txt")
    same(evaluate_log(tmp_path))


@pytest.mark.parametrize("timed", [True, False])
def test_poses_of_kitti(tmp_path, timed):
    """Their times are beside them, or are the numbers of their lines."""
    times = TIMES - TIMES[0] if timed else np.arange(STEPS)
    if timed:
        lines(tmp_path / "times.txt", times)
    estimate = lines(tmp_path / "estimate.txt", ESTIMATE[:, :3])
    truth = lines(tmp_path / "truth.txt", TRUTH[:, :3])
    upper = lines(tmp_path / "c.txt", times, P[:, *UPPER], header="# error=split axes=mixed\n")
    same(evaluate_log(estimate, truth=truth, covariance=upper))


@pytest.mark.parametrize("kind", ["σ", "full"])
def test_covariances_as_all_numbers_or_as_deviations(tmp_path, kind):
    write_tum(tmp_path / "estimate.txt", TIMES, ESTIMATE)
    write_tum(tmp_path / "truth.txt", TIMES, TRUTH)
    header = "# error=split axes=mixed\n"
    lines(tmp_path / "covariance.txt", TIMES, SIGMA if kind == "σ" else P, header=header)
    same(evaluate_log(tmp_path))


def flat(T):
    return np.column_stack([T[:, :2, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])


@pytest.mark.parametrize("kind", ["upper", "σ", "full"])
def test_poses_in_the_plane(tmp_path, kind):
    truth = np.column_stack([np.arange(STEPS), np.zeros(STEPS), 0.1 * np.arange(STEPS)])
    sigma = np.tile([0.2, 0.1, 0.03], (STEPS, 1))
    estimate = truth - sigma * RNG.normal(size=(STEPS, 3))
    planar = np.tile(np.diag(sigma[0] ** 2), (STEPS, 1, 1))
    split = {"error": "split", "axes": "world"}
    wanted = evaluate_poses(estimate[None], planar[None], truth[None], Convention(**split))
    assert wanted.names == ("x", "y", "r")
    assert np.median(wanted.nees) == pytest.approx(2.4, abs=1.5)
    files = {"σ": sigma, "full": planar, "upper": planar[:, *np.triu_indices(3)]}
    lines(tmp_path / "estimate.txt", TIMES, estimate)
    lines(tmp_path / "truth.txt", TIMES, truth)
    lines(tmp_path / "covariance.txt", TIMES, files[kind], header="# error=split axes=world\n")
    same(evaluate_log(tmp_path), wanted)
    write_tum(tmp_path / "truth.txt", TIMES, TRUTH)
    with pytest.raises(ValueError, match=r"truth\.txt: estimate and truth must both be planar"):
        evaluate_log(tmp_path)


def test_marginals_of_gtsam_come_rotation_first(tmp_path):
    """`marginals.marginalCovariance(key)` of a Pose3 is right, along the body, rotation first."""
    R = ESTIMATE[:, :3, :3]
    right = P.copy()
    right[:, :3, :3] = np.swapaxes(R, 1, 2) @ P[:, :3, :3] @ R
    marginals = np.roll(right, 3, axis=(1, 2))
    arrays = {"estimates": ESTIMATE[None], "covariances": marginals[None], "truths": TRUTH[None]}
    np.savez(tmp_path / "run.npz", **arrays, error="right", order="rotation-first")
    found = evaluate_log(tmp_path / "run.npz")
    np.testing.assert_allclose(found.nees, WANTED.nees, rtol=0.02)  # to first order of the errors
    assert found.names[:3] == ("rx", "ry", "rz")


@pytest.mark.parametrize("wrong", ["σ", "state"])
def test_a_deviation_that_is_none_is_refused(tmp_path, wrong):
    sigma = np.where(np.arange(6) == 2, -0.1, 1.0) * np.ones((STEPS, 1))
    more = np.zeros((STEPS, 11))
    lines(tmp_path / "c.txt", TIMES, *([sigma, more] if wrong == "state" else [sigma]))
    with pytest.raises(ValueError, match=r"c\.txt: a σ is -0\.1; expected 0 to 1e\+\d+"):
        read_covariances(tmp_path / "c.txt")


ERRORS = RNG.normal(size=(4, 5, 4)) @ np.linalg.cholesky(np.eye(4) + 0.5)
COVARIANCES = np.tile(np.eye(4) + 0.5, (4, 5, 1, 1))
PLACES = np.array([(run, step) for run in range(4) for step in range(5)])


def test_a_table_of_full_covariances(tmp_path):
    """Of n = 4 they are as many numbers as of n = 5 and a triangle."""
    full = COVARIANCES.reshape(20, 16)
    path = lines(tmp_path / "runs.csv", PLACES, ERRORS.reshape(20, 4), full)
    same(evaluate_log(path), jaxslam.evaluate(ERRORS, COVARIANCES))
    upper = COVARIANCES[:, :, *np.triu_indices(4)].reshape(20, 10)
    path = lines(tmp_path / "runs.csv", PLACES, ERRORS.reshape(20, 4), upper)
    same(evaluate_log(path), jaxslam.evaluate(ERRORS, COVARIANCES))


def test_deviations_in_place_of_covariances(tmp_path):
    sigma = np.sqrt(np.diagonal(COVARIANCES, axis1=2, axis2=3))
    wanted = jaxslam.evaluate(ERRORS, sigma[..., None] * np.eye(4) * sigma[..., None, :])
    np.savez(tmp_path / "runs.npz", errors=ERRORS, sigmas=sigma)
    same(evaluate_log(tmp_path / "runs.npz"), wanted)
    header = "run,step,a,b,c,d,sigma_a,sigma_b,sigma_c,sigma_d\n"
    columns = PLACES, ERRORS.reshape(20, 4), sigma.reshape(20, 4)
    found = same(evaluate_log(lines(tmp_path / "runs.csv", *columns, header=header)), wanted)
    assert found.names == ("a", "b", "c", "d")
    np.savez(tmp_path / "runs.npz", errors=ERRORS, sigmas=-sigma)
    with pytest.raises(
        ValueError, match=r"sigmas of run 0, step 0 must not be negative, not -1\.22"
    ):
        evaluate_log(tmp_path / "runs.npz")


def test_a_table_of_one_run_needs_no_column_of_runs(tmp_path):
    header = "step,a,b,c,d,aa,ab,ac,ad,bb,bc,bd,cc,cd,dd\n"
    upper = COVARIANCES[0][:, *np.triu_indices(4)]
    path = lines(tmp_path / "run.csv", np.arange(5), ERRORS[0], upper, header=header)
    same(evaluate_log(path), jaxslam.evaluate(ERRORS[:1], COVARIANCES[:1]))


@pytest.mark.parametrize("quantity", ["NEES", "NIS"])
def test_nees_alone(tmp_path, quantity):
    of = jaxslam.evaluate(ERRORS, COVARIANCES)
    wanted = evaluate_nees(of.nees, 4, quantity=quantity)
    alone: dict[str, Any] = {quantity.lower(): of.nees, "dof": 4}
    np.savez(tmp_path / "runs.npz", **alone)
    found = same(evaluate_log(tmp_path / "runs.npz"), wanted)
    columns = PLACES, of.nees.reshape(20, 1), np.full(20, 4)
    header = f"run,step,{quantity.lower()},dof\n"
    same(evaluate_log(lines(tmp_path / "runs.csv", *columns, header=header)), wanted)
    if quantity == "NEES":
        assert found.verdict["interval99"] == of.verdict["interval99"]
    assert str(found).startswith(quantity)
    found.save(tmp_path)
    columns = PLACES, of.nees.reshape(20, 1), np.arange(20)
    with pytest.raises(ValueError, match="dof must be the same whole number"):
        evaluate_log(lines(tmp_path / "runs.csv", *columns, header=header))
    with pytest.raises(ValueError, match="NEES of run 0, step 1 is -1; 0 or more"):
        evaluate_nees([[1.0, -1.0]], 3)
    assert evaluate_nees([[1e6]], 10**6).dof == 10**6  # of a state that is tested as a whole
    for dof in (0, -1, 10**6 + 1):
        with pytest.raises(ValueError, match="dof must be one whole number"):
            evaluate_nees([[1.0]], dof)
