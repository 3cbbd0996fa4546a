"""The figure of a comparison: every filter on every scenario, its NEES and its confidence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from jaxslam.plots.style import COLOURS, GREY, new_figure, save

MARKERS = ("o", "s", "^", "D", "v", "P")
MOST_NEES = 1000.0


def plot_comparison(scenarios: dict[str, dict[str, Any]], path: str | Path | None = None) -> Figure:
    """Draw `{scenario: {"filter/landmarks": {"nees", "band95", "dof", "sigma_over_rmse", …}}}`.

    One column a scenario, one row of marks a parametrization, one colour and mark a filter.
    Above: mean NEES at the end, with its exact 95 % band. Below: σ/RMSE of the position.
    """
    names = next(iter(scenarios.values()))
    landmarks = list(dict.fromkeys(name.split("/")[1] for name in names))
    filters = list(dict.fromkeys(name.split("/")[0] for name in names))
    figure = new_figure(3.2 * len(scenarios) + 2.2, 0.62 * len(landmarks) + 2.6)
    axes = figure.subplots(2, len(scenarios), sharey=True, squeeze=False)
    for column, (scenario, results) in zip(axes.T, scenarios.items(), strict=True):
        band = next(iter(results.values()))
        column[0].axvspan(*band["band95"], color=GREY, alpha=0.3, lw=0, label="95 % band")
        column[0].axvline(band["dof"], color=GREY, lw=0.8)
        column[1].axvline(1, color=GREY, lw=0.8)
        for axis, key in zip(column, ("nees", "sigma_over_rmse"), strict=True):
            _marks(axis, results, key, landmarks, filters)
        column[0].set_title(scenario, fontsize=10)
        _log_axis(column[0], "mean pose NEES at the end")
        column[1].set_xlabel("σ / RMSE of the position")
        column[1].set_xlim(0, max(1.15, column[1].get_xlim()[1]))
    for axis in axes[:, 0]:
        axis.set_yticks(range(len(landmarks)), landmarks, fontsize=8)
    axes[0, 0].invert_yaxis()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9)
    if path is not None:
        save(figure, path)
    return figure


def _marks(axis: Axes, results, key: str, landmarks: list[str], filters: list[str]) -> None:
    for i, name in enumerate(filters):
        rows = [j for j, landmark in enumerate(landmarks) if f"{name}/{landmark}" in results]
        values = np.array([results[f"{name}/{landmarks[j]}"][key] for j in rows], float)
        place = np.array(rows) + 0.16 * (i - (len(filters) - 1) / 2)
        shown = np.where(np.isfinite(values), np.minimum(values, MOST_NEES), MOST_NEES)
        axis.plot(shown, place, MARKERS[i], color=COLOURS[i], ms=6, label=name, ls="none")
    axis.grid(alpha=0.25)


def _log_axis(axis: Axes, label: str) -> None:
    axis.set_xscale("log")
    low, high = min(2.0, axis.get_xlim()[0]), max(10.0, axis.get_xlim()[1])
    axis.set_xlim(low, high)
    ticks = [t for t in (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000) if low <= t <= high]
    axis.xaxis.set_major_locator(FixedLocator(ticks))
    axis.xaxis.set_major_formatter(ScalarFormatter())
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel(label)
