"""The figure of the exact posterior: one run's draws beside the Gaussians, and all runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from jaxslam.plots.style import COLOURS, GREY, new_figure, save

ELLIPSE_SIGMAS = 2.4477
"""Half axes of the region with 95 % of a Gaussian in the plane, in σ."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


def plot_posterior(summary: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw the content of `posterior.json`, one column a scenario, at its last step.

    Above: draws of the exact posterior of the camera's position in one run, with the 95 %
    ellipses of MAP + Laplace, of the first filter and of the last. Middle: mean pose NEES by step.
    Below: the filters' σ of position over the exact one.
    """
    scenarios = _compared(summary["scenarios"])
    if not scenarios:
        raise ValueError("there is nothing to draw: the chains of no scenario converged")
    figure = new_figure(4.4 * len(scenarios), 9.5)
    axes = figure.subplots(
        3, len(scenarios), squeeze=False, gridspec_kw={"height_ratios": (1.5, 1, 0.8)}
    )
    for row in axes[1:]:
        for axis in row[1:]:
            axis.sharey(row[0])
    for column, (name, by_step) in zip(axes.T, scenarios.items(), strict=True):
        steps = max(by_step, key=int)
        _draws(column[0], by_step[steps]["telling"])
        column[0].set_title(f"{name}: one run at step {steps}", fontsize=10)
        _nees(column[1], by_step)
        _sigma(column[2], by_step)
    bottom, top = axes[1, 0].get_ylim()
    axes[1, 0].set_ylim(min(bottom, 2), max(top, 6))
    axes[2, 0].set_ylim(0, max(1.15, axes[2, 0].get_ylim()[1]))
    axes[1, 0].set_ylabel("mean pose NEES")
    axes[2, 0].set_ylabel("σ of position / exact σ")
    for row, columns in ((0, 3), (1, 3)):
        handles, labels = axes[row, 0].get_legend_handles_labels()
        axes[row, 0].figure.legend(
            handles,
            labels,
            loc=f"outside {('upper', 'lower')[row]} center",
            ncols=columns,
            fontsize=9,
        )
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


def _style(names: list[str]) -> dict[str, dict[str, Any]]:
    """Colour and mark of everything that is compared, the same in every panel."""
    return {
        name: {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)]}
        for i, name in enumerate(names)
    }


def _draws(axis: Axes, telling: dict[str, Any]) -> None:
    draws = np.array(telling["draws"])
    axis.plot(*draws.T[[0, -1]], ".", color=GREY, ms=2, alpha=0.5, label="draws, exact posterior")
    axis.plot(*np.array(telling["truth"])[[0, -1]], "k*", ms=11, label="true position")
    gaussians = telling["gaussians"]
    names = list(gaussians)
    style = _style(names)
    for name in dict.fromkeys([*names[:2], names[-1]]):
        gaussian = gaussians[name]
        mean, P = np.array(gaussian["mean"]), np.array(gaussian["covariance"])
        P = P[np.ix_([0, -1], [0, -1])]
        values, vectors = np.linalg.eigh(P)
        turn = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        half = ELLIPSE_SIGMAS * np.sqrt(values)
        ellipse = Ellipse(
            (float(mean[0]), float(mean[-1])),
            2 * half[1],
            2 * half[0],
            angle=turn,
            fill=False,
            lw=1.6,
            ls="-" if names.index(name) < len(COLOURS) else "--",
            edgecolor=style[name]["color"],
            label=f"{name}, 95 %",
        )
        axis.add_patch(ellipse)
        axis.plot(*mean[[0, -1]], "+", color=style[name]["color"], ms=8)
    axis.autoscale_view()
    axis.set_xlabel("x, sideways, m")
    axis.set_ylabel("z, ahead, m")
    axis.grid(alpha=0.25)


def _nees(axis: Axes, by_step: dict[str, Any]) -> None:
    steps = sorted(by_step, key=int)
    x = np.arange(len(steps))
    one = by_step[steps[0]]
    filters = list(one["filters"])
    style = _style(["gaussian_prior_laplace", *filters])
    named: dict[str, tuple[str, dict[str, Any]]] = {
        "exact": ("exact posterior", {"color": "k", "marker": "o"}),
        "gaussian_prior": ("… with the untruncated prior", {"color": GREY, "marker": "s"}),
        "gaussian_prior_laplace": ("MAP + Laplace", style["gaussian_prior_laplace"]),
    }
    low, high = np.array([by_step[s]["nees"]["exact"]["band95"] for s in steps]).T
    axis.bar(x, high - low, 0.6, low, color=GREY, alpha=0.25, label="95 % band")
    offsets = _offsets(len(named) + len(filters))
    for offset, (key, (label, line)) in zip(offsets, named.items(), strict=False):
        values = [_value(by_step[s]["nees"][key]["mean"]) for s in steps]
        axis.plot(x + offset, values, label=label, **line)
    for offset, name in zip(offsets[len(named) :], filters, strict=True):
        values = [_value(by_step[s]["filters"][name]["nees"]["mean"]) for s in steps]
        axis.plot(x + offset, values, label=name, ls="--", **style[name])
    axis.set_yscale("log")
    axis.set_xticks(x, steps)
    axis.set_xlabel("steps, 1/30 s")
    ticks = [2, 3, 4, 5, 7, 10, 20, 50, 100, 200, 500, 1000, 10000]
    axis.yaxis.set_major_locator(FixedLocator(ticks))
    axis.yaxis.set_major_formatter(ScalarFormatter())
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.25)


def _sigma(axis: Axes, by_step: dict[str, Any]) -> None:
    steps = sorted(by_step, key=int)
    x = np.arange(len(steps))
    filters = list(by_step[steps[0]]["filters"])
    style = _style(["gaussian_prior_laplace", *filters])
    axis.axhline(1, color="k", lw=1)
    rows = [("gaussian_prior_laplace", [by_step[s]["laplace"] for s in steps], "-")]
    rows += [(name, [by_step[s]["filters"][name] for s in steps], "--") for name in filters]
    for offset, (name, numbers, dash) in zip(_offsets(len(rows)), rows, strict=True):
        values = [_value(number["position"]["sigma_ratio"]) for number in numbers]
        axis.plot(x + offset, values, ls=dash, **style[name])
    axis.set_xticks(x, steps)
    axis.set_xlabel("steps, 1/30 s")
    axis.grid(alpha=0.25)


def _offsets(count: int) -> np.ndarray:
    """Sideways shifts by which equal values do not hide each other."""
    return 0.4 * (np.arange(count) / (count - 1) - 0.5)


def _value(number: float | None) -> float:
    return np.nan if number is None else number
