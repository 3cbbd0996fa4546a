"""The figure of a calibration study: mean NEES of every treatment under every truth."""

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


def plot_calibration(summary: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw `{"scenarios": {scenario: {truth: {filter: {treatment: numbers}}}}}`.

    One panel for each world and filter, one row for each truth, one mark for each treatment.
    """
    panels = [
        (scenario, name)
        for scenario, by_truth in summary["scenarios"].items()
        for name in next(iter(by_truth.values()))
    ]
    figure = new_figure(max(4.2 * len(panels) + 1.2, 8.0), 0.75 * len(summary["truths"]) + 1.9)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axis, (scenario, name) in zip(axes, panels, strict=True):
        by_truth = summary["scenarios"][scenario]
        own = {truth: by_truth[truth][name] for truth in summary["truths"] if truth in by_truth}
        plot_treatments(own, ax=axis)
        set_title(axis, f"{scenario}, {name}")
    same_x(axes)
    axes[0].set_ylabel("true intrinsics")
    handles, labels = axes[0].get_legend_handles_labels()
    title = f"treated by the filter as ({summary['runs']} runs)"
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), title=title)
    if path is not None:
        save(figure, path)
    return figure


def plot_treatments(
    by_truth: dict[str, dict[str, dict[str, Any]]],
    *,
    ax: Axes,
    label: Mapping[str, str] | None = None,
) -> Axes:
    """Mean NEES at the end of `{truth: {treatment: {"nees", "band95", "dof"}}}`, with its band.

    A row for each truth, a mark for each treatment; `label` has other words for treatments.
    """
    truths, treatments = list(by_truth), list(next(iter(by_truth.values())))
    band = by_truth[truths[0]][treatments[0]]
    ax.axvspan(*band["band95"], color=GREY, alpha=0.3, lw=0, label="95 % band")
    ax.axvline(band["dof"], color=GREY, lw=0.8)
    for i, treatment in enumerate(treatments):
        values = np.array([of[treatment]["nees"] for of in by_truth.values()], float)
        place = np.arange(len(truths)) + 0.2 * (i - (len(treatments) - 1) / 2)
        told = (label or {}).get(treatment, treatment)
        style = {"colour": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)]}
        draw_dots(ax, values, place, MOST_NEES, label=told, **style)
    ax.set_xscale("log")
    ax.set_xlim(min(2.0, ax.get_xlim()[0]), min(max(10.0, ax.get_xlim()[1]), MOST_NEES))
    name_numbers(ax.xaxis)
    ax.grid(alpha=0.25)
    ax.set_xlabel(f"mean pose NEES at the end (ideal {band['dof']})")
    ax.set_yticks(range(len(truths)), truths)
    ax.set_ylim(len(truths) - 0.5, -0.5)
    return ax
