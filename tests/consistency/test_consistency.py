"""Tests of jaxslam.consistency: exact bands, chunking, divergence, resuming, the summary."""

import threading
import time
from collections import Counter
from collections.abc import Generator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FourFunctions
from scipy.special import gammainc
from scipy.stats import chi2, norm

import jaxslam
from jaxslam._runtime import programs
from jaxslam.consistency import (
    FolderStore,
    MemoryStore,
    backends,
    check_sizes,
    draw,
    filter_run,
    montecarlo,
    simulator,
    summary,
    tally,
)  # fmt: skip
from jaxslam.consistency.simulator import Simulator
from jaxslam.consistency.store import NATIVE
from jaxslam.consistency.sums import added
from jaxslam.filters.words import scenario_pieces
from jaxslam.native.build import compiler
from jaxslam.plots.consistency import plot_consistency, plot_outside
from jaxslam.plots.style import new_figure
from jaxslam.simulation import Room
from jaxslam.statistics import lost_threshold, run_verdict, sentences
from jaxslam.statistics.bands import chi2_quantile, normalised_squared
from jaxslam.statistics.beyond_scale import one_scale_of

SCENARIO = jaxslam.scenario("matched-tight", steps=6, landmarks=5)
NAME = "robocentric/inverse_scaling"
CHUNK = 2
"""Of most tests: studies whose chunks are of one size share their compiled programs."""


def monte_carlo(runs, chunk=CHUNK, filters="robocentric", **more):
    return jaxslam.monte_carlo(SCENARIO, filters, runs=runs, chunk=chunk, **more)


def all_runs(study, name=NAME):
    parts = [study.store.load(name, chunk) for chunk in study.chunks]
    keys = [key for key in parts[0] if not key.startswith("sample_")]
    return {key: np.concatenate([part[key] for part in parts]) for key in keys}


@pytest.fixture(scope="module")
def study():
    """Twenty runs, three chunks at a time; tests change copies of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(montecarlo, "processors", lambda: 3)
        return monte_carlo(20)


def with_records(study, runs, steps, **values):
    """The study with other records of a run, or of some, at some steps."""
    store, chosen = MemoryStore(), np.arange(study.runs)[runs]
    for chunk in study.chunks:
        records = study.store.load(NAME, chunk)
        records = {name: record.copy() for name, record in records.items()}
        for name, value in values.items():
            for run in set(np.ravel(chosen)) & set(chunk):
                records[name][run - chunk.start, steps] = value
        store.save(NAME, chunk, records)
    return replace(study, store=store)


def of_filter(study):
    return jaxslam.summarise(study)["filters"][NAME]


def test_bands_are_the_published_ones_and_quantiles_those_of_scipy():
    for dof, runs, low, high in (
        (3, 25, 2.118, 4.034),
        (3, 5000, 2.932, 3.068),
        (6, 25, 4.719, 7.432),
    ):
        assert jaxslam.mean_band(dof, runs) == pytest.approx((low, high), abs=6e-4)
    for dof in (1, 3, 6, 3000):
        for q in (0.0001, 0.5, 0.9999):
            assert chi2_quantile(q, dof) == pytest.approx(chi2.ppf(q, dof), rel=1e-9)
            assert gammainc(dof / 2, chi2_quantile(q, dof) / 2) == pytest.approx(q, rel=1e-9)
    assert lost_threshold(3) == pytest.approx(21.1, abs=0.02)


def test_the_normalised_square_is_the_mahalanobis_distance_and_nan_if_there_is_none():
    A = np.random.default_rng(0).normal(size=(4, 4))
    P, e = A @ A.T, np.arange(4.0)
    assert normalised_squared(e, P) == pytest.approx(e @ np.linalg.solve(P, e), rel=1e-9)
    assert np.isnan(normalised_squared(e, -P))


# --- chunks, threads and resuming ----------------------------------------------------------------


def test_chunks_in_threads_are_those_one_after_another(study, monkeypatch):
    monkeypatch.setattr(montecarlo, "processors", lambda: 1)
    for key, values in all_runs(monte_carlo(20)).items():
        np.testing.assert_array_equal(values, all_runs(study)[key], err_msg=key)


def test_runs_are_drawn_once_for_all_filters_where_they_are_few(monkeypatch):
    drawn = Simulator(SCENARIO, 0, "float64", 7)
    first = drawn(range(7))
    assert drawn(range(7)) is first
    monkeypatch.setattr(simulator, "DRAWN", 0)
    again = Simulator(SCENARIO, 0, "float64", 7)
    assert again(range(7)) is not again(range(7))
    assert drawn(range(7, 14)) is not drawn(range(7, 14))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["xla", "native"])
def test_of_the_last_chunk_only_what_is_wanted_is_computed(backend, study, monkeypatch):
    """Three at a time by XLA, as soon as one of them is wanted; as many as are wanted natively.
    Only here a batch is computed in parts that fit the cache."""
    if backend == "native" and compiler() is None:
        pytest.skip("no C++ compiler")
    all_seven = Simulator(SCENARIO, 0, "float64", 7)
    room, batch = draw(SCENARIO, 7)
    n = 6 + 3 * room.landmarks
    monkeypatch.setattr(backends, "CACHE", 3 * 8 * n**2)
    assert backends._runs_in_cache(room, batch) == 3
    programs.forget()
    slam = montecarlo._as_filters(SCENARIO, "robocentric")[NAME]
    program = montecarlo.ChunkTask("", slam, all_seven, room, backend).program(batch)
    (all_of_them, sample), (some, same) = (program(np.int32(n)) for n in (7, 2))
    programs.forget()
    wanted = all_runs(study)
    for key, values in all_of_them.items():
        np.testing.assert_array_equal(some[key][:2], values[:2], err_msg=key)
        np.testing.assert_allclose(values, wanted[key][:7], rtol=1e-6, atol=1e-12, err_msg=key)
    jax.tree.map(np.testing.assert_array_equal, sample, same)
    assert len(some["nees"]) == {"xla": 7, "native": 2}[backend]
    assert np.all(some["nees"][3:] == 0)


def without(summary, *gone):
    """A summary without what is named so, at any depth."""
    if not isinstance(summary, dict):
        return summary
    return {key: without(value, *gone) for key, value in summary.items() if key not in gone}


@pytest.mark.slow
def test_a_reduced_study_says_the_same_but_for_its_medians(tmp_path):
    """One run diverges, others are lost: all that is counted has something to count. No quick test
    adds up sums of chunks in place of their records."""
    spoilt = jaxslam.scenario("matched-loose", steps=6)
    name, six = "robocentric/cartesian", dict[str, Any](runs=40, chunk=6)
    whole = jaxslam.monte_carlo(spoilt, name, **six)
    store = FolderStore(tmp_path, {"reduced": True}, resume=False)
    reduced = jaxslam.monte_carlo(spoilt, name, **six, store=store, reduced=True)
    kept = "nees_median", "error_median", "sigma_median", "medians_of", "seconds", "lost_runs"
    found, wanted = (jaxslam.summarise(study) for study in (reduced, whole))
    assert without(found, *kept) == without(wanted, *kept)
    assert (found["medians_of"], wanted["medians_of"]) == (6, 40)
    first = jaxslam.summarise(jaxslam.monte_carlo(spoilt, name, runs=6, chunk=6))
    assert found["filters"][name]["nees_median"] == first["filters"][name]["nees_median"]
    assert tally(reduced, name) == tally(whole, name)
    titles = "".join(axes.get_title() for axes in plot_consistency(reduced, found).axes)
    assert titles.count("median of the first 6 runs") == 2
    kept = store.load(name, reduced.chunks[1])
    assert not kept.pop(NATIVE)
    assert all(name.startswith("sum_") for name in kept)
    with pytest.raises(ValueError, match=r"another reduced \(True, now False\)"):
        jaxslam.monte_carlo(spoilt, name, **six, store=store)


def test_sums_of_something_else_and_records_with_an_axis_too_many_are_refused():
    with pytest.raises(ValueError, match="other sums: nees"):
        added([{"nees": 1, "nis": 2}, {"nis": 3}])
    study = monte_carlo(2)
    (chunk,) = study.chunks
    records = study.store.load(NAME, chunk)
    study.store.save(NAME, chunk, {**records, "nis": records["nis"][..., None]})
    with pytest.raises(ValueError, match=f"{NAME}, runs 0 to 1: the record nis is damaged"):
        jaxslam.summarise(study)


def test_no_chunk_begins_after_an_error(monkeypatch):
    began, told = [], []

    def computed(chunk):
        began.append(chunk.start)
        if chunk.start == 2:
            raise ValueError("chunk 2")
        time.sleep(0.01)
        return chunk.stop

    monkeypatch.setattr(montecarlo, "processors", lambda: 1)
    chunks = [range(i, i + 1) for i in range(99)]
    with pytest.raises(ValueError, match="chunk 2"):
        told.extend((chunk.start, stop) for chunk, stop in montecarlo.in_threads(computed, chunks))
    assert told == [(0, 1), (1, 2)]
    assert len(began) < 99


def test_an_interruption_waits_for_no_chunk(monkeypatch):
    """Nor for a compiler, which runs as one: neither hears it."""
    let_go = threading.Event()
    monkeypatch.setattr(montecarlo, "processors", lambda: 2)
    found = montecarlo.in_threads(lambda c: c.start and let_go.wait(60), [range(2), range(2, 4)])
    assert next(found)[0] == range(2)
    assert isinstance(found, Generator)
    with pytest.raises(KeyboardInterrupt):
        found.throw(KeyboardInterrupt)  # as of one who waits for the next
    assert not let_go.is_set()
    let_go.set()


def test_an_interrupted_study_says_what_is_kept_and_goes_on_from_there(
    study, tmp_path, monkeypatch
):
    store = FolderStore(tmp_path)
    save = store.save

    def interrupted(name, chunk, records):
        if chunk.start:
            raise KeyboardInterrupt
        save(name, chunk, records)

    monkeypatch.setattr(montecarlo, "processors", lambda: 1)
    monkeypatch.setattr(store, "save", interrupted)
    with pytest.raises(KeyboardInterrupt, match=r"2 of 6 runs are kept in .*; the same study with"):
        monte_carlo(6, store=store, progress=True)
    store, done = FolderStore(tmp_path, resume=True), []
    again = monte_carlo(6, None, store=store, progress=lambda *told: done.append(told[1]))
    assert [len(chunk) for chunk in again.chunks] == [2] * 3  # those of the store
    assert done == [0, 0, 2, 2]  # compiled from here, to here, and run
    np.testing.assert_array_equal(all_runs(again)["nees"], all_runs(study)["nees"][:6])


@pytest.mark.slow
def test_filters_meet_the_same_worlds():
    """Where two programs draw: no quick study has two filters."""
    study = monte_carlo(CHUNK, filters=["robocentric", "robocentric/inverse_depth"])
    samples = [study.store.load(name, study.chunks[0]) for name in study.filters]
    for key in ("sample_true_path", "sample_points"):
        # Drawn by one program, but made matrices by two.
        np.testing.assert_allclose(samples[0][key], samples[1][key], rtol=0, atol=1e-13)
    assert not np.array_equal(samples[0]["nees"], samples[1]["nees"])


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((0, 0, "float64", 5), "runs must be at least 1, not 0"),
        ((4, 0, "float64", 0), "chunk must be at least 1"),
        ((4, -1, "float64", 5), "seed must not be negative"),
        ((4, 0, "float16", 5), r"unknown dtype 'float16' .*; known: float64, float32"),
        (("10", 0, "float64", 5), "must be a whole number, not"),
        ((2.5, 0, "float64", 5), "must be a whole number, not"),
        ((10, None, "float64", 5), "must be a whole number, not"),
        ((10, 0, "float64", 5.0), "must be a whole number, not"),
    ],
)
def test_sizes_that_make_no_sense_are_refused(sizes, message):
    with pytest.raises(ValueError, match=message):
        check_sizes(*sizes)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({1: "world"}, "the name of a filter is a word, not 1"),
        ({"": "world"}, "the name of a filter is a word, not ''"),
        ({"a": "world"}, "a is no AbstractFilter but str"),
        ({"a": jaxslam.Slam}, "a is no AbstractFilter but the class Slam; an instance is accepted"),
        ({}, "no filters by name"),
        *((x, "a dict is accepted, .* or a list of words") for x in ([], None, 3, [SCENARIO])),
    ],
)
def test_filters_that_are_none_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        jaxslam.monte_carlo("matched", given, runs=2)


# --- the summary ---------------------------------------------------------------------------------


def test_a_diverged_run_is_counted_and_spoils_no_other(study):
    before = of_filter(study)
    spoilt = with_records(study, 4, slice(3, None), nees=np.nan)
    summary = jaxslam.summarise(spoilt)
    after = summary["filters"][NAME]
    good = np.delete(all_runs(study)["nees"], 4, axis=0)
    assert (before["diverged"], after["diverged"]) == (0, 1)
    np.testing.assert_allclose(after["nees"], good.mean(axis=0))
    assert after["band95"] == list(jaxslam.mean_band(3, 19))
    assert (before["survivors"], after["survivors"]) == (20, 19)
    for key in ("lost", "lost_ever"):
        assert after[key][-1] == pytest.approx(before[key][-1] + 1 / 20)
    # It is not dropped from the verdict: of twenty runs there is no mean.
    assert after["verdict"]["word"] == "lost"
    assert after["verdict"]["nees"] is None
    table = jaxslam.table(summary)
    assert "1 of 20 runs diverged, no mean NEES: lost" in table
    assert "means and band are of the 19 runs that did not diverge" in table


def test_a_run_that_comes_back_was_lost_ever(study):
    # A step of so many is above the quantile of one step more often: 22 loses no run.
    for steps, value in ((slice(None), 1.0), (1, 22.0)):
        study = with_records(study, slice(None), steps, nees=value)
    study = with_records(with_records(study, 1, 2, nees=30.0), 3, [2, 4], nees=25.0)
    result = of_filter(study)
    assert result["lost"] == [0, 1, 0.1, 0, 0.05, 0]
    assert result["lost_ever"] == [0, 0, 0.1, 0.1, 0.1, 0.1]
    assert (result["verdict"]["lost"], result["verdict"]["lost_runs"]) == (0.1, [1, 3])


class OneLandmarkUnknown(jaxslam.Slam):
    """A filter that has no covariance for slot 0."""

    def landmark_marginal(self, state, function, slots):
        value, covariance = super().landmark_marginal(state, function, slots)
        return value, jnp.where((slots == 0)[:, None, None], jnp.nan, covariance)


def test_a_landmark_without_a_finite_nees_is_counted_and_spoils_no_other(study):
    spoilt = monte_carlo(3, filters={NAME: OneLandmarkUnknown(**scenario_pieces(SCENARIO))})
    summary, runs, whole = jaxslam.summarise(spoilt), all_runs(spoilt), all_runs(study)
    found = summary["filters"][NAME]
    assert of_filter(study)["landmark_not_finite"] == [0] * 6
    np.testing.assert_array_equal(runs["landmark_not_finite"], 1)  # slot 0 is always in view
    assert found["landmark_not_finite"] == [3] * 6
    four = runs["landmark_nees"] * (runs["landmark_count"] - 1)
    assert (four < (whole["landmark_nees"] * whole["landmark_count"])[:3]).all()
    np.testing.assert_allclose(
        found["landmark_nees"], four.sum(0) / (runs["landmark_count"] - 1).sum(0)
    )
    assert f"{NAME}: 18 NEES of landmarks are not finite" in jaxslam.table(summary)
    assert "not finite" not in jaxslam.table(study)


def test_the_summary_is_that_of_the_runs(study):
    summary = jaxslam.summarise(study)
    result, runs = summary["filters"][NAME], all_runs(study)
    np.testing.assert_allclose(result["nees"], runs["nees"].mean(axis=0))
    np.testing.assert_allclose(result["nees_median"], np.median(runs["nees"], axis=0))
    np.testing.assert_allclose(
        result["rmse"]["position"], np.sqrt((runs["error"][..., :2] ** 2).sum(-1).mean(0))
    )
    np.testing.assert_allclose(
        result["sigma"]["orientation"], np.sqrt(runs["variance"][..., 2].mean(0))
    )
    low, high = jaxslam.mean_band(3, 20)
    inside = [low <= value <= high for value in result["nees"]]
    assert result["inside"] == pytest.approx(np.mean(inside))
    assert summary["steps"] == len(result["nees"]) == len(summary["time"]) == 6
    expected = run_verdict(runs["nees"], 3)
    assert result["verdict"]["interval99"] == pytest.approx(expected["interval99"])
    assert result["verdict"]["end"]["p"] == pytest.approx(expected["end"]["p"])
    assert tally(study, NAME).average.mean == pytest.approx(runs["nees"].mean())


def test_a_summary_reads_every_chunk_once_for_sums_and_once_for_so_many_steps(study, monkeypatch):
    load, read = study.store.load, []

    def counted(name, chunk, names=None):
        read.append((name, chunk))
        return load(name, chunk, names)

    monkeypatch.setattr(study.store, "load", counted)
    whole = jaxslam.summarise(replace(study))  # without what it has found
    assert Counter(read) == {(n, chunk): 2 for n in study.filters for chunk in study.chunks}
    monkeypatch.setattr(summary, "_VALUES_AT_ONCE", 20 * 4)  # of the six steps, four and two
    read.clear()
    assert jaxslam.summarise(replace(study)) == whole
    assert set(Counter(read).values()) == {3}


def test_the_summary_beyond_scale_is_that_of_the_runs(study):
    study = with_records(study, 7, 3, beyond_scale=50.0, log_scale=-2.0, reversed=1.0)
    study = with_records(study, 4, 5, unit_fixed=0.0)
    study = with_records(study, slice(1, None), 0, reversed=np.nan)  # only what moved is reversed
    study = with_records(study, 0, 0, reversed=1.0)
    study = with_records(study, slice(None), 1, reversed=np.nan)
    result, runs = of_filter(study), all_runs(study)
    beyond, scale, drift = (result[k] for k in ("beyond_scale", "log_scale", "scale_drift"))
    one = one_scale_of(runs)
    assert beyond["dof"] == 3
    assert beyond["band95"] == [jaxslam.mean_band(2, 20)[0], jaxslam.mean_band(3, 20)[1]]
    np.testing.assert_allclose(beyond["nees"], one.nees.mean(axis=0))
    np.testing.assert_allclose(beyond["nees_median"], np.median(one.nees, axis=0))
    assert beyond["lost"] == [0, 0, 0, 0.05, 0, 0]  # 50 is beyond what χ² with 3 dof reaches
    expected = run_verdict(one.nees, 3, fitted=1.0)
    assert beyond["verdict"]["nees"] == pytest.approx(expected["nees"])
    assert drift["runs"] == [20] * 5 + [19]
    np.testing.assert_allclose(drift["normalised_rms"], np.sqrt(np.nanmean(one.normalised, axis=0)))
    np.testing.assert_allclose(drift["rms"], np.sqrt(np.nanmean(one.drift**2, axis=0)))
    expected = run_verdict(one.normalised, 1, fitted=1.0, logged=np.isfinite(one.normalised))
    assert drift["verdict"]["nees"] == pytest.approx(expected["nees"])
    error, sigma = runs["log_scale"], runs["log_scale_sigma"]
    for key, values in (
        ("error_rms", error), ("sigma", sigma), ("normalised_rms", error / sigma)
    ):  # fmt: skip
        np.testing.assert_allclose(scale[key], np.sqrt(np.mean(values**2, axis=0)))
    np.testing.assert_allclose(scale["error_median"], np.median(np.abs(error), axis=0))
    np.testing.assert_allclose(scale["sigma_median"], np.median(sigma, axis=0))
    assert result["reversed"] == [1.0, None, 0, 0.05, 0, 0]


# --- tables and figures --------------------------------------------------------------------------


def test_scale_is_reported_where_nothing_is_told_in_metres(study):
    assert SCENARIO.scale_free
    assert not jaxslam.scenario("positions").scale_free
    assert not jaxslam.scenario("room").scale_free
    summary = jaxslam.summarise(study)
    measured, result = {**summary, "scale_free": False}, summary["filters"][NAME]
    panels = {axes.get_title(): axes for axes in plot_consistency(study, summary).axes}
    fewer = {axes.get_title() for axes in plot_consistency(study, measured).axes}
    more = {title.split(":")[0].split(";")[0]: title for title in panels.keys() - fewer}
    assert more.keys() == {"NEES at one scale a run", "scale"}
    lines = panels[more["scale"]].lines[:2]
    error, ideal = (np.asarray(line.get_ydata()) for line in lines)
    np.testing.assert_array_equal(error, result["log_scale"]["error_median"])
    np.testing.assert_allclose(
        ideal, norm.ppf(0.75) * np.array(result["log_scale"]["sigma_median"]), rtol=1e-4
    )
    below = jaxslam.table(summary).split("at one scale a run")[1].splitlines()
    row = next(line for line in below if line.startswith(NAME))
    for value in (result["beyond_scale"]["nees"][-1], result["log_scale"]["error_rms"][-1]):
        assert f" {value:.3f}" in row
    assert "at one scale a run" not in jaxslam.table(measured)


def test_table_and_figure_begin_with_the_verdicts_and_show_what_was_lost(study):
    study = with_records(study, slice(None), slice(None), nees=3.0)
    study = with_records(study, 7, slice(4, None), nees=400.0)
    summary = jaxslam.summarise(study)
    result = summary["filters"][NAME]
    said = sentences(result["verdict"])[0]
    title, verdict, _, others, _, header, row, *_ = jaxslam.table(summary).splitlines()
    assert (title, verdict.strip()) == (f"{NAME}:", said)
    assert others.strip().startswith("1 of 20 runs was lost (run 7), the 19 never lost: NEES")
    assert header.split()[:3] == ["filter/landmarks", "NEES", "mean"]
    assert result["nees"][-1] == pytest.approx((19 * 3 + 400) / 20)
    assert f"{result['nees'][-1]:.3f}" in row
    assert f"{result['nees_not_lost'][-1]:.3f}" in row
    assert row.count("5.0%") == 2
    figure = plot_consistency(study, summary)
    told, world = figure.get_suptitle().splitlines()
    assert told == f"{NAME}: {said}; 5.0% of the runs lost"
    assert world.startswith(SCENARIO.name)
    for axes in figure.axes[:4]:
        assert [text.get_text() for text in axes.texts] == [NAME]


def test_the_share_outside_three_sigma_is_counted_and_drawn(study):
    whole = slice(None)
    study = with_records(study, whole, whole, error=0.0, variance=1.0)
    # Of a quarter of the runs, on one of two axes of the position.
    study = with_records(study, slice(5), 2, error=[3.01, 0, 0])
    study = with_records(study, whole, 3, error=[0, 0, -2.99])
    study = with_records(study, slice(2), 4, error=[0, 0, -40.0])
    summary = jaxslam.summarise(study)
    outside = summary["filters"][NAME]["outside3sigma"]
    assert outside["position"] == [0, 0, 5 / 40, 0, 0, 0]
    assert outside["orientation"] == [0, 0, 0, 0, 2 / 20, 0]
    axes = plot_outside(summary, ax=new_figure(3, 3).subplots(), label={NAME: "IS"})
    drawn = [np.asarray(line.get_ydata()) for line in axes.lines[:2]]
    np.testing.assert_allclose(drawn[0], 100 * np.array(outside["position"]))
    np.testing.assert_allclose(drawn[1], 100 * np.array(outside["orientation"]))
    assert [text.get_text() for text in axes.texts] == ["IS"]


def test_a_filter_that_cannot_remove_landmarks_cannot_use_slots_again():
    scenario = jaxslam.scenario("handheld", steps=2, landmarks=3)
    slam = FourFunctions(jaxslam.make_filter("world", **scenario_pieces(scenario)))
    run = jax.eval_shape(partial(jaxslam.simulate, scenario), jax.random.key(0))
    with pytest.raises(ValueError, match=r"FourFunctions has no remove\(state, gone\)"):
        jax.eval_shape(partial(filter_run, slam, Room(3, 3, 3, 3), scenario.sensor), run)


def test_no_frame_has_room_for_more_features_than_there_are_landmarks():
    room, _ = draw(jaxslam.scenario("matched-6dof", steps=1), 2)
    assert room == Room(landmarks=32, first=30, known=30, new=1)
