"""Maps from above whose landmarks are drawn as what they are: clouds, not only ellipses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from jaxslam.plots.style import COLOURS
from jaxslam.statistics.bands import chi2_quantile

_FARTHEST = 1 / 60
"""Least inverse distance that is drawn, 1/m."""


def plot_landmark_clouds(
    samples: Float[np.ndarray, "m count n"],
    means: Float[np.ndarray, "m n"],
    covariances: Float[np.ndarray, "m n n"],
    *,
    ax: Axes,
    colour: str = COLOURS[0],
    label: str = "",
) -> Axes:
    """Draw (x, z) of points in the world: draws as dots, and their first-order 95 % ellipses.

    `samples` is of `jaxslam.landmark_samples`, `means` and `covariances` of
    `jaxslam.landmarks_in_world`. Where dots leave their ellipse, a Gaussian in Euclidean space
    is not what the filter believes.
    """
    axes, plane = ax, np.array([0, samples.shape[-1] - 1])
    dots = np.asarray(samples)[..., plane].reshape(-1, 2)
    axes.plot(*dots.T, ",", color=colour, alpha=0.5, rasterized=True)
    axes.plot([], [], ".", color=colour, label=f"{label}: draws")
    for i, (mean, covariance) in enumerate(zip(means, covariances, strict=True)):
        flat = np.asarray(covariance)[np.ix_(plane, plane)]
        ellipse = _ellipse(np.asarray(mean)[plane], flat, 0.95)
        name = f"{label}: 95 % ellipse to first order" if i == 0 else None
        axes.plot(*ellipse, color=colour, lw=1.0, label=name)
    return axes


def _ellipse(
    mean: Float[np.ndarray, " 2"], covariance: Float[np.ndarray, "2 2"], share: float
) -> Float[np.ndarray, "2 k"]:
    """The outline of so much of a Gaussian in the plane."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = np.sqrt(chi2_quantile(share, 2)) * np.stack([np.cos(angle), np.sin(angle)])
    return mean[:, None] + vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * circle)


def region_from_above(
    mean: Float[np.ndarray, " 2"], covariance: Float[np.ndarray, "2 2"], share: float = 0.95
) -> Float[np.ndarray, "2 k"]:
    """The outline, from the camera, of so much of a Gaussian in azimuth and inverse distance.

    It is an ellipse bent into the plane; what reaches behind the camera ends in front of it, far.
    """
    azimuth, inverse = _ellipse(mean, covariance, share)
    distance = 1 / np.maximum(inverse, _FARTHEST)
    return distance * np.stack([np.sin(azimuth), np.cos(azimuth)])


def draw_ellipses(
    axes: Axes,
    centres: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    sigmas: float,
    colour: str,
) -> None:
    """The ellipses of Gaussians in the plane, so many standard deviations from their centres."""
    variances, vectors = np.linalg.eigh(covariances)
    diameters = 2 * sigmas * np.sqrt(np.maximum(variances, 0.0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            diameters[:, 1], diameters[:, 0], angles, units="xy",
            offsets=centres, offset_transform=axes.transData,
            facecolors=colour + "18", edgecolors=colour + "90", linewidths=0.7,
        )
    )  # fmt: skip
