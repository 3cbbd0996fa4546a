"""Landmarks as the tracker keeps them beside the filter: what they look like, where they were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from jaxslam.tracking.patches import Patch

NO_LOOKS = np.zeros((0, 32), np.uint8)
MEMORY = 0.95
"""Weight of an innovation by that of a frame later: twenty frames count."""
_OLDER = np.array([MEMORY, MEMORY, MEMORY**2])


@dataclass(frozen=True)
class Landmark:
    """The appearance and the record of the landmark in a slot."""

    number: int
    patch: Patch
    first_camera: np.ndarray
    """T_wc of its first view, (4, 4)."""
    seen_at: np.ndarray
    """Pixel (u, v) of its latest view."""
    success: float = 1.0
    """Share of the latest searches that found it, the older ones weighing ever less."""
    missed: int = 0
    """Searches in a row, up to now, that did not find it."""
    unseen: int = 0
    """Frames since it was found."""
    found: int = 0
    """Searches that found it."""
    looks: np.ndarray = field(default_factory=NO_LOOKS.copy)
    """Its latest descriptors, by which it is known again where nothing says where it is."""
    innovations: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Sums over its matches, (3,): of the innovation (u, v) given all others, whitened, and of the
    variance that this has; the older ones weigh ever less."""

    @property
    def noise_factor(self) -> float:
        """By how much more variance its noise has than white noise, if its innovations point one
        way for long: a corner of two depths or a reflection slides over the world."""
        u, v, variance = self.innovations.tolist()
        return max(1.0, (u * u + v * v) / (2 * max(variance, 1.0)))

    def compared(self, innovation: np.ndarray) -> Landmark:
        """The landmark after a whitened innovation (2,)."""
        sums = _OLDER * self.innovations + (*innovation.tolist(), 1.0)
        return replace(self, innovations=sums)

    def searched(self, found: bool, pixel: np.ndarray, patience: float) -> Landmark:
        """The landmark after one search, that found it at this pixel or not; `success` is an
        average over about `patience` of them."""
        success = self.success + (found - self.success) / patience
        if not found:
            missed, unseen = self.missed + 1, self.unseen + 1
            return replace(self, success=success, missed=missed, unseen=unseen)
        count = self.found + 1
        return replace(self, success=success, missed=0, unseen=0, seen_at=pixel, found=count)


Landmarks = Mapping[int, Landmark]
"""Landmarks by their slots of a filter's map, or by their numbers."""


class Points(NamedTuple):
    """n landmarks in the world, as they were seen last."""

    numbers: np.ndarray
    maps: np.ndarray
    """The numbers of their maps."""
    submaps: np.ndarray
    """The numbers of the submaps in which they were then."""
    points: np.ndarray
    """(n, 3); not finite for one at infinity."""
    covariances: np.ndarray
    """(n, 3, 3), the camera's uncertainty and that of the map's start included."""
    in_map: np.ndarray
    """The same given where the map begins, (n, 3, 3)."""
