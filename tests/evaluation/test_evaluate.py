"""Errors and covariances of anybody's filter: the verdict, the files, the command, the figure."""

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from logs import drawn

import jaxslam
from jaxslam.cli import main
from jaxslam.evaluation import evaluate_nees
from jaxslam.plots.evaluation import plot_axis, plot_evaluation, plot_nees, plot_outside
from jaxslam.plots.style import new_figure
from jaxslam.statistics import run_verdict
from jaxslam.statistics.bands import whiteness_p_value

KEYS = {
    "schema", "version", "quantity", "runs", "steps", "dof", "time", "band95", "nees", "inside",
    "verdict", "outside3sigma", "rmse", "sigma", "axis_verdict", "convention", "alignment",
    "suggested", "identified", "notes", "runs_of_step", "band95_of_step",
    "run_names", "lost_runs", "mistakes",
    "fitted", "scale", "truth_sigma", "coverage", "bias", "correlation",
}  # fmt: skip


def as_json(found):
    return json.loads(json.dumps(found.asdict(), allow_nan=False))


def test_nees_verdict_and_shares_are_those_of_the_definitions():
    before, (e, P) = dict(jax.config.values), drawn()
    found = jaxslam.evaluate(e, P)
    nees = np.einsum("rki,rkij,rkj->rk", e, np.linalg.inv(P), e)
    np.testing.assert_allclose(found.nees, nees, rtol=1e-9)
    assert found.verdict == run_verdict(found.nees, 3) == evaluate_nees(found.nees, 3).verdict
    assert found.band95 == jaxslam.mean_band(3, 60)
    np.testing.assert_allclose(found.mean, nees.mean(axis=0), rtol=1e-9)
    sigma = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    np.testing.assert_allclose(found.rmse, np.sqrt((e**2).mean(axis=0)), rtol=1e-12)
    np.testing.assert_allclose(found.sigma, np.sqrt((sigma**2).mean(axis=0)), rtol=1e-12)
    np.testing.assert_array_equal(found.outside3sigma, (abs(e) > 3 * sigma).mean(axis=(0, 1)))
    units = np.array([1e-10, 1.0, 1e10])
    scaled = jaxslam.evaluate(e * units, P * units * units[:, None])
    np.testing.assert_allclose(scaled.nees, nees, rtol=1e-9)
    assert dict(jax.config.values) == before


def as_unit(e):
    return e, np.broadcast_to(np.eye(e.shape[-1]), (*e.shape, e.shape[-1]))


def test_what_a_right_mean_nees_hides_is_named():
    """A correlation that P lacks, a mean error, and tails: of Student's t with 4 degrees."""
    rng = np.random.default_rng(5)
    e = rng.normal(size=(40, 100, 3))
    right = jaxslam.evaluate(*as_unit(e))
    assert "correlate" not in str(right)
    assert "mean error" not in str(right)
    np.testing.assert_allclose([*right.coverage.values()], [0.5, 0.9, 0.99], atol=0.02)
    found = jaxslam.evaluate(*as_unit(e * np.sqrt(2 / rng.chisquare(4, (40, 100, 1)))))
    assert found.coverage["50"] > 0.6
    inside = f"{found.coverage['99']:.1%}"
    assert found.coverage["99"] < 0.98
    assert re.search(rf"^sets of 50, .* and {inside} of the errors$", str(found), re.M)
    e[..., 2] = 0.8 * e[..., 0] + 0.6 * e[..., 2]
    e[..., 1] += 0.5
    found = jaxslam.evaluate(*as_unit(e), names=["x", "y", "z"])
    assert re.search(r"whitened errors of x and z correlate by 0\.(7|8)\d, more", str(found))
    assert re.search(r"the mean error of y is 0\.[45]\d σ, more than chance \(p < 0", str(found))
    written = as_json(found)
    assert (written["correlation"]["axes"], written["correlation"]["p"] < 1e-6) == (["x", "z"], 1)
    assert written["correlation"]["matrix"][0][2] == pytest.approx(0.8, abs=0.05)
    assert written["bias"]["y"]["p"] < 1e-6
    assert jaxslam.evaluate(*as_unit(e[..., :1])).correlation is None
    assert evaluate_nees(found.nees, 3).asdict()["bias"] is None


# --- innovations and single runs ------------------------------------------------------------------


def autoregressive(steps, correlation, seed=0):
    """One run of innovations (1, steps, 2) and their covariances, correlated so."""
    rng = np.random.default_rng(seed)
    e = rng.normal(size=(1, steps, 2))
    for step in range(1, steps):
        e[:, step] *= np.sqrt(1 - correlation**2)
        e[:, step] += correlation * e[:, step - 1]
    return as_unit(e)


@pytest.mark.parametrize(
    ("factor", "word"), [(1.0, "consistent"), (1.3, "over-confident"), (0.77, "under-confident")]
)
def test_one_run_of_white_innovations_is_as_many_samples_as_it_has_steps(factor, word):
    e, P = autoregressive(800, 0.0)
    found = jaxslam.evaluate(factor * e, P, quantity="NIS")
    assert (found.verdict["word"], found.verdict["samples"]) == (word, "steps")
    assert found.verdict["white"] > 0.01
    assert found.axis_verdict(0)["word"] == word
    assert "each step is one sample" in str(found)
    assert found.headline.startswith("NIS ")
    assert "NEES" not in str(found)
    assert found.asdict()["quantity"] == "NIS"
    # The same numbers as errors are one run, which shows only that σ is too small.
    of_errors = jaxslam.evaluate(factor * e, P)
    assert of_errors.verdict["word"] == (word if word == "over-confident" else "cannot tell")
    steps = of_errors.verdict["effective"]
    assert 600 < steps <= 800
    assert f"its steps are worth {steps:.0f} independent ones" in str(of_errors)


def test_innovations_that_are_not_white_tell_no_more_than_their_runs_do():
    e, P = autoregressive(800, 0.5)
    found = jaxslam.evaluate(1.3 * e, P, quantity="NIS")
    assert (found.verdict["word"], found.verdict["samples"]) == ("cannot tell", "runs")
    assert "innovations are not white (p = " in str(found)
    short = jaxslam.evaluate(e[:, :6], P[:, :6], quantity="NIS")
    assert short.verdict["white"] is None
    assert "too few steps to tell whether innovations are white" in str(short)


def test_white_innovations_are_called_otherwise_once_in_a_hundred():
    drawn = [autoregressive(100, 0.0, seed)[0] for seed in range(200)]
    found = np.array([whiteness_p_value(np.sum(e**2, axis=-1), e) for e in drawn], float)
    assert np.mean(found < 0.01) < 0.04
    assert np.median(found) > 0.3


def test_innovations_with_a_bias_or_with_gaps_are_tested_too():
    e, P = autoregressive(800, 0.0)
    assert jaxslam.evaluate(e + 0.5, P, quantity="NIS").verdict["white"] < 1e-6
    always = jaxslam.evaluate(e * [1, 0], P, quantity="NIS")
    assert always.axis_verdict(1)["white"] is None
    e[0, 100:300] = np.nan
    P = np.where(np.isnan(e)[..., None], np.nan, P)
    found = jaxslam.evaluate(e, P, quantity="NIS").verdict
    assert (found["samples"], found["word"]) == ("steps", "consistent")
    assert found["nees"] == pytest.approx(np.nansum(e**2) / 600)


def test_a_step_of_an_innovation_is_outlying_and_nothing_is_lost():
    e, P = autoregressive(800, 0.0)
    e[0, 400] = 9.0
    found = jaxslam.evaluate(e, P, quantity="NIS")
    assert found.verdict["lost_runs"] == [0]
    assert "the only run has an outlying NIS" in str(found)
    assert "lost" not in str(found)
    e[0, 400] = 1e300
    found = jaxslam.evaluate(e, P * 1e-100, quantity="NIS")
    assert found.verdict["word"] == "outlying"
    assert "lost" not in str(found)


def test_one_run_shows_that_sigma_is_too_small_by_all_its_steps():
    """Of all axes, of each of them, and where NEES alone is known."""
    e, P = autoregressive(2000, 0.9)
    root = np.array([[2.0, 0.0], [3.0, 0.5]])
    found = jaxslam.evaluate(2 * e @ root.T, P @ (root @ root.T))
    assert found.whitened is not None
    np.testing.assert_allclose(found.whitened, 2 * e, rtol=1e-9)
    alone = evaluate_nees(found.nees, 2)
    for verdict in (found.verdict, found.axis_verdict(0), found.axis_verdict(1), alone.verdict):
        assert (verdict["word"], verdict["samples"]) == ("over-confident", "effective")
        low, high = verdict["interval99"]
        assert 1 < low < 2 < high < 3
    assert jaxslam.evaluate(e, P).verdict["word"] == "cannot tell"


# --- what is known exactly, lost, or not logged ---------------------------------------------------


def test_steps_that_are_known_by_definition_are_left_out():
    e, P = drawn()
    e[:, 0], P[:, 0] = 0, 0
    found = jaxslam.evaluate(e, P, times=np.arange(7) / 10)
    assert found.steps == 6
    assert found.times[0] == 0.1
    assert "the first step is known exactly" in str(found)
    np.testing.assert_array_equal(found.nees, jaxslam.evaluate(e[:, 1:], P[:, 1:]).nees)
    # The beginning of one run may be later than the others'.
    e[3, 0], P[3, 0], e[3, 1], P[3, 1] = np.nan, np.nan, 0, 0
    later = jaxslam.evaluate(e, P)
    assert (later.steps, later.runs_of_step[0]) == (6, 59)
    assert "at the beginning of runs 60 steps are known exactly, and left out" in str(later)


def test_lost_runs_are_named_and_columns_of_the_table_never_run_together():
    e, P = drawn(runs=40)
    assert "lost:" not in str(jaxslam.evaluate(e, P))
    e[[3, 17], 5] *= 30
    found = jaxslam.evaluate(e, P)
    assert found.lost_runs == found.asdict()["lost_runs"] == ["run 3", "run 17"]
    assert "lost: run 3, run 17" in str(found).splitlines()
    name = "an axis of so long a name"
    told = str(jaxslam.evaluate(e * [1.5e8, 1, 1], P, names=[name, *"bc"]))
    assert "and 20 more" in told
    (row,) = (line for line in told.splitlines() if line.startswith(name))
    cells = re.split(" {2,}", row)
    assert [len(cells), cells[0], cells[4][0], cells[4][-1]] == [6, name, "[", "]"]
    e[2] = 1e300
    diverged = jaxslam.evaluate(e, P * 1e-100)
    assert (diverged.verdict["word"], as_json(diverged)["verdict"]["diverged"]) == ("lost", 1)


def test_the_end_of_an_interval_that_says_nothing_is_no_number():
    """Of one run whose error is one number."""
    found = jaxslam.evaluate(np.full((1, 30, 1), 3.0), np.ones((1, 30, 1, 1)))
    assert found.axis_verdict(0)["interval99"][1] > 1000
    assert "[0.905, > 1000]" in str(found)


def test_runs_with_gaps_and_of_unlike_length_are_averaged_over_what_they_have(tmp_path):
    e, P = drawn(factor=1.2)
    e[2, 4:], P[2, 4:], e[5, 1:3], P[5, 1:3] = (np.nan,) * 4
    found = jaxslam.evaluate(e, P)
    there = ~np.isnan(e).any(axis=-1)
    nees = np.einsum("rki,rkij,rkj->rk", e, np.linalg.pinv(np.nan_to_num(P)), e)
    averages = [row[own].mean() for row, own in zip(nees, there, strict=True)]
    assert found.verdict["nees"] == pytest.approx(np.mean(averages), rel=1e-9)
    assert found.verdict["diverged"] == 0
    np.testing.assert_allclose(found.mean, np.nanmean(nees, axis=0), rtol=1e-9)
    np.testing.assert_allclose(found.rmse, np.sqrt(np.nanmean(e**2, axis=0)), rtol=1e-12)
    np.testing.assert_array_equal(found.runs_of_step, [60, 59, 59, 60, 59, 59, 59])
    for step, count in enumerate(found.runs_of_step):
        np.testing.assert_array_equal(found.band95_of_step[step], jaxslam.mean_band(3, int(count)))
    sigma = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    outside = (abs(e) > 3 * sigma)[there].mean(axis=0)
    np.testing.assert_allclose(found.outside3sigma, outside, rtol=1e-12)
    assert "5 of 420 steps are not compared (run 2: 3, run 5: 2)" in str(found)
    written = as_json(found)
    assert written["runs_of_step"] == found.runs_of_step.tolist()
    assert any("not compared" in note for note in written["notes"])
    plot_evaluation(found)
    runs, steps = np.indices(there.shape)  # in a table, whose runs have numbers of their own
    rows = np.dstack([3 * runs, steps, e, P[..., *np.triu_indices(3)]])[there]
    np.savetxt(tmp_path / "log.csv", rows[::-1], delimiter=",")
    of_table = jaxslam.evaluate_log(tmp_path / "log.csv")
    np.testing.assert_allclose(of_table.nees, found.nees, rtol=1e-12)
    assert "5 of 420 steps are not compared (run 6: 3, run 15: 2)" in str(of_table)


# --- the command and the figures ------------------------------------------------------------------


def test_the_command_writes_what_others_read(tmp_path, capsys):
    e, P = drawn(factor=1.4)
    np.savez(tmp_path / "runs.npz", errors=e, covariances=P, names=["x", "y", "θ"])
    main(["evaluate", str(tmp_path / "runs.npz"), "--out", str(tmp_path / "out")])
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert written.keys() >= KEYS
    assert written["schema"] == 1
    assert written["verdict"]["word"] == "over-confident"
    assert len(written["nees"]) == written["steps"] == 7
    assert set(written["outside3sigma"]) == {"x", "y", "θ"}
    assert len(written["rmse"]["θ"]) == len(written["sigma"]["x"]) == 7
    assert written["convention"] is None
    assert written["suggested"] is None
    assert (tmp_path / "out" / "evaluation.png").read_bytes().startswith(b"\x89PNG")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"evaluation.json", "evaluation.png"}
    out = capsys.readouterr().out
    assert out.startswith("NEES ")
    assert "over-confident" in out


def test_every_option_of_the_command_is_one_of_the_evaluation(tmp_path, monkeypatch, capsys):
    """And what is stated comes before what a file says, which the evaluation sees to."""
    given: dict[str, Any] = {
        "covariance": Path("c.txt"), "truth": "t.txt", "estimate": "/odom", "align": "sim3",
        "axes_used": "x,rz", "truth_sigma": (0.05, 1.0), "innovations": Path("i.npz"),
        "time_offset": 0.02, "against": Path("b.csv"),
    }  # fmt: skip
    stated = {"error": "left", "axes": "body", "order": "rotation-first", "scale": "given"}
    asked = {}

    def noted(source, **options):
        asked.update(options, source=source)
        return jaxslam.evaluate(*drawn(runs=2))

    monkeypatch.setattr("jaxslam.cli.evaluate.evaluate_log", noted)
    words = ["evaluate", "log", "--nis", "--out", str(tmp_path)]
    for name, value in (given | stated).items():
        values = value if isinstance(value, tuple) else [value]
        words += [f"--{name.replace('_', '-')}", *map(str, values)]
    main(words)
    assert asked == {**given, "source": Path("log"), "stated": stated, "nis": True}
    main(["evaluate", "log", "--out", str(tmp_path)])
    assert (asked["stated"], asked["nis"], asked["align"]) == ({}, False, "none")
    assert "wrote" in capsys.readouterr().out


def test_an_evaluation_shows_and_draws_itself(tmp_path):
    found = jaxslam.evaluate(*drawn(), names=("<", "b", "c"))
    assert repr(found) == str(found)
    assert len(repr(found).splitlines()) < 12
    shown = found._repr_html_()
    assert "<td>&lt;</td>" in shown
    assert shown.count("<tr>") == shown.count("</tr>") == 5
    assert found.to_dict() == found.asdict()
    assert found.verdict.word == found.verdict["word"]
    assert found.verdict.end.p == found.verdict["end"]["p"]
    with pytest.raises(AttributeError, match="has no 'wrod'; known: nees"):
        found.verdict.wrod  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'plott' \(did you mean plot\?\)"):
        found.plott  # noqa: B018
    figure = found.plot(tmp_path / "figure.png", column=True)
    assert figure.get_figwidth() == 3.4
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    many = plot_evaluation(jaxslam.evaluate(*drawn(n=14)))
    assert len(many.axes) == 2 + 12
    assert many.get_suptitle().startswith("NEES ")
    axes = new_figure(4, 3).subplots(1, 3)
    for place, label in enumerate(("mine", "theirs")):
        for ax, plot in zip(axes[:2], (plot_nees, partial(plot_axis, axis=1)), strict=True):
            assert plot(found, ax=ax, label=label, place=place) is ax
        plot_outside(found, ax=axes[2], label=label)
    assert [text.get_text().strip() for text in axes[1].texts] == ["mine", "theirs"]
