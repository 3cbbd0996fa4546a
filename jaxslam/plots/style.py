"""Colours and file writing that all figures share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from jaxslam.files import write_atomically

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours, distinct to the colour-blind."""
DASHES = ("-", "--", "-.", ":")
GREY = "#666666"


def line_style(index: int) -> dict[str, Any]:
    """Colour and dash of the i-th line: all colours, then the next dash."""
    dash = DASHES[index // len(COLOURS) % len(DASHES)]
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": dash}


def new_figure(width: float, height: float) -> Figure:
    """A figure in inches, outside pyplot's global state."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path) -> None:
    """Write the figure whole or not at all."""
    with write_atomically(path) as temporary:
        figure.savefig(temporary, dpi=150)


def name_decades(axes: Axes) -> None:
    """Numbers between the powers of ten of a logarithmic axis that has few of them."""
    bottom, top = axes.get_ylim()
    if top < 100 * bottom:
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        axes.yaxis.set_major_formatter(ScalarFormatter())
        axes.yaxis.set_minor_formatter(NullFormatter())
