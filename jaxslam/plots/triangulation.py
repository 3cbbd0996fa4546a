"""The figure of a point seen twice: its regions from above, and the density of its depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from jaxslam.plots.style import GREY, line_style, new_figure, save
from jaxslam.triangulation import Comparison, Samples, marginal, quantiles, shares_up_to

_REGIONS = (0.5, 0.95)
"""Shares of a distribution inside the contours that are drawn."""
_TAIL = 0.003
"""Share of a distribution that may lie outside the axes, on each side."""
_FARTHEST = 4.0
"""Times the true depth that the figure reaches, at the most."""
_DOTS = 4000
"""Particles of the truth that are drawn one by one."""
_PLANE_BINS, _DEPTH_BINS, _SMOOTH = 100, 120, 2.0
_TRUTH = "triangulation"
Limits = tuple[float, float]
_LABELS = {
    "triangulation": "truth: triangulation",
    "posterior": "truth: posterior with the prior",
    "inverse_scaling": "Inverse Scaling",
    "inverse_depth": "Unified Inverse Depth",
    "cartesian": "Cartesian",
}


def plot_triangulation(comparison: Comparison, path: str | Path | None = None) -> Figure:
    """Draw a comparison at its exact pixels; written to `path` where one is given.

    Left: regions of (x, z) in the second camera, x measured from the ray to the true point, since
    off the axis all regions are thin along it; the estimates are as bent as their parametrization
    bends them. Right: the density of the depth, and how far each distribution function of the
    depth is from the particles' of triangulation: the furthest is the KS distance.
    """
    views = comparison.views
    figure = new_figure(11.5, 5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.25], height_ratios=[1.5, 1])
    density = figure.add_subplot(grid[0, 1])
    plot_plane(comparison, ax=figure.add_subplot(grid[:, 0]))
    plot_density(comparison, ax=density)
    plot_difference(comparison, ax=figure.add_subplot(grid[1, 1], sharex=density))
    density.tick_params(labelbottom=False)
    density.set_xlabel("")
    figure.suptitle(
        f"a point at {views.depth:g} m, pixel {views.pixel:g}, seen from a baseline of "
        f"{views.baseline:g} m; calibration {views.calibration}, $d_{{min}}$ "
        f"{views.nearest_depth:g} m",
        fontsize=11,
    )
    return save(figure, path)


def _distributions(comparison: Comparison) -> dict[str, Samples]:
    return {**comparison.truth, **comparison.estimates}


def _depths(comparison: Comparison) -> Limits:
    """The range of the axes of depth, m."""
    farthest = _FARTHEST * comparison.views.depth
    return _limits(_distributions(comparison), lambda of: of.z, farthest)


def _styles(comparison: Comparison) -> dict[str, dict[str, Any]]:
    styles = {
        _TRUTH: {"color": GREY, "linestyle": "-"},
        "posterior": {"color": "black", "linestyle": (0, (1, 1.5))},
    }
    for i, name in enumerate(comparison.estimates):
        # Curves that lie on one another are told apart by their dashes.
        styles[name] = {**line_style(i), "linestyle": ("-", "--", "-.")[i % 3]}
    return styles


def _limits(
    distributions: Mapping[str, Samples],
    coordinate: Callable[[Samples], np.ndarray],
    farthest: float = np.inf,
) -> Limits:
    """An interval that holds nearly all of every distribution that is not beyond infinity."""
    ends = []
    for of in distributions.values():
        values = coordinate(of)
        seen = np.isfinite(values)
        if seen.any():
            tails = np.array([_TAIL, 1 - _TAIL])
            ends.append(quantiles(marginal(values[seen], of.weight[seen]), tails))
    low, high = float(np.min(ends)), float(np.max(ends))
    return max(low, -farthest / 4), min(high, farthest)


Labels = Mapping[str, str]
"""Other names of distributions: `{"inverse_depth": "UID"}`."""


def plot_plane(comparison: Comparison, *, ax: Axes, label: Labels | None = None) -> Axes:
    """Regions of 50 % and 95 % in the second camera: x from the ray to the point, and depth, m."""
    distributions, styles = _distributions(comparison), _styles(comparison)
    axes, depths, point = ax, _depths(comparison), comparison.views.point
    axes.set_title("+ the point, particles of triangulation, regions of 50 % and 95 %", fontsize=9)

    def sideways(of: Samples) -> np.ndarray:
        with np.errstate(invalid="ignore"):  # ∞ − ∞: no place in the picture
            offset = of.x - point[0] / point[1] * of.z
        return np.where((of.z >= depths[0]) & (of.z <= depths[1]), offset, np.nan)

    offsets = {name: sideways(of) for name, of in distributions.items()}
    truth = distributions[_TRUTH]
    # Neighbours in an evenly spread sequence would show its lattice.
    dots = np.random.default_rng(0).choice(truth.z.size, min(_DOTS, truth.z.size), replace=False)
    axes.plot(offsets[_TRUTH][dots], truth.z[dots], ".", color=GREY, alpha=0.35, ms=2, mew=0)
    width = _limits(distributions, sideways)
    for name, of in distributions.items():
        style = styles[name]
        edges, density, levels = _regions(offsets[name], of, (width, depths))
        if not levels:
            continue
        axes.contour(
            *edges, density.T, levels, colors=style["color"], linestyles=[style["linestyle"]],
            linewidths=1.5,
        )  # fmt: skip
        if label and name in label:
            axes.plot([], [], lw=1.5, label=label[name], **style)
    axes.plot(0, point[1], "k+", ms=9, mew=1.5)
    axes.set_xlim(*width)
    axes.set_ylim(*depths)
    axes.set_xlabel("x from the second camera's ray to the point, m")
    axes.set_ylabel("depth z, m")
    axes.grid(alpha=0.25)
    return axes


def _regions(
    x: np.ndarray, of: Samples, limits: tuple[Limits, Limits]
) -> tuple[list[np.ndarray], np.ndarray, list[float]]:
    """Centres of cells, the density in them, and the densities that bound `_REGIONS`."""
    total, seen = of.weight.sum(), np.isfinite(of.z)
    counts, *edges = np.histogram2d(
        x[seen], of.z[seen], bins=_PLANE_BINS, range=limits, weights=of.weight[seen] / total
    )
    density = gaussian_filter(counts, _SMOOTH)
    falling = np.sort(density, axis=None)[::-1]
    inside = np.cumsum(falling)
    # A region that reaches out of the axes, or to infinity, has no outline in them.
    levels = [falling[np.searchsorted(inside, s)] for s in _REGIONS if s < inside[-1]]
    return [(e[1:] + e[:-1]) / 2 for e in edges], density, sorted(set(levels))


def plot_density(comparison: Comparison, *, ax: Axes, label: Labels | None = None) -> Axes:
    """The density of the depth, 1/m, by triangulation (grey), posterior and estimates."""
    distributions, styles = _distributions(comparison), _styles(comparison)
    axes, limits, named = ax, _depths(comparison), {**_LABELS, **(label or {})}
    for name, of in distributions.items():
        counts, edges = np.histogram(of.z, _DEPTH_BINS, range=limits, weights=of.weight)
        width = edges[1] - edges[0]
        density = gaussian_filter(counts / of.weight.sum() / width, _SMOOTH / 2)
        centres = edges[:-1] + width / 2
        if name == _TRUTH:
            axes.fill_between(centres, density, color=GREY, alpha=0.25, lw=0)
        axes.plot(centres, density, lw=1.5, label=named.get(name, name), **styles[name])
    axes.set_ylabel("density of the depth, 1/m")
    axes.set_ylim(0, 1.15 * axes.get_ylim()[1])
    axes.set_xlim(*limits)
    axes.set_xlabel("depth z, m")
    axes.legend(fontsize=8, loc="upper right")
    axes.grid(alpha=0.25)
    return axes


def plot_difference(comparison: Comparison, *, ax: Axes, label: Labels | None = None) -> Axes:
    """Draw how far each distribution function of the depth is from triangulation's."""
    distributions, styles = _distributions(comparison), _styles(comparison)
    axes, limits, named = ax, _depths(comparison), label or {}
    depths = np.linspace(*limits, 400)
    functions = {
        name: shares_up_to(marginal(of.z, of.weight), depths) for name, of in distributions.items()
    }
    for name, function in functions.items():
        told = named.get(name)
        axes.plot(depths, function - functions[_TRUTH], lw=1.5, label=told, **styles[name])
    axes.set_xlim(*limits)
    axes.set_xlabel("depth z, m")
    axes.set_ylabel("distribution function\nless triangulation's")
    axes.grid(alpha=0.25)
    return axes
