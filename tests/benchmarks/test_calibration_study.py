"""Tests of the calibration study: its numbers, its files."""

import dataclasses
import json

import calibration
import numpy as np
import pytest
from benchmark import END

import jaxslam

OPTIONS = calibration.CalibrationStudy(
    scenarios=("matched",), truths=("constant",), treatments=("estimated",), runs=3, steps=3
)


@pytest.mark.slow
def test_the_study_is_that_of_the_library_and_writes_its_files(tmp_path):
    """Runs of another room, or of other cameras, than those of `monte_carlo`."""
    options = dataclasses.replace(OPTIONS, out=tmp_path / "r" / "c.json", docs=tmp_path)
    marks = (f"{mark}\n{END}\n" for mark in (calibration.SAID, calibration.MARK))
    (tmp_path / "calibration.md").write_text("".join(marks))
    options()
    found = json.loads(options.out.read_text())
    filters = found["scenarios"]["matched"]["constant"]["robocentric/inverse_scaling"]
    assert set(filters) == {"estimated"}
    scenario = jaxslam.scenario("matched", steps=3, true_calibration="constant")
    same = jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"], "estimated")
    (expected,) = jaxslam.summarise(jaxslam.monte_carlo(scenario, same, runs=3))["filters"].values()
    assert filters["estimated"]["nees"] == pytest.approx(expected["nees"][-1], rel=1e-6)
    estimate = filters["estimated"]["intrinsics"]
    assert estimate["dof"] == 2
    # Three steps tell little of them: what is left is near the prior's σ of 3 and 2 px.
    assert estimate["sigma_px"] == pytest.approx([3, 2], rel=0.1)
    page = (options.docs / "calibration.md").read_text()
    assert "\n| constant | estimated |" in page


def test_sentences_are_written_after_the_first_truth_of_all():
    """As the command does, which keeps what it has after every one."""
    results = calibration.CalibrationStudy().found()
    truth, *others = results["truths"]
    name, by_truth = next(iter(results["scenarios"].items()))
    said = calibration.in_words({**results, "scenarios": {name: {truth: by_truth[truth]}}})
    assert said.startswith(f"- **{calibration.TRUTH[truth].capitalize()}**: ")
    assert not any(calibration.TRUTH[other].capitalize() in said for other in others)


def test_the_estimate_of_the_intrinsics_is_judged_by_its_covariance():
    rng = np.random.default_rng(0)
    P = np.array([[4.0, 1.0], [1.0, 2.0]])
    error = rng.multivariate_normal([0, 0], P, 2000)
    covariance = np.tile(P, (2000, 1, 1))
    covariance[7] = np.nan  # a run that diverged
    found = calibration._intrinsics({"error": error, "covariance": covariance})
    assert found["rmse_px"] == pytest.approx([2, np.sqrt(2)], rel=0.06)
    assert found["sigma_px"] == pytest.approx([2, np.sqrt(2)])
    low, high = jaxslam.mean_band(2, 1999, confidence=1 - 1e-6)
    assert low < found["nees"] < high
