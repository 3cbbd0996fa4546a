"""A camera that was lost, in a map that it knows: candidates by descriptors, then geometry.

Descriptors of the landmarks say which corners of a picture may be which of them; a pose from
2-D–3-D matches with RANSAC says which can be, all at once (image-to-map: Williams et al., RAS 57,
2009). Only where the filter then finds the landmarks again, each where it expects it from there,
is the camera back.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jaxslam.io.calibration import Calibration
from jaxslam.io.tum import transforms
from jaxslam.tracking.estimator import Correction
from jaxslam.tracking.map import Map, TrackerState
from jaxslam.tracking.observations import Observations, Slots
from jaxslam.tracking.optics import on_pinhole
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.places.descriptors import ByNumber, candidates, described_corners
from jaxslam.tracking.policy import Policy
from jaxslam.tracking.pose_with_covariance import Positions, Spreads, Transform

FEWEST = 12
"""The fewest matches of one pose, and landmarks found again, for which a camera is relocalised."""
MOST_OF = 0.4
"""The share of the landmarks expected in the picture that must then be found."""
PIXELS = 4.0
"""The largest error of a match of the pose."""
TURN, SHIFT = 0.01, 0.02
"""σ of that pose: rad, and shares of the landmarks' median depth."""
TRIED = 3
"""Places that are looked at in a frame, those of the most candidates."""
NOTED_EVERY = 5
"""Frames between two in which landmarks are described."""


def well_known(points: Positions, covariances: Spreads) -> Bool[np.ndarray, " n"]:
    """Return which points a pose may be found from."""
    with np.errstate(invalid="ignore"):  # at infinity
        sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        # σ of a point by its distance, of those from which a pose is found.
        return sigma < 0.3 * np.linalg.norm(points, axis=1)


def pose_of(
    points: Float[np.ndarray, "m 3"], pixels: Float[np.ndarray, "m 2"], calibration: Calibration
) -> tuple[Transform, Slots] | None:
    """Return T_wc of a picture that shows most of these points at these pixels, and which of them;
    None if `FEWEST` of them cannot be seen at once."""
    if len(points) < FEWEST:
        return None
    flat, within = on_pinhole(calibration, pixels)
    near, K, nothing = np.flatnonzero(within), calibration.matrix, np.zeros(0)
    # OpenCV refuses, by exception, a sample of points that are one, by an absolute distance.
    unit = max(float(points.std()), 1e-12) / 10
    points, pixels = points[near] / unit, flat[near]
    try:
        found, turn, shift, inside = cv2.solvePnPRansac(
            points, pixels, K, nothing, iterationsCount=500, reprojectionError=PIXELS,
            flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:
        return None
    if not found or inside is None or len(inside) < FEWEST:
        return None
    which = inside[:, 0].astype(int)
    turn, shift = cv2.solvePnPRefineLM(points[which], pixels[which], K, nothing, turn, shift)
    return np.linalg.inv(transforms(cv2.Rodrigues(turn)[0], unit * shift)), near[which]


def known_again(
    image: Picture, policy: Policy, state: TrackerState, but: Container[int] = ()
) -> tuple[TrackerState, Observations, Correction] | None:
    """Return what is found of the landmarks in the first place that the picture shows, of those of
    which it shows the most candidates, and of all maps `but` some, and the state in that map,
    corrected by them. None where it shows none that is known."""
    if not state.estimator.displaceable:
        return None
    by_number = candidates(state.described(), described_corners(image))
    places = [one for one in state.places() if one.number not in but]
    shown = [sum(x.number in by_number for x in one.landmarks.values()) for one in places]
    for which in np.argsort(np.negative(shown), stable=True)[:TRIED].tolist():
        if shown[which] < FEWEST:
            return None
        found = _found(image, by_number, policy, replace(state, map=places[which]))
        if found is not None:
            after, seen, correction = found
            return state.come_back(places[which], after), seen, correction
    return None


def _found(
    image: Picture, by_number: ByNumber, policy: Policy, state: TrackerState
) -> tuple[Map, Observations, Correction] | None:
    """This map after a picture that shows some of its landmarks at these pixels, what is found
    there, and what the filter made of it."""
    map, place, estimator = state.map, state.map.place, state.estimator
    known = {slot: one.number for slot, one in map.landmarks.items() if one.number in by_number}
    slots = np.array(list(known), int)
    pixels = np.array([by_number[number] for number in known.values()]).reshape(-1, 2)
    points, covariances = (part[slots] for part in estimator.points(map.state))
    sure = well_known(points, covariances)
    posed = pose_of(points[sure], pixels[sure], policy.calibration)
    if posed is None:
        return None
    T_new, _ = posed
    T_last = np.linalg.inv(place.origin.T_wc) @ place.camera.T_wc
    T_last[:3, 3] /= place.unit
    depth = np.median((points[sure] - T_new[:3, 3]) @ T_new[:3, 2])
    sigma = np.repeat([SHIFT * depth, TURN], 3)
    # The seconds in which a camera moves there: so few that no acceleration matters.
    moved = np.linalg.inv(T_last) @ T_new
    predicted = estimator.displaced(map.state, moved, sigma, (1 / 30))
    # What is only tried is no memory of the policy's.
    seen, reason, _ = policy.observed(image, state, predicted, lost=True)
    if reason is not None or seen.matched.sum() < max(FEWEST, MOST_OF * len(seen.slots)):
        return None
    belief, correction = estimator.correct(predicted, seen)
    after, seen = replace(map, state=belief), seen.but_for(correction.used)
    return None if correction.failed else (after, seen, correction)
