"""The figure of an evaluation: the verdict, NEES over time, errors beside σ, shares outside 3σ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxslam.evaluation import Evaluation
from jaxslam.evaluation.result import OUTSIDE
from jaxslam.plots.style import (
    COLOURS,
    COLUMN,
    GREY,
    LETTERS,
    End,
    column_title,
    for_print,
    label_end,
    line_style,
    name_numbers,
    new_figure,
    save,
    set_title,
)

_PER_ROW = 3
_MOST_LOG = 50.0
"""Of a scale that is drawn."""
_WIDEST = 12
"""Axes that are drawn; of more the first."""


def plot_evaluation(
    evaluation: Evaluation, path: str | Path | None = None, *, column: bool = False
) -> Figure:
    """Draw an evaluation, the verdict as its title; written to `path` where one is given.

    Above: the mean NEES of every step with its exact 95 % band, and the share of errors outside
    ±3σ, axis by axis. Below: RMSE and claimed σ of every axis. As one `column` for print, 3.4 in
    wide with letters of 8 pt, it is what is above.
    """
    return save(_column(evaluation) if column else _page(evaluation), path)


def _column(evaluation: Evaluation) -> Figure:
    shown = max(1, min(len(evaluation.names), _WIDEST))
    figure = new_figure(COLUMN, 3.0 + 0.16 * shown)
    figure.suptitle(column_title(evaluation.headline), x=0.02, ha="left")
    above, below = figure.subplots(2, 1, height_ratios=[1.9, 0.16 * shown])
    plot_nees(evaluation, ax=above)
    plot_outside(evaluation, ax=below)
    for_print(figure)
    return figure


def _page(evaluation: Evaluation) -> Figure:
    axes = min(len(evaluation.names), _WIDEST)
    panels = axes + (evaluation.scale is not None)
    rows = -(-panels // _PER_ROW)
    figure = new_figure(11.5, 3.9 + 1.9 * rows)
    title = evaluation.headline.replace("; ", "\n")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, weight="bold")
    grid = figure.add_gridspec(1 + rows, _PER_ROW, height_ratios=[1.6, *[1] * rows])
    plot_nees(evaluation, ax=figure.add_subplot(grid[0, :2]))
    plot_outside(evaluation, ax=figure.add_subplot(grid[0, 2]))
    for panel in range(panels):
        ax = figure.add_subplot(grid[1 + panel // _PER_ROW, panel % _PER_ROW])
        _ = plot_axis(evaluation, panel, ax=ax) if panel < axes else plot_scale(evaluation, ax=ax)
    return figure


def plot_nees(
    evaluation: Evaluation, *, ax: Axes, label: str | None = None, place: int = 0
) -> Axes:
    """Mean NEES over time with its exact 95 % band, at whose end the `label` stands.

    For evaluations in the same axes `place` counts, for their colours.
    """
    style = line_style(place)
    _band(evaluation, ax)
    ax.axhline(evaluation.dof, color=GREY, lw=0.8)
    _line(evaluation, ax, evaluation.mean, label, **style)
    ax.set_yscale("log")
    bottom, top = ax.get_ylim()
    ax.set_ylim(min(bottom, evaluation.dof / 2), max(top, evaluation.dof * 2))
    name_numbers(ax.yaxis)
    ax.set_ylabel(f"mean {evaluation.quantity} (ideal {evaluation.expected})")
    runs = _runs(evaluation)
    set_title(ax, f"{evaluation.quantity} of {runs}\ngrey: exact 95 % band of one step")
    return _over_time(evaluation, ax)


def _runs(evaluation: Evaluation) -> str:
    """The text that says of how many runs the means are."""
    least = int(evaluation.runs_of_step.min())
    if 0 < least < evaluation.finite.sum():
        return f"{least} to {evaluation.runs} runs"
    return f"{evaluation.runs} runs" if evaluation.runs > 1 else "one run"


def _band(evaluation: Evaluation, ax: Axes) -> None:
    """Draw where the mean of a consistent filter is; wider at steps that fewer runs have."""
    if evaluation.logged.all():
        ax.axhspan(*evaluation.band95, color=GREY, alpha=0.25, lw=0)
        return
    low, high = evaluation.band95_of_step.T
    ax.fill_between(evaluation.times, low, high, color=GREY, alpha=0.25, lw=0, step="mid")


def plot_outside(evaluation: Evaluation, *, ax: Axes, label: str | None = None) -> Axes:
    """Share of the errors of every axis outside ±3σ, beside the .27 % of Gaussian ones."""
    shares = 100 * evaluation.outside3sigma[:_WIDEST]
    if not len(shares):
        ax.set_axis_off()  # of a NEES alone
        return ax
    places = np.arange(len(shares))
    ax.barh(places, shares, color=COLOURS[0], label=label)
    for place, share in zip(places, shares, strict=True):
        beyond = max(share, 100 * OUTSIDE)  # where the grey line hides no digit
        written = f"  {float(f'{share:.2g}'):g} %"  # 100, not 1e+02
        ax.annotate(written, (beyond, place), va="center", fontsize=LETTERS)
    ax.axvline(100 * OUTSIDE, color=GREY, lw=1.2)
    ax.set_yticks(places, evaluation.names[:_WIDEST])
    ax.invert_yaxis()
    ax.set(xlim=(0, max(1.25 * shares.max(), 1.0)), xlabel="% of errors")
    set_title(ax, "outside ±3σ\ngrey line: 0.27 % of Gaussian errors")
    return ax


def plot_axis(
    evaluation: Evaluation, axis: int, *, ax: Axes, label: str | None = None, place: int = 0
) -> Axes:
    """RMSE (solid) and claimed σ (dashed) of one axis over time."""
    colour = line_style(place)["color"]
    _line(evaluation, ax, evaluation.rmse[:, axis], label, color=colour)
    _line(evaluation, ax, evaluation.sigma[:, axis], None, color=colour, lw=1.4, ls="--")
    ax.set_ylim(bottom=0)
    if evaluation.convention is not None:
        length = "m" if evaluation.scale is None else "map units"
        ax.set_ylabel("rad" if evaluation.names[axis].startswith("r") else length)
    set_title(ax, f"{evaluation.names[axis]}: RMSE (solid), σ claimed (dashed)")
    return _over_time(evaluation, ax)


def plot_scale(evaluation: Evaluation, *, ax: Axes, label: str | None = None) -> Axes:
    """Scale of every step relative to its run's: median, at whose end the `label` stands, and 95 %
    of the runs, beside ±2σ claimed.

    Raises ValueError where the evaluation has none.
    """
    if evaluation.scale is None:
        raise ValueError("no scale to draw: poses are neither given it nor aligned by Sim(3)")
    (low, high), median, sigma = evaluation.scale.over_runs
    percent = 100 * np.expm1(np.clip([low, median, high], -_MOST_LOG, _MOST_LOG))
    ax.fill_between(evaluation.times, percent[0], percent[2], color=COLOURS[0], alpha=0.25, lw=0)
    _line(evaluation, ax, percent[1], label, color=COLOURS[0])
    claimed = 100 * np.expm1(np.clip([-2 * sigma, 2 * sigma], -_MOST_LOG, _MOST_LOG))
    ax.plot(evaluation.times, claimed.T, lw=1.4, ls="--", color=COLOURS[1])
    shown = np.abs([*percent, *claimed])
    largest = np.nanquantile(shown, 0.9) if np.isfinite(shown).any() else 1.0
    ax.set_ylim(-1.6 * largest - 1e-9, 1.6 * largest + 1e-9)
    ax.set_ylabel("% off its run's")
    set_title(ax, "scale: median, 95 % of runs; ±2σ claimed (dashed)")
    return _over_time(evaluation, ax)


def _line(
    evaluation: Evaluation, ax: Axes, values: np.ndarray, label: str | None, **style: Any
) -> None:
    """Draw values over time, a dot where there is one step, and the label at their end."""
    marker = "o" if evaluation.steps == 1 else None
    ax.plot(evaluation.times, values, marker=marker, lw=style.pop("lw", 1.8), **style)
    if label is not None:
        label_end(ax, End(label, evaluation.times, values, style["color"]))


def _over_time(evaluation: Evaluation, ax: Axes) -> Axes:
    ax.margins(x=0)
    ax.set_xlabel("time, s" if evaluation.timed else "step")
    first, last = evaluation.times[[0, -1]]
    if evaluation.timed and first > 1e8:  # s: stamps of a clock, as those since 1970
        ticks = MaxNLocator(6).tick_values(0, last - first)[:-1]  # the last is at the end or beyond
        ax.set_xticks(first + ticks, [f"{tick:g}" for tick in ticks])
        ax.set_xlabel("time from the first pose, s")
    ax.grid(alpha=0.25)
    return ax
