"""What stands in the figure of a map: lines, ticks, marks, where the axes end."""

import itertools

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb

from jaxslam.io.tum import poses
from jaxslam.plots.style import COLOURS
from jaxslam.plots.tracking import plot_map


def drawn(*data, **more):
    """The axes of the figure of a map, by title."""
    return {axis.get_title().split(":")[0]: axis for axis in plot_map(*data, **more).axes}


def path_along_x(n=30, length=1.0):
    """A camera that looks along z, moving to its right."""
    return poses(np.outer(np.linspace(0, length, n), [1, 0, 0]), np.tile([0, 0, 0, 1], (n, 1)))


def wall(n=40, width=1.0, depth=4.0):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (n, 3)) * [width, 1, 0.1] + [0, 0, depth]
    return points, np.tile(0.01 * np.eye(3), (n, 1, 1))


def line(axis, label):
    (found,) = [line for line in axis.lines if line.get_label() == label]
    return found.get_xydata()


def test_the_estimate_is_interrupted_where_it_was_only_predicted():
    lost = np.zeros(30, bool)
    lost[10:13] = True
    axis = drawn(path_along_x(), *wall(), lost=lost)["from above"]
    shown = np.isfinite(line(axis, "estimate")[:, 0])
    assert np.flatnonzero(~shown).tolist() == [10, 11, 12]
    predicted = np.isfinite(line(axis, "lost: only predicted")[:, 0])
    # It joins what was tracked before and after.
    assert np.flatnonzero(predicted).tolist() == [9, 10, 11, 12, 13]


def test_the_line_breaks_where_a_map_begins():
    covariance = np.diag([0.01, 0.02, 0.04])
    given = dict(begun=[10], begun_covariances=[covariance])
    axis = drawn(path_along_x(), *wall(), **given)["from above"]
    estimate = line(axis, "estimate")
    assert len(estimate) == 31
    assert np.isnan(estimate[10]).all()
    np.testing.assert_allclose(line(axis, "a map begins; ellipse: 95 %"), [estimate[11]])
    *_, ellipses = (c for c in axis.collections if isinstance(c, EllipseCollection))
    # Of z and x, as z is to the right: 2 sqrt(5.99 σ²).
    sizes = ellipses.get_widths(), ellipses.get_heights()
    np.testing.assert_allclose(sizes, [[2 * np.sqrt(5.991 * 0.04)], [2 * np.sqrt(5.991 * 0.01)]])


def test_ticks_point_where_the_camera_looks():
    turned = path_along_x()
    turned[:, :3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # along x
    axis = drawn(turned, *wall(width=9.0))["from above"]
    (ticks,) = (c for c in axis.collections if isinstance(c, LineCollection))
    steps = np.array([np.diff(path.vertices, axis=0)[0] for path in ticks.get_paths()])
    assert np.all(steps[:, 0] > 0.2)
    np.testing.assert_allclose(steps[:, 1], 0, atol=1e-12)
    starts = np.array([path.vertices[0] for path in ticks.get_paths()])
    np.testing.assert_allclose(starts, turned[::2][:, [0, 2], 3], atol=1e-12)


@pytest.mark.parametrize(
    ("width", "titles"),
    [(9.0, ["from above", "from behind"]), (1.0, ["from above", "from the side"])],
)
def test_what_is_longer_lies_to_the_right_in_equal_axes(width, titles):
    axes = drawn(path_along_x(length=5.0 if width > 4 else 2.5), *wall(width=width), unit="m")
    assert list(axes) == titles
    above, upright = axes.values()
    assert (above.get_xlabel(), above.get_ylabel()) == (
        ("x (m)", "z (m)") if width > 4 else ("z (m)", "x (m)")
    )
    assert above.get_aspect() == upright.get_aspect() == 1
    # y points down; x to the right of z.
    assert upright.yaxis_inverted()
    assert above.yaxis_inverted() == (width < 4)


def test_a_path_that_is_small_in_its_map_is_shown_alone_too():
    axes = drawn(path_along_x(length=0.2), *wall())
    assert list(axes) == ["the path, from above", "from above", "from the side"]
    alone = axes["the path, from above"]
    assert (alone.get_xlabel(), alone.get_ylabel()) == ("x (m)", "z (m)")
    assert alone.get_xlim() == pytest.approx((-0.012, 0.212))
    assert not alone.yaxis_inverted()
    assert axes["from above"].get_xlim()[1] > 4


def test_titles_count_what_is_not_shown():
    points, covariances = wall()
    points[0] = (0, 0, 1e6)
    covariances[1] = 1e3 * np.eye(3)
    axes = drawn(path_along_x(length=3.0), points, covariances)
    title = axes["from above"].get_title()
    assert title == "from above: 39 landmarks, 1 more outside, 1 without ellipse"


def test_a_camera_that_stands_still_without_landmarks_is_drawn():
    still = np.tile(np.eye(4), (5, 1, 1))
    axes = drawn(still, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert list(axes) == ["from above", "from behind"]
    assert not landmarks_of(axes["from above"])


def landmarks_of(axis):
    """Widths and heights of the ellipses, and the points drawn, that are of landmarks."""
    colours = to_rgb(COLOURS[2])
    ellipses = [c for c in axis.collections if isinstance(c, EllipseCollection)]
    own = [c for c in ellipses if np.allclose(c.get_edgecolor()[:, :3], colours)]
    return [c.get_widths() for c in own if len(c.get_widths())]


def test_landmarks_have_their_ellipses_in_the_figure_and_in_its_file(tmp_path):
    points, covariances = wall()
    covariances *= np.arange(1, 41)[:, None, None]
    axis = drawn(path_along_x(length=3.0), points, covariances, path=tmp_path / "map.png")
    (widths,) = landmarks_of(axis["from above"])
    # As long as 95 % of the two coordinates, σ of 0.1 and more.
    np.testing.assert_allclose(widths, 0.2 * np.sqrt(5.991 * np.arange(1, 41)))
    assert [path.name for path in tmp_path.iterdir()] == ["map.png"]


@pytest.mark.parametrize(("length", "width"), [(100.0, 20.0), (0.2, 1.0)])
def test_titles_labels_and_legend_have_room(length, width):
    """None is cut off or drawn over another."""
    figure = drawn(
        path_along_x(length=length), *wall(width=width),
        reference=path_along_x(length=length), lost=np.arange(30) > 25,
        begun=[10], begun_covariances=[0.01 * np.eye(3)],
    )["from above"].figure  # fmt: skip
    figure.draw_without_rendering()
    words = [part for axis in figure.axes for part in (axis.title, axis.xaxis.label)]
    boxes = [part.get_window_extent() for part in [*words, figure.legends[0]]]
    whole = figure.bbox
    assert all(box.y0 >= whole.y0 and box.y1 <= whole.y1 for box in boxes)
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_loops_join_two_places_and_the_path_without_them_lies_below():
    before = path_along_x(length=1.2)
    ends = np.array([[[0.9, 0.0, 0.0], [0.1, 0.0, 0.0]], [[1.0, 0.0, 0.0], [0.2, 0.0, 0.0]]])
    axis = drawn(path_along_x(), *wall(), loops=ends, before=before, reference=before[:7])[
        "from above"
    ]
    assert line(axis, "reference") == pytest.approx(before[:7][:, [2, 0], 3])
    assert line(axis, "a loop closed") == pytest.approx(ends[0][:, [2, 0]])
    assert line(axis, "before loops were closed") == pytest.approx(before[:, [2, 0], 3])
    labels = [one.get_label() for one in axis.lines]
    assert labels.index("before loops were closed") < labels.index("estimate")
    labels = drawn(path_along_x(), *wall())["from above"].get_legend_handles_labels()[1]
    never = {"a loop closed", "lost: only predicted", "reference", "a map begins; ellipse: 95 %"}
    assert not never & set(labels)
