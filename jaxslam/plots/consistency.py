"""The figure of a consistency study: mean NEES with its band, a sample run's errors, its map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.consistency import Study, summarise
from jaxslam.consistency.verdict import headline
from jaxslam.evaluation.evaluate import OUTSIDE
from jaxslam.plots.landmarks import region_from_above
from jaxslam.plots.style import GREY, line_style, name_decades, new_figure, save

_LEGEND_LINE = 0.05
"""Of the height of the axes of NEES, on which its legend hides no curve."""
_MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| for a standard normal x."""


def plot_consistency(
    study: Study, summary: dict[str, Any] | None = None, path: str | Path | None = None
) -> Figure:
    """Draw a study; `summary` is `summarise(study)`, made here if it is not given.

    Above: the mean NEES of every filter with its exact 95 % band, and the share of errors outside
    ±3σ. Where the scale is free, below that: NEES given the scale, and the scale's own error.
    Below: the error of run 0 with ±3σ, axis by axis, and its map at the end. Written to `path`
    where one is given.
    """
    summary = summarise(study) if summary is None else summary
    geometry = study.scenario.world
    rows, free = geometry.tangent_dim // 3, summary["scale_free"]
    heights = [2.1, *[1.3] * free, *[1.1] * rows]
    figure = new_figure(12.5, 1.0 + 0.2 * len(study.filters) + 2.1 * sum(heights))
    # Over the whole width, as the verdicts are longer than the axes that they are on.
    figure.suptitle(_title(summary), x=0.01, ha="left", fontsize=10)
    grid = figure.add_gridspec(len(heights), 12, height_ratios=heights)
    plot_nees(summary, ax=figure.add_subplot(grid[0, :8]))
    plot_outside(summary, ax=figure.add_subplot(grid[0, 8:]))
    if free:
        plot_beyond_scale(summary, ax=figure.add_subplot(grid[1, :6]))
        plot_log_scale(summary, ax=figure.add_subplot(grid[1, 6:]))
    samples = {name: study.store.load(name, study.chunks[0]) for name in study.filters}
    _plot_map(figure.add_subplot(grid[1 + free :, 9:]), samples)
    axes = [
        figure.add_subplot(grid[1 + free + r, 3 * c : 3 * c + 3])
        for r in range(rows)
        for c in range(3)
    ]
    _plot_errors(axes, samples, np.array(summary["time"]), geometry.point_dim)
    if path is not None:
        save(figure, path)
    return figure


def plot_nees(summary: dict[str, Any], *, ax: Axes, label: Mapping[str, str] | None = None) -> Axes:
    """Mean NEES of every filter over time with its exact 95 % band, and the medians, dotted.

    A filter may be called otherwise in the legend: `label={"robocentric/inverse_depth": "UID"}`.
    """
    axes, label = ax, label or {}
    time = np.array(summary["time"])
    first = next(iter(summary["filters"].values()))
    low, high = first["band95"]
    band = f"exact 95 % band of the mean of {first['survivors']} runs, at one step"
    axes.axhspan(low, high, color=GREY, alpha=0.25, lw=0, label=band)
    axes.axhline(first["dof"], color=GREY, lw=0.8)
    for i, (name, f) in enumerate(summary["filters"].items()):
        style = line_style(i)
        axes.plot(
            time,
            np.array(f["nees"], float),
            lw=1.8,
            label=f"{label.get(name, name)}: {_curve(f)}",
            **style,
        )
        axes.plot(
            time, np.array(f["nees_median"], float), color=style["color"], lw=0.9, ls=(0, (1, 2))
        )
    axes.plot(
        [], [], color=GREY, lw=0.9, ls=(0, (1, 2)), label="median (2.37 for χ²₃, 5.35 for χ²₆)"
    )
    axes.set_yscale("log")
    bottom, top = axes.get_ylim()
    bottom, top = min(bottom, first["dof"] / 2), max(top, first["dof"] * 1.2)
    legend = _LEGEND_LINE * (len(summary["filters"]) + 2)
    axes.set_ylim(bottom, bottom * (top / bottom) ** (1 / (1 - min(legend, 0.5))))
    name_decades(axes)
    _over_time(axes, time)
    axes.set_ylabel(f"pose NEES (ideal {first['dof']})")
    axes.legend(fontsize=8, loc="upper left")
    return axes


def plot_outside(
    summary: dict[str, Any], *, ax: Axes, label: Mapping[str, str] | None = None
) -> Axes:
    """Share of errors outside ±3σ over time, of the position (solid) and the orientation (thin).

    Where a `label` is given for a filter, it stands at the end of its line.
    """
    time, label = np.array(summary["time"]), label or {}
    for i, (name, f) in enumerate(summary["filters"].items()):
        style, outside = line_style(i), f["outside3sigma"]
        position, orientation = (
            100 * np.array(outside[part], float) for part in ("position", "orientation")
        )
        ax.plot(time, position, lw=1.8, **style)
        ax.plot(time, orientation, lw=0.8, **style)
        if name in label:
            place = (time[-1], position[-1])
            ax.annotate(f" {label[name]}", place, color=style["color"], va="center", fontsize=8)
    ax.axhline(100 * OUTSIDE, color=GREY, lw=0.8)
    ax.set_ylim(0, max(1.0, ax.get_ylim()[1]))
    _over_time(ax, time)
    ax.set_ylabel("% of errors")
    told = "outside ±3σ: position, orientation (thin)"
    ax.set_title(f"{told}\ngrey: 0.27 % of Gaussian errors", fontsize=9)
    return ax


def _over_time(axes: Axes, time: np.ndarray) -> None:
    axes.set_xlim(0, time[-1])
    axes.set_xlabel("time, s")
    axes.grid(alpha=0.25, which="major")


def plot_beyond_scale(summary: dict[str, Any], *, ax: Axes) -> Axes:
    """Mean and median NEES at the scale of the truth that explains the estimate best."""
    axes = ax
    time = np.array(summary["time"])
    first = next(iter(summary["filters"].values()))["beyond_scale"]
    axes.axhspan(*first["band95"], color=GREY, alpha=0.25, lw=0)
    axes.axhline(first["dof"], color=GREY, lw=0.8)
    for i, f in enumerate(summary["filters"].values()):
        style, beyond = line_style(i), f["beyond_scale"]
        axes.plot(time, np.array(beyond["nees"], float), lw=1.8, **style)
        median = np.array(beyond["nees_median"], float)
        axes.plot(time, median, color=style["color"], lw=0.9, ls=(0, (1, 2)))
    axes.set_yscale("log")
    bottom, top = axes.get_ylim()
    axes.set_ylim(min(bottom, first["dof"] / 2), max(top, first["dof"] * 2.5))
    name_decades(axes)
    _over_time(axes, time)
    axes.set_title(f"pose NEES given the scale (ideal {first['dof']})", fontsize=9)
    return axes


def plot_log_scale(summary: dict[str, Any], *, ax: Axes) -> Axes:
    """The error of log-scale and what it should be by the σ claimed: medians, as one reversed run,
    which no scale explains, has an error and a σ beyond all others."""
    axes = ax
    time = np.array(summary["time"])
    for i, f in enumerate(summary["filters"].values()):
        style, scale = line_style(i), f["log_scale"]
        axes.plot(time, np.array(scale["error_median"], float), lw=1.8, **style)
        ideal = _MEDIAN_OF_NORMAL * np.array(scale["sigma_median"], float)
        axes.plot(time, ideal, color=style["color"], lw=0.9, ls=(0, (4, 2)))
    axes.plot([], [], color=GREY, lw=1.8, label="|error|, median of runs")
    axes.plot([], [], color=GREY, lw=0.9, ls=(0, (4, 2)), label="by the σ claimed: 0.67 σ, median")
    axes.set_yscale("log")
    name_decades(axes)
    _over_time(axes, time)
    axes.set_title("log of the scale: error and claimed σ", fontsize=9)
    axes.legend(fontsize=7, loc="best")
    return axes


def _title(summary: dict[str, Any]) -> str:
    """What was run, and the verdict on every filter."""
    runs = f"{summary['runs']} runs, seed {summary['seed']}; over all steps, [99 % interval]:"
    verdicts = (f"{name}: {headline(f['verdict'])}" for name, f in summary["filters"].items())
    return "\n".join([f"{summary['scenario']['name']}, {runs}", *verdicts])


def _curve(f: dict[str, Any]) -> str:
    """A curve's description."""
    inside = f"{f['inside']:.0%} of steps in the band"
    now, ever = f["lost"][-1], f["lost_ever"][-1]
    return f"{inside}, lost {now:.1%} at the end, {ever:.1%} ever" if ever else inside


def _plot_errors(axes: list[Axes], samples: dict[str, Any], time: np.ndarray, n: int) -> None:
    positions = ["x", "z"] if n == 2 else ["x", "y", "z"]
    rotations = ["θ"] if n == 2 else ["rotation about x", "rotation about y", "rotation about z"]
    for axis, ax in enumerate(axes):
        position = axis < n
        scale = 1.0 if position else 180 / np.pi
        for i, records in enumerate(samples.values()):
            style = line_style(i)
            error = records["error"][0, :, axis] * scale
            bound = 3 * np.sqrt(records["variance"][0, :, axis]) * scale
            ax.fill_between(time, -bound, bound, color=style["color"], alpha=0.12, lw=0)
            ax.plot(time, bound, time, -bound, lw=0.8, alpha=0.8, **style)
            ax.plot(time, error, lw=1.5, **style)
        label = positions[axis] if position else rotations[axis - n]
        ax.set_title(f"run 0: {label} with ±3σ", fontsize=9)
        ax.set_ylabel("m" if position else "degrees")
        ax.set_xlim(0, time[-1])
        ax.grid(alpha=0.25)
        if axis >= len(axes) - 3:
            ax.set_xlabel("time, s")


def _plot_map(axes: Axes, samples: dict[str, Any]) -> None:
    first = next(iter(samples.values()))
    truth = first["sample_true_path"][:, :-1, -1]
    seen = first["sample_active"].nonzero()[0]
    points = first["sample_points"]
    axes.plot(truth[:, 0], truth[:, -1], color="black", lw=1.2)
    axes.plot(points[:, 0], points[:, -1], "k+", ms=6, mew=1)
    for i, records in enumerate(samples.values()):
        style = line_style(i)
        path = records["sample_path"][:, :-1, -1]
        axes.plot(path[:, 0], path[:, -1], lw=1.5, **style)
        for slot in records["sample_active"].nonzero()[0]:
            region = region_from_above(
                records["sample_landmarks"][slot], records["sample_landmarks_covariance"][slot]
            )
            axes.plot(*(path[-1, [0, -1], None] + region), lw=0.8, alpha=0.8, **style)
    _set_view(axes, truth[:, [0, -1]], points[seen][:, [0, -1]])
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    # Said in the title: a legend would hide landmarks and ticks of a narrow map.
    axes.set_title("run 0 from above, 95 % regions\nblack: the truth", fontsize=9)
    axes.grid(alpha=0.25)


def _set_view(axes: Axes, path: np.ndarray, points: np.ndarray) -> None:
    """Show the path and the landmarks, but none of the very far ones."""
    distance = np.linalg.norm(points - path.mean(axis=0), axis=1)
    near = np.concatenate([path, points[distance <= 2.5 * np.median(distance)]])
    low, high = near.min(axis=0), near.max(axis=0)
    margin = 0.12 * (high - low).max()
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal", adjustable="box")
