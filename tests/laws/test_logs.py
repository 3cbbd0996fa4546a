"""Every format of a log gives the verdict of its arrays, and says in one line what is wrong."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import EPOCH, KINDS, ros_of, write_bag
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.evaluation import Evaluation, evaluate_log, evaluate_nees, evaluate_poses
from jaxslam.evaluation.convention import MIXED, Convention, write_covariances
from jaxslam.io.tum import quaternions, write_tum

STEPS = 24
TIMES = EPOCH + np.arange(STEPS) / 10
UPPER, UPPER3, UPPER4 = (np.triu_indices(n) for n in (6, 3, 4))
RNG = np.random.default_rng(0)
HEADER = "# error=split axes=mixed\n"


def in_space():
    """Estimates, covariances (split, mixed; σ differ by axis, and correlate), truths."""
    truth = np.tile(np.eye(4), (STEPS, 1, 1))
    turned = np.outer(np.arange(STEPS), [0.1, 0.2, -0.05])
    truth[:, :3, :3] = Rotation.from_rotvec(turned).as_matrix()
    truth[:, 0, 3] = np.arange(STEPS)
    root = 0.2 * np.diag([0.1, 0.3, 0.05, 0.01, 0.03, 0.02])
    root[:3, :3] @= np.eye(3) + 0.3 * RNG.normal(size=(3, 3))
    root[3:, 3:] @= np.eye(3) + 0.3 * RNG.normal(size=(3, 3))
    noise = RNG.normal(size=(STEPS, 6)) @ root.T
    estimate = truth.copy()
    estimate[:, :3, 3] -= noise[:, :3]
    turn = Rotation.from_rotvec(-noise[:, 3:]).as_matrix()
    estimate[:, :3, :3] = truth[:, :3, :3] @ turn
    return estimate, np.tile(root @ root.T, (STEPS, 1, 1)), truth


ESTIMATE, P, TRUTH = in_space()
SIGMA = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
R = ESTIMATE[:, :3, :3]
FLAT_TRUTH = np.column_stack([np.arange(STEPS), np.zeros(STEPS), 0.1 * np.arange(STEPS)])
FLAT_SIGMA = np.tile([0.2, 0.1, 0.03], (STEPS, 1))
FLAT = FLAT_TRUTH - FLAT_SIGMA * RNG.normal(size=(STEPS, 3))
FLAT_P = FLAT_SIGMA[:, :, None] * np.eye(3) * FLAT_SIGMA[:, None]
RUNS = (4, 5)
ERRORS = RNG.normal(size=(*RUNS, 4)) @ np.linalg.cholesky(np.eye(4) + 0.5)
COVARIANCES = np.tile(np.eye(4) + 0.5, (*RUNS, 1, 1))
PLACES = np.argwhere(np.ones(RUNS))


def of_sigmas(sigma):
    return sigma[..., None] * np.eye(sigma.shape[-1]) * sigma[..., None, :]


def right_rotation_first(cov):
    """The covariance (split, mixed) as GTSAM has it: right, along the body, rotation first."""
    right = cov.copy()
    right[:, :3, :3] = np.swapaxes(R, 1, 2) @ cov[:, :3, :3] @ R
    return np.roll(right, 3, axis=(1, 2))


def in_the_world(cov):
    """The covariance (split, mixed) as ROS has it: about the axes of the world."""
    A = np.tile(np.eye(6), (STEPS, 1, 1))
    A[:, 3:, 3:] = R
    return A @ cov @ np.swapaxes(A, 1, 2)


MIXED_BLOCKS = P[:, 3:, 3:][:, *UPPER3], P[:, :3, :3][:, *UPPER3]
SPLIT = Convention("split", "world")
IN_SPACE = evaluate_poses(ESTIMATE[None], P[None], TRUTH[None], Convention(**MIXED))
OF_SIGMAS = evaluate_poses(ESTIMATE[None], of_sigmas(SIGMA)[None], TRUTH[None], Convention(**MIXED))
IN_THE_PLANE = evaluate_poses(FLAT[None], FLAT_P[None], FLAT_TRUTH[None], SPLIT)
OF_ERRORS = jaxslam.evaluate(ERRORS, COVARIANCES)
DEVIATIONS = np.sqrt(np.diagonal(COVARIANCES, axis1=2, axis2=3))


# --- writers: files in a folder, and what `evaluate_log` is given of them ----------------------


def lines(path, *columns, header="", between=" "):
    rows = np.column_stack([np.asarray(x, float).reshape(len(columns[0]), -1) for x in columns])
    text = "\n".join(between.join(f"{x:.17g}" for x in row) for row in rows)
    path.write_text(f"{header}{text}\n")
    return path


def tum(folder, estimate="estimate.txt", covariance="covariance.txt", truth="truth.txt"):
    write_tum(folder / estimate, TIMES, ESTIMATE)
    write_covariances(folder / covariance, TIMES, P, Convention(**MIXED))
    write_tum(folder / truth, TIMES, TRUTH)
    return {"source": folder}


def tum_named_by_options(folder):
    tum(folder, "mine.tum", "sigma.txt", "mocap.csv")
    beside = {"covariance": folder / "sigma.txt", "truth": str(folder / "mocap.csv")}
    return {"source": folder / "mine.tum", **beside}


def tum_and(values):
    def write(folder):
        tum(folder)
        lines(folder / "covariance.txt", TIMES, values, header=HEADER)
        return {"source": folder}

    return write


def states(cameras):
    """OpenVINS's `t q p v bg ba dt cameras …`."""

    def write(folder):
        more = np.zeros((STEPS, 9 + 1 + 1 + 15 * cameras))
        header = "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot ...\n"
        for name, T in (("estimate", ESTIMATE), ("groundtruth", TRUTH)):
            state = TIMES, quaternions(T[:, :3, :3]), T[:, :3, 3], more
            lines(folder / f"state_{name}.txt", *state, header=header)
        sigma = SIGMA[:, 3:], SIGMA[:, :3], np.zeros((STEPS, 9 + 1 + 1 + 14 * cameras))
        lines(folder / "state_deviation.txt", TIMES, *sigma, header="# timestamp(s) q p v …\n")
        return {"source": folder}

    return write


def poses_with_covariances(folder):
    """OpenVINS's `pose_to_file`."""
    write_tum(folder / "truth.txt", TIMES, TRUTH)
    lines(folder / "estimate.txt", TIMES, ESTIMATE[:, :3, 3], quaternions(R), *MIXED_BLOCKS)
    return {"source": folder}


def one_file_of_poses_with_covariances(folder):
    poses_with_covariances(folder)
    return {"source": folder / "estimate.txt", "truth": folder / "truth.txt"}


def kitti(timed):
    """Times are beside the poses, or are the numbers of their lines."""

    def write(folder):
        times = TIMES - TIMES[0] if timed else np.arange(STEPS)
        if timed:
            lines(folder / "times.txt", times)
        lines(folder / "estimate.txt", ESTIMATE[:, :3])
        lines(folder / "truth.txt", TRUTH[:, :3])
        lines(folder / "covariance.txt", times, P[:, *UPPER], header=HEADER)
        return {"source": folder}

    return write


def planar(values):
    def write(folder):
        lines(folder / "estimate.txt", TIMES, FLAT)
        lines(folder / "truth.txt", TIMES, FLAT_TRUTH)
        lines(folder / "covariance.txt", TIMES, values, header="# error=split axes=world\n")
        return {"source": folder}

    return write


def npz(**arrays: Any):
    def write(folder):
        np.savez(folder / "runs.npz", **arrays)
        return {"source": folder / "runs.npz"}

    return write


def csv(*columns, header="", between=","):
    def write(folder):
        path = lines(folder / "runs.csv", *columns, header=header, between=between)
        return {"source": path}

    return write


def bag(name, estimate="odometry", truth="pose_stamped"):
    """The estimate among other topics, in messages of these kinds."""

    def write(folder):
        r, covariances = ros_of(name), in_the_world(P)
        told = [getattr(r, estimate)(*x) for x in zip(TIMES, ESTIMATE, covariances, strict=True)]
        if truth == "path":  # published as it grows: the last one is the whole
            true = [r.path(TIMES[:n], TRUTH[:n]) for n in (1, 10, STEPS)]
        else:
            zero = [np.zeros((6, 6))] * (truth not in ("pose_stamped", "transform_stamped"))
            true = [getattr(r, truth)(*x, *zero) for x in zip(TIMES, TRUTH, strict=True)]
        path = write_bag(folder / name, {"/filter/pose": told, "/mocap": true})
        return {"source": path, "estimate": "filter/pose", "truth": "/mocap"}

    return write


@dataclass(frozen=True)
class Log:
    """How a log is written, and the verdict of its arrays."""

    write: Callable[[Path], dict[str, Any]]
    wanted: Evaluation = IN_SPACE
    rtol: float = 1e-4
    convention: Convention | None = None
    """Where it is not that of the arrays."""


def of_n(n, header=""):
    """A table of errors of n axes, and of the upper triangles of their covariances."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(*RUNS, n, n)) + 2 * np.eye(n)
    e, cov = rng.normal(size=(*RUNS, n)), root @ np.swapaxes(root, -1, -2)
    triangles = cov[..., *np.triu_indices(n)].reshape(len(PLACES), -1)
    write = csv(PLACES, e.reshape(len(PLACES), -1), triangles, header=header)
    return Log(write, jaxslam.evaluate(e, cov, names=[f"e{i}" for i in range(n)] if header else ()))


def of_bag(name, *kinds, **truth):
    return Log(bag(name, *kinds, **truth), rtol=1e-9, convention=SPLIT)


FLAT_ERRORS = ERRORS.reshape(-1, 4)
TRIANGLES = COVARIANCES[..., *UPPER4].reshape(-1, 10)
NAMED = "run,step,e0,e1,P0,P1,P2\n"
SIGMAS_NAMED = "run,step,a,b,c,d,sigma_a,sigma_b,sigma_c,sigma_d\n"
ONE_RUN = "step,a,b,c,d,aa,ab,ac,ad,bb,bc,bd,cc,cd,dd\n"
NEES = OF_ERRORS.nees
NEES_ALONE = NEES.reshape(-1, 1), np.full(NEES.size, 4)
OF_DEVIATIONS = jaxslam.evaluate(ERRORS, of_sigmas(DEVIATIONS))
MARGINALS: dict[str, Any] = {
    "estimates": ESTIMATE[None], "covariances": right_rotation_first(P)[None],
    "truths": TRUTH[None], "error": "right", "order": "rotation-first",
}  # fmt: skip
POSES: dict[str, Any] = {**MARGINALS, "covariances": P[None], **MIXED}
POSES["order"] = "position-first"
LOGS = {
    "TUM": Log(tum),
    "TUM, of the tracker": Log(lambda x: tum(x, "trajectory.txt", truth="groundtruth.txt")),
    "TUM, named by options": Log(tum_named_by_options),
    "TUM, all of a covariance": Log(tum_and(P)),
    "TUM, σ": Log(tum_and(SIGMA), OF_SIGMAS),
    **{f"states of OpenVINS, {n} cameras": Log(states(n), OF_SIGMAS) for n in (0, 1, 2)},
    "poses of OpenVINS": Log(poses_with_covariances),
    "poses of OpenVINS, one file": Log(one_file_of_poses_with_covariances),
    "KITTI": Log(kitti(timed=False)),
    "KITTI, timed": Log(kitti(timed=True)),
    "plane, triangle": Log(planar(FLAT_P[:, *UPPER3]), IN_THE_PLANE),
    "plane, all of a covariance": Log(planar(FLAT_P), IN_THE_PLANE),
    "plane, σ": Log(planar(FLAT_SIGMA), IN_THE_PLANE),
    "npz of poses": Log(npz(**POSES)),
    # To the first order of the errors.
    "npz of GTSAM's marginals": Log(
        npz(**MARGINALS), rtol=0.02, convention=Convention("right", order="rotation-first")
    ),
    "npz of errors": Log(npz(errors=ERRORS, covariances=COVARIANCES), OF_ERRORS),
    "npz of σ": Log(npz(errors=ERRORS, sigmas=DEVIATIONS), OF_DEVIATIONS),
    "npz of innovations": Log(
        npz(innovations=ERRORS, covariances=COVARIANCES),
        jaxslam.evaluate(ERRORS, COVARIANCES, quantity="NIS"),
    ),
    "npz of NEES": Log(npz(nees=NEES, dof=4), evaluate_nees(NEES, 4)),
    "npz of NIS": Log(npz(nis=NEES, dof=4), evaluate_nees(NEES, 4, quantity="NIS")),
    **{f"CSV, n = {n}": of_n(n) for n in (1, 3, 6)},
    "CSV, n = 2, with names": of_n(2, NAMED),
    # Of n = 4 a full covariance is as many numbers as of n = 5 and a triangle.
    "CSV, n = 4": Log(csv(PLACES, FLAT_ERRORS, TRIANGLES), OF_ERRORS),
    "CSV, all of a covariance": Log(
        csv(PLACES, FLAT_ERRORS, COVARIANCES.reshape(-1, 16)), OF_ERRORS
    ),
    "CSV, semicolons": Log(csv(PLACES, FLAT_ERRORS, TRIANGLES, between=";"), OF_ERRORS),
    "CSV, σ": Log(
        csv(PLACES, FLAT_ERRORS, DEVIATIONS.reshape(-1, 4), header=SIGMAS_NAMED),
        jaxslam.evaluate(ERRORS, of_sigmas(DEVIATIONS), names="abcd"),
    ),
    "CSV, one run": Log(
        csv(np.arange(5), ERRORS[0], TRIANGLES[:5], header=ONE_RUN),
        jaxslam.evaluate(ERRORS[:1], COVARIANCES[:1], names="abcd"),
    ),
    "CSV of NEES": Log(
        csv(PLACES, *NEES_ALONE, header="run,step,nees,dof\n"), evaluate_nees(NEES, 4)
    ),
    "CSV of NIS": Log(
        csv(PLACES, *NEES_ALONE, header="run,step,nis,dof\n"),
        evaluate_nees(NEES, 4, quantity="NIS"),
    ),
    **{f"bag {name}": of_bag(name) for name in KINDS},
    "bag: PoseWithCovarianceStamped, Path, of ROS 1": of_bag(
        "run.bag", "pose_with_covariance_stamped", "path"
    ),
    "bag: PoseWithCovarianceStamped, Odometry, of ROS 2": of_bag(
        "run.mcap", "pose_with_covariance_stamped", "odometry"
    ),
    "bag: TransformStamped, of ROS 1": of_bag("run.bag", truth="transform_stamped"),
    "bag: TransformStamped, of ROS 2": of_bag("run.mcap", truth="transform_stamped"),
    "bag: Path, of ROS 2": of_bag("run.mcap", truth="path"),
    "bag: PoseWithCovarianceStamped as truth": of_bag(
        "run.bag", truth="pose_with_covariance_stamped"
    ),
}
TEXTS = [name for name in LOGS if not name.startswith(("npz", "bag"))]
TABLES = [name for name in TEXTS if name.startswith("CSV")]


@pytest.fixture
def written(request, tmp_path):
    """What evaluates a log, whatever became of its files, and these."""
    given = LOGS[request.param].write(tmp_path)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    return (lambda: evaluate_log(**given)), files


def of_logs(names):
    return pytest.mark.parametrize("written", names, indirect=True, ids=str)


def refused(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


# --- the laws ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LOGS)
def test_a_log_has_the_verdict_of_its_arrays(name, tmp_path):
    log = LOGS[name]
    found, wanted = evaluate_log(**log.write(tmp_path)), log.wanted
    np.testing.assert_allclose(found.nees, wanted.nees, rtol=log.rtol)
    assert found.verdict["word"] == wanted.verdict["word"]
    assert found.convention == (log.convention or wanted.convention)
    assert (found.quantity, found.dof, found.fitted) == (wanted.quantity, wanted.dof, wanted.fitted)
    assert set(found.names) == set(wanted.names)
    assert log.convention or found.names == wanted.names
    assert ("NEES" in str(found)) == (wanted.quantity == "NEES")
    assert not any("does not state its convention" in note for note in found.notes)
    if name.startswith(("TUM", "states", "poses", "plane", "bag")):  # which are of stamps
        np.testing.assert_allclose(found.times, TIMES, rtol=0, atol=1e-6)


@of_logs(TEXTS)
def test_a_line_that_is_cut_or_not_finite_is_named(written):
    evaluated, files = written
    for path in files:
        whole = path.read_text().splitlines()
        between = re.search(r"[ ,;]", whole[-1])
        cut = whole[-1][: len(whole[-1]) // 2].rpartition(between[0])[0] if between else "x"
        for spoilt in (cut, re.sub(r"\d[^ ,;]*$", "nan", whole[-1]), whole[-1] + ".x"):
            path.write_text("\n".join([*whole[:-1], spoilt]))
            refused(evaluated, rf"{path.name}, line {len(whole)}: expected .*(numbers|times)")
        path.write_text("\n".join(whole))


SPOILT_TEXTS = b"", b"\xff\xfe", b"a: [", b"rosbag2_bagfile_information:\n  version: 5\n"


@of_logs([name for name in LOGS if not name.startswith("bag:")])
def test_a_file_that_is_empty_or_of_another_kind_is_named(written):
    evaluated, files = written
    for path in files:
        whole = path.read_bytes()
        expected, spoilt = rf"{path.name}|has no covariance\.txt or", SPOILT_TEXTS
        if path.suffix in (".bag", ".mcap", ".db3", ".yaml"):
            expected = "cannot be read .*; expected a ROS bag .*, complete"
        if path.suffix in (".npz", ".bag", ".mcap", ".db3"):
            spoilt = b"", b"hello\n", whole[: len(whole) // 2], whole[:20], bytes(3000)
        for content in spoilt:
            path.write_bytes(content)
            refused(evaluated, expected)
        path.write_bytes(whole)


@of_logs([name for name in TEXTS if name != "KITTI" and name not in TABLES])
def test_lines_of_a_trajectory_are_in_the_order_of_their_times(written):
    evaluated, files = written
    for path in files:
        whole = path.read_text().splitlines()
        if len(whole[-1].split()) != 12:  # of KITTI, whose times are beside
            path.write_text("\n".join([*whole[:-2], *reversed(whole[-2:])]))
            refused(evaluated, r"times decrease from .* s; expected one run in temporal order")
            path.write_text("\n".join(whole))


@of_logs([name for name in TABLES if "NEES" not in name])
def test_lines_of_a_table_are_in_any_order(written):
    evaluated, (path,) = written
    before = evaluated()
    whole = path.read_text().splitlines()
    titles = 1 if whole[0][0].isalpha() else 0
    path.write_text("\n".join([*whole[:titles], *reversed(whole[titles:])]))
    np.testing.assert_array_equal(evaluated().nees, before.nees)


@of_logs(["TUM", "TUM, of the tracker", "states of OpenVINS, 1 cameras", "plane, σ"])
def test_a_file_that_is_missing_is_named(written):
    evaluated, files = written
    for path in files:
        kept = path.rename(path.with_suffix(".away"))
        refused(evaluated, "has (no|neither) ")
        kept.rename(path)
