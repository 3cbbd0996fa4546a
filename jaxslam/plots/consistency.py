"""The figure of a consistency study: mean NEES with its band, a sample run's errors, its map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxslam._runtime.files import Json
from jaxslam._runtime.lookup import lookup
from jaxslam.consistency import Results, Study
from jaxslam.consistency.results import Nees
from jaxslam.consistency.summary import results_of
from jaxslam.evaluation.result import OUTSIDE
from jaxslam.plots.landmarks import region_from_above
from jaxslam.plots.style import (
    COLUMN,
    GREY,
    MEDIAN_DASH,
    End,
    column_title,
    for_print,
    label_ends,
    line_style,
    name_numbers,
    new_figure,
    save,
    set_title,
    short_names,
)
from jaxslam.statistics.verdict import brief, headline

Drawn = Study | Results | Mapping[str, Json]
"""What is drawn: a study, its results, or the summary that `consistency.json` holds."""


def plot_consistency(
    study: Study,
    summary: Drawn | None = None,
    path: str | Path | None = None,
    *,
    column: bool = False,
) -> Figure:
    """Draw a study; `summary` is that of the study, made here if it is not given.

    Above: the mean NEES of every filter with its exact 95 % band, and the share of errors outside
    ±3σ. Where the scale is free, below that: NEES at one scale a run, and the scale's own error.
    Below: the error of run 0 with ±3σ, axis by axis, and its map at the end. As one `column` for
    print, 3.4 in wide with letters of 8 pt, it is without run 0. Written to `path` where one is
    given.
    """
    results = results_of(study if summary is None else summary)
    return save(_column(results) if column else _page(study, results), path)


def _column(results: Results) -> Figure:
    drawn = [plot_nees, plot_outside]
    if results.scale_free:
        drawn += [plot_beyond_scale, plot_log_scale]
    called = short_names(list(results))
    verdicts = [f"{called[name]}: {brief(result.verdict)}" for name, result in results.items()]
    title = column_title("\n".join([*verdicts, _world(results)]))
    lines = len(title.splitlines()) + len(results) + 2
    figure = new_figure(COLUMN, 0.14 * lines + 1.25 * len(drawn))
    figure.suptitle(title, x=0.02, ha="left")
    axes = figure.subplots(len(drawn), 1, sharex=True)
    for plot, ax in zip(drawn, axes, strict=True):
        plot(results, ax=ax)
    for ax in axes[:-1]:  # time, and a legend, stand below all
        ax.set_xlabel("")
        if (legend := ax.get_legend()) is not None:
            legend.remove()
    for_print(figure)
    return figure


def _page(study: Study, results: Results) -> Figure:
    geometry = study.scenario.geometry
    rows, free = geometry.tangent_dim // 3, results.scale_free
    heights = [2.1, *[1.3] * free, *[1.1] * rows]
    figure = new_figure(12.5, 1.0 + 0.2 * len(study.filters) + 2.1 * sum(heights))
    # Over the whole width, as the verdicts are longer than the axes that they are on.
    figure.suptitle(_title(results), x=0.01, ha="left", fontsize=11)
    # Each row by itself, as the room that names take is of its own; those of run 0 are one.
    ratios = [*heights[:-rows], sum(heights[-rows:])]
    grid = figure.add_gridspec(len(heights) - rows + 1, 1, height_ratios=ratios)
    places = [figure.add_subfigure(cell) for cell in grid]
    plots = [(plot_nees, plot_outside), *[(plot_beyond_scale, plot_log_scale)] * free]
    for place, pair in zip(places, plots, strict=False):
        for plot, ax in zip(pair, place.subplots(1, 2, width_ratios=[4, 3]), strict=True):
            plot(results, ax=ax)
    samples = {name: study.store.load(name, study.chunks[0]) for name in study.filters}
    grid = places[-1].add_gridspec(rows, 4)
    axes = [places[-1].add_subplot(grid[r, c]) for r in range(rows) for c in range(3)]
    _plot_errors(axes, samples, results.time, geometry.point_dim)
    _plot_map(places[-1].add_subplot(grid[:, 3]), samples)
    return figure


Labels = Mapping[str, str]
"""What filters are called at the ends of their lines: `{"robocentric/inverse_depth": "UID"}`."""


def plot_nees(summary: Drawn, *, ax: Axes, label: Labels | None = None) -> Axes:
    """Mean NEES of every filter over time with its exact 95 % band, and the medians, dotted.

    `summary` is of `summarise`, or a study. Names stand at the ends of the lines; a filter may be
    called otherwise by `label`.
    """
    results = results_of(summary)
    shown = results.reference
    _plot_means({name: r.nees for name, r in results.items()}, results, ax, label)
    ax.set_ylabel(f"pose NEES (ideal {shown.nees.dof})")
    band = f"grey: exact 95 % band of {shown.survivors} runs"
    if not shown.survivors:
        band = "every run diverged, so that there is no mean"
    set_title(ax, f"mean NEES; dotted: median{_of_some(results)}\n{band}")
    return ax


def _of_some(results: Results) -> str:
    """The text that says of which runs the medians are, where it is not all."""
    some = results.medians_of
    return "" if some == results.runs else f" of the first {some} runs"


def _plot_means(each: dict[str, Nees], results: Results, ax: Axes, label: Labels | None) -> None:
    """Means with the band of the filter with most surviving runs, and medians, over time."""
    shown = each[results.reference.name]
    if results.reference.survivors:
        ax.axhspan(*shown.band, color=GREY, alpha=0.25, lw=0)
    ax.axhline(shown.dof, color=GREY, lw=0.8)
    pairs = {name: (nees.mean, nees.median) for name, nees in each.items()}
    lines = _plot_pairs(pairs, results, ax, label, lw=0.9, ls=MEDIAN_DASH)
    ax.set_yscale("log")
    bottom, top = ax.get_ylim()
    ax.set_ylim(min(bottom, shown.dof / 2), max(top, shown.dof * 1.5))
    name_numbers(ax.yaxis)
    label_ends(ax, lines)


def _plot_pairs(
    pairs: Mapping[str, Sequence[ArrayLike]],
    results: Results,
    ax: Axes,
    label: Labels | None,
    **second: Any,
) -> list[End]:
    """Two lines of every filter over time, the `second` in a style of its own.

    Returns the ends of the first, to be named when the limits of the axes are set.
    """
    lookup("label", label or pairs, dict.fromkeys(pairs))
    called = {**short_names(list(pairs)), **(label or {})}
    time, lines = results.time, []
    for i, (name, pair) in enumerate(pairs.items()):
        style = line_style(i)
        values, others = (np.where(np.isfinite(x), x, np.nan) for x in pair)
        ax.plot(time, values, lw=1.8, **style)
        ax.plot(time, others, color=style["color"], **{"ls": style["linestyle"], **second})
        lines.append(End(called[name], time, values, style["color"]))
    ax.set(xlim=(0, time[-1]), xlabel="time, s")
    ax.grid(alpha=0.25, which="major")
    return lines


def plot_outside(summary: Drawn, *, ax: Axes, label: Labels | None = None) -> Axes:
    """Share of errors outside ±3σ over time, of the position (solid) and the orientation (thin).

    Names stand at the ends of the position's lines; a filter may be called otherwise by `label`.
    """
    results = results_of(summary)
    outside = {name: result.outside3sigma for name, result in results.items()}
    percent = {name: [100 * x.position, 100 * x.orientation] for name, x in outside.items()}
    lines = _plot_pairs(percent, results, ax, label, lw=0.8)
    ax.axhline(100 * OUTSIDE, color=GREY, lw=0.8)
    ax.set(ylim=(0, max(1.0, ax.get_ylim()[1])), ylabel="% of errors")
    set_title(ax, "outside ±3σ: position, orientation (thin)\ngrey: 0.27 % of Gaussian errors")
    label_ends(ax, lines)
    return ax


def _with_scale(given: Drawn) -> Results:
    """Results that have the scale's error. Raises ValueError where the scale is no unknown."""
    results = results_of(given)
    if not results.scale_free:
        raise ValueError("the scale of this scenario is measured: there is no error of it to draw")
    return results


def plot_beyond_scale(summary: Drawn, *, ax: Axes, label: Labels | None = None) -> Axes:
    """Mean and median NEES at the one scale of a run that explains all of its poses best.

    Where the scale is free; names at the ends of the lines, or those of `label`.
    """
    results = _with_scale(summary)
    _plot_means({name: r.beyond_scale for name, r in results.items()}, results, ax, label)
    dof = results.reference.beyond_scale.dof
    ax.set_ylabel(f"NEES (ideal {dof - 1} to {dof})")
    set_title(ax, f"NEES at one scale a run; dotted: median{_of_some(results)}")
    return ax


def plot_log_scale(summary: Drawn, *, ax: Axes, label: Labels | None = None) -> Axes:
    """The error of log-scale and what it should be by the σ claimed: medians, as one reversed run,
    which no scale explains, has an error and a σ beyond all others.

    Where the scale is free; names at the ends of the lines, or those of `label`.
    """
    results = _with_scale(summary)
    # 0.6745 is the median of |x| for a standard normal x.
    scales = {name: result.log_scale for name, result in results.items()}
    pairs = {name: (x.error_median, 0.6745 * x.sigma_median) for name, x in scales.items()}
    lines = _plot_pairs(pairs, results, ax, label, lw=0.9, ls=(0, (4, 2)))
    if results.reference.survivors:
        ax.set_yscale("log")
        name_numbers(ax.yaxis)
    ax.set_ylabel("error of ln(scale)")
    of = _of_some(results) or " of the runs"
    set_title(ax, f"scale: median error{of}\ndashed: by the σ claimed, 0.67 of its median")
    label_ends(ax, lines)
    return ax


def _title(results: Results) -> str:
    """The verdict on every filter, how many of its runs were lost, and what was run."""
    verdicts = []
    for name, result in results.items():
        ever = result.lost_ever[-1]
        lost = f"; {ever:.1%} of the runs lost" if ever else ""
        verdicts.append(f"{name}: {headline(result.verdict)}{lost}")
    return "\n".join([*verdicts, f"{_world(results)}; over all steps, [99 % interval]"])


def _world(results: Results) -> str:
    return f"{results.scenario['name']}, {results.runs} runs, seed {results.seed}"


def _plot_errors(
    axes: list[Axes], samples: Mapping[str, Mapping[str, np.ndarray]], time: np.ndarray, n: int
) -> None:
    turns = [f"rotation about {x}" for x in "xyz"]
    labels = ["x", "z", "θ"] if n == 2 else ["x", "y", "z", *turns]
    for axis, (label, ax) in enumerate(zip(labels, axes, strict=True)):
        position = axis < n
        scale = 1.0 if position else 180 / np.pi
        for i, records in enumerate(samples.values()):
            style = line_style(i)
            bound = 3 * np.sqrt(records["variance"][0, :, axis]) * scale
            ax.fill_between(time, -bound, bound, color=style["color"], alpha=0.12, lw=0)
            ax.plot(time, bound, time, -bound, lw=0.8, alpha=0.8, **style)
            ax.plot(time, records["error"][0, :, axis] * scale, lw=1.5, **style)
        set_title(ax, f"run 0: {label} with ±3σ")
        ax.set(ylabel="m" if position else "degrees", xlim=(0, time[-1]))
        ax.grid(alpha=0.25)
        if axis >= len(axes) - 3:
            ax.set_xlabel("time, s")


def _plot_map(axes: Axes, samples: Mapping[str, Mapping[str, np.ndarray]]) -> None:
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
            covariance = records["sample_landmarks_covariance"][slot]
            region = region_from_above(records["sample_landmarks"][slot], covariance)
            axes.plot(*(path[-1, [0, -1], None] + region), lw=0.8, alpha=0.8, **style)
    _set_view(axes, truth[:, [0, -1]], points[seen][:, [0, -1]])
    axes.set(xlabel="x, m", ylabel="z, m")
    # Said in the title: a legend would hide landmarks and ticks of a narrow map.
    set_title(axes, "run 0 from above, 95 % regions\nblack: the truth")
    axes.grid(alpha=0.25)


def _set_view(axes: Axes, path: np.ndarray, points: np.ndarray) -> None:
    """Show the path and the landmarks, but none of the very far ones."""
    distance = np.linalg.norm(points - path.mean(axis=0), axis=1)
    near = np.concatenate([path, points[distance <= 2.5 * np.median(distance)]])
    margin = 0.12 * np.ptp(near, axis=0).max()
    x, y = np.stack([near.min(axis=0) - margin, near.max(axis=0) + margin], axis=1)
    # Free to grow to where the axes have room, without a warning.
    axes.set(xlim=x, ylim=y, autoscale_on=True)
    axes.set_aspect("equal", adjustable="datalim")
