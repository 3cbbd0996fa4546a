"""The figure of a calibration study: mean NEES of every treatment under every truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from jaxslam.plots.style import COLOURS, GREY, new_figure, save

MARKERS = ("o", "s", "^", "D", "v", "P")
MOST_NEES = 1000.0


def plot_calibration(summary: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw `{"scenarios": {scenario: {truth: {filter: {treatment: numbers}}}}}`.

    One panel for each world and filter, one row for each truth, one mark for each treatment.
    """
    panels = [
        (scenario, name)
        for scenario, by_truth in summary["scenarios"].items()
        for name in next(iter(by_truth.values()))
    ]
    truths, treatments = summary["truths"], summary["treatments"]
    figure = new_figure(max(4.2 * len(panels) + 1.2, 8.0), 0.75 * len(truths) + 1.9)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axis, (scenario, name) in zip(axes, panels, strict=True):
        by_truth = summary["scenarios"][scenario]
        band = next(iter(next(iter(by_truth.values()))[name].values()))
        axis.axvspan(*band["band95"], color=GREY, alpha=0.3, lw=0, label="95 % band")
        axis.axvline(band["dof"], color=GREY, lw=0.8)
        for i, treatment in enumerate(treatments):
            rows = [j for j, truth in enumerate(truths) if truth in by_truth]
            values = np.array([by_truth[truths[j]][name][treatment]["nees"] for j in rows], float)
            shown = np.where(np.isfinite(values), np.minimum(values, MOST_NEES), MOST_NEES)
            place = np.array(rows) + 0.17 * (i - (len(treatments) - 1) / 2)
            axis.plot(shown, place, MARKERS[i], color=COLOURS[i], ms=7, ls="none", label=treatment)
        axis.set_xscale("log")
        axis.set_xlim(min(2.0, axis.get_xlim()[0]), max(10.0, axis.get_xlim()[1]))
        axis.xaxis.set_major_locator(FixedLocator([1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000]))
        axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.25)
        axis.set_title(f"{scenario}, {name}", fontsize=10)
        axis.set_xlabel(f"mean pose NEES at the end (ideal {band['dof']})")
    axes[0].set_yticks(range(len(truths)), truths)
    axes[0].set_ylabel("true intrinsics")
    axes[0].set_ylim(len(truths) - 0.5, -0.5)
    handles, labels = axes[0].get_legend_handles_labels()
    title = f"treated by the filter as ({summary['runs']} runs)"
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), title=title)
    if path is not None:
        save(figure, path)
    return figure
