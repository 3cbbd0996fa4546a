"""The map's upkeep: which landmarks to search, which are in view, and which to give up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.landmarks import Landmark, Points
from jaxslam.tracking.settings import TrackerSettings

_MOST_SCALED = 2.0
"""A patch that looks larger or smaller than at first by more is not like itself any more."""


class Prediction(NamedTuple):
    """What the filter expects to see, slot by slot; JAX's arrays, then NumPy's."""

    pixels: Any
    covariances: Any
    usable: Any
    """In the map and in front of the camera."""
    T_wc: Any
    points: Any
    """Homogeneous points (X, ω) in the predicted camera."""
    omegas: Any
    sides: Any = (0, 0)
    """How many landmarks are surely in front of the camera, and how many behind it."""

    def enlarged(self, scale: float) -> Prediction:
        """With all lengths so many times as large."""
        T_wc = self.T_wc.copy()
        T_wc[:3, 3] *= scale
        return self._replace(T_wc=T_wc, omegas=self.omegas / scale)


def to_search(
    landmarks: Mapping[int, Landmark],
    prediction: Prediction,
    calibration: Calibration,
    settings: TrackerSettings,
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 2 2"]]:
    """Slots to search, and how the picture around each changed since its first view.

    In front, in the picture, with a bearing that the lens can see, from where they still look
    alike. Should there be more than can be measured, those come first that were found when they
    were searched last, of them the longest known.
    """
    s, size = settings, np.array([calibration.width, calibration.height])
    pixels = prediction.pixels
    inside = np.all((pixels >= s.border) & (pixels < size - s.border), axis=1)
    slots = np.flatnonzero(prediction.usable & inside)
    affines = changes_of_view(landmarks, prediction, slots, calibration)
    zoomed = np.abs(np.log(np.clip(np.linalg.det(affines), 1e-6, 1e6)))
    alike = [
        i
        for i in np.flatnonzero(zoomed < 2 * np.log(_MOST_SCALED))
        if landmarks[slots[i]].patch.covers(affines[i])
    ]
    absent = ~in_view(landmarks, slots, s)
    alike.sort(key=lambda i: (absent[i], landmarks[slots[i]].number))
    order = np.array(alike[: s.wanted], int)
    return slots[order], affines[order]


def changes_of_view(
    landmarks: Mapping[int, Landmark],
    prediction: Prediction,
    slots: Int[np.ndarray, " k"],
    calibration: Calibration,
) -> Float[np.ndarray, "k 2 2"]:
    """How the picture around each landmark changed since its first view; zero where it cannot
    be told.

    The surface is taken to face the first camera; distortion is neglected, being nearly the
    same over a patch.
    """
    first = np.array([landmarks[slot].first_camera for slot in slots]).reshape(-1, 4, 4)
    T_first_now = np.linalg.inv(first) @ prediction.T_wc
    X, omega = prediction.points[slots], prediction.omegas[slots]
    start = np.einsum("kij,kj->ki", T_first_now[:, :3, :3], X)
    start += omega[:, None] * T_first_now[:, :3, 3]
    ahead = np.where(np.abs(start[:, 2:]) < 1e-9, 1e-9, start[:, 2:])
    # One pixel to the right and down in the first view, on the plane through the point.
    step = ahead[:, :, None] * np.eye(3)[None, :2] / [[[calibration.fx]]]
    moved = X[:, None] + np.einsum("kji,kaj->kai", T_first_now[:, :3, :3], step)
    pixel = X[:, :2] / X[:, 2:]
    focal = np.array([calibration.fx, calibration.fy])
    affine = (moved[..., :2] / moved[..., 2:] - pixel[:, None]) * focal
    affine = np.swapaxes(affine, 1, 2)
    return np.where(np.isfinite(affine).all(axis=(1, 2), keepdims=True), affine, 0.0)


def in_view(
    landmarks: Mapping[int, Landmark], slots: Sequence[int] | np.ndarray, settings: TrackerSettings
) -> Bool[np.ndarray, " k"]:
    """Which of the slots hold landmarks that are found, but for a few searches at the most.

    Only these are among the landmarks wanted, and keep new ones at a distance.
    """
    most = settings.absent_after
    return np.array([s in landmarks and landmarks[s].missed <= most for s in slots], bool)


def note_found(
    landmarks: Mapping[int, Landmark],
    slots: Int[np.ndarray, " k"],
    found: Bool[np.ndarray, " k"],
    pixels: Float[np.ndarray, "k 2"],
    settings: TrackerSettings,
) -> None:
    """Note which of the landmarks searched were found, and where.

    That nothing at all was found is the camera's failure, and held against no landmark.
    """
    for landmark in landmarks.values():
        landmark.unseen += 1
    if found.any():
        for slot, ok, pixel in zip(slots, found, pixels, strict=True):
            landmarks[slot].searched(bool(ok), pixel, settings.patience)


def failing(landmarks: Mapping[int, Landmark], settings: TrackerSettings) -> list[int]:
    """Slots of landmarks that are searched in vain of late."""
    return [slot for slot, one in landmarks.items() if one.success < settings.least_success]


def worst_first(
    landmarks: Sequence[Landmark], points: Points, settings: TrackerSettings
) -> Int[np.ndarray, " k"]:
    """The order in which to give up landmarks that are not in view; `points` are theirs.

    First those that are searched in vain, then by the time since they were seen, times the σ of
    their place as a share of their distance from where they were first seen: known ones are
    worth more, as they say where the camera is when it returns.
    """
    away = np.array([one.missed <= settings.absent_after for one in landmarks], bool)
    unseen = np.array([one.unseen for one in landmarks])
    starts = np.array([one.first_camera[:3, 3] for one in landmarks]).reshape(-1, 3)
    distances = np.linalg.norm(points.points - starts, axis=1)
    with np.errstate(invalid="ignore"):  # at infinity, or of unknown depth
        shares = np.sqrt(np.trace(points.in_map, axis1=1, axis2=2)) / distances
    unknown = np.minimum(np.nan_to_num(shares, nan=1.0), 1.0)
    return np.lexsort((-unseen * unknown, away))
