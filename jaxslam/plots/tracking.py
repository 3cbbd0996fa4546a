"""The map of a tracked video: trajectory, reference and landmarks with their uncertainty."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from numpy.typing import ArrayLike

from jaxslam.plots.style import COLOURS, new_figure, save

_TRAJECTORY, _REFERENCE, _LANDMARKS, _BEGUN = COLOURS[:4]
_CHI2_95 = 5.991  # 95 % quantile of chi-squared with two degrees of freedom
_MARGIN = 0.12  # around what is shown, as a share of its size


def plot_map(
    trajectory: ArrayLike,
    points: ArrayLike,
    covariances: ArrayLike,
    *,
    reference: ArrayLike | None = None,
    path: str | Path,
    unit: str = "m",
    begun: ArrayLike = (),
    begun_covariances: ArrayLike = (),
) -> None:
    """Draw the map from above (x, z) and from behind (x, y) into the image file `path`.

    `trajectory` and `reference` are poses T_wc (n, 4, 4), drawn as they are (align them first),
    `points` (n, 3) and `covariances` (n, 3, 3) landmarks in the world frame. Ellipses hold 95 %
    of the two coordinates shown. The axes cover the trajectories and the bulk of the landmarks;
    the title says how many lie outside, and ellipses larger than the view are left out. At the
    poses `begun` a new map begins: the line breaks and is marked, with the 95 % of
    `begun_covariances` (k, 3, 3) of where that is; the landmarks' covariances are then to be
    those given where their map begins.
    """
    trajectory = np.asarray(trajectory, dtype=float).reshape(-1, 4, 4)[:, :3, 3]
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    covariances = np.asarray(covariances, dtype=float).reshape(-1, 3, 3)
    finite = np.isfinite(points).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    points, covariances = points[finite], covariances[finite]
    begun = np.asarray(begun, dtype=int)
    begun_covariances = np.asarray(begun_covariances, dtype=float).reshape(-1, 3, 3)
    broken = np.insert(trajectory, begun, np.nan, axis=0)
    lines = [("estimate", broken, _TRAJECTORY, "-")]
    if reference is not None:
        reference = np.asarray(reference, dtype=float).reshape(-1, 4, 4)[:, :3, 3]
        lines.append(("reference", reference, _REFERENCE, "--"))
    low, high = _view(np.concatenate([line for _, line, _, _ in lines]), points)
    inside = np.all((points >= low) & (points <= high), axis=1)
    figure = new_figure(11, 5.2)
    axes = figure.subplots(1, 2)
    for axis, (across, up), title in zip(
        axes, [(0, 2), (0, 1)], ["from above", "from behind"], strict=True
    ):
        plane = [across, up]
        hidden = _draw_landmarks(
            axis, points[inside][:, plane], covariances[inside][:, plane][:, :, plane], high - low
        )
        for name, line, colour, style in lines:
            axis.plot(line[:, across], line[:, up], style, color=colour, lw=1.6, label=name)
        if len(trajectory):
            start = trajectory[0, plane]
            axis.plot(*start, "o", color=_TRAJECTORY, ms=5, mfc="white", label="start")
        if len(begun):
            _draw_begun(axis, trajectory[begun][:, plane], begun_covariances[:, plane][:, :, plane])
        axis.set(xlabel=f"x ({unit})", ylabel=f"{'xyz'[up]} ({unit})", aspect="equal")
        axis.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))
        axis.set_title(f"{title}: {_counts(inside, hidden)}", fontsize=10)
        axis.grid(alpha=0.25, lw=0.5)
    axes[1].invert_yaxis()  # y points down
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    save(figure, path)


def _counts(inside: np.ndarray, hidden: int) -> str:
    text = f"{inside.sum()} of {len(inside)} landmarks"
    if not inside.all():
        text += f", {(~inside).sum()} outside"
    return text + (f", {hidden} without ellipse (too large)" if hidden else "")


def _view(
    lines: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
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
    margin = _MARGIN * max(float((high - low).max()), 1e-3)
    return low - margin, high + margin


def _draw_landmarks(
    axis: Axes,
    points: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    size: Float[np.ndarray, " 3"],
) -> int:
    """Draw points and their 95 % ellipses; return how many ellipses were too large to draw."""
    if not len(points):
        return 0
    shown = 2 * np.sqrt(_CHI2_95 * np.linalg.eigvalsh(covariances)[:, 1]) <= size.max()
    _draw_ellipses(axis, points[shown], covariances[shown], _LANDMARKS)
    axis.plot(
        *points.T, ".", color=_LANDMARKS, ms=3.5, label="landmarks, 95 % ellipses in their maps"
    )
    return int((~shown).sum())


def _draw_begun(
    axis: Axes, places: Float[np.ndarray, "k 2"], covariances: Float[np.ndarray, "k 2 2"]
) -> None:
    """Mark where maps begin, and where in the world that can be."""
    _draw_ellipses(axis, places, covariances, _BEGUN)
    label = "a new map begins, 95 % of where"
    axis.plot(*places.T, "D", color=_BEGUN, ms=6, mfc="white", label=label)


def _draw_ellipses(
    axis: Axes,
    centres: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    colour: str,
) -> None:
    """The 95 % ellipses of Gaussians in the plane."""
    variances, vectors = np.linalg.eigh(covariances)
    diameters = 2 * np.sqrt(_CHI2_95 * np.maximum(variances, 0.0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axis.add_collection(
        EllipseCollection(
            diameters[:, 1], diameters[:, 0], angles, units="xy",
            offsets=centres, offset_transform=axis.transData,
            facecolors=colour + "18", edgecolors=colour + "90", linewidths=0.7,
        )
    )  # fmt: skip
