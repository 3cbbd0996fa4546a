"""The figure of a comparison: every filter on every scenario, its NEES and its confidence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.plots.style import (
    COLOURS,
    GREY,
    MARKERS,
    MOST_NEES,
    draw_dots,
    name_numbers,
    new_figure,
    same_x,
    save,
    set_title,
)

Numbers = dict[str, dict[str, Any]]
"""`{"filter/landmarks": {"nees", "band95", "dof", "sigma_over_rmse", …}}` of one scenario."""


def plot_comparison(scenarios: dict[str, Numbers], path: str | Path | None = None) -> Figure:
    """Draw `{scenario: {"filter/landmarks": {"nees", "band95", "dof", "sigma_over_rmse", …}}}`.

    One column a scenario, one row of marks a parametrization, one colour and mark a filter.
    Above: mean NEES at the end, with its exact 95 % band. Below: σ/RMSE of the position.
    """
    rows = len(_parts(next(iter(scenarios.values())), 1))
    figure = new_figure(3.2 * len(scenarios) + 2.2, 0.62 * rows + 2.6)
    axes = figure.subplots(2, len(scenarios), sharey=True, squeeze=False)
    for column, (scenario, results) in zip(axes.T, scenarios.items(), strict=True):
        plot_nees(results, ax=column[0])
        plot_confidence(results, ax=column[1])
        set_title(column[0], scenario)
    for row in axes:
        same_x(row)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    if path is not None:
        save(figure, path)
    return figure


def plot_nees(results: Numbers, *, ax: Axes, label: Mapping[str, str] | None = None) -> Axes:
    """Mean NEES at the end of every filter (colour and mark) with every landmark (row).

    Grey is the exact 95 % band. `label` has other words for filters and landmarks.
    """
    band = next(iter(results.values()))
    ax.axvspan(*band["band95"], color=GREY, alpha=0.3, lw=0, label="95 % band")
    ax.axvline(band["dof"], color=GREY, lw=0.8)
    _marks(ax, results, "nees", label or {})
    ax.set_xscale("log")
    ax.set_xlim(min(2.0, ax.get_xlim()[0]), min(max(10.0, ax.get_xlim()[1]), MOST_NEES))
    name_numbers(ax.xaxis)
    ax.set_xlabel("mean pose NEES at the end")
    return ax


def plot_confidence(results: Numbers, *, ax: Axes, label: Mapping[str, str] | None = None) -> Axes:
    """σ/RMSE of the position at the end, likewise; a consistent filter has 1."""
    ax.axvline(1, color=GREY, lw=0.8)
    _marks(ax, results, "sigma_over_rmse", label or {})
    ax.set_xlabel("σ / RMSE of the position")
    ax.set_xlim(0, max(1.15, ax.get_xlim()[1]))
    return ax


def _parts(results: Numbers, place: int) -> list[str]:
    """The filters (0) or the landmarks (1) of names, in their order."""
    return list(dict.fromkeys(name.split("/")[place] for name in results))


def _marks(axis: Axes, results: Numbers, key: str, label: Mapping[str, str]) -> None:
    filters, landmarks = (_parts(results, place) for place in (0, 1))
    for i, name in enumerate(filters):
        rows = [j for j, landmark in enumerate(landmarks) if f"{name}/{landmark}" in results]
        values = np.array([results[f"{name}/{landmarks[j]}"][key] for j in rows], float)
        place = np.array(rows) + 0.3 * (i - (len(filters) - 1) / 2)
        style = {"colour": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)]}
        draw_dots(axis, values, place, MOST_NEES, label=label.get(name, name), **style)
    named = [label.get(name, name) for name in landmarks]
    axis.set_yticks(range(len(landmarks)), named, fontsize=8)
    axis.set_ylim(len(landmarks) - 0.5, -0.5)
    axis.grid(alpha=0.25)
