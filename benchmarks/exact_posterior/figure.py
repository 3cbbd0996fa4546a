"""The figure of the exact posterior: one run's draws beside the Gaussians, and all runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator

from jaxslam.plots.style import (
    COLOURS,
    DASHES,
    GREY,
    MOST_NEES,
    draw_dots,
    name_numbers,
    new_figure,
    same_x,
    save,
    set_title,
)

ELLIPSE_SIGMAS = 2.4477
"""Half axes of the region with 95 % of a Gaussian in the plane, in σ."""
MOST_RATIO = 3.0
"""What is beyond is an arrow with a number."""
LAPLACE = "MAP + Laplace"
_STAGES = {
    "exact": "exact posterior",
    "gaussian_prior": "… with the untruncated prior",
    "gaussian_prior_laplace": LAPLACE,
}
Labels = Mapping[str, str]


def plot_posterior(summary: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw the content of `posterior.json`, one column a scenario, at its last step.

    Above: draws of the exact posterior of the camera's position in one run, with the 95 %
    ellipses of MAP + Laplace, of the first filter and of the last. Middle: mean pose NEES, a row
    for each method. Below: σ of position over the exact one. Raises ValueError where no chain
    converged.
    """
    scenarios = _compared(summary["scenarios"])
    if not scenarios:
        raise ValueError("there is nothing to draw: the chains of no scenario converged")
    last = {name: max(by_step, key=int) for name, by_step in scenarios.items()}
    methods = 3 + len(next(iter(scenarios.values()))[next(iter(last.values()))]["filters"])
    heights = (3.2, 0.2 * methods + 0.7, 0.2 * methods + 0.5)
    figure = new_figure(3.4 * len(scenarios) + 2.4, sum(heights) + 1.0)
    axes = figure.subplots(3, len(scenarios), squeeze=False, height_ratios=heights)
    for column, (name, steps) in zip(axes.T, last.items(), strict=True):
        numbers = scenarios[name][steps]
        plot_draws(numbers["telling"], ax=column[0])
        set_title(column[0], f"{name}: one run at step {steps}")
        plot_nees(numbers, ax=column[1])
        plot_sigma(numbers, ax=column[2])
    for row in axes[1:]:
        same_x(row)
        for axis in row[1:]:
            axis.tick_params(labelleft=False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=9)
    if path is not None:
        save(figure, path)
    return figure


def _compared(scenarios: dict[str, Any]) -> dict[str, Any]:
    """The scenarios and steps whose chains converged."""
    kept = {
        name: {steps: numbers for steps, numbers in by_step.items() if "nees" in numbers}
        for name, by_step in scenarios.items()
    }
    return {name: by_step for name, by_step in kept.items() if by_step}


def _shown(telling: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The Gaussians that have an ellipse, and how it is drawn: MAP, the first filter, the last."""
    names = list(telling["gaussians"])
    looks = zip(dict.fromkeys([*names[:2], names[-1]]), COLOURS, DASHES, strict=False)
    return {name: {"edgecolor": colour, "ls": dash} for name, colour, dash in looks}


def plot_draws(telling: dict[str, Any], *, ax: Axes, label: Labels | None = None) -> Axes:
    """Draws of the exact posterior of (x, z), m, beside the 95 % ellipses of Gaussians.

    `telling` has `draws`, `truth` and `gaussians` by name; `label` has other names for these.
    """
    draws = np.array(telling["draws"])
    ax.plot(*draws.T[[0, -1]], ".", color=GREY, ms=2, alpha=0.5, label="draws, exact posterior")
    ax.plot(*np.array(telling["truth"])[[0, -1]], "k*", ms=11, label="true position")
    for name, look in _shown(telling).items():
        gaussian = telling["gaussians"][name]
        mean, P = np.array(gaussian["mean"])[[0, -1]], np.array(gaussian["covariance"])
        told = f"{(label or {}).get(name, name)}, 95 %"
        ax.add_patch(_ellipse(mean, P[np.ix_([0, -1], [0, -1])], label=told, **look))
        ax.plot(*mean, "+", color=look["edgecolor"], ms=8)
    ax.autoscale_view()
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlabel("x, sideways, m")
    ax.set_ylabel("z, ahead, m")
    ax.grid(alpha=0.25)
    return ax


def _ellipse(mean: np.ndarray, covariance: np.ndarray, **look: Any) -> Ellipse:
    values, vectors = np.linalg.eigh(covariance)
    turn = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    short, long = 2 * ELLIPSE_SIGMAS * np.sqrt(values)
    x, z = mean.tolist()
    return Ellipse((x, z), long, short, angle=turn, fill=False, lw=1.6, **look)


def plot_nees(numbers: dict[str, Any], *, ax: Axes, label: Labels | None = None) -> Axes:
    """Mean pose NEES of the exact posterior, of its approximations and of the filters.

    `numbers` are those of a scenario and step of `posterior.json`, `label` other names of
    methods. Grey is the 95 % band of the mean.
    """
    means = {_STAGES[key]: numbers["nees"][key]["mean"] for key in _STAGES}
    means |= {name: f["nees"]["mean"] for name, f in numbers["filters"].items()}
    ax.axvspan(*numbers["nees"]["exact"]["band95"], color=GREY, alpha=0.25, lw=0)
    _rows(ax, means, MOST_NEES, label or {})
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ax.set_xlim(min(2.0, low), min(max(6.0, high), MOST_NEES))
    name_numbers(ax.xaxis)
    ax.set_xlabel("mean pose NEES; grey: 95 % band")
    return ax


def plot_sigma(numbers: dict[str, Any], *, ax: Axes, label: Labels | None = None) -> Axes:
    """σ of position that methods claim, over that of the exact posterior, likewise."""
    ratios = {LAPLACE: numbers["laplace"]["position"]["sigma_ratio"]}
    ratios |= {name: f["position"]["sigma_ratio"] for name, f in numbers["filters"].items()}
    ax.axvline(1, color="k", lw=1)
    _rows(ax, ratios, MOST_RATIO, label or {})
    ax.set_xlim(0, min(max(1.25, ax.get_xlim()[1]), MOST_RATIO))
    ax.set_xlabel("σ of position / exact σ")
    return ax


def _rows(ax: Axes, values: dict[str, float | None], most: float, label: Labels) -> None:
    """A row and a dot for each method: approximations black, filters in colour."""
    filters = [name not in _STAGES.values() for name in values]
    for colour, chosen in (("k", False), (COLOURS[0], True)):
        rows = np.flatnonzero(np.array(filters) == chosen)
        dots = np.array(list(values.values()), float)[rows]
        draw_dots(ax, dots, rows, most, colour=colour)
    ax.set_yticks(range(len(values)), [label.get(name, name) for name in values], fontsize=8)
    ax.set_ylim(len(values) - 0.4, -0.6)
    ax.grid(alpha=0.25)
