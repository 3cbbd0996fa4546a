"""Landmarks as the tracker keeps them beside the filter: what they look like, where they were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.tracking.patches import STORED, Patch

_COUNTS = ("number", "missed", "unseen", "found")


@dataclass
class Landmark:
    """What the picture side remembers of the landmark in a slot."""

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

    def searched(self, found: bool, pixel: np.ndarray, patience: float) -> None:
        """Count one search, that found it at this pixel or not; `success` is an average over about
        `patience` of them."""
        self.success += (found - self.success) / patience
        self.missed = 0 if found else self.missed + 1
        if found:
            self.unseen, self.seen_at = 0, pixel
            self.found += 1


class Points(NamedTuple):
    """n landmarks in the world, as they were seen last."""

    numbers: np.ndarray
    maps: np.ndarray
    """Numbers of their maps."""
    points: np.ndarray
    """(n, 3); not finite for one at infinity."""
    covariances: np.ndarray
    """(n, 3, 3), the camera's uncertainty and that of the map's start included."""
    in_map: np.ndarray
    """The same given where the map begins, (n, 3, 3)."""

    def only(self, which: np.ndarray) -> Points:
        """Some of them, in the order given."""
        return Points(*(part[which] for part in self))


NO_POINTS = Points(
    np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3))
)


def joined(parts: list[Points]) -> Points:
    """Several as one; there is at least one."""
    return Points(*(np.concatenate(of_all) for of_all in zip(*parts, strict=True)))


def stacked(landmarks: Mapping[int, Landmark]) -> dict[str, np.ndarray]:
    """Arrays of k landmarks in order of their entries, for a file."""
    kept = list(landmarks.values())
    cameras = [landmark.first_camera for landmark in kept]
    counts = [[getattr(landmark, name) for name in _COUNTS] for landmark in kept]
    patches = [landmark.patch for landmark in kept]
    return {
        "slots": np.array(list(landmarks), int),
        "counts": np.array(counts, int).reshape(-1, len(_COUNTS)),
        "success": np.array([landmark.success for landmark in kept], float),
        "first_cameras": np.array(cameras, float).reshape(-1, 4, 4),
        "seen_at": np.array([landmark.seen_at for landmark in kept], float).reshape(-1, 2),
        "pixels": np.array([patch.pixel for patch in patches], float).reshape(-1, 2),
        "stored": np.array([patch.stored for patch in patches], np.float32).reshape(
            -1, STORED, STORED
        ),
    }


def unstacked(arrays: Mapping[str, np.ndarray]) -> dict[int, Landmark]:
    """What `stacked` was made of."""
    rows = zip(*(arrays[name] for name in _FIELDS), strict=True)
    return {int(slot): _restored(*row) for slot, *row in rows}


_FIELDS = ("slots", "counts", "success", "first_cameras", "seen_at", "pixels", "stored")


def _restored(
    counts: np.ndarray,
    success: float,
    first_camera: Float[np.ndarray, "4 4"],
    seen_at: Float[np.ndarray, " 2"],
    pixel: Float[np.ndarray, " 2"],
    stored: np.ndarray,
) -> Landmark:
    patch, named = Patch(pixel, stored), dict(zip(_COUNTS, counts.tolist(), strict=True))
    return Landmark(
        patch=patch, first_camera=first_camera, seen_at=seen_at, success=float(success), **named
    )
