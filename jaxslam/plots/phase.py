"""The figure of a phase diagram: small multiples of coloured cells with a number in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from jaxslam.plots.style import COLOURS, new_figure, save

# Of Okabe and Ito's; lost is grey, the darker the more runs are; the number says the rest.
_COLOUR = {
    "consistent": "#FFFFFF",
    "under-confident": COLOURS[5],
    "over-confident": COLOURS[4],
}
_FEW_LOST, _ALL_LOST = 0.78, 0.05
"""Lightness, linear in the root of the share: most of what is lost is lost by a few runs."""
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
    lost: float = 0.0
    """Share of the runs."""


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
    xs, ys = _values(cells)
    width = 0.47 * len(xs) * len(columns) + 0.25 * len(columns) + 2.3
    height = 0.29 * len(ys) * len(rows) + 0.3 * len(rows) + 1.4
    height += 0.15 * max(column.count("\n") for column in columns)
    figure = new_figure(max(width, 7.0), height)
    axes = figure.subplots(len(rows), len(columns), sharex=True, sharey=True, squeeze=False)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            inside = [c for c in cells if (c.row, c.column) == (row, column)]
            plot_cells(inside, ax=axes[i, j], label=column if i == 0 else "", of=cells)
            if j == len(columns) - 1:
                axes[i, j].yaxis.set_label_position("right")
                axes[i, j].set_ylabel(row, fontsize=9, rotation=0, ha="left", va="center")
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


def _values(cells: Sequence[PhaseCell]) -> tuple[list[float], list[float]]:
    """Of both axes."""
    return sorted({cell.x for cell in cells}), sorted({cell.y for cell in cells})


def plot_cells(
    cells: Sequence[PhaseCell],
    *,
    ax: Axes,
    label: str = "",
    of: Sequence[PhaseCell] | None = None,
) -> Axes:
    """One panel, with `label` as its title; the axes show the places of all cells it is one `of`,
    hatched where there is none."""
    xs, ys = _values(of or cells)
    ax.add_patch(Rectangle((-0.5, -0.5), len(xs), len(ys), fc="none", hatch=_MISSING, ec="0.85"))
    for cell in cells:
        x, y = xs.index(cell.x), ys.index(cell.y)
        ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, fc=_colour(cell), ec="0.7", lw=0.5))
        dark = cell.verdict == "lost" and _lightness(cell.lost) < 0.5
        ink = "white" if dark else "black"
        ax.text(x, y, cell.text, ha="center", va="center", fontsize=7.5, color=ink)
    ax.set_xlim(-0.5, len(xs) - 0.5)
    ax.set_ylim(-0.5, len(ys) - 0.5)
    ax.set_xticks(range(len(xs)), [f"{x:g}" for x in xs], fontsize=8)
    ax.set_yticks(range(len(ys)), [f"{y:g}" for y in ys], fontsize=8)
    ax.tick_params(length=0)
    ax.set_title(label, fontsize=9)
    return ax


def _lightness(lost: float) -> float:
    return _FEW_LOST + (_ALL_LOST - _FEW_LOST) * lost**0.5


def _colour(cell: PhaseCell) -> str:
    if cell.verdict == "lost":
        return f"{_lightness(cell.lost):.3f}"
    return _COLOUR[cell.verdict] if cell.certain else _DOUBTFUL[cell.verdict]


def _legend() -> list[Patch]:
    def patch(colour, label):
        return Patch(facecolor=colour, edgecolor="0.6", label=label)

    return [
        patch(_COLOUR["consistent"], "NEES inside the 95 % band"),
        patch(_DOUBTFUL["over-confident"], "above it"),
        patch(_COLOUR["over-confident"], "above the band of all cells together"),
        Patch(facecolor="none", edgecolor="0.6", hatch=_MISSING, label="not measured"),
        patch(_DOUBTFUL["under-confident"], "below it"),
        patch(_COLOUR["under-confident"], "below the band of all cells"),
        *(patch(f"{_lightness(s):.3f}", f"{s:.0%} of the runs lost") for s in (0.02, 0.25, 0.9)),
    ]
