"""Tests of benchmarks/from_rest_posterior.py: what its summary says of records that are known."""

import json
from pathlib import Path

import from_rest_posterior as benchmark
import jax
import jax.numpy as jnp
import numpy as np
import pytest

RUNS = 40


def records():
    """Of a posterior N(0, I), calibrated; a tenth of the runs has a second mode of weight 0.2."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(RUNS, 3))
    one = np.ones((RUNS, 2))
    second = np.where(np.arange(RUNS) < RUNS // 10, 0.2, 0.0)
    found = {name: 0.5 * one for name in benchmark.SAMPLER}
    return found | {
        "reached": one > 0,
        "draws": rng.normal(size=(RUNS, 128, 3)),
        "error": np.stack([truth, truth + 0.25], axis=1),
        "covariance": np.broadcast_to(np.eye(3), (RUNS, 2, 3, 3)),
        "nees": np.sum(truth**2, axis=1)[:, None] * one,
        "log_evidence": np.array([-100.0, -100.5]) * one,
        "reversed": 0.1 * one,
        "reversed_mode": 0 * one,
        "second_mode": second[:, None] * one,
        "pooled_error": truth,
        "pooled_covariance": np.broadcast_to(np.eye(3), (RUNS, 3, 3)),
        "pooled_nees": np.sum(truth**2, axis=1),
        "pooled_reversed_mode": np.zeros(RUNS),
        "pooled_second_mode": second,
        "pooled_kl_of_one_gaussian": np.linspace(0, 1, RUNS),
    }


def test_the_summary_says_of_known_records_what_they_are():
    found = benchmark.summarise(records(), {})
    assert found["used"] == RUNS
    low, high = found["nees"]["band95"]
    assert low < found["nees"]["mean"] < high
    assert min(*found["rank_p_values"], found["nees"]["rank_p_value"]) > 1e-3
    # The variance of χ² with 3 degrees of freedom is 6.
    assert found["nees"]["spread_of_mean"] == pytest.approx(np.sqrt(6 / RUNS), rel=0.1)
    np.testing.assert_allclose(found["sigma"], 1)
    assert found["modes"]["second_mode"]["runs"] == pytest.approx(0.1)
    assert found["modes"]["second_mode"]["weight"]["median"] == pytest.approx(0.2)
    assert found["modes"]["reversed_mode"] == {
        "runs": 0, "runs_by_repeat": [0, 0], "weight": None, "nees": None,
    }  # fmt: skip
    assert found["repeats"]["log_evidence"]["median"] == pytest.approx(0.5)
    np.testing.assert_allclose(found["repeats"]["mean_over_sigma"]["worst_tenth"], 0.25)
    assert found["kl"]["pooled_kl_of_one_gaussian"]["median"] == pytest.approx(0.5)
    json.dumps(found)


def of_filter():
    """A filter whose error and σ are twice the exact ones; its weights are those of the draws,
    in every other run with 0.1 more."""
    exact = records()
    draws = np.linspace(0, 0.5, RUNS)
    return {
        "nees": exact["pooled_nees"],
        "kl": np.full(RUNS, 1.5),
        "error": 2 * exact["pooled_error"],
        "covariance": 4 * exact["pooled_covariance"],
        "kl_of_sum": np.linspace(0, 1, RUNS),
        "reversed": draws + np.where(np.arange(RUNS) % 2, 0.1, 0.0),
        "exact_reversed": draws,
    }


def test_the_summary_says_of_a_filter_how_far_it_is_from_the_exact_posterior():
    found = benchmark.summarise(records(), {"mine": of_filter()})
    mine = found["filters"]["mine"]
    for part in ("position", "orientation"):
        assert mine[part]["rmse_ratio"] == pytest.approx(2)
        assert mine[part]["sigma_ratio"] == pytest.approx(2)
    np.testing.assert_allclose(mine["rmse"], 2 * np.array(found["rmse"]))
    np.testing.assert_allclose(mine["sigma"], 2)
    assert mine["nees"]["mean"] == pytest.approx(found["nees"]["mean"])
    assert mine["kl_of_sum"]["median"] == pytest.approx(0.5)
    assert mine["reversed"]["mean_difference"] == pytest.approx(0.05)
    assert 0.9 < mine["reversed"]["correlation"] < 0.99
    json.dumps(found)


def test_a_row_of_the_table_says_how_far_a_filter_is_from_the_exact_posterior():
    two = {"pooled_kl_of_two_gaussians": np.full(RUNS, 0.25)}
    rows = benchmark.as_table(
        benchmark.summarise(records() | two, {"mine": of_filter()})
    ).splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    exact, one, two, mine = cells[2:]
    assert (exact[4], mine[4]) == (f"{np.sqrt(2):.3f}", f"{2 * np.sqrt(2):.3f}")
    assert float(mine[2]) == pytest.approx(2 * float(exact[2]), abs=2e-3)
    assert (exact[3], mine[3]) == ("1.00", "2.00")
    assert [row[5] for row in (one, two, mine)] == ["0.50; 0.90", "0.25; 0.25", "0.50; 0.90"]
    assert mine[0] == "`mine`"
    assert mine[6].startswith("0.050; 0.9")


def test_what_was_drawn_is_not_drawn_again_but_filters_are_measured_anew(tmp_path, monkeypatch):
    options = benchmark.FromRestPosterior(
        steps=3, landmarks=4, runs=4, chunk=2, filters=("robocentric",), cache=tmp_path,
    )  # fmt: skip
    asked = []

    def drawn(study, options, indices):
        asked.append(indices)
        found = records() | {"pooled_kl_of_two_gaussians": np.zeros(RUNS)}
        poses = study.scenario.geometry.group.identity((RUNS, 128)).parameters()
        return {k: v[list(indices)] for k, v in (found | {"poses": np.asarray(poses)}).items()}

    def beside(study, name, options, indices, poses):
        asked.append((name, indices, poses.shape))
        return {k: v[list(indices)] for k, v in of_filter().items()}

    monkeypatch.setattr(benchmark, "drawn", drawn)
    monkeypatch.setattr(benchmark, "beside", beside)
    *_, first = options.measure()
    measured = [("robocentric", range(i, i + 2), (2, 128, 4)) for i in (0, 2)]
    assert asked == [range(2), measured[0], range(2, 4), measured[1]]
    asked.clear()
    *_, second = options.measure()
    assert asked == measured
    assert second == first
    assert first["runs"] == 4


def test_runs_that_did_not_reach_the_whole_likelihood_are_counted_and_left_out():
    all_runs = records()
    all_runs["reached"][3, 1] = False
    all_runs["pooled_nees"][3] = 1e6
    found = benchmark.summarise(all_runs, {"mine": of_filter()})
    assert found["filters"]["mine"]["nees"]["runs"] == RUNS - 1
    assert len(found["filters"]["mine"]["by_run"]["reversed"]) == RUNS - 1
    assert (found["runs"], found["used"]) == (RUNS, RUNS - 1)
    assert found["nees"]["mean"] < 10


def test_the_camera_is_at_rest_but_for_what_is_not_known():
    study = benchmark.standstill(benchmark.FromRestPosterior(steps=6))
    assert study.steps == 6
    assert [*study.scenario.velocity] == [0.0, 0.0, 0.0]
    assert [*study.scenario.velocity_sigma] == [0.5, 0.5, 0.2]
    assert study.scenario.landmarks == 12


def test_no_key_is_used_twice_nor_by_the_simulator():
    keys = jax.vmap(lambda index: benchmark._keys(jax.random.key(0), index))(jnp.arange(3))
    runs = jax.vmap(lambda index: jax.random.fold_in(jax.random.key(0), index))(jnp.arange(3))
    own = [tuple(k) for k in np.asarray(jax.random.key_data(keys)).reshape(-1, 2).tolist()]
    assert len(set(own)) == 3 * (benchmark.REPEATS + 1)
    parts = jax.vmap(lambda key: jax.random.split(key, 16))(runs)
    simulated = np.asarray(jax.random.key_data(parts)).reshape(-1, 2).tolist()
    assert not {*own} & {tuple(k) for k in simulated}


def test_options_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="at least 2 runs"):
        benchmark.FromRestPosterior(runs=1)
    with pytest.raises(ValueError, match="velocity"):
        benchmark.standstill(benchmark.FromRestPosterior(velocity_sigma=(0.5,)))


def test_the_file_in_the_repository_is_calibrated():
    """Of 60 runs of which the truth is a draw of the prior; false alarms 0.3 % and 0.4 %."""
    path = Path(benchmark.__file__).parent / "results" / "from_rest_posterior.json"
    found = json.loads(path.read_text())
    assert found["used"] == found["runs"] == 60
    assert abs(found["nees"]["mean"] - 3) < 3 * found["nees"]["spread_of_mean"]
    assert min(*found["rank_p_values"], found["nees"]["rank_p_value"]) > 1e-3
