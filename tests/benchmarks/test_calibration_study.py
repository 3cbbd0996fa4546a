"""Tests of the calibration study: the true cameras, its numbers, its files."""

import dataclasses
import json
from pathlib import Path

import calibration
import jax
import numpy as np
import pytest
from cases import quick_jit

import jaxslam
from jaxslam.simulation import simulate

ROOT = Path(__file__).parents[2]
OPTIONS = calibration.CalibrationStudy(
    scenarios=("matched",), truths=("constant",), treatments=("estimated",), runs=3, steps=3
)


def test_a_run_says_which_camera_was_the_true_one():
    def in_cameras(run):
        return jax.vmap(lambda T: jax.vmap(T.inverse().apply)(run.points))(run.poses)

    intrinsics = {}
    for truth in ("white", "constant", "nominal"):
        scenario = jaxslam.scenario("matched", steps=3, true_calibration=truth)
        run = quick_jit(lambda key, s=scenario: simulate(s, key))(jax.random.key(0))
        intrinsics[truth] = np.asarray(
            jax.vmap(lambda camera: camera.intrinsics)(run.sensors.camera)
        )
        assert intrinsics[truth].shape == (4, 2)
        # The pixels are that camera's: 0.3 px of noise.
        seen = in_cameras(run)
        f, c = intrinsics[truth].T[..., None]
        expected = f * seen[..., 0] / seen[..., 1] + c
        error = (np.asarray(run.measured)[..., 0] - expected)[np.asarray(run.visible)]
        assert np.abs(error).max() < 1.8  # 6 σ
    assert (np.ptp(intrinsics["white"], axis=0) > 0).all()
    assert (np.ptp(intrinsics["constant"], axis=0) < 1e-12).all()  # rounding of hundreds
    assert (intrinsics["constant"] != [650, 320]).all()
    assert (intrinsics["nominal"] == [650, 320]).all()


@pytest.mark.slow
def test_the_study_is_that_of_the_library_and_writes_its_files(tmp_path):
    options = dataclasses.replace(OPTIONS, out=tmp_path / "r" / "c.json", docs=tmp_path / "docs")
    options()
    found = json.loads(options.out.read_text())
    filters = found["scenarios"]["matched"]["constant"]["robocentric/inverse_scaling"]
    assert set(filters) == {"estimated"}
    scenario = jaxslam.scenario("matched", steps=3, true_calibration="constant")
    same = jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"], "estimated")
    study = jaxslam.monte_carlo(scenario, same, runs=3)
    (expected,) = jaxslam.summarise(study)["filters"].values()
    assert filters["estimated"]["nees"] == pytest.approx(expected["nees"][-1], rel=1e-6)
    estimate = filters["estimated"]["intrinsics"]
    assert estimate["dof"] == 2
    # Three steps tell little of them: what is left is near the prior's σ of 3 and 2 px.
    assert estimate["sigma_px"] == pytest.approx([3, 2], rel=0.1)
    page = (options.docs / "calibration.md").read_text()
    assert "3 runs of 3 steps" in page
    assert "\n| constant | estimated |" in page


def test_the_page_is_written_after_the_first_truth_of_all():
    """As the command does, which keeps what it has after every one."""
    results = json.loads((ROOT / "benchmarks/results/calibration.json").read_text())
    truth, *others = results["truths"]
    name, by_truth = next(iter(results["scenarios"].items()))
    page = calibration.page({**results, "scenarios": {name: {truth: by_truth[truth]}}})
    assert f"- **{calibration.TRUTH[truth].capitalize()}**: " in page
    assert not any(calibration.TRUTH[other].capitalize() in page for other in others)


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
    halved = calibration._intrinsics({"error": error, "covariance": covariance / 2})
    assert halved["nees"] == pytest.approx(2 * found["nees"])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"truths": ("wrong",)}, r"truths must be some of nominal, white, constant, not \('wrong'"),
        ({"treatments": ()}, "treatments must be some of white, consider, estimated, known"),
        ({"runs": 0}, "runs must be at least 1, not 0"),
        ({"seed": -1}, "seed must not be negative"),
    ],
)
def test_options_that_make_no_sense_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        calibration.CalibrationStudy(**fields)


def test_the_page_has_the_numbers_on_disk():
    results = json.loads((ROOT / "benchmarks/results/calibration.json").read_text())
    assert (ROOT / "docs/calibration.md").read_text() == calibration.page(results)
