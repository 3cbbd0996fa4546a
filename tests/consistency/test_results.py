"""Tests of what a study is to its user: names, typed results, JSON, files, tables and figures."""

import json
import math
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxslam
from jaxslam.consistency import FolderStore, MemoryStore, Results, Seconds, Study, montecarlo
from jaxslam.consistency.montecarlo import Interruption
from jaxslam.plots.consistency import plot_beyond_scale, plot_nees
from jaxslam.plots.style import new_figure
from jaxslam.statistics import Verdict, sentences

STEPS, RUNS = 6, 30
WORLD = jaxslam.scenario("matched", steps=STEPS)
PAPER = "robocentric/inverse_scaling"
BEST = "recommended/inverse_scaling"


def records(nees, seed):
    """Records with that NEES, as a filter of three degrees of freedom has them."""
    rng, one = np.random.default_rng(seed), np.ones_like(nees)
    path = np.tile(np.eye(3), (STEPS + 1, 1, 1))
    path[:, 0, 2] = np.arange(STEPS + 1)
    return {
        "nees": nees, "beyond_scale": 0.8 * nees, "unit_log_scale": 0 * one, "unit_fixed": one,
        "unit_log_scale_sigma": one, "log_scale": 0.1 * rng.normal(size=one.shape),
        "log_scale_sigma": 0.1 * one, "reversed": 0 * one, "nis": nees, "nis_dof": 3 * one,
        "status": np.zeros(nees.shape, int), "error": 0.1 * rng.normal(size=(*nees.shape, 3)),
        "variance": np.full((*nees.shape, 3), 0.01), "landmark_nees": 2 * one,
        "landmark_count": 4 * one, "landmark_not_finite": 0 * one, "sample_native": np.array(False),
        "sample_path": path, "sample_true_path": path, "sample_points": rng.normal(size=(4, 2)) + 9,
        "sample_landmarks": np.tile([0.0, 0.1], (4, 1)), "sample_active": np.ones(4, bool),
        "sample_landmarks_covariance": np.tile(1e-4 * np.eye(2), (4, 1, 1)),
    }  # fmt: skip


def study(factors=(1.0, 1.0), names=(PAPER, BEST), chunk=10):
    """A study whose NEES is so many times that of a consistent filter; NaN to diverge."""
    store, chunks = MemoryStore(), montecarlo.divided(RUNS, chunk)
    for i, (name, factor) in enumerate(zip(names, factors, strict=True)):
        nees = np.random.default_rng(i).chisquare(3, (RUNS, STEPS))
        nees[:, 2:] *= factor
        for part in chunks:
            store.save(name, part, records(nees[part.start : part.stop], part.start))
    return Study(
        WORLD, dict.fromkeys(names), RUNS, 0, "float64", chunks, store,
        dict.fromkeys(names, Seconds(1.0, 2.0)), "cpu", backends=dict.fromkeys(names, "xla"),
    )  # fmt: skip


def test_a_study_is_a_mapping_of_filters_by_names_and_by_parts_of_them():
    found = study()
    assert (list(found), len(found)) == ([PAPER, BEST], 2)
    for given, name in (("robocentric", PAPER), (PAPER, PAPER), ("recommended", BEST)):
        assert found[given] is found[name]
        assert given in found
    with pytest.raises(KeyError, match=r"no filter is called 'robocentic' \(did you mean roboce"):
        found["robocentic"]
    with pytest.raises(
        ValueError, match="several filters are called 'inverse_scaling'; known: rob"
    ):
        found["inverse_scaling"]
    with pytest.raises(AttributeError, match=rf"each filter has one: study\['{PAPER}'\]\.nees"):
        found.nees  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'plott' \(did you mean plot\?\)"):
        found.plott  # noqa: B018
    summary = found.summary()
    assert summary["robocentric"] is summary["filters"][PAPER]
    with pytest.raises(KeyError, match="other keys of a summary: 'schema', 'version'"):
        summary["robocentic"]
    assert max(len(repr(x)) for x in (summary, found["robocentric"])) < 300


def test_json_is_made_of_the_results_and_read_back_to_them():
    found = study((1.0, math.nan))
    told = json.loads(json.dumps(jaxslam.summarise(found), allow_nan=False))
    result, part = found[PAPER], told["filters"][PAPER]
    assert part["nees"] == result.nees.mean.tolist()
    assert part["band95"] == list(result.nees.band)
    assert part["beyond_scale"]["lost"] == result.beyond_scale.lost.tolist()
    assert part["verdict"]["word"] == result.verdict.word
    assert part["seconds"] == {"compile": 1.0, "run": 2.0}
    np.testing.assert_allclose(told["time"], np.arange(1, STEPS + 1) / WORLD.rate, atol=1e-6)
    again = Results.from_json(told)
    assert json.loads(json.dumps(again.to_json())) == told
    assert again[PAPER].verdict.end.p == result.verdict.end.p
    assert jaxslam.table(told) == jaxslam.table(found) == found.table()


def test_a_study_that_is_saved_and_loaded_is_the_same(tmp_path, monkeypatch):
    before, folder = study((1.0, math.nan), chunk=7), tmp_path / "mine"
    assert before.save(folder) == folder
    after = Study.load(folder)
    assert json.dumps(after.summary()) == json.dumps(before.summary())
    assert (after.scenario, after.chunks, after.seconds) == (WORLD, before.chunks, before.seconds)
    np.testing.assert_array_equal(after[BEST].nees.median, before[BEST].nees.median)  # infinite
    for key, record in before.records("robocentric").items():
        np.testing.assert_array_equal(after.records("robocentric")[key], record)
    study((2.0, 2.0)).save(folder)  # over it
    over = Study.load(folder)
    assert over[PAPER].nees.mean[-1] > 1.5 * after[PAPER].nees.mean[-1]
    with monkeypatch.context() as context:
        context.setattr("jaxslam.consistency.summary.write_json", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            before.save(folder)
    assert {path.name for path in tmp_path.iterdir()} == {"mine"}
    assert Study.load(folder)[PAPER].verdict == over[PAPER].verdict
    assert over.save(folder) == folder  # to where it is from
    (folder / "notes.txt").write_text("somebody's")
    with pytest.raises(ValueError, match=r"mine has other files \(notes\.txt\); name a new folder"):
        before.save(folder)
    next((folder / "runs").glob("*/0000010-*.npz")).unlink()
    with pytest.raises(ValueError, match="lacks runs 10 to 19 of "):
        Study.load(folder)
    with pytest.raises(ValueError, match="cannot read the study"):
        Study.load(tmp_path)


def test_a_filter_that_always_diverges_spoils_neither_table_nor_figure(tmp_path):
    lost, found = study((math.nan, 1.0)), study((1.0, 1.0))
    table = lost.table()
    assert f"{PAPER}: every run diverged, so that there is no mean" in table
    rows = [line for line in table.splitlines() if line.startswith(PAPER) and "–" in line]
    assert [row.split()[1:4] for row in rows] == [["–"] * 3] * 2
    assert rows[1].endswith("  lost; –")
    assert lost["robocentric"].verdict.word == "lost"
    for plot in (plot_nees, plot_beyond_scale):
        axes, others = (plot(x, ax=new_figure(4, 3).subplots()) for x in (lost, found))
        assert axes.get_ylim()[1] < 2 * others.get_ylim()[1]
        band, wanted = (x.patches[0].get_extents() for x in (axes, others))
        assert (band.y0, band.y1) == pytest.approx((wanted.y0, wanted.y1), rel=0.2)
    assert study((math.nan, math.nan)).plot(tmp_path / "figure.png", column=True).axes


def test_an_interval_next_to_one_excludes_it_in_words():
    """Two runs show that σ is too small, and not by how much."""
    found = jaxslam.evaluation.evaluate_nees(np.array([[40.0], [900.0], [45.0]]), 3).verdict
    assert found.word == "over-confident"
    assert found.interval99[1] is None
    told = sentences(Verdict(found | {"interval99": [math.nextafter(1, 2), None]}))[0]
    assert "[>1, ∞]: over-confident" in told
    told = sentences(found | {"word": "consistent", "interval99": [0.9, 1.001]})[0]
    assert "[0.90, 1.00]: consistent" in told


def test_a_notebook_shows_html_and_tables_are_made_where_their_libraries_are(monkeypatch):
    found = study(names=("a<b", "c"))
    shown = found._repr_html_()
    assert "<td>a&lt;b</td>" in shown
    assert shown.count("<table>") == shown.count("</table>") == 2
    frame = pytest.importorskip("pandas") and found.to_dataframe()
    assert frame.shape[0] == 2 * STEPS
    last = frame[frame["filter"] == "c"].iloc[-1]
    assert last["rmse_position"] == found["c"].rmse.position[-1]
    fake: Any = SimpleNamespace(Dataset=lambda data, coords: (data, coords))
    monkeypatch.setitem(sys.modules, "xarray", fake)
    data, coords = found.to_xarray()
    assert coords["filter"] == ["a<b", "c"]
    axes, values = data["error"]
    assert dict(zip(axes, values.shape, strict=True)) == {
        "filter": 2, "run": RUNS, "step": STEPS, "axis": 3
    }  # fmt: skip
    for make, library in ((found.to_dataframe, "pandas"), (found.to_xarray, "xarray")):
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(ValueError, match=f"needs {library}: pip install {library}"):
            make()


@pytest.mark.parametrize(
    ("runs", "number", "seconds", "chunk"),
    [(1000, 2, 0.01, 100), (100, 2, 0.01, 12), (100, 1, 0.01, 25), (5, 2, 9, 100),
     (1000, 2, 0.3, 50), (1000, 2, 10, 12)],
)  # fmt: skip
def test_chunks_keep_every_processor_busy_and_a_bar_moving(
    runs, number, seconds, chunk, monkeypatch
):
    monkeypatch.setattr(montecarlo, "processors", lambda: number)
    assert montecarlo._chunk(runs, MemoryStore(), None, seconds) == chunk
    assert montecarlo._chunk(runs, MemoryStore(), None, seconds, reduced=True) == 100
    kept = MemoryStore()
    kept.begin({"chunk": 7}, {})
    assert montecarlo._chunk(runs, kept, None, seconds) == 7


def test_the_time_of_a_step_grows_with_the_state_of_a_filter():
    """Of the five members of a sum, and of one."""
    made = jaxslam.make_filters(WORLD, ["scale_gauge", "scale_gauge+mixture5"], "inverse_scaling")
    one, five = map(montecarlo._step_seconds, made.values())
    assert 1e-5 < 4 * one < five < 12 * one < 1e-2


def test_filters_are_made_of_words():
    made = montecarlo._as_filters(WORLD, ["robocentric", "recommended"])
    assert list(made) == list(montecarlo._as_filters(WORLD, dict(made))) == [PAPER, BEST]
    for word in ("robocentric", PAPER):
        assert list(montecarlo._as_filters(WORLD, word)) == [PAPER]


def test_an_interruption_says_what_is_kept_and_what_to_do(tmp_path):
    """What is kept in a folder is a test of the studies that are interrupted."""
    told = str(Interruption(0, 60, 10, FolderStore(tmp_path)))
    assert told.startswith("no chunk of 10 runs was finished, so that nothing of 60 is kept in /")
    assert told.endswith("with a chunk smaller than 10 the first runs are kept sooner")
    assert "20 of 60 runs were finished, and are not kept" in str(Interruption(20, 60, 10, None))


def test_degrees_of_freedom_and_runs_the_wrong_way_round_are_told():
    for dof, runs in ((300, 3), (101, 100)):
        with pytest.raises(ValueError, match=f"{dof} degrees of freedom and {runs} runs: mean_b"):
            jaxslam.mean_band(dof, runs)
    for dof, runs in ((100, 3), (101, 101)):  # a pose's, and of as many runs as a state has
        low, high = jaxslam.mean_band(dof, runs)
        assert low < dof < high
