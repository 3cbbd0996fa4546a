"""Smoothing: every camera and landmark of a map as it is known at the end, loops included.

Between two hand-overs a camera keeps its place from the first one, but for what all that was seen
later says of the second: as much of that as of the way is behind it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from jaxslam.io.logs.log import interpolated
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.map import Map, TrackerState
from jaxslam.tracking.places.submaps import Graph, Solved
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance, Transform, carried
from jaxslam.tracking.report import History, Tracked


def smoothed(state: TrackerState, history: History) -> tuple[list[Tracked], Points]:
    """Return the frames and landmarks as they are known now; those of maps with one submap, of maps
    that no camera can come back to, and of one whose poses would not be finite stay as they are."""
    before = state.points()
    frames, points = list(history), before
    # What branches off is of two: the way from there on, and what led there as the latest has it.
    for one in (*state.known()[::-1], state.map):
        if one.submaps:
            graph = one.graph(state.estimator.settings, state.estimator.slam)
            solved = graph.solved()
            if not all(np.isfinite(x).all() for x in (solved.T_bc, solved.covariances)):
                told = f"map {one.number} cannot be smoothed: numbers are not finite"
                warnings.warn(told, stacklevel=2)
                continue
            parts = _parts(one, graph, solved)
            for i, camera in _cameras(parts, history).items():
                frames[i] = replace(history[i], camera=camera)
            points = _seen_from(parts, before, points)
    return frames, points


@dataclass(frozen=True)
class _Part:
    """A submap of a map, in the world and in the map's unit, when all is known."""

    number: int
    """Among those of all maps."""
    reported: np.ndarray
    """T of the camera with which it began, as it was reported."""
    begins: PoseWithCovariance
    """… and as it is known now."""
    way: PoseWithCovariance
    """Its last camera from there, as the filter had it."""
    ends: PoseWithCovariance
    """Its last camera as it is known now."""
    numbers: np.ndarray
    """Of its landmarks, (slots,)."""
    points: np.ndarray
    """These from its last camera, as they are known now, (slots, 3)."""
    covariances: np.ndarray
    """Given where that is."""

    def at(self, T_wc: np.ndarray, share: float, *, elsewhere: bool) -> PoseWithCovariance:
        """Return where a camera is, reported at T, with this share of the way behind it, which may
        begin `elsewhere` than where the submap before ended."""
        T_here = np.linalg.inv(self.reported) @ T_wc
        bent = np.linalg.inv(self.begins.T_wc) @ self.ends.T_wc @ np.linalg.inv(self.way.T_wc)
        T = self.begins.T_wc @ _part_of(bent, share) @ T_here
        first, last = (
            carried(end.covariance, np.linalg.inv(T) @ end.T_wc) for end in (self.begins, self.ends)
        )
        between = (1 if elsewhere else share) * (1 - share) * self.way.covariance
        return PoseWithCovariance(T, (1 - share) * first + share * last + between)


def _part_of(T: Transform, share: float) -> Transform:
    return interpolated(np.arange(2.0), np.array([np.eye(4), T]), np.array([share]))[0]


def _parts(one: Map, graph: Graph, solved: Solved) -> list[_Part]:
    """All submaps of a map, the present one last."""
    place, unit = one.place, one.place.unit
    submaps = [*graph.submaps, graph.present]
    told = [PoseWithCovariance(), *(submap.told.scaled(unit) for submap in submaps)]
    pairs = zip(solved.T_bc, solved.covariances, strict=True)
    known = [place.origin.then(PoseWithCovariance(T, P).scaled(unit)) for T, P in pairs]
    begins = [place.origin, *known[:-1]]
    reported = [place.origin.T_wc, *(submap.camera.T_wc for submap in one.submaps)]
    return [
        _Part(
            submap.number,
            reported[i],
            begins[i],
            replace(told[i + 1], T_wc=np.linalg.inv(told[i].T_wc) @ told[i + 1].T_wc),
            known[i],
            submap.numbers,
            unit * solved.points[i],
            unit**2 * submap.covariances,
        )
        for i, submap in enumerate(submaps)
    ]


def _cameras(parts: list[_Part], history: History) -> dict[int, PoseWithCovariance]:
    """The cameras of these submaps as they are known now, by the frames' places in the history."""
    known = {}
    where = np.array([frame.submap for frame in history])
    for part in parts:
        own = np.flatnonzero(where == part.number)
        if len(own):
            last = own[-1] + (part is not parts[-1])
            elsewhere = history[own[0]].relocalised
            for i in own.tolist():
                share = (i - own[0]) / max(last - own[0], 1)
                known[i] = part.at(history[i].T_wc, share, elsewhere=elsewhere)
    return known


def _seen_from(parts: list[_Part], before: Points, points: Points) -> Points:
    """The landmarks as the last of these submaps has them that has them. One that no submap has at
    its end is moved, from where it was `before`, with the camera of the submap in which it was
    given up."""
    X, P, in_map = points.points.copy(), points.covariances.copy(), points.in_map.copy()
    for part in parts:
        own = np.flatnonzero(points.submaps == part.number)
        moved = PoseWithCovariance(part.begins.T_wc @ np.linalg.inv(part.reported))
        _, in_map[own] = moved.points(before.points[own], before.in_map[own])
        X[own], P[own] = moved.points(before.points[own], before.covariances[own])
    for part in parts:
        _, here, there = np.intersect1d(points.numbers, part.numbers, return_indices=True)
        X[here], P[here] = part.ends.points(part.points[there], part.covariances[there])
        in_map[here] = P[here]
    return points._replace(points=X, covariances=P, in_map=in_map)
