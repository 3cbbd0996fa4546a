"""The map laid over frames of the video that it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.plots.landmarks import draw_ellipses
from jaxslam.plots.style import COLOURS, new_figure, save, set_title

SIGMAS = 3.0
_PER_ROW, _WIDTH = 3, 4.2
_FAINT = 2.0
"""Lightness of white in what is drawn as grey: the frame steps back behind the map."""


class Laid(NamedTuple):
    """A frame, and where the landmarks of the map are in it."""

    title: str
    image: UInt8[np.ndarray, "h w"]
    pixels: Float[np.ndarray, "n 2"]
    """(u, v); what is not finite is not drawn."""
    covariances: Float[np.ndarray, "n 2 2"]
    """Pixels²."""


def plot_frames(frames: Sequence[Laid], path: str | Path | None = None) -> Figure:
    """Draw the map over some frames, three in a row; written to `path` where one is given.

    Crosses are landmarks, ellipses three standard deviations of where the map has them. Raises
    ValueError where there is no frame.
    """
    if not frames:
        raise ValueError("no frame to draw: at least one is needed")
    height, width = frames[0].image.shape
    columns = min(len(frames), _PER_ROW)
    rows = -(-len(frames) // columns)
    figure = new_figure(_WIDTH * columns, rows * (_WIDTH * height / width + 0.4))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes:
        ax.axis("off")
    for ax, frame in zip(axes, frames, strict=False):
        plot_frame(frame, ax=ax)
    return save(figure, path)


def plot_frame(frame: Laid, *, ax: Axes, label: str | None = None) -> Axes:
    """One frame with the map over it, in pixels; `label` in place of its title."""
    height, width = frame.image.shape
    # Light, so that dark lines of any colour stand out on it.
    ax.imshow(255 - (255 - frame.image.astype(float)) / _FAINT, cmap="gray", vmin=0, vmax=255)
    shown = np.isfinite(frame.pixels).all(axis=1)
    pixels, covariances = frame.pixels[shown], frame.covariances[shown]
    ax.plot(*pixels.T, "+", color=COLOURS[1], ms=5, mew=1.0)
    draw_ellipses(ax, pixels, covariances, SIGMAS, COLOURS[0])
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    set_title(ax, frame.title if label is None else label)
    return ax
