"""What all figures share: names at lines, ticks, sizes for print, files, how they are called."""

import importlib
import inspect
import itertools
import json
import pkgutil
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text

import jaxslam
import jaxslam.plots
from jaxslam.plots.consistency import (
    plot_beyond_scale,
    plot_consistency,
    plot_log_scale,
    plot_nees,
    plot_outside,
)
from jaxslam.plots.evaluation import plot_evaluation
from jaxslam.plots.evaluation import plot_outside as plot_shares
from jaxslam.plots.style import (
    COLUMN,
    End,
    drawn,
    label_ends,
    name_numbers,
    new_figure,
    save,
    short_names,
)


@pytest.fixture(scope="module")
def study():
    scenario = jaxslam.scenario("matched-tight", steps=6, landmarks=5)
    (slam,) = jaxslam.make_filters(scenario, "robocentric", ["inverse_scaling"]).values()
    # Twice the same, whose programs are one.
    filters = dict.fromkeys(("robocentric/inverse_scaling", "robocentric/inverse_depth"), slam)
    return jaxslam.monte_carlo(scenario, filters, runs=4, chunk=2)


def evaluation():
    rng, sigma = np.random.default_rng(0), np.array([0.1, 0.1, 0.02])
    errors = 1.3 * sigma * rng.normal(size=(20, 10, 3))
    return jaxslam.evaluate(errors, np.broadcast_to(np.diag(sigma**2), (20, 10, 3, 3)))


def annotations(axes):
    return [text for text in axes.texts if isinstance(text, Annotation)]


def ends(values):
    x = np.arange(3.0)
    return [End(f"line {i}", x, np.array([1.0, y, y]), "k") for i, y in enumerate(values)]


def places(axes):
    """Where names stand, in pixels from below, by name."""
    axes.figure.draw_without_rendering()
    boxes = {text.get_text(): Text.get_window_extent(text) for text in axes.texts}
    return {name: (box.y0, box.y1, box.x0) for name, box in boxes.items()}


def test_names_stand_where_their_lines_end_and_never_on_one_another():
    axes = new_figure(5, 3).subplots()
    axes.set(xlim=(0, 2), ylim=(0, 10))
    label_ends(axes, ends([2.0, 8.0, 8.01, 8.02]))
    found = places(axes)
    alone = found.pop("line 0")
    assert np.mean(alone[:2]) == pytest.approx(axes.transData.transform((2, 2.0))[1], abs=2)
    boxes = [found[f"line {i}"] for i in (1, 2, 3)]  # in the order of the lines
    assert all(below[1] <= above[0] for below, above in itertools.pairwise(boxes))
    assert all(box[2] >= axes.get_window_extent().x1 for box in boxes)


def test_a_line_that_breaks_off_is_named_at_its_last_number_and_one_without_any_is_not():
    axes = new_figure(5, 3).subplots()
    axes.set(xlim=(0, 2), ylim=(0, 10))
    gone, never = np.array([1.0, 7.0, np.nan]), np.full(3, np.nan)
    label_ends(axes, [End("gone", np.arange(3.0), gone, "k"), End("never", gone, never, "k")])
    (text,) = annotations(axes)
    assert (text.get_text(), text.xy) == ("gone", (1.0, 7.0))


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [
        (2.2, 6.5, ["3", "4", "5"]),
        (0.9, 12, ["1", "2", "3", "5", "10"]),
        (0.9, 300, ["1", "2", "5", "10", "20", "50", "100", "200"]),
        (0.002, 0.011, ["0.002", "0.003", "0.005", "0.01"]),
        (0.5, 5000, ["1", "10", "100", "1000"]),
        (0.0012, 0.0019, ["0.0012", "0.0014", "0.0016", "0.0018"]),
    ],
)
def test_ticks_are_round_numbers_written_out(low, high, told):
    figure = new_figure(4, 3)
    axes = figure.subplots()
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    name_numbers(axes.yaxis)
    figure.draw_without_rendering()
    ticks = zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
    assert [label.get_text() for value, label in ticks if low <= value <= high][: len(told)] == told


@pytest.mark.parametrize(("wrong", "said"), [(1000.0, "100 %"), (0.001, "0 %")])
def test_shares_of_errors_are_written_out(wrong, said):
    errors = wrong * (1.0 + np.arange(200.0).reshape(20, 5, 2))  # beyond 3 σ, or all inside
    found = jaxslam.evaluate(errors, np.broadcast_to(np.eye(2), (20, 5, 2, 2)))
    axes = plot_shares(found, ax=new_figure(4, 3).subplots())
    assert [text.get_text().strip() for text in axes.texts] == [said, said]


def test_stamps_of_a_clock_are_counted_from_the_first_pose():
    times = 1.4e9 + np.linspace(0.3, 170.3, 10)
    found = jaxslam.evaluate(np.ones((2, 10, 1)), np.ones((2, 10, 1, 1)), times=times)
    figure = plot_evaluation(found)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    assert axes.get_xlabel() == "time from the first pose, s"
    assert [x.get_text() for x in axes.get_xticklabels()] == ["0", "30", "60", "90", "120", "150"]
    drawn_at = np.asarray(axes.lines[-1].get_xdata())  # as are those of another log beside it
    np.testing.assert_allclose(drawn_at, times)


def test_long_names_leave_most_of_a_column_to_the_lines(tmp_path):
    figure = new_figure(COLUMN, 2.6)
    axes = figure.subplots()
    axes.plot([0, 2], [0, 1])
    axes.set_xlabel("time, s")
    label_ends(axes, [end._replace(label=f"{end.label} of a long name") for end in ends([1, 2])])
    save(figure, tmp_path / "long.png")
    assert axes.get_position().width > 0.8
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text()[:6] for text in legend.get_texts()] == ["line 0", "line 1"]
    named, drawn = axes.xaxis.label.get_window_extent(), legend.get_window_extent()
    assert figure.bbox.y0 <= drawn.y0 < drawn.y1 <= named.y0 + 2
    assert drawn.x0 >= figure.bbox.x0
    assert drawn.x1 <= figure.bbox.x1


def test_filters_are_named_by_what_tells_them_apart():
    assert short_names(["a/x", "b/x"]) == {"a/x": "a", "b/x": "b"}
    assert short_names(["a/x", "a/y"]) == {"a/x": "x", "a/y": "y"}
    for names in (["a/x"], ["a/x", "b/y"], ["mine", "b/x"]):
        assert short_names(names) == {name: name for name in names}


@pytest.mark.slow
def test_a_column_for_print_has_its_width_its_letters_and_nothing_outside(study, tmp_path):
    for figure in (
        plot_evaluation(evaluation(), column=True),
        plot_consistency(study, column=True),
    ):
        assert figure.get_figwidth() == COLUMN == 3.4
        save(figure, tmp_path / "figure.pdf")
        shown = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        assert {text.get_fontsize() for text in shown} == {8.0}
        assert figure.get_figheight() <= 7.0
        drawn = figure.get_tightbbox()  # inches
        assert -0.01 <= drawn.x0 < drawn.x1 <= COLUMN + 0.01
        written = (tmp_path / "figure.pdf").read_bytes()
        assert b"/Type3" not in written.replace(b" ", b"")
        assert b"/FontFile2" in written  # TrueType: type 42


def test_a_figure_is_a_picture_in_a_notebook():
    shown = getattr(new_figure(1, 1), "_repr_png_")  # noqa: B009
    assert shown().startswith(b"\x89PNG")


def plot_functions():
    for module in pkgutil.iter_modules(jaxslam.plots.__path__):
        found = vars(importlib.import_module(f"jaxslam.plots.{module.name}"))
        for name, value in found.items():
            if name.startswith("plot_") and value.__module__.endswith(module.name):
                yield pytest.param(value, id=f"{module.name}.{name}")


@pytest.mark.parametrize("plot", list(plot_functions()))
def test_what_draws_a_figure_returns_it_and_what_draws_axes_takes_them(plot):
    """Whole figures are made of functions that draw into axes of one's own, by a name."""
    taken, returned = inspect.signature(plot).parameters, inspect.signature(plot).return_annotation
    if returned in ("Figure", Figure):
        assert "path" in taken
        room = importlib.import_module(plot.__module__)
        # The panels of a map share their limits, as do those of a point seen from two places.
        if room.__name__ not in ("jaxslam.plots.tracking", "jaxslam.plots.triangulation"):
            assert any("ax" in inspect.signature(f).parameters for f in public_plots(room))
    else:
        assert returned in ("Axes", Axes)
        for name in ("ax", "label"):
            assert taken[name].kind is inspect.Parameter.KEYWORD_ONLY


def public_plots(module):
    return [value for name, value in vars(module).items() if name.startswith("plot_")]


def test_a_study_is_drawn_and_tabled_as_its_summary_is(study):
    summary = jaxslam.summarise(study)
    assert jaxslam.table(study) == jaxslam.table(summary) == repr(study)
    for plot in (plot_nees, plot_outside, plot_beyond_scale, plot_log_scale):
        lines = [plot(of, ax=new_figure(3, 3).subplots()).lines for of in (study, summary)]
        for one, other in zip(*lines, strict=True):
            np.testing.assert_array_equal(one.get_xydata(), other.get_xydata())


def test_the_first_picture_of_the_site_is_as_the_program_draws_it_now(study):
    """But for its own title and number of runs: a study of as many filters in the plane."""
    path = Path(__file__).parents[2] / "docs/consistency.png"
    with PIL.Image.open(path) as picture:
        shown = json.loads(picture.info["Drawn"])
    now = json.loads(drawn(plot_consistency(study)).replace(f"{study.runs} runs", "1000 runs"))
    assert shown | {"title": ""} == now | {"title": ""}


def test_the_map_of_a_run_fills_its_place_with_equal_units_and_warns_of_nothing(study, caplog):
    figure = plot_consistency(study)
    figure.draw_without_rendering()
    (map_,) = (ax for ax in figure.axes if ax.get_xlabel() == "x, m")
    place, (left, right), (low, high) = map_.get_window_extent(), map_.get_xlim(), map_.get_ylim()
    assert place.width > 1.3 * place.height  # as wide as the axes beside it
    assert place.width / (right - left) == pytest.approx(place.height / (high - low), rel=1e-3)
    assert not caplog.records


@pytest.mark.usefixtures("unchecked")
def test_wrong_names_and_kinds_are_told_what_is_accepted(study):
    ax = new_figure(3, 3).subplots()
    wrong = "robocentric/inverse_dept"
    with pytest.raises(ValueError, match=r"unknown label .*did you mean robocentric/inverse_depth"):
        plot_nees(study, ax=ax, label={wrong: "UID"})
    with pytest.raises(ValueError, match=r"the scale of this scenario is measured"):
        plot_log_scale({**jaxslam.summarise(study), "scale_free": False}, ax=ax)
    with pytest.raises(ValueError, match=r"a study is summarised, .* not list"):
        jaxslam.summarise([study])  # ty: ignore[invalid-argument-type]
    with pytest.raises(ValueError, match="confidence must be between 0 and 1, not 95"):
        jaxslam.mean_band(3, 10, 95)
