"""The start of a first map: a filter that can track, and known points if there are any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxslam.filters.protocol import AbstractFilter, AbstractStaged
from jaxslam.filters.slam import Slam
from jaxslam.models.frame import Robocentric, Submaps
from jaxslam.tracking.pose_with_covariance import Depths, Places
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.target import Target, TargetObservation


def trackable(
    name: str, made: AbstractFilter, settings: TrackerSettings, target: Target | None
) -> AbstractStaged:
    """The filter of this name that was `made`. Raises ValueError where it cannot track, or cannot
    begin with the target."""
    if not isinstance(made, AbstractStaged):
        raise ValueError(
            f"filter {name} cannot track: {type(made).__name__} takes a frame as a whole; accepted "
            "is an `AbstractStaged`, whose frames are taken in stages"
        )
    plain = isinstance(made, Slam) and not made.layered and made.depth.common is None
    if target is not None and not (plain and not made.scale.free):
        raise ValueError(
            f"filter {name} cannot begin with a target: a Slam of one Gaussian in metres, "
            "as `world` and `robocentric` are, is accepted"
        )
    if target is not None and len(target.points) > settings.wanted:
        raise ValueError(
            f"the target has {len(target.points)} points, but only {settings.wanted} "
            "landmarks are wanted"
        )
    return _handing_over(made)


def _handing_over(made: AbstractStaged) -> AbstractStaged:
    """The filter with submaps, whose ends the tracker decides, where it is a robocentric `Slam`
    that they go together with."""
    if not isinstance(made, Slam) or made.frame != Robocentric():
        return made
    try:
        return replace(made, frame=Submaps(spare=None))
    except ValueError:
        return made


def places_with_target(
    seen: TargetObservation, corners: Places, settings: TrackerSettings
) -> tuple[np.ndarray, Depths]:
    """Return pixels to start landmarks at, of a target's points first and of the corners away from
    them; and mean and σ of 1/z of as many as are wanted."""
    s, others = settings, settings.wanted - len(seen.sigma)
    distances = np.linalg.norm(corners[:, None] - seen.pixels, axis=2)
    apart = corners[np.all(distances >= s.spacing, axis=1)]
    pixels = np.concatenate([seen.pixels, apart])[: s.wanted]
    means = np.append(seen.inverse_depths, np.full(others, float(s.depth.mean)))
    sigmas = np.append(seen.sigma, np.full(others, float(s.depth.sigma)))
    return pixels, (means[:, None], sigmas[:, None])
