"""Whether matches fit the focal length that was given: bundles adjusted with it and with others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.report import Tracked

FACTOR = 1.2
"""Focal lengths so many times as long, and as short, are tried."""
CLEAR = 0.8
"""The share of the squares that is left where one of them fits clearly better."""
_STRETCHES, _SPAN, _VIEWS = 3, 100, 10  # of the video, in frames, and of each stretch
_STEPS, _LOOSE = 12, 1.5  # of Levenberg and Marquardt; Cauchy's loss, pixels

_Views = list[tuple[np.ndarray, np.ndarray]]
"""Of each, which points it sees, and at which pixels."""


def better_focal(
    history: Sequence[Tracked], points: Points, calibration: Calibration
) -> tuple[float, float]:
    """Return the factor, `FACTOR` or its inverse, with which focal lengths fit better, and the
    share of the squared residuals that is left then; 1 where too few points are shared to tell.

    Views of three stretches of the video are adjusted with the points that they share, from where
    the tracker has both. On real videos .89 of the squares are left at least where the focal length
    is right, and at most .75 where it is 20 % off and the path tells (docs/own-video.md).
    """
    left = np.zeros(3)
    for first in np.unique(np.linspace(0, max(len(history) - _SPAN, 0), _STRETCHES).astype(int)):
        last = min(first + _SPAN, len(history)) - 1
        chosen = [history[i] for i in np.unique(np.linspace(first, last, _VIEWS).astype(int))]
        seen = [one for one in chosen if not one.lost and one.map == chosen[-1].map]
        views, places = _shared(seen, points)
        # A camera that turned away shares nothing with the others.
        sharing = [i for i, (which, _) in enumerate(views) if len(which)]
        seen, views = [seen[i] for i in sharing], [views[i] for i in sharing]
        if 2 * sum(len(which) for which, _ in views) > 1.2 * (6 * len(views) + places.size):
            T_wc = np.array([one.T_wc for one in seen])
            factors = (1 / FACTOR, 1.0, FACTOR)
            left += [_left(T_wc, views, places, calibration, factor) for factor in factors]
    best = 0 if left[0] < left[2] else 2
    return (1 / FACTOR, 1.0, FACTOR)[best], float(left[best] / left[1]) if left[1] else 1.0


def _shared(seen: Sequence[Tracked], points: Points) -> tuple[_Views, Float[np.ndarray, "p 3"]]:
    """The points that three views share and all have before them, and where those are."""
    sights = [one.sights for one in seen]
    count = sum((np.isin(points.numbers, list(those)) for those in sights), 0 * points.numbers)
    with np.errstate(invalid="ignore"):  # of points that are nowhere
        ahead = [(points.points - one.T_wc[:3, 3]) @ one.T_wc[:3, 2] > 0 for one in seen]
    kept = (count >= 3) & np.all(ahead, axis=0) & np.isfinite(points.points).all(axis=1)
    index = {number: i for i, number in enumerate(points.numbers[kept].tolist())}
    found = [[(index[n], *pixel) for n, pixel in those.items() if n in index] for those in sights]
    tables = [np.array(rows, float).reshape(-1, 3) for rows in found]
    return [(table[:, 0].astype(int), table[:, 1:]) for table in tables], points.points[kept]


def _left(
    T_wc: Float[np.ndarray, "v 4 4"],
    views: _Views,
    places: Float[np.ndarray, "p 3"],
    calibration: Calibration,
    factor: float,
) -> float:
    """Return the sum of squares that Levenberg and Marquardt reach, with focal lengths `factor`
    times as long."""
    K = calibration.matrix.copy()
    K[[0, 1], [0, 1]] *= factor
    # What is so much deeper, and turns so much less, looks nearly the same.
    to_first, longer = np.linalg.inv(T_wc[0]), np.array([1.0, 1.0, factor])
    poses = np.zeros((len(views), 6))
    for pose, T in zip(poses, to_first @ T_wc, strict=True):
        pose[:3] = cv2.Rodrigues(T[:3, :3].T)[0][:, 0] / [factor, factor, 1.0]
        pose[3:] = -cv2.Rodrigues(pose[:3])[0] @ (T[:3, 3] * longer)
    places = (places @ to_first[:3, :3].T + to_first[:3, 3]) * longer
    now, damping = _Linear.at(poses, places, views, K, calibration), 1e-3
    for _ in range(_STEPS):
        step = now.step(damping)
        tried = _Linear.at(poses - step[0], places - step[1], views, K, calibration)
        if tried.left < now.left:
            poses, places, now, damping = poses - step[0], places - step[1], tried, damping / 10
        else:
            damping *= 10
    return now.left


class _Linear(NamedTuple):
    """The sum of squares by Cauchy's loss, half its gradient and its Hessian after Gauss, by poses
    (rotation vectors and positions of the world in v views) and by p places."""

    left: float
    by_poses: Float[np.ndarray, "v 6"]
    by_places: Float[np.ndarray, "p 3"]
    of_poses: Float[np.ndarray, "v 6 6"]
    of_places: Float[np.ndarray, "p 3 3"]
    of_both: Float[np.ndarray, "v p 6 3"]

    @classmethod
    def at(
        cls,
        poses: Float[np.ndarray, "v 6"],
        places: Float[np.ndarray, "p 3"],
        views: _Views,
        K: Float[np.ndarray, "3 3"],
        calibration: Calibration,
    ) -> _Linear:
        v, p = len(poses), len(places)
        shapes = (v, 6), (p, 3), (v, 6, 6), (p, 3, 3), (v, p, 6, 3)
        distortion = np.array(calibration.distortion)
        left, parts = 0.0, tuple(np.zeros(shape) for shape in shapes)
        for i, (pose, (which, pixels)) in enumerate(zip(poses, views, strict=True)):
            seen, by = cv2.projectPoints(places[which], pose[:3], pose[3:], K, distortion)
            off = seen[:, 0] - pixels
            far = np.sum(off**2, axis=1) / _LOOSE**2
            left += _LOOSE**2 * float(np.log1p(far).sum())
            A = by[:, :6].reshape(-1, 2, 6)
            B = (by[:, 3:6] @ cv2.Rodrigues(pose[:3])[0]).reshape(-1, 2, 3)
            WA, WB = (np.swapaxes(X, 1, 2) / (1 + far)[:, None, None] for X in (A, B))
            parts[0][i] = (WA @ off[:, :, None]).sum(axis=0)[:, 0]
            parts[1][which] += (WB @ off[:, :, None])[:, :, 0]
            parts[2][i] = (WA @ A).sum(axis=0)
            parts[3][which] += WB @ B
            parts[4][i, which] = WA @ B
        return cls(left, *parts)

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """What Levenberg and Marquardt subtract, the places by Schur's complement."""
        of_poses, of_places = (
            H + np.eye(H.shape[-1]) * (damping * H + 1e-9) for H in (self.of_poses, self.of_places)
        )
        both, each = self.of_both, np.linalg.inv(of_places)
        gain, v = both @ each, len(both)
        left = -np.einsum("vpik,wpjk->viwj", gain, both)
        left[np.arange(v), :, np.arange(v)] += of_poses
        right = self.by_poses - np.einsum("vpik,pk->vi", gain, self.by_places)
        of_pose = np.linalg.solve(left.reshape(6 * v, -1), right.ravel()).reshape(v, 6)
        rest = self.by_places - np.einsum("vpij,vi->pj", both, of_pose)
        return of_pose, np.einsum("pij,pj->pi", each, rest)
