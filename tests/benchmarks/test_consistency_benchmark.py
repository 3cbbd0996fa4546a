"""Tests of benchmarks/consistency.py: seeds are pooled as one study, and measured only once."""

import dataclasses
import json

import consistency as benchmark
import numpy as np
import pytest
from benchmark import END

import jaxslam
from jaxslam.statistics import Tally, run_verdict

NAME = "robocentric/inverse_scaling"


def measured(nees, seed=0):
    """What `measure` returns of runs with these NEES."""
    tally = Tally.of(nees, 3)
    one, drift = Tally.of(nees, 3, 1.0), Tally.of(nees / 3, 1, 1.0)
    return {
        "seeds": [seed], "runs": len(nees), "tally": tally.asdict(),
        "one_scale": one.asdict(), "drift": drift.asdict(),
        "nees": list(nees.mean(axis=0)), "lost": int(np.sum(nees[:, -1] > 21.1)),
        "nees_not_lost": float(np.mean(nees[nees[:, -1] <= 21.1, -1])), "nees_median": 2.4,
        "rmse": 0.3, "sigma": 0.1, "nis_per_dof": 1.0, "microseconds_per_step": 1.0,
    }  # fmt: skip


@pytest.fixture
def options(tmp_path):
    marks = (f"{mark}\n{END}\n" for mark in (benchmark.SAID, benchmark.MARK))
    (tmp_path / "consistency.md").write_text("".join(marks))
    return benchmark.Consistency(
        scenarios=("matched",), filters=("robocentric",), runs=30, seeds=(0, 1),
        out=tmp_path / "x.json", docs=tmp_path,
    )  # fmt: skip


def test_pooled_seeds_are_one_study_of_all_their_runs():
    rng = np.random.default_rng(0)
    parts = [rng.chisquare(3, (runs, 12)) for runs in (100, 300)]
    parts[0][3, 4], parts[1][7, -1] = 50.0, 90.0
    whole = np.concatenate(parts)
    rows = [measured(nees, seed) for seed, nees in enumerate(parts)]
    rows[1] |= {"nees_median": 3.2, "rmse": 0.5}
    row = benchmark.together(*rows)
    verdict = benchmark.verdicts_of(row)["tally"]
    assert (row["seeds"], row["runs"], row["lost"]) == ([0, 1], 400, 1)
    np.testing.assert_allclose(row["nees"], whole.mean(axis=0))
    assert verdict["lost"] == 2 / 400
    assert verdict["interval99"] == pytest.approx(run_verdict(whole, 3)["interval99"])
    assert row["nees_not_lost"] == pytest.approx(np.delete(whole, 107, axis=0)[:, -1].mean())
    assert row["nees_median"] == pytest.approx(2.8)
    assert row["rmse"] == pytest.approx(np.sqrt((100 * 0.3**2 + 300 * 0.5**2) / 400))


def test_seeds_are_one_study_in_any_order():
    rng = np.random.default_rng(5)
    a, b, c = (measured(rng.chisquare(3, (runs, 12)), i) for i, runs in enumerate((9, 20, 31)))
    one = benchmark.together(benchmark.together(a, b), c)
    other = benchmark.together(c, benchmark.together(b, a))
    # Of medians each seed counts the same, however they were put together.
    assert one["seeds"] == other["seeds"] == [0, 1, 2]
    assert benchmark._row("x/y", one) == benchmark._row("x/y", other)
    np.testing.assert_allclose(one["nees"], other["nees"])
    assert json.loads(json.dumps(one, allow_nan=False)) == one


@pytest.mark.slow
def test_a_seed_is_measured_as_the_library_summarises_it(options):
    """A number of another step, or of another seed."""
    scenario = jaxslam.scenario("matched", steps=3, landmarks=4)
    options = dataclasses.replace(options, runs=6, chunk=4)
    found = benchmark.measure(scenario, NAME, 2, options)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    filters = jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"])
    study = jaxslam.monte_carlo(scenario, filters, runs=6, seed=2, chunk=4)
    expected = jaxslam.summarise(study)["filters"][NAME]
    assert benchmark.verdicts_of(found)["tally"] | {"lost_runs": []} == expected["verdict"]
    assert (found["seeds"], found["nees"]) == ([2], expected["nees"])
    assert found["lost"] / 6 == pytest.approx(expected["lost"][-1])
    for key in ("rmse", "sigma"):
        assert found[key] == expected[key]["position"][-1]


def test_seeds_that_are_there_are_not_measured_again(options, monkeypatch):
    rng, asked = np.random.default_rng(0), []

    def measure(scenario, name, seed, options):
        asked.append(seed)
        return measured(rng.chisquare(3, (30, 4)), seed)

    monkeypatch.setattr(benchmark, "measure", measure)
    options()
    dataclasses.replace(options, seeds=(0, 1, 3))()
    assert asked == [0, 1, 3]
    assert options.found()["matched"][NAME]["seeds"] == [0, 1, 3]
    page = (options.docs / "consistency.md").read_text()
    assert "90 to 90 runs of seeds 0–1, 3." in page
    assert page.count("| `robocentric` |") == 1
    with pytest.raises(ValueError, match=r"a row with 30 runs of every seed, not 20: remove it"):
        dataclasses.replace(options, runs=20)()


def test_a_diverged_run_leaves_a_row_without_a_mean():
    nees = np.random.default_rng(2).chisquare(3, (50, 12))
    broken = nees.copy()
    broken[4, 2:] = np.nan
    row = benchmark._row("x/y", measured(nees) | {"tally": Tally.of(broken, 3).asdict()})
    assert row[1:4] == ["–", "–", "lost"]
    assert "**" not in "".join(row)
