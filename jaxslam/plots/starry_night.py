"""The figure of Starry Night: mean NEES over the windows, and how its noise is correlated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.plots.style import (
    GREY,
    MEDIAN_DASH,
    line_style,
    name_numbers,
    new_figure,
    save,
    set_title,
)

MOST_NEES = 3000.0


def plot_starry_night(summary: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw `{"variants": {variant: {filter: numbers}}, "noise": …}`, a panel for each variant.

    Lines are the mean NEES over the windows, dotted ones the median, on one scale for all.
    """
    variants = {name: found for name, found in summary["variants"].items() if found}
    columns = min(len(variants) + 1, 3)
    rows = -(-(len(variants) + 1) // columns)
    figure = new_figure(4.6 * columns, 3.7 * rows + 0.5)
    grid = figure.add_gridspec(rows, columns)
    places = [figure.add_subplot(grid[i // columns, i % columns]) for i in range(len(variants) + 1)]
    for axes, (variant, filters) in zip(places, variants.items(), strict=False):
        plot_windows(filters, ax=axes)
        axes.sharey(places[0])
        windows = next(iter(filters.values()))["windows"]
        set_title(axes, f"{variant}: {windows} windows")
    most = max(max(f["nees"]) for filters in variants.values() for f in filters.values())
    places[0].set_ylim(2, min(1.2 * max(most, 10), MOST_NEES))
    name_numbers(places[0].yaxis)
    plot_noise(summary["noise"], ax=places[-1])
    handles, labels = places[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    if path is not None:
        save(figure, path)
    return figure


def plot_windows(
    filters: dict[str, dict[str, Any]], *, ax: Axes, label: Mapping[str, str] | None = None
) -> Axes:
    """Mean NEES over the steps of `{filter: {"nees", "nees_median", "band95", "dof"}}`.

    Medians dotted; a filter may be called otherwise in the legend by `label`.
    """
    first = next(iter(filters.values()))
    ax.axhspan(*first["band95"], color=GREY, alpha=0.25, lw=0, label="95 % band of the mean")
    ax.axhline(first["dof"], color=GREY, lw=0.8)
    steps = range(1, len(first["nees"]) + 1)
    for i, (name, f) in enumerate(filters.items()):
        style = line_style(i)
        ax.plot(steps, f["nees"], lw=1.6, label=(label or {}).get(name, name), **style)
        ax.plot(steps, f["nees_median"], color=style["color"], lw=0.9, ls=MEDIAN_DASH)
    ax.plot([], [], color=GREY, lw=0.9, ls=MEDIAN_DASH, label="median (5.35 for χ²₆)")
    ax.set_yscale("log")
    name_numbers(ax.yaxis)
    ax.set_xlabel("step of the window")
    ax.set_ylabel(f"pose NEES (ideal {first['dof']})")
    ax.grid(alpha=0.25)
    return ax


def plot_noise(noise: dict[str, Any], *, ax: Axes, label: Mapping[str, str] | None = None) -> Axes:
    """Autocorrelation of the measurements' errors over lags in steps; 0 where they are white.

    `noise` has `lags`, and `pixel_correlation` and `rate_correlation` by axis; a curve may be
    called otherwise by `label`.
    """
    axes = ax
    curves = {
        **{f"pixel error {axis}": values for axis, values in noise["pixel_correlation"].items()},
        **{f"rate error {axis}": values for axis, values in noise["rate_correlation"].items()},
    }
    axes.axhline(0, color=GREY, lw=0.8)
    for i, (name, values) in enumerate(curves.items()):
        told = (label or {}).get(name, name)
        axes.plot(noise["lags"], values, marker="o", ms=3, lw=1.4, label=told, **line_style(i))
    axes.set_xlabel("lag, steps")
    axes.set_ylabel("autocorrelation (0 if white)")
    set_title(axes, "errors of the measurements")
    axes.legend(fontsize=7, ncols=2)
    axes.grid(alpha=0.25)
    return axes
