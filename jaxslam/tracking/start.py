"""The start of a first map: a filter that can track, and known points if there are any."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.filters.ekf import EkfSlam, check_can_track, check_one_gaussian
from jaxslam.filters.protocol import AbstractFilter, AbstractStaged
from jaxslam.filters.submaps.handover import in_submaps
from jaxslam.io.calibration import Calibration
from jaxslam.models.coordinates import ROBOCENTRIC
from jaxslam.models.scale import Metre
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.target import Target, TargetObservation, known_depths, sighted


def trackable(
    name: str, made: AbstractFilter, settings: TrackerSettings, target: Target | None
) -> AbstractStaged:
    """The filter of this name that was `made`. Raises ValueError where it cannot track, or cannot
    begin with the target."""
    check_can_track(made, name)
    assert isinstance(made, AbstractStaged)
    plain = isinstance(made, EkfSlam) and made.depth.common is None
    if target is not None and not (plain and isinstance(made.scale, Metre)):
        raise ValueError(
            f"filter {name} cannot begin with a target: one that is an EkfSlam, "
            "without a scale of its own, as `world` and `robocentric` are, is accepted"
        )
    if target is not None and len(target.points) > settings.wanted:
        raise ValueError(
            f"the target has {len(target.points)} points, but only {settings.wanted} "
            "landmarks are wanted"
        )
    return _handing_over(made)


def _handing_over(made: AbstractStaged) -> AbstractStaged:
    """The filter with submaps where it is robocentric and one Gaussian, or a sum of them."""
    inner = made.unwrapped
    if not isinstance(inner, EkfSlam) or inner.coordinates is not ROBOCENTRIC:
        return made
    try:
        check_one_gaussian(inner, "a map of submaps", corrected=True)
    except ValueError:
        return made
    return made if inner.landmark.anchored else in_submaps(made)


def with_target(
    target: Target,
    image: UInt8[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    calibration: Calibration,
    settings: TrackerSettings,
) -> tuple[TargetObservation, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return where a picture shows a target; pixels to start landmarks at, of its points first and
    of the corners away from them; and mean and σ of 1/z of as many as are wanted."""
    s = settings
    seen = sighted(target, image, calibration, s.pixel_sigma)
    distances = np.linalg.norm(corners[:, None] - seen.pixels, axis=2)
    apart = corners[np.all(distances >= s.spacing, axis=1)]
    pixels = np.concatenate([seen.pixels, apart])[: s.wanted]
    return seen, pixels, known_depths(seen, s.wanted, float(s.depth.mean), float(s.depth.sigma))
