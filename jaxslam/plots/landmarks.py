"""Landmarks from above: ellipses, and what they are in azimuth and inverse distance."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from jaxslam.statistics.bands import chi2_quantile

Positions = Float[np.ndarray, "n 3"]
"""Points of the world."""
Spreads = Float[np.ndarray, "n 3 3"]
"""Their covariances."""
Ellipses = Float[np.ndarray, "n 2 2"]
"""Covariances of points of a plane."""


def region_from_above(
    mean: Float[np.ndarray, " 2"], covariance: Float[np.ndarray, "2 2"], share: float = 0.95
) -> Float[np.ndarray, "2 k"]:
    """The outline, from the camera, of so much of a Gaussian in azimuth and inverse distance.

    It is an ellipse bent into the plane; what reaches behind the camera ends in front of it, far.
    """
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = np.sqrt(chi2_quantile(share, 2)) * np.stack([np.cos(angle), np.sin(angle)])
    roots = np.sqrt(np.maximum(values, 0))[:, None]
    azimuth, inverse = mean[:, None] + vectors @ (roots * circle)
    # Least inverse distance that is drawn, 1/m.
    distance = 1 / np.maximum(inverse, (1 / 60))
    return distance * np.stack([np.sin(azimuth), np.cos(azimuth)])


def draw_ellipses(
    axes: Axes, centres: Float[np.ndarray, "n 2"], covariances: Ellipses, sigmas: float, colour: str
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
