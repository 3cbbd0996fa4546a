"""The figure of Starry Night: mean NEES over the windows, and how its noise is correlated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxslam.plots.style import GREY, line_style, new_figure, save

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
        _plot_nees(axes, filters)
        axes.sharey(places[0])
        windows = next(iter(filters.values()))["windows"]
        axes.set_title(f"{variant}: {windows} windows", fontsize=10)
    most = max(max(f["nees"]) for filters in variants.values() for f in filters.values())
    places[0].set_ylim(2, min(1.2 * max(most, 10), MOST_NEES))
    _plot_noise(places[-1], summary["noise"])
    handles, labels = places[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    if path is not None:
        save(figure, path)
    return figure


def _plot_nees(axes: Axes, filters: dict[str, Any]) -> None:
    first = next(iter(filters.values()))
    axes.axhspan(*first["band95"], color=GREY, alpha=0.25, lw=0, label="95 % band of the mean")
    axes.axhline(first["dof"], color=GREY, lw=0.8)
    steps = range(1, len(first["nees"]) + 1)
    for i, (name, f) in enumerate(filters.items()):
        style = line_style(i)
        axes.plot(steps, f["nees"], lw=1.6, label=name, **style)
        axes.plot(steps, f["nees_median"], color=style["color"], lw=0.9, ls=":")
    axes.plot([], [], color=GREY, lw=0.9, ls=":", label="median (5.35 for χ²₆)")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("step of the window")
    axes.set_ylabel(f"pose NEES (ideal {first['dof']})")
    axes.grid(alpha=0.25)


def _plot_noise(axes: Axes, noise: dict[str, Any]) -> None:
    curves = {
        **{f"pixel error {axis}": values for axis, values in noise["pixel_correlation"].items()},
        **{f"rate error {axis}": values for axis, values in noise["rate_correlation"].items()},
    }
    axes.axhline(0, color=GREY, lw=0.8)
    for i, (name, values) in enumerate(curves.items()):
        axes.plot(noise["lags"], values, marker="o", ms=3, lw=1.4, label=name, **line_style(i))
    axes.set_xlabel("lag, steps")
    axes.set_ylabel("autocorrelation (0 if white)")
    axes.set_title("errors of the measurements", fontsize=10)
    axes.legend(fontsize=7, ncols=2)
    axes.grid(alpha=0.25)
