"""The figure of a phase diagram: small multiples of coloured cells with a number in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from jaxslam.plots.style import COLOURS, new_figure, save

# Of Okabe and Ito's, with a lightness that falls from consistent to lost, so that the order
# survives without colour; the number in the cell says the rest.
_COLOUR = {
    "consistent": "#FFFFFF",
    "under-confident": COLOURS[5],
    "over-confident": COLOURS[4],
    "lost": "#4D4D4D",
}
_DOUBTFUL = {"under-confident": "#D9EEFA", "over-confident": "#FBEBC8"}
_MISSING = "///"


@dataclass(frozen=True)
class PhaseCell:
    """One cell: where it is, and what was found there."""

    row: str
    column: str
    """Names of the panel."""
    x: float
    y: float
    """Place in the panel; every panel shows the values of all."""
    verdict: str
    """Of `jaxslam.consistency.VERDICTS`, by the band of this cell alone."""
    certain: bool
    """Whether it is the same by the band of all cells together."""
    text: str


def plot_phase_diagram(
    cells: Sequence[PhaseCell],
    *,
    x_label: str,
    y_label: str,
    title: str,
    path: str | Path | None = None,
) -> Figure:
    """One panel for each pair of row and column, in the order of the cells; absent cells hatched.

    Raises ValueError where there is no cell.
    """
    if not cells:
        raise ValueError("no cell to draw: a phase diagram needs at least one")
    rows, columns = (
        list(dict.fromkeys(getattr(c, name) for c in cells)) for name in ("row", "column")
    )
    xs, ys = (sorted({getattr(c, axis) for c in cells}) for axis in ("x", "y"))
    width = 0.47 * len(xs) * len(columns) + 0.25 * len(columns) + 1.1
    height = 0.29 * len(ys) * len(rows) + 0.3 * len(rows) + 1.3
    figure = new_figure(max(width, 7.0), height)
    axes = figure.subplots(len(rows), len(columns), sharex=True, sharey=True, squeeze=False)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            inside = [c for c in cells if (c.row, c.column) == (row, column)]
            _panel(axes[i, j], inside, xs, ys)
            if i == 0:
                axes[i, j].set_title(column, fontsize=9)
            if j == len(columns) - 1:
                axes[i, j].yaxis.set_label_position("right")
                axes[i, j].set_ylabel(row, fontsize=9)
    figure.supxlabel(x_label, fontsize=9)
    figure.supylabel(y_label, fontsize=9)
    figure.legend(
        handles=_legend(),
        title=title,
        loc="outside upper center",
        ncols=3,
        fontsize=8,
        title_fontsize=10,
        frameon=False,
    )
    if path is not None:
        save(figure, path)
    return figure


def _panel(axes: Axes, cells: list[PhaseCell], xs: list[float], ys: list[float]) -> None:
    axes.add_patch(Rectangle((-0.5, -0.5), len(xs), len(ys), fc="none", hatch=_MISSING, ec="0.85"))
    for cell in cells:
        x, y = xs.index(cell.x), ys.index(cell.y)
        axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, fc=_colour(cell), ec="0.7", lw=0.5))
        ink = "white" if cell.verdict == "lost" else "black"
        axes.text(x, y, cell.text, ha="center", va="center", fontsize=7.5, color=ink)
    axes.set_xlim(-0.5, len(xs) - 0.5)
    axes.set_ylim(-0.5, len(ys) - 0.5)
    axes.set_xticks(range(len(xs)), [f"{x:g}" for x in xs], fontsize=8)
    axes.set_yticks(range(len(ys)), [f"{y:g}" for y in ys], fontsize=8)
    axes.tick_params(length=0)


def _colour(cell: PhaseCell) -> str:
    return _COLOUR[cell.verdict] if cell.certain else _DOUBTFUL[cell.verdict]


def _legend() -> list[Patch]:
    def patch(colour, label):
        return Patch(facecolor=colour, edgecolor="0.6", label=label)

    return [
        patch(_COLOUR["consistent"], "inside the 95 % band"),
        patch(_COLOUR["lost"], "lost runs (their share)"),
        patch(_DOUBTFUL["over-confident"], "above the 95 % band"),
        patch(_COLOUR["over-confident"], "above the band of all cells together"),
        patch(_DOUBTFUL["under-confident"], "below the 95 % band"),
        patch(_COLOUR["under-confident"], "below the band of all cells together"),
    ]
