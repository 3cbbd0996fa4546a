"""A camera that was lost, in a map that it knows: candidates by descriptors, then geometry.

OpenCV's ORB descriptors (Rublee et al., ICCV 2011) of the landmarks say which corners of a picture
may be which of them; a pose from 2-D–3-D matches with RANSAC says which can be, all at once
(image-to-map: Williams et al., RAS 57, 2009). Only where the filter then finds the landmarks again,
each where it expects it from there, is the camera back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.estimator import Correction
from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.map import Map
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.policy import Policy

CORNERS = 600
"""Of a picture, which are compared."""
RATIO = 0.85
"""The distance of the likest descriptor by that of the next, at the most."""
FEWEST = 12
"""Matches of one pose, and landmarks found again, with which a camera is where it seems to be …"""
MOST_OF = 0.4
"""… and the share of the landmarks expected in the picture that are then found."""
PIXELS = 4.0
"""By how much a match of the pose may be off."""
TURN, SHIFT = 0.01, 0.02
"""σ of that pose: rad, and shares of the landmarks' median depth."""
SURE = 0.3
"""σ of a point by its distance, of those from which a pose is found."""
SECONDS = 1 / 30
"""In which a camera moves there: between two frames, so that no acceleration matters."""
NOTED_EVERY = 5
"""Frames between two in which landmarks are described."""
LOOKS = 3
"""Descriptors of a landmark that are kept, of different frames."""

Corners = tuple[Float[np.ndarray, "n 2"], UInt8[np.ndarray, "n 32"]]
"""Of a picture: pixels and descriptors."""


def describe(
    image: UInt8[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]
) -> tuple[UInt8[np.ndarray, "n 32"], Bool[np.ndarray, " n"]]:
    """Return upright ORB descriptors of these pixels, and which have one: not those at the edge."""
    places = enumerate(pixels.astype(float).tolist())
    keys = [cv2.KeyPoint(u, v, 31.0, 0.0, 1.0, 0, i) for i, (u, v) in places]
    kept, found = cv2.ORB.create().compute(image, keys)
    descriptors, there = np.zeros((len(pixels), 32), np.uint8), np.zeros(len(pixels), bool)
    if found is not None:
        which = [key.class_id for key in kept]
        descriptors[which], there[which] = found, True
    return descriptors, there


def note_looks(
    landmarks: Mapping[int, Landmark],
    image: UInt8[np.ndarray, "h w"],
    slots: np.ndarray,
    pixels: Float[np.ndarray, "n 2"],
) -> None:
    """Note what the landmarks in these slots look like in a picture that shows them there."""
    for slot, descriptor, there in zip(slots.tolist(), *describe(image, pixels), strict=True):
        if there:
            one = landmarks[slot]
            one.looks = np.concatenate([one.looks, descriptor[None]])[-LOOKS:]


def described_corners(image: UInt8[np.ndarray, "h w"]) -> Corners:
    """Return the corners of a picture, (n, 2), and their descriptors."""
    found = cv2.goodFeaturesToTrack(image, CORNERS, 0.01, 7)
    corners = np.zeros((0, 2)) if found is None else found[:, 0].astype(float)
    descriptors, there = describe(image, corners)
    return corners[there], descriptors[there]


def candidates(
    landmarks: Mapping[int, Landmark], corners: Corners
) -> tuple[np.ndarray, Float[np.ndarray, "m 2"]]:
    """Return slots of landmarks that look like corners of a picture, and these corners."""
    owner = np.repeat(list(landmarks), [len(one.looks) for one in landmarks.values()])
    pixels, descriptors = corners
    if len(owner) == 0 or len(pixels) < FEWEST:
        return np.zeros(0, int), np.zeros((0, 2))
    looks = np.concatenate([one.looks for one in landmarks.values()])
    two = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(looks, descriptors, 2)
    best: dict[int, tuple[float, int]] = {}
    for first, second in (pair for pair in two if len(pair) == 2):
        slot = int(owner[first.queryIdx])
        if first.distance < RATIO * second.distance:
            best[slot] = min(best.get(slot, (np.inf, 0)), (first.distance, first.trainIdx))
    return np.array(list(best), int), pixels[[corner for _, corner in best.values()]]


def pose_of(
    points: Float[np.ndarray, "m 3"], pixels: Float[np.ndarray, "m 2"], calibration: Calibration
) -> Float[np.ndarray, "4 4"] | None:
    """Return T_wc of a picture that shows most of these points at these pixels; None if `FEWEST` of
    them cannot be seen at once."""
    if len(points) < FEWEST:
        return None
    K, distortion = calibration.matrix, np.array(calibration.distortion, float)
    found, turn, shift, inside = cv2.solvePnPRansac(
        points, pixels, K, distortion, iterationsCount=500, reprojectionError=PIXELS,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or inside is None or len(inside) < FEWEST:
        return None
    which = inside[:, 0].astype(int)
    turn, shift = cv2.solvePnPRefineLM(points[which], pixels[which], K, distortion, turn, shift)
    T_cw = np.eye(4)
    T_cw[:3, :3], T_cw[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return np.linalg.inv(T_cw)


def known_again(
    image: UInt8[np.ndarray, "h w"], map: Map, policy: Policy
) -> tuple[Observations, Correction] | None:
    """Return what is found of the landmarks in the first map that the picture shows: that is then
    the `map`, corrected by them. None, and nothing changes, where it shows none that is known."""
    if not map.estimator.displaceable:
        return None
    now, corners = map.now(), described_corners(image)
    for known in map.known():
        map.become(known)
        found = _found(
            image, corners, map, replace(policy)
        )  # what is only tried is no memory of its
        after = map.now()
        map.become(now)
        if found is not None:
            map.come_back(after)
            return found
    return None


def _found(
    image: UInt8[np.ndarray, "h w"], corners: Corners, map: Map, policy: Policy
) -> tuple[Observations, Correction] | None:
    """The landmarks of this map in a picture, and what they make of it."""
    slots, pixels = candidates(map.landmarks, corners)
    points, covariances = (part[slots] for part in map.estimator.points())
    with np.errstate(invalid="ignore"):  # at infinity
        sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        sure = sigma < SURE * np.linalg.norm(points, axis=1)
    T_new = pose_of(points[sure], pixels[sure], policy.calibration)
    if T_new is None:
        return None
    place = map.place
    T_last = np.linalg.inv(place.origin.T_wc) @ place.camera.T_wc
    T_last[:3, 3] /= place.unit
    depth = np.median((points[sure] - T_new[:3, 3]) @ T_new[:3, 2])
    sigma = np.repeat([SHIFT * depth, TURN], 3)
    predicted = map.estimator.displaced(np.linalg.inv(T_last) @ T_new, sigma, SECONDS)
    seen, reason = policy.observed(image, map, predicted, lost=True)
    if reason is not None or seen.matched.sum() < max(FEWEST, MOST_OF * len(seen.slots)):
        return None
    correction = map.estimator.correct(predicted, seen)
    return None if correction.failed else (seen.but_for(correction.used), correction)
