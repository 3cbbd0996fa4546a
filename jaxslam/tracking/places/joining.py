"""Two maps that turn out to be of one world: where one is in the other, and in which unit.

A camera that is known again in a map which was left is in both at once. How far it is from the
landmarks that both maps have says how long the unit of one is in that of the other: with the pose
that is the similarity, Sim(3), between two maps of one camera (Strasdat et al., RSS 2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.stats import median_abs_deviation

from jaxslam.tracking.estimator import Correction
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.map import Map, TrackerState
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.places.relocalisation import known_again, well_known
from jaxslam.tracking.places.submaps import Submap, in_submaps
from jaxslam.tracking.policy import Policy
from jaxslam.tracking.pose_with_covariance import (
    Places,
    PoseWithCovariance,
    Transform,
    carried,
    positive,
)
from jaxslam.tracking.report import History, Tracked
from jaxslam.tracking.unit import Join

LOOKED_EVERY = 15
"""Frames between two in which another map is looked for."""


def known_elsewhere(
    image: Picture, policy: Policy, state: TrackerState
) -> tuple[TrackerState, Observations, Correction] | None:
    """Do what `known_again` does for a camera that is not lost and maps that are not joined to its
    own."""
    number, joins = state.map.number, state.joins
    own = _world(number, joins)
    same = {one.number for one in state.left if _world(one.number, joins) == own}
    others = [one for one in state.left if one.number not in same]
    if not (others and state.map.place.unit_fixed and in_submaps(state.estimator.slam)):
        return None
    return known_again(image, policy, state.remembered(), but=same | {number})


def _world(number: int, joins: Sequence[Join]) -> int:
    """Return the number of the map to which this one is joined in the end."""
    for join in joins:
        number = join.to if join.map == number else number
    return number


def join_of(before: Map, state: TrackerState, last: Transform) -> Join | None:
    """The map as it was `before` joined to that in which the camera was known again in this frame;
    `last` is T of the camera in the frame before. None where too few landmarks are of both."""
    settings, slam, now = state.estimator.settings, state.estimator.slam, state.map
    (pixels, z, variance), (others, depths, variances) = (
        _depths(one, one.graph(settings, slam).present) for one in (before, now)
    )
    if not (len(pixels) and len(others)):
        return None
    apart = np.linalg.norm(pixels[:, None] - others, axis=2)
    i, j = np.arange(len(pixels)), np.argmin(apart, axis=1)
    # The most pixels between two landmarks, one of each map, that are the same point.
    same = (apart[i, j] < 2.0) & (np.argmin(apart, axis=0)[j] == i)
    # The fewest such pairs that join two maps.
    if same.sum() < 6:
        return None
    i, j = i[same], j[same]
    ratios = np.log(depths[j] / z[i])
    ratio = float(np.median(ratios))
    # What a map does not know of its scale, its depths have in common: that part of their variance
    # is not seen in how the ratios scatter, and no number of them makes it less.
    scatter = median_abs_deviation(ratios, scale="normal") ** 2
    common = max(float(np.median(variance[i] + variances[j])) - scatter, 0.0)
    sigma = float(np.sqrt(common + np.pi / 2 * scatter / len(ratios)))
    moved = np.linalg.inv(last) @ before.place.camera.T_wc
    return Join(before.number, now.number, state.steps, moved, ratio, sigma)


def joined(joins: Sequence[Join], history: History, points: Points) -> tuple[list[Tracked], Points]:
    """The frames and landmarks, each in the world of the map that its own was joined to."""
    frames = list(history)
    for join in joins:
        if not 0 < join.step < len(frames):
            continue
        here, last = frames[join.step].camera, frames[join.step - 1].camera
        there = last.then(PoseWithCovariance(join.moved))
        own = [i for i, frame in enumerate(frames) if frame.map == join.map]
        for i in own:
            frames[i] = _joined_frame(join, frames[i], there, here, before=i < join.step)
        points = _joined_points(join, points, there, here)
    return frames, points


def _joined_frame(
    join: Join, frame: Tracked, there: PoseWithCovariance, here: PoseWithCovariance, *, before: bool
) -> Tracked:
    """A frame of the map that is joined. Its camera is as well known as the one of both maps, and
    besides by how much less, or more, than that it was known in its own."""
    ratio = float(np.exp(join.log_ratio))
    T = np.linalg.inv(there.T_wc) @ frame.T_wc
    way = PoseWithCovariance(T).scaled(ratio)
    since = frame.covariance - carried(there.covariance, np.linalg.inv(T))
    between = PoseWithCovariance(T, positive(-since if before else since)).scaled(ratio)
    along = np.concatenate([T[:3, :3].T @ way.T_wc[:3, 3], np.zeros(3)])
    P = between.covariance + join.sigma**2 * np.outer(along, along)
    camera = here.then(PoseWithCovariance(way.T_wc, P))
    scale = None if frame.log_scale is None else frame.log_scale - join.log_ratio
    return replace(frame, map=join.to, camera=camera, log_scale=scale)


def _joined_points(
    join: Join, points: Points, there: PoseWithCovariance, here: PoseWithCovariance
) -> Points:
    ratio, own = float(np.exp(join.log_ratio)), points.maps == join.map
    back = PoseWithCovariance(np.linalg.inv(there.T_wc))
    X, P = back.points(points.points[own], points.in_map[own])
    X, P = ratio * X, ratio**2 * P
    with np.errstate(invalid="ignore", over="ignore"):  # at infinity
        P = P + join.sigma**2 * X[:, :, None] * X[:, None, :]
    _, in_map = PoseWithCovariance(here.T_wc).points(X, P)
    X, P = here.points(X, P)
    whole = {"points": X, "covariances": P, "in_map": in_map, "maps": join.to}
    changed = {name: np.array(getattr(points, name)) for name in whole}
    for name, value in whole.items():
        changed[name][own] = value
    return points._replace(**changed)


def _depths(
    one: Map, present: Submap
) -> tuple[Places, Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Of the landmarks that the latest frame shows: pixels, depths in the map's unit, and the
    variances of their logs."""
    slots = np.array([slot for slot, x in one.landmarks.items() if not x.unseen], int)
    X, P = present.points[slots], present.covariances[slots]
    sure = well_known(X, P) & (X[:, 2] > 0)
    pixels = np.array([one.landmarks[slot].seen_at for slot in slots]).reshape(-1, 2)
    z = X[sure, 2]
    return pixels[sure], one.place.unit * z, P[sure, 2, 2] / z**2
