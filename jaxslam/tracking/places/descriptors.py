"""What landmarks and corners look like: OpenCV's ORB descriptors (Rublee et al., ICCV 2011)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxslam.tracking.landmarks import Landmarks
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.pose_with_covariance import Places

CORNERS = 600
"""The number of corners of a picture that are compared."""
LOOKS = 3
"""Descriptors of a landmark that are kept, of different frames."""

Corners = tuple[Places, UInt8[np.ndarray, "n 32"]]
"""The corners of a picture: pixels and descriptors."""
ByNumber = Mapping[int, Float[np.ndarray, " 2"]]
"""Pixels of landmarks."""


def describe(
    image: Picture, pixels: Places
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


def with_looks(landmarks: Landmarks, image: Picture) -> Landmarks:
    """The landmarks with what they look like in the latest picture, those that it shows."""
    shown = {slot: one for slot, one in landmarks.items() if not one.unseen}
    pixels = np.array([one.seen_at for one in shown.values()]).reshape(-1, 2)
    looking = dict(landmarks)
    for (slot, one), descriptor, there in zip(shown.items(), *describe(image, pixels), strict=True):
        if there:
            looks = np.concatenate([one.looks, descriptor[None]])[-LOOKS:]
            looking[slot] = replace(one, looks=looks)
    return looking


def described_corners(image: Picture) -> Corners:
    """Return the corners of a picture, (n, 2), and their descriptors."""
    found = cv2.goodFeaturesToTrack(image, CORNERS, 0.01, 7)
    corners = np.zeros((0, 2)) if found is None else found[:, 0].astype(float)
    descriptors, there = describe(image, corners)
    return corners[there], descriptors[there]


def candidates(landmarks: Landmarks, corners: Corners) -> ByNumber:
    """Return the corners of a picture that look like landmarks, by the keys of these."""
    owner = np.repeat(list(landmarks), [len(one.looks) for one in landmarks.values()])
    pixels, descriptors = corners
    if len(owner) == 0 or len(pixels) < 2:
        return {}
    looks = np.concatenate([one.looks for one in landmarks.values()])
    two = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(looks, descriptors, 2)
    best: dict[int, tuple[float, int]] = {}
    for first, second in (pair for pair in two if len(pair) == 2):
        slot = int(owner[first.queryIdx])
        # The largest ratio of the distance of the most similar descriptor to that of the next.
        if first.distance < 0.85 * second.distance:
            best[slot] = min(best.get(slot, (np.inf, 0)), (first.distance, first.trainIdx))
    return {number: pixels[corner] for number, (_, corner) in best.items()}
