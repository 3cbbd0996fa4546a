"""Tests of the phase diagram: verdicts, its file, resuming, its page and its figure."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from cases import quick_jit

import jaxslam
from jaxslam.plots.phase import PhaseCell, plot_phase_diagram
from jaxslam.simulation import as_data, simulate
from jaxslam.statistics import VERDICTS, mean_band, verdict

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import phase_diagram

OPTIONS = phase_diagram.Options(
    accelerations=(0.2, 1.0),
    velocities=(0.1,),
    depths=(3.0,),
    directions=("sideways", "turn"),
    filters=("robocentric",),
    landmarks=("inverse_scaling",),
    runs=4,
    steps=3,
)


# --- the verdict --------------------------------------------------------------------------------


def test_a_mean_is_judged_by_the_band_of_its_runs():
    low, high = mean_band(3, 100)
    for nees, expected in (
        (3.0, "consistent"),
        (low + 1e-6, "consistent"),
        (low - 1e-6, "under-confident"),
        (high - 1e-6, "consistent"),
        (high + 1e-6, "over-confident"),
    ):
        assert verdict(nees, 0.0, dof=3, runs=100) == expected
    # The same mean of more runs is no longer chance.
    assert verdict(3.2, 0.0, dof=3, runs=100) == "consistent"
    assert verdict(3.2, 0.0, dof=3, runs=1000) == "over-confident"


def test_lost_runs_come_first_and_their_bound_is_not_lost_yet():
    assert verdict(3.0, 0.011, dof=3, runs=1000) == "lost"
    assert verdict(3.0, 0.01, dof=3, runs=1000) == "consistent"
    assert verdict(3.0, 0.04, dof=3, runs=1000, lost_bound=0.05) == "consistent"
    for nees in (None, float("nan")):
        assert verdict(nees, 0.0, dof=3, runs=1000) == "lost"
    # The mean of those that did not diverge is no mean of all.
    assert verdict(3.0, 0.001, dof=3, runs=1000, diverged=1) == "lost"


def test_many_comparisons_are_inside_their_band_together():
    """2000 times 50 means of consistent filters: all 50 are inside in 95 % of cases, or more."""
    rng = np.random.default_rng(0)
    means = rng.chisquare(3 * 20, (2000, 50)) / 20
    alone, together = (
        np.array(
            [[verdict(m, 0.0, dof=3, runs=20, comparisons=c) for m in row] for row in means[:n]]
        )
        for c, n in ((1, 200), (50, 2000))
    )
    assert np.mean(alone == "consistent") == pytest.approx(0.95, abs=0.01)
    assert np.mean((alone == "consistent").all(axis=1)) < 0.2
    assert np.mean((together == "consistent").all(axis=1)) == pytest.approx(0.95, abs=0.02)
    assert set(np.unique(together)) <= set(VERDICTS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"comparisons": 0}, "comparisons must be at least 1, not 0"),
        ({"lost": 1.5}, "lost must be a share from 0 to 1, not 1.5"),
        ({"lost": float("nan")}, "lost must be a share from 0 to 1"),
        ({"lost_bound": -0.1}, "lost_bound must be a share from 0 to 1, not -0.1"),
        ({"runs": 0}, "at least one run"),
    ],
)
def test_a_verdict_refuses_numbers_that_make_no_sense(arguments, message):
    numbers: dict[str, Any] = {"nees": 3.0, "lost": 0.0, "dof": 3, "runs": 10, **arguments}
    with pytest.raises(ValueError, match=message):
        verdict(**numbers)


# --- one simulator for all worlds ---------------------------------------------------------------


def structure(scenario):
    """All but its numbers and its name."""
    return jax.tree.structure(as_data(scenario))


@pytest.mark.parametrize("name", ["matched-loose", "circle", "positions"])
def test_a_structure_with_the_numbers_as_data_draws_the_same_runs(name):
    scenario = jaxslam.scenario(name, steps=4)
    key = jax.random.key(3)
    one, program = structure(scenario), []

    def with_data(data, key):
        program.append(1)
        return simulate(data, key)

    drawn = quick_jit(with_data)
    expected = quick_jit(lambda key: simulate(scenario, key))(key)
    for a, b in zip(*map(jax.tree.leaves, (drawn(as_data(scenario), key), expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    noise = {"acceleration_sigma": (0.3, 0.2, 0.1)}
    if scenario.motion == "odometry":
        noise = {"odometry_sigma": (0.3, 0.2, 0.1), "position_sigma": 0.7}
    other = dataclasses.replace(scenario, velocity=(0.5, 0.7, 0.2), **noise)
    assert structure(other) == one
    moved = drawn(as_data(other), key)
    assert not np.allclose(moved.measured, expected.measured)
    assert len(program) == 1
    # What is no number stays: other steps are another structure.
    assert structure(dataclasses.replace(scenario, steps=5)) != one


def test_all_worlds_of_the_grid_share_one_structure():
    grid = [scenario for _, scenario in phase_diagram.worlds(phase_diagram.Options())]
    assert len(grid) == 4 * 3 * 5 * 4
    assert len(set(grid)) == len(grid)
    assert len({structure(scenario) for scenario in grid}) == 1


def test_worlds_from_rest_have_an_axis_of_their_own():
    options = phase_diagram.Options(
        directions=("from-rest", "turn"), accelerations=(1.0,), depths=(3.0,)
    )
    found = list(phase_diagram.worlds(options))
    at_rest = [scenario for name, scenario in found if name == "from-rest"]
    assert [scenario.velocity for scenario in at_rest] == [(0.0, 0.0, 0.0)] * 4
    assert [scenario.velocity_sigma[0] for scenario in at_rest] == [0.05, 0.15, 0.5, 1.5]
    assert [scenario.velocity_sigma[2] for scenario in at_rest] == [0.025, 0.075, 0.25, 0.75]
    assert at_rest[2].acceleration_sigma == (0.5, 0.5, 0.3)
    turning = [scenario for name, scenario in found if name == "turn"]
    assert [scenario.velocity_sigma[0] for scenario in turning] == [0.002, 0.01, 0.05, 0.1]
    assert len({structure(scenario) for _, scenario in found}) == 1


# --- the file -----------------------------------------------------------------------------------


def without_seconds(path):
    rows = phase_diagram.read(path)
    for row in rows:
        assert row.pop("seconds") >= 0
    return rows


def test_an_interrupted_run_goes_on_and_writes_the_same_file(tmp_path, monkeypatch):
    whole, broken = (
        dataclasses.replace(OPTIONS, out=tmp_path / f"{name}.csv", docs=tmp_path / name)
        for name in ("whole", "broken")
    )
    phase_diagram.main(whole)
    expected = without_seconds(whole.out)
    assert len(expected) == 4
    assert len({row["nees"] for row in expected}) == 4

    measured, worlds = [], []
    measure = phase_diagram._measure

    def stops(direction, scenario, *rest):
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(direction)
        return measure(direction, scenario, *rest)

    monkeypatch.setattr(phase_diagram, "_measure", stops)
    with pytest.raises(KeyboardInterrupt):
        phase_diagram.main(broken)
    assert len(phase_diagram.read(broken.out)) == 2

    monkeypatch.setattr(phase_diagram, "_measure", lambda *a: worlds.append(a[0]) or measure(*a))
    phase_diagram.main(broken)
    assert len(worlds) == 2  # only what was missing
    assert without_seconds(broken.out) == expected
    phase_diagram.main(broken)
    assert len(worlds) == 2
    for name in ("phase-diagram.md", "phase-diagram.png"):
        assert (broken.docs / name).stat().st_size > 500
    page = (broken.docs / "phase-diagram.md").read_text()
    assert "4 cells, 4 runs each" in page
    assert "(../broken.csv)" in page


def test_a_cell_is_what_the_library_says_of_its_world(tmp_path):
    options = dataclasses.replace(OPTIONS, directions=("turn",), accelerations=(1.0,))
    ((direction, scenario),) = phase_diagram.worlds(options)
    filters = jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"])
    (row,) = phase_diagram._measure(direction, scenario, filters, options)
    phase_diagram.write([row], tmp_path / "one.csv")
    assert phase_diagram.read(tmp_path / "one.csv") == [row]
    assert (row["velocity_z_m_s"], row["turn_rate_rad_s"]) == (1.2, 0.3)
    assert (row["acceleration_sigma_m_s2"], row["turn_acceleration_sigma_rad_s2"]) == (0.5, 0.3)
    assert (row["velocity_sigma_m_s"], row["turn_rate_sigma_rad_s"]) == (0.01, 0.005)
    study = jaxslam.monte_carlo(scenario, filters, runs=4)
    nees = study.store.load("robocentric/inverse_scaling", range(4))["nees"][:, -1]
    assert row["nees"] == pytest.approx(nees.mean())
    assert row["nees_median"] == pytest.approx(np.median(nees))


def test_other_settings_are_refused(tmp_path):
    rows = synthetic_rows()
    path = tmp_path / "x.csv"
    phase_diagram.write(rows, path)
    for name, value in (("runs", 7), ("seed", 3), ("steps", 9)):
        options = dataclasses.replace(SYNTHETIC, out=path, **{name: value})
        with pytest.raises(ValueError, match=rf"made with {name} .*, now {value}; give another"):
            phase_diagram.main(options)
    assert phase_diagram.read(path) == rows


def test_filters_with_a_window_take_their_own_number_of_runs_one_by_one(tmp_path, monkeypatch):
    asked = {}

    def monte_carlo(scenario, filters, *, runs, seed, chunk):
        (name,) = filters
        asked[name] = runs, chunk
        found = {key: 0 for key in ("dof", "inside", "diverged")}
        curves = {key: [3.0] for key in ("nees", "nees_median", "nees_not_lost", "lost")}
        sizes = {key: {"position": [0.1]} for key in ("rmse", "sigma")}
        each = found | curves | sizes | {"band95": (2.0, 4.0), "seconds": {"run": 1.0}}
        return {"filters": {name: each}}

    monkeypatch.setattr(jaxslam, "monte_carlo", monte_carlo)
    monkeypatch.setattr(jaxslam, "summarise", lambda study: study)
    options = dataclasses.replace(OPTIONS, runs=100, window_runs=7, out=tmp_path / "x.csv")
    filters = {"robocentric/inverse_scaling": None, "mixture5+rest/inverse_scaling": None}
    ((_, scenario), *_) = phase_diagram.worlds(options)
    rows = phase_diagram._measure("sideways", scenario, filters, options)
    assert asked == {
        "robocentric/inverse_scaling": (100, phase_diagram.CHUNK),
        "mixture5+rest/inverse_scaling": (7, 1),
    }
    assert [row["runs"] for row in rows] == [100, 7]
    phase_diagram.check_same(rows, options)
    with pytest.raises(ValueError, match=r"made with runs 7, now 8; give another"):
        phase_diagram.check_same(rows, dataclasses.replace(options, window_runs=8))


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="has other columns than a phase diagram"):
        phase_diagram.read(path)
    phase_diagram.write(synthetic_rows()[:1], path)
    path.write_text(path.read_text().replace("sideways", "sideways,,"))
    with pytest.raises(ValueError, match="line 2 is not a row of a phase diagram"):
        phase_diagram.read(path)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"directions": ("up",)}, "directions"),
        ({"filters": ("kalman",)}, "filters"),
        ({"accelerations": (-1.0,)}, "acceleration_sigma must be positive"),
        ({"depths": (0.0,)}, "nearest_depth must be positive"),
        ({"runs": 0}, "runs must be at least 1"),
        ({"accelerations": ()}, "accelerations holds no value"),
        ({"rest_velocities": ()}, "rest_velocities holds no value"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, fields, message):
    options = dataclasses.replace(OPTIONS, out=tmp_path / "x.csv", docs=tmp_path, **fields)
    with pytest.raises(ValueError, match=message):
        phase_diagram.main(options)


# --- what it says -------------------------------------------------------------------------------

SYNTHETIC = phase_diagram.Options(
    accelerations=(0.2, 1.0, 2.0), velocities=(0.1,), depths=(3.0, 6.0), runs=100, steps=60
)


def synthetic_rows():
    """Consistent up to 0.5 m/s² at both depths, then over-confident at one of them, then lost."""
    numbers = {name: 0 for name in phase_diagram.COLUMNS} | {
        "direction": "sideways", "velocity_sigma_m_s": 0.01, "filter": "robocentric",
        "landmarks": "inverse_scaling", "runs": 100, "steps": 60, "dof": 3, "nees_not_lost": None,
        "velocity_x_m_s": 1.2, "lost": 0.0, "seconds": 1.0,
    }  # fmt: skip
    found = {
        (3.0, 0.1): (3.0, 0.0), (3.0, 0.5): (3.4, 0.0), (3.0, 1.0): (4.1, 0.0),
        (3.0, 3.0): (1e5, 0.2), (6.0, 0.1): (3.0, 0.0), (6.0, 0.5): (2.5, 0.0),
        (6.0, 1.0): (3.0, 0.0), (6.0, 3.0): (2.0, 0.0),
    }  # fmt: skip
    return [
        numbers | {"nearest_depth_m": d, "acceleration_sigma_m_s2": a, "nees": nees, "lost": lost}
        for (d, a), (nees, lost) in found.items()
    ]


def test_the_page_counts_what_the_rows_say():
    rows = phase_diagram.judged(synthetic_rows(), 0.01)
    assert [row["verdict"] for row in rows] == [
        *("consistent", "consistent", "over-confident", "lost"),
        *("consistent", "under-confident", "consistent", "under-confident"),
    ]
    assert [row["together"] for row in rows] == [
        *("consistent", "consistent", "over-confident", "lost"),
        *("consistent", "consistent", "consistent", "under-confident"),
    ]
    (diverged,) = phase_diagram.judged([synthetic_rows()[0] | {"diverged": 1}], 0.01)
    assert (diverged["verdict"], diverged["together"]) == ("lost", "lost")
    page = phase_diagram.page(rows, SYNTHETIC)
    assert "| robocentric/inverse_scaling | sideways | 8 | 50% | 62% | 12% | 12% | 12% |" in page
    assert "| robocentric/inverse_scaling | sideways | 0.5 |" in page
    assert "2.54–3.50" in page  # 100 runs


def test_what_is_found_from_rest_has_a_section_and_a_figure_of_its_own(tmp_path):
    """And changes neither the rest of the page nor its band of all cells."""
    moving = synthetic_rows()
    resting = [
        row | {"direction": "from-rest", "velocity_x_m_s": 0.0, "filter": name, "runs": runs}
        for row in moving[:2]
        for name, runs in (("mixture5+rest", 20), ("robocentric", 100))
    ]
    options = dataclasses.replace(SYNTHETIC, window_runs=20, docs=tmp_path)
    options = dataclasses.replace(options, out=tmp_path / "x.csv")
    pages = []
    for rows in (moving, [*moving, *resting]):
        phase_diagram.write(rows, options.out)
        phase_diagram.report(options)
        pages.append((tmp_path / "phase-diagram.md").read_text())
    before, after = pages
    assert after.startswith(before.rstrip("\n"))
    section = after[len(before) :]
    assert "`mixture5+rest/inverse_scaling`: 20 runs a cell, 95 % band 2.02–4.16" in section
    assert "one lost run is 5.0%" in section
    assert "| robocentric/inverse_scaling | from-rest | 2 | 100% |" in section
    assert (tmp_path / "phase-diagram-from-rest.png").stat().st_size > 500


def test_the_figure_shows_every_cell_once():
    cells = [
        PhaseCell("a", "b", 0.1, 0.2, "lost", True, "12%"),
        PhaseCell("a", "b", 0.3, 0.2, "over-confident", False, "3.6"),
        PhaseCell("c", "b", 0.1, 0.2, "consistent", True, "3.0"),
    ]
    figure = plot_phase_diagram(cells, x_label="x", y_label="y", title="t")
    assert len(figure.axes) == 2
    assert [[text.get_text() for text in axes.texts] for axes in figure.axes] == [
        ["12%", "3.6"],
        ["3.0"],
    ]
    colours = {patch.get_facecolor() for patch in figure.axes[0].patches[1:]}
    assert len(colours) == 2
    with pytest.raises(ValueError, match="no cell to draw"):
        plot_phase_diagram([], x_label="x", y_label="y", title="t")
