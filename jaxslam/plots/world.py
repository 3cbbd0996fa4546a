"""The figure of a simulated world, from above."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from jaxslam.plots.style import COLOURS, GREY, new_figure, save, set_title
from jaxslam.simulation import Run, World, simulate


def plot_world(world: World, run: Run | int = 0, path: str | Path | None = None) -> Figure:
    """A world from above: the true path of a run, its landmarks, which of them the last frame sees.

    `run` is a run, or i of run i of a study with seed 0. The figure is written to `path` where one
    is given.
    """
    if not isinstance(run, Run):
        key = jax.random.fold_in(jax.random.key(0), run)
        run = jax.jit(partial(simulate, world))(key)
    T = np.asarray(run.poses.as_matrix())
    track, ahead = T[:, [0, -2], -1], T[-1, [0, -2], -2]
    points, visible = np.asarray(run.points_by_frame)[..., [0, -1]], np.asarray(run.visible)
    seen, now = np.unique(points[visible], axis=0), points[-1][visible[-1]]
    figure = new_figure(5.5, 5.5)
    ax = figure.subplots()
    ax.plot(*track.T, color="black", lw=1.2, label="true path")
    ax.plot(*track[0], "o", color="black", ms=4)
    if run.new is None:
        ax.plot(*points[0][~visible.any(axis=0)].T, "x", color=GREY, ms=4, label="never measured")
    ax.plot(*seen.T, "o", mfc="none", color=COLOURS[0], ms=5, label="measured")
    ax.plot(*now.T, "o", color=COLOURS[0], ms=5, label="measured in the last frame")
    if run.known is not None:
        known = np.asarray(run.known.points)[:, [0, -1]]
        ax.plot(*known.T, "s", mfc="none", color=COLOURS[1], ms=9, label="beacon, as surveyed")
    size = np.ptp(np.concatenate([track, seen]), axis=0).max()
    ax.annotate(
        "", track[-1] + 0.08 * size * ahead, track[-1], arrowprops={"arrowstyle": "->", "lw": 1.5}
    )
    ax.set(aspect="equal", xlabel="x, m", ylabel="z, m")
    ax.grid(alpha=0.25)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    told = f"{world.steps} steps at {float(world.rate):g} Hz; dot: start, arrow: last camera"
    set_title(ax, f"{world.name} from above\n{told}")
    return save(figure, path)
