"""The figure of Starry Night: mean NEES over the windows, and how its noise is correlated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.plots.style import GREY, line_style, new_figure, save


def plot_starry_night(summary: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw `{"variants": {variant: {filter: numbers}}, "noise": …}`; a panel for each variant."""
    variants = {name: found for name, found in summary["variants"].items() if found}
    columns = min(len(variants) + 1, 3)
    rows = -(-(len(variants) + 1) // columns)
    figure = new_figure(4.6 * columns, 3.7 * rows)
    grid = figure.add_gridspec(rows, columns)
    places = [figure.add_subplot(grid[i // columns, i % columns]) for i in range(len(variants) + 1)]
    for axes, (variant, filters) in zip(places, variants.items(), strict=False):
        _plot_nees(axes, filters)
        windows = next(iter(filters.values()))["windows"]
        axes.set_title(f"{variant}: {windows} windows", fontsize=10)
    _plot_noise(places[-1], summary["noise"])
    if path is not None:
        save(figure, path)
    return figure


def _plot_nees(axes: Axes, filters: dict[str, Any]) -> None:
    first = next(iter(filters.values()))
    axes.axhspan(*first["band95"], color=GREY, alpha=0.25, lw=0, label="exact 95 % band")
    axes.axhline(first["dof"], color=GREY, lw=0.8)
    for i, (name, f) in enumerate(filters.items()):
        axes.plot(range(1, len(f["nees"]) + 1), f["nees"], lw=1.6, label=name, **line_style(i))
    axes.set_yscale("log")
    axes.set_ylim(min(axes.get_ylim()[0], 3), max(axes.get_ylim()[1], 12))
    axes.set_xlabel("step of the window")
    axes.set_ylabel(f"mean pose NEES (ideal {first['dof']})")
    axes.legend(fontsize=8)
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
