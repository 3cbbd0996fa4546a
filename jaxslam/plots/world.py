"""The figure of a simulated world, from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.plots.style import COLOURS, GREY, new_figure, save, set_title


def plot_world(
    title: str,
    poses: Float[np.ndarray, "frames m m"],
    points: Float[np.ndarray, "frames l n"],
    visible: Bool[np.ndarray, "frames l"],
    beacons: Float[np.ndarray, "b n"],
    path: str | Path | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """A world from above: true poses T_BC, landmarks in B, which of them are measured in a frame,
    and beacons as surveyed, m; in axes of your own, or in a figure that is written to `path`."""
    track, ahead = poses[:, [0, -2], -1], poses[-1, [0, -2], -2]
    points, beacons = points[..., [0, -1]], beacons[:, [0, -1]]
    seen, now = np.unique(points[visible], axis=0), points[-1][visible[-1]]
    ax = new_figure(5.5, 5.5).subplots() if ax is None else ax
    ax.plot(*track.T, color="black", lw=1.2, label="true path")
    ax.plot(*track[0], "o", color="black", ms=4)
    for places, label, marker, colour, fill in (
        (points[0][~visible.any(axis=0)], "never measured", "x", GREY, GREY),
        (seen, "measured", "o", COLOURS[0], "none"),
        (now, "measured in the last frame", "o", COLOURS[0], COLOURS[0]),
        (beacons, "beacon, as surveyed", "s", COLOURS[1], "none"),
    ):
        if len(places):
            ax.plot(*places.T, marker, ms=5, mfc=fill, color=colour, label=label)
    tip = track[-1] + 0.08 * np.ptp(np.concatenate([track, seen]), axis=0).max() * ahead
    ax.annotate("", tuple(tip), tuple(track[-1]), arrowprops={"arrowstyle": "->", "lw": 1.5})
    ax.set(aspect="equal", adjustable="datalim", xlabel="x, m", ylabel="z, m")
    ax.grid(alpha=0.25)
    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    set_title(ax, f"{title}\ndot: start, arrow: last camera")
    return save(figure, path)
