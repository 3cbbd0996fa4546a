"""Colours, labels, sizes and file writing that all figures share."""

from __future__ import annotations

import io
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import offset_copy
from scipy.optimize import isotonic_regression

from jaxslam._runtime.files import write_atomically

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours, distinct to the colour-blind."""
DASHES = ("-", "--", "-.", ":")
GREY = "#666666"
COLUMN = 3.4
"""Width of one column of a paper, inches."""
LETTERS = 8.0
"""Points: of labels at lines, and of everything in print."""
MEDIAN_DASH = (0, (1, 2))
"""The dashes of medians, where a line is a mean."""
_POWERS = range(-9, 13)
_DIGITS = ((4, (1, 1.5, 2, 3, 4, 5, 7)), (20, (1, 2, 3, 5)), (500, (1, 2, 5)), (np.inf, (1,)))
"""Of the numbers named on an axis whose ends differ by a factor of so much at the most."""


class _Shown(Figure):
    """A figure that a notebook shows by itself, without pyplot or a magic line."""

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=80)
        return picture.getvalue()


LineStyle = dict[str, Any]
"""Properties of a line, as matplotlib calls them."""


def line_style(index: int) -> LineStyle:
    """Colour and dash of the i-th line: all colours, then the next dash."""
    dash = DASHES[index // len(COLOURS) % len(DASHES)]
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": dash}


def new_figure(width: float, height: float) -> Figure:
    """A figure in inches, outside pyplot's global state; as a cell's last value it is shown."""
    figure = _Shown(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path | None) -> Figure:
    """Return the figure, written where a path is given, whole or not at all; a PDF with TrueType
    letters, as publishers ask, a PNG with what is `drawn`."""
    if path is not None:
        metadata = {"Drawn": drawn(figure)} if Path(path).suffix == ".png" else None
        with write_atomically(path) as temporary, mpl.rc_context({"pdf.fonttype": 42}):
            figure.savefig(temporary, dpi=150, metadata=metadata)
    return figure


def drawn(figure: Figure) -> str:
    """The size, the title and the labels of a figure as JSON, by which an older one is found."""
    labels = [[ax.get_title(), ax.get_xlabel(), ax.get_ylabel()] for ax in figure.axes]
    size = np.round(figure.get_size_inches(), 6).tolist()
    return json.dumps({"inches": size, "title": figure.get_suptitle(), "axes": labels})


def column_title(text: str) -> str:
    """Lines that fit on a figure of `COLUMN` width."""
    # Characters in a line of a column.
    return "\n".join(part for line in text.splitlines() for part in textwrap.wrap(line, 50))


def for_print(figure: Figure) -> None:
    """Every letter of a figure of `COLUMN` width at 8 points."""
    for axes in figure.axes:
        axes.tick_params(which="both", labelsize=LETTERS)
    for text in figure.findobj(Text):
        text.set_fontsize(LETTERS)


def set_title(axes: Axes, text: str) -> None:
    """Above the left end of the axes: in a column there is room to the right of them."""
    axes.set_title(text, x=0, ha="left", fontsize=9)


def name_numbers(axis: Axis) -> None:
    """Name the round numbers of a logarithmic axis, as many as its length bears, as they are."""
    low, high = sorted(axis.get_view_interval())
    digits = next(digits for most, digits in _DIGITS if high <= most * low)
    # What is out of sight costs a tick, too: half of the time of a figure.
    every = (d * 10.0**power for power in _POWERS for d in digits)
    named = [number for number in every if low <= number <= high]
    # Fewer than three do not say how fast a short axis grows.
    if len(named) < 3:
        named = list(MaxNLocator(4).tick_values(low, high))
    axis.set_major_locator(FixedLocator(named))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


class End(NamedTuple):
    """The name of a line, and the place where it ends."""

    label: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    colour: str


def label_end(axes: Axes, end: End) -> None:
    """Write a line's name where it ends, whatever the limits of the axes become."""
    for i in np.flatnonzero(np.isfinite(end.y))[-1:]:
        axes.annotate(
            end.label, (end.x[i], end.y[i]), (4, 0), textcoords="offset points", va="center",
            color=end.colour, fontsize=LETTERS, annotation_clip=False,
        )  # fmt: skip


def label_ends(axes: Axes, ends: Sequence[End]) -> None:
    """Write each line's name to the right of the axes, in its colour, where it ends.

    Names that would lie on one another are moved apart, as little as that takes, and joined to
    their line. Where they would take too much of the figure's width they stand in a legend below.
    To be called when the limits of the axes are set; a line without a number gets none.
    """
    ends = [end for end in ends if np.isfinite(end.y).any()]
    longest = max((len(end.label) for end in ends), default=0)
    # Of about half their height each, letters may take such a share of the figure's width.
    if longest * 0.55 * LETTERS / 72 > 0.3 * axes.figure.bbox.width / axes.figure.dpi:
        lines = [Line2D([], [], color=end.colour, lw=1.8) for end in ends]
        # Inches from the axes to what stands below the numbers and the name of x.
        below = offset_copy(axes.transAxes, axes.get_figure(root=True), y=-0.42, units="inches")
        axes.legend(
            lines, [end.label for end in ends], loc="upper left", bbox_to_anchor=(0, 0),
            bbox_transform=below, labelcolor="linecolor", fontsize=LETTERS, frameon=False,
            borderpad=0, handlelength=1.0, borderaxespad=0, labelspacing=0.2,
        )  # fmt: skip
        return
    last = [np.flatnonzero(np.isfinite(end.y))[-1] for end in ends]
    points = np.array([(end.x[i], end.y[i]) for end, i in zip(ends, last, strict=True)])
    if not ends:
        return
    pixels = axes.transData.transform(points)
    heights = np.clip(axes.transAxes.inverted().transform(pixels)[:, 1], 0, 1)
    # Height of a line of text, in sizes of its letters, and about that of the axes, in inches, as
    # the layout is made later.
    apart = 1.25 * LETTERS / 72 / (0.85 * axes.bbox.height / axes.figure.dpi)
    for end, point, height in zip(ends, points, _apart(heights, apart), strict=True):
        axes.annotate(
            end.label, tuple(point), (1.02, height), textcoords=axes.transAxes, color=end.colour,
            fontsize=LETTERS, va="center", annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": end.colour, "lw": 0.5, "relpos": (0, 0.5)},
        )  # fmt: skip


def _apart(places: Float[np.ndarray, " n"], least: float) -> Float[np.ndarray, " n"]:
    """The places nearest to those given, in squares, that are apart by the least distance."""
    order = np.argsort(places, kind="stable")
    steps = least * np.arange(len(places))
    moved = np.empty(len(places))
    moved[order] = isotonic_regression(places[order] - steps).x + steps
    return moved - max(0.0, moved.max() - 1)


def short_names(names: Sequence[str]) -> dict[str, str]:
    """`filter/landmarks` without what all of several have in common."""
    parts = [name.split("/") for name in names]
    if len(names) > 1 and all(len(part) == 2 for part in parts):
        for same, other in ((0, 1), (1, 0)):
            if len({part[same] for part in parts}) == 1:
                return {name: part[other] for name, part in zip(names, parts, strict=True)}
    return {name: name for name in names}
