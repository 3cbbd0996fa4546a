"""The map of a tracked video: trajectory, reference and landmarks with their uncertainty."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxslam.plots.landmarks import Ellipses, Positions, Spreads, draw_ellipses
from jaxslam.plots.style import COLOURS, GREY, new_figure, save

_TRAJECTORY, _REFERENCE, _LANDMARKS, _BEGUN, _LOOPS = COLOURS[:5]
# 95 % quantile of chi-squared with two degrees of freedom
_SIGMAS_95 = math.sqrt(5.991)
_WIDTH, _LEAST_HEIGHT, _HEIGHT = 5.0, 0.9, 3.5  # of a panel, inches
_WORDS, _LEGEND = 0.7, 1.2  # height of a panel's title and label, and of the legend, inches
_TICKS, _TICK = 15, 0.05  # how many viewing directions, and how long: a share of the view's size

_Box = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]
"""The least and the greatest coordinates of a view."""


@dataclass(frozen=True)
class _Panel:
    """A view of the world along one axis."""

    title: str
    plane: list[int]
    """The coordinates to the right and up."""
    box: _Box
    with_landmarks: bool = True

    @property
    def size(self) -> float:
        """The length of the longest side of the box, the hidden one too."""
        return float(np.max(self.box[1] - self.box[0]))

    @property
    def height(self) -> float:
        """Inches."""
        across, up = (self.box[1] - self.box[0])[self.plane]
        return min(max(_WIDTH * up / across, _LEAST_HEIGHT), _HEIGHT)

    def seen(
        self, points: Positions, covariances: Spreads
    ) -> tuple[Float[np.ndarray, "n 2"], Ellipses]:
        """The points that are seen from here."""
        return points[:, self.plane], covariances[:, self.plane][:, :, self.plane]


def plot_map(
    trajectory: ArrayLike,
    points: ArrayLike,
    covariances: ArrayLike,
    *,
    reference: ArrayLike | None = None,
    path: str | Path | None = None,
    unit: str = "m",
    lost: ArrayLike = (),
    begun: ArrayLike = (),
    begun_covariances: ArrayLike = (),
    loops: ArrayLike = (),
    before: ArrayLike = (),
) -> Figure:
    """Draw the map from above (x and z) and from behind or the side (y); written to `path` where
    one is given.

    `trajectory` and `reference` are poses T_wc (n, 4, 4) and (m, 4, 4), drawn as they are (align
    them first); ticks point where the camera looks. `points` (k, 3) and `covariances` (k, 3, 3)
    are landmarks in the world frame. Ellipses hold 95 % of the two coordinates shown. The axes
    cover the trajectories and the bulk of the landmarks; titles say how many lie outside, and
    ellipses larger than the view are left out; a path that is small beside them is shown alone
    too. Where `lost`, true or false for each pose, the line is dotted: there nothing was measured.
    At the poses `begun` a new map begins: the line breaks and is marked, with the 95 % of
    `begun_covariances` (b, 3, 3) of where that is; the landmarks' covariances are then to be those
    given where their map begins. `loops` (l, 2, 3) are pairs of places where a loop was closed, and
    `before` the poses as they were without.
    """
    poses = np.asarray(trajectory, dtype=float).reshape(-1, 4, 4)
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    covariances = np.asarray(covariances, dtype=float).reshape(-1, 3, 3)
    finite = np.isfinite(points).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    points, covariances = points[finite], covariances[finite]
    begun = np.asarray(begun, dtype=int)
    begun_covariances = np.asarray(begun_covariances, dtype=float).reshape(-1, 3, 3)
    lines = _lines(poses, np.resize(np.asarray(lost, dtype=bool), len(poses)), begun)
    if reference is not None:
        true = np.asarray(reference, dtype=float).reshape(-1, 4, 4)[:, :3, 3]
        lines.insert(0, ("reference", true, _REFERENCE, "--"))
    old = np.asarray(before, dtype=float).reshape(-1, 4, 4)[:, :3, 3]
    if len(old):
        lines.insert(0, ("before loops were closed", old, GREY, ":"))
    shown = np.concatenate([line for _, line, _, _ in lines])
    low, high = _view(shown, points)
    inside = np.all((points >= low) & (points <= high), axis=1)
    figure, panels = _panels(_view(shown, points[:0]), (low, high))
    for axis, panel in panels:
        hidden = 0
        if panel.with_landmarks:
            hidden = _draw_landmarks(axis, panel, points[inside], covariances[inside])
        _draw_directions(axis, panel, poses)
        for name, line, colour, style in lines:
            axis.plot(*line[:, panel.plane].T, style, color=colour, lw=1.6, label=name)
        if len(poses):
            start = poses[0, panel.plane, 3]
            axis.plot(*start, "o", color=_TRAJECTORY, ms=6, mfc="white", label="start")
        _draw_loops(axis, panel, np.asarray(loops, dtype=float).reshape(-1, 2, 3))
        if len(begun):
            _draw_begun(axis, panel, poses[begun, :3, 3], begun_covariances)
        counts = f": {_counts(inside, hidden)}" if panel.with_landmarks else ""
        axis.set_title(panel.title + counts, fontsize=9)
        _set_axes(axis, panel, unit)
    entries = panels[-1][0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=2, fontsize=8)
    return save(figure, path)


def _lines(
    poses: Float[np.ndarray, "n 4 4"], lost: Bool[np.ndarray, " n"], begun: Int[np.ndarray, " b"]
) -> list[tuple[str, np.ndarray, str, str]]:
    """Name, points, colour and style: the estimate, and separately where the camera was lost."""
    positions = poses[:, :3, 3]

    def broken(hidden: np.ndarray) -> np.ndarray:
        return np.insert(np.where(hidden[:, None], np.nan, positions), begun, np.nan, axis=0)

    lines = [("estimate", broken(lost), _TRAJECTORY, "-")]
    if lost.any():
        # From the last frame that was tracked to the next.
        around = lost.copy()
        around[1:] |= lost[:-1]
        around[:-1] |= lost[1:]
        lines.append(("lost: only predicted", broken(~around), GREY, ":"))
    return lines


def _panels(path: _Box, everything: _Box) -> tuple[Figure, list[tuple[Axes, _Panel]]]:
    """Two panels, one above the other: from above and from behind, x to the right; of what is
    deeper than wide from above and from the side, z to the right. Over them the path alone, where
    it is small, its own longer side to the right."""

    def from_above(box: _Box) -> list[int]:
        across, _, deep = box[1] - box[0]
        return [2, 0] if deep > across else [0, 2]

    above = from_above(everything)
    aside = _Panel("from the side" if above[0] else "from behind", [above[0], 1], everything)
    panels = [_Panel("from above", above, everything), aside]
    alone = _Panel("the path, from above", from_above(path), path, with_landmarks=False)
    if alone.size < 0.5 * panels[0].size:
        panels.insert(0, alone)
    heights = [panel.height for panel in panels]
    figure = new_figure(_WIDTH + 0.6, sum(heights) + _WORDS * len(panels) + _LEGEND)
    axes = figure.subplots(len(panels), 1, height_ratios=heights)
    return figure, list(zip(axes, panels, strict=True))


def _set_axes(axis: Axes, panel: _Panel, unit: str) -> None:
    (left, bottom), (right, top) = (corner[panel.plane] for corner in panel.box)
    across, up = ("xyz"[i] for i in panel.plane)
    axis.set(xlabel=f"{across} ({unit})", ylabel=f"{up} ({unit})", aspect="equal")
    axis.set(xlim=(left, right), ylim=(bottom, top))
    axis.locator_params(axis="x", nbins=6)  # numbers of three decimals side by side
    axis.grid(alpha=0.25, lw=0.5)
    if panel.plane != [0, 2]:  # y points down, and so does x where z points to the right
        axis.invert_yaxis()


def _draw_directions(axis: Axes, panel: _Panel, poses: Float[np.ndarray, "n 4 4"]) -> None:
    """Ticks along the path to where the camera looks, as long as they are seen from here."""
    chosen = poses[:: max(1, len(poses) // _TICKS)]
    ends = chosen[:, :3, 3] + _TICK * panel.size * chosen[:, :3, 2]
    ticks = np.stack([chosen[:, :3, 3], ends], axis=1)[:, :, panel.plane]
    label = "where the camera looks"
    axis.add_collection(LineCollection(list(ticks), colors=GREY, linewidths=0.9, label=label))


def _counts(inside: np.ndarray, hidden: int) -> str:
    text = f"{inside.sum()} landmarks"
    if not inside.all():
        text += f", {(~inside).sum()} more outside"
    return text + (f", {hidden} without ellipse" if hidden else "")


def _view(lines: Positions, points: Float[np.ndarray, "m 3"]) -> _Box:
    """The box around the trajectories and the landmarks that are not absurdly far, with margin.

    Far: beyond five times the interquartile range from the quartiles, along any axis.
    """
    lines = lines[np.isfinite(lines).all(axis=1)]
    if len(points):
        first, third = np.quantile(points, [0.25, 0.75], axis=0)
        # A wall has next to no range in depth: each axis gets at least a tenth of the largest.
        spread = np.maximum(third - first, 0.1 * (third - first).max())
        near = ((points >= first - 5 * spread) & (points <= third + 5 * spread)).all(axis=1)
        lines = np.concatenate([lines, points[near]])
    if not len(lines):
        lines = np.zeros((1, 3))
    low, high = lines.min(axis=0), lines.max(axis=0)
    # Around what is shown, as a share of its size
    margin = 0.06 * max(float((high - low).max()), 1e-3)
    return low - margin, high + margin


def _draw_landmarks(axis: Axes, panel: _Panel, points: Positions, covariances: Spreads) -> int:
    """Draw points and their 95 % ellipses; return how many ellipses were too large to draw."""
    if not len(points):
        return 0
    points, covariances = panel.seen(points, covariances)
    shown = 2 * _SIGMAS_95 * np.sqrt(np.linalg.eigvalsh(covariances)[:, 1]) <= panel.size
    draw_ellipses(axis, points[shown], covariances[shown], _SIGMAS_95, _LANDMARKS)
    axis.plot(*points.T, ".", color=_LANDMARKS, ms=3.5, label="landmark; ellipse: 95 %, in its map")
    return int((~shown).sum())


def _draw_loops(axis: Axes, panel: _Panel, loops: Float[np.ndarray, "l 2 3"]) -> None:
    """Join the places where a loop was closed."""
    for i, ends in enumerate(loops[:, :, panel.plane]):
        label = "a loop closed" if i == 0 else None
        axis.plot(*ends.T, "s-", color=_LOOPS, ms=2.5, lw=1.0, label=label, zorder=3)


def _draw_begun(axis: Axes, panel: _Panel, places: Positions, covariances: Spreads) -> None:
    """Mark where maps begin, and where in the world that can be."""
    places, covariances = panel.seen(places, covariances)
    draw_ellipses(axis, places, covariances, _SIGMAS_95, _BEGUN)
    axis.plot(*places.T, "D", color=_BEGUN, ms=6, mfc="white", label="a map begins; ellipse: 95 %")
