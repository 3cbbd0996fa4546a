"""The figure of a point seen from two places: its regions from above, the density of its depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from jaxslam.plots.style import GREY, LineStyle, line_style, new_figure, save
from jaxslam.triangulation import Comparison, Samples, marginal, quantiles, shares_up_to

_TRUTH = "triangulation"
_LABELS = {
    "triangulation": "truth: triangulation",
    "posterior": "truth: posterior with the prior",
    "inverse_scaling": "Inverse Scaling",
    "inverse_depth": "Unified Inverse Depth",
    "cartesian": "Cartesian",
}
Limits = tuple[float, float]
Distributions = dict[str, Samples]
Styles = dict[str, LineStyle]


def plot_triangulation(comparison: Comparison, path: str | Path | None = None) -> Figure:
    """Draw a comparison at its exact pixels; written to `path` if one is given.

    Left: regions of (x, z) in the second camera, with x measured from the ray to the true point.
    Right: the density of the depth, and the difference of each distribution function of the depth
    from that of triangulation, the largest of which is the KS distance.
    """
    views = comparison.views
    distributions = {**comparison.truth, **comparison.estimates}
    low, high = _limits(distributions, {name: of.z for name, of in distributions.items()})
    depths = max(low, -views.depth), min(high, 4 * views.depth)
    styles: Styles = {
        _TRUTH: {"color": GREY, "linestyle": "-"},
        "posterior": {"color": "black", "linestyle": (0, (1, 1.5))},
    }
    for i, name in enumerate(comparison.estimates):
        # Dashes distinguish curves that coincide.
        styles[name] = line_style(i) | {"linestyle": ("-", "--", "-.")[i % 3]}
    figure = new_figure(11.5, 5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.25], height_ratios=[1.5, 1])
    density = figure.add_subplot(grid[0, 1])
    difference = figure.add_subplot(grid[1, 1], sharex=density)
    _plot_plane(figure.add_subplot(grid[:, 0]), distributions, views.point, depths, styles)
    at = np.linspace(*depths, 400)
    share = {n: shares_up_to(marginal(of.z, of.weight), at) for n, of in distributions.items()}
    for name, of in distributions.items():
        counts, edges = np.histogram(of.z, 120, range=depths, weights=of.weight)
        smooth = gaussian_filter(counts / of.weight.sum() / (edges[1] - edges[0]), 1.0)
        centres = (edges[:-1] + edges[1:]) / 2
        if name == _TRUTH:
            density.fill_between(centres, smooth, color=GREY, alpha=0.25, lw=0)
        density.plot(centres, smooth, lw=1.5, label=_LABELS.get(name, name), **styles[name])
        difference.plot(at, share[name] - share[_TRUTH], lw=1.5, **styles[name])
    density.set_ylabel("density of the depth, 1/m")
    density.set_ylim(0, 1.15 * density.get_ylim()[1])
    density.set_xlim(*depths)
    density.tick_params(labelbottom=False)
    density.legend(fontsize=8, loc="upper right")
    difference.set_xlabel("depth z, m")
    difference.set_ylabel("distribution function\nminus that of triangulation")
    for axes in figure.axes:
        axes.grid(alpha=0.25)
    figure.suptitle(
        f"a point at {views.depth:g} m, pixel {views.pixel:g}, seen from a baseline of "
        f"{views.baseline:g} m; calibration {views.calibration}, $d_{{min}}$ "
        f"{views.nearest_depth:g} m",
        fontsize=11,
    )
    return save(figure, path)


def _limits(of: Distributions, values: dict[str, Float[np.ndarray, " n"]]) -> Limits:
    """An interval that holds nearly all of every distribution that is not beyond infinity."""
    ends = []
    for name, value in values.items():
        if (seen := np.isfinite(value)).any():
            tails = np.array([0.003, 1 - 0.003])
            ends.append(quantiles(marginal(value[seen], of[name].weight[seen]), tails))
    return float(np.min(ends)), float(np.max(ends))


def _plot_plane(
    axes: Axes, distributions: Distributions, point: Limits, depths: Limits, styles: Styles
) -> None:
    """Regions of 50 % and 95 % in the second camera."""
    offsets = {}
    for name, of in distributions.items():
        with np.errstate(invalid="ignore"):  # ∞ − ∞ has no place in the picture
            offset = of.x - point[0] / point[1] * of.z
        offsets[name] = np.where((of.z >= depths[0]) & (of.z <= depths[1]), offset, np.nan)
    truth = distributions[_TRUTH].z
    # At random: neighbours in an evenly spread sequence would show its lattice.
    dots = np.random.default_rng(0).choice(truth.size, min(4000, truth.size), replace=False)
    axes.plot(offsets[_TRUTH][dots], truth[dots], ".", color=GREY, alpha=0.35, ms=2, mew=0)
    width = _limits(distributions, offsets)
    for name, of in distributions.items():
        x, seen = offsets[name], np.isfinite(of.z)
        counts, *edges = np.histogram2d(
            x[seen], of.z[seen], 100, [width, depths], weights=of.weight[seen] / of.weight.sum()
        )
        density = gaussian_filter(counts, 2.0)
        falling = np.sort(density, axis=None)[::-1]
        inside = np.cumsum(falling)
        # A region that reaches out of the axes, or to infinity, has no outline in them.
        levels = {falling[np.searchsorted(inside, s)] for s in (0.5, 0.95) if s < inside[-1]}
        if levels:
            color, dash = styles[name].values()
            axes.contour(
                *((e[1:] + e[:-1]) / 2 for e in edges), density.T, sorted(levels), colors=color,
                linestyles=[dash], linewidths=1.5,
            )  # fmt: skip
    axes.plot(0, point[1], "k+", ms=9, mew=1.5)
    axes.set_title("+ the point, particles of triangulation, regions of 50 % and 95 %", fontsize=9)
    axes.set_xlim(*width)
    axes.set_ylim(*depths)
    axes.set_xlabel("x from the second camera's ray to the point, m")
    axes.set_ylabel("depth z, m")
