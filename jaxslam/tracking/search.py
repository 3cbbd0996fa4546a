"""Active search: the landmarks that a frame may show, and the places that look like them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.landmarks import Landmarks
from jaxslam.tracking.map import in_view
from jaxslam.tracking.matching import Matches, match_patches
from jaxslam.tracking.observations import Observations, Prediction, Slots
from jaxslam.tracking.optics import sighted
from jaxslam.tracking.patches import WINDOW, Picture
from jaxslam.tracking.settings import TrackerSettings


def search(
    image: Picture,
    landmarks: Landmarks,
    prediction: Prediction,
    calibration: Calibration,
    settings: TrackerSettings,
    *,
    several: bool,
) -> tuple[Observations, Matches]:
    """The landmarks searched, none of them matched yet, and the places found in their ellipses.

    A match's `owner` is the row of its landmark; `several` are given for a wide ellipse where
    that is asked.
    """
    slots, affines = to_search(landmarks, prediction, calibration, settings)
    seen = Observations(
        slots,
        prediction.pixels[slots],
        prediction.covariances[slots],
        np.full((len(slots), 2), np.nan),
        np.zeros(len(slots)),
        np.full(len(slots), "unmatched"),
    )
    pairs = zip(slots, affines, strict=True)
    warped = [landmarks[slot].patch.warped(affine) for slot, affine in pairs]
    templates = np.array(warped, np.float32).reshape(-1, WINDOW, WINDOW)
    return seen, match_patches(image, templates, seen.predicted, seen.covariances, several=several)


def to_search(
    landmarks: Landmarks,
    prediction: Prediction,
    calibration: Calibration,
    settings: TrackerSettings,
) -> tuple[Slots, Float[np.ndarray, "k 2 2"]]:
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
    # A patch that looks larger or smaller than at first by more is not like itself any more.
    near = np.flatnonzero(zoomed < 2 * np.log(2.0))
    alike = [i for i in near if landmarks[slots[i]].patch.covers(affines[i])]
    absent = ~in_view(landmarks, slots, s)
    alike.sort(key=lambda i: (absent[i], landmarks[slots[i]].number))
    order = np.array(alike[: s.wanted], int)
    return slots[order], affines[order]


def changes_of_view(
    landmarks: Landmarks, prediction: Prediction, slots: Slots, calibration: Calibration
) -> Float[np.ndarray, "k 2 2"]:
    """Return how the picture around each landmark changed since its first view; zero where it
    cannot be determined.

    The surface is taken to face the first camera: to have one depth there.
    """
    first = np.array([landmarks[slot].first_camera for slot in slots]).reshape(-1, 4, 4)
    T_first_now = np.linalg.inv(first) @ prediction.T_wc
    X, omega = prediction.points[slots], prediction.omegas[slots]
    start = np.einsum("kij,kj->ki", T_first_now[:, :3, :3], X)
    start += omega[:, None] * T_first_now[:, :3, 3]
    then, now = (sighted(calibration, points) for points in (start, X))
    known = then.seen & np.isfinite(start).all(axis=1)
    # One pixel to the right and down in the first view, in the axes of that camera.
    step = np.linalg.inv(np.where(known[:, None, None], then.slopes, np.eye(3)))[..., :2]
    affine = now.slopes[:, :2] @ np.swapaxes(T_first_now[:, :3, :3], 1, 2) @ step
    return np.where(known[:, None, None], affine, 0.0)
