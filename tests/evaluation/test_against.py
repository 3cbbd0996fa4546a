"""Two logs of one run without a truth, the table for LaTeX, and what the file says beside NEES."""

import json

import numpy as np
import pytest
from logs import lines
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.cli import main
from jaxslam.evaluation import evaluate_log
from jaxslam.evaluation.convention import MIXED, Convention

STEPS = 200
TIMES = 1000 + np.arange(STEPS) / 10
SIGMA = np.repeat([0.05, 0.01], 3)
TITLES = "t,tx,ty,tz,qx,qy,qz,qw,pxx,pxy,pxz,pyy,pyz,pzz,qrr,qrp,qry,qpp,qpy,qyy"
TURNS = Rotation.from_euler("ZYX", np.outer(np.sin(TIMES), [0.5, 0.2, 0.1]))
PLACES = np.outer(np.arange(STEPS), [0.1, 0.02, 0.0])


def log(path, seed, factor=1.0, late=0.0):
    """Poses whose errors are independent, and so many times as large as their covariances say."""
    e = factor * SIGMA * np.random.default_rng(seed).normal(size=(STEPS, 6))
    block = np.array([1, 0, 0, 1, 0, 1])
    P = np.tile([*(SIGMA[0] ** 2 * block), *(SIGMA[3] ** 2 * block)], (STEPS, 1))
    q = (TURNS * Rotation.from_rotvec(e[:, 3:])).as_quat()
    lines(path, TIMES + late, PLACES + e[:, :3], q, P, header=TITLES + "\n", between=",")
    return path


def test_two_logs_of_one_run_are_compared_without_a_truth(tmp_path):
    """Their difference has the covariances of both: NEES of (1 + f²)/2 times the degrees."""
    first = log(tmp_path / "a.csv", 0)
    for factor, word in ((1.0, "cannot tell"), (2.0, "over-confident")):
        found = evaluate_log(first, against=log(tmp_path / "b.csv", 1, factor))
        assert found.verdict["word"] == word
        assert np.mean(found.nees) == pytest.approx(6 * (1 + factor**2) / 2, rel=0.1)
        assert found.verdict["effective"] > 100
    with pytest.raises(ValueError, match="give --truth or --against, not both"):
        evaluate_log(first, truth=first, against=tmp_path / "b.csv")
    lines(tmp_path / "c.txt", TIMES, PLACES, TURNS.as_quat())
    with pytest.raises(ValueError, match=r"c\.txt has no covariances; --against needs"):
        evaluate_log(first, against=tmp_path / "c.txt")


def test_without_an_offset_of_their_clocks_both_covariances_count_still(tmp_path):
    """Of errors that are a fifth of σ, so that rotations tell the offset."""
    found = evaluate_log(
        log(tmp_path / "a.csv", 0, 0.2, late=0.2), against=log(tmp_path / "b.csv", 1, 0.2)
    )
    (cause,) = found.causes
    assert cause.what == "the clocks of estimate and truth differ"
    assert cause.nees == pytest.approx(6 * 0.2**2, rel=0.2)


def test_the_file_and_the_table_for_latex(tmp_path, capsys):
    log(tmp_path / "a.csv", 0)
    lines(tmp_path / "late.txt", TIMES - 0.05, PLACES, TURNS.as_quat())
    words = ["evaluate", str(tmp_path / "a.csv"), "--truth", str(tmp_path / "late.txt")]
    main([*words, "--out", str(tmp_path), "--latex"])
    told = json.loads((tmp_path / "evaluation.json").read_text())
    assert told["time_offset"]["seconds"] == pytest.approx(0.05, abs=0.03)
    assert 0 < told["time_offset"]["sigma"] < 0.02
    (cause,) = told["causes"]
    assert cause["cause"] == "the clocks of estimate and truth differ"
    assert cause["nees_without"] < 8
    assert cause["certain"] is True
    assert cause["evidence"] in capsys.readouterr().out
    assert set(told["coverage"]) == {"50", "90", "99"}
    assert told["effective_samples"] > 1
    text = (tmp_path / "evaluation.tex").read_text()
    assert text.splitlines()[0].startswith("% no verdict: the clocks")
    assert r"axis & RMSE, m or rad & $\sigma$ claimed & $\sigma$ should be $\times$" in text
    assert text.count(r"\\") == 8


def test_a_first_pose_that_is_not_known_moves_all_others():
    """With its covariance added to theirs, NEES of independent errors stays what it is."""
    rng = np.random.default_rng(0)
    runs, steps = 100, 4
    truth = np.tile(np.eye(4), (runs, steps, 1, 1))
    truth[..., 0, 3] = np.arange(steps)
    e = SIGMA * rng.normal(size=(runs, steps, 6))
    estimate = truth.copy()
    estimate[..., :3, 3] -= e[..., :3]
    turn = Rotation.from_rotvec(-e[..., 3:].reshape(-1, 3)).as_matrix()
    estimate[..., :3, :3] = turn.reshape(runs, steps, 3, 3)
    P = np.tile(np.diag(SIGMA**2), (runs, steps, 1, 1))
    found = jaxslam.evaluate_poses(estimate, P, truth, Convention(**MIXED), align="first")
    np.testing.assert_allclose(found.nees[:, 0], 0, atol=1e-9)
    assert np.mean(found.nees[:, 1:]) == pytest.approx(6, rel=0.08)
