"""Whether matches fit the lens that was given: bundles adjusted with it, and with it free."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxslam._runtime.files import Json
from jaxslam._runtime.threads import in_one_thread
from jaxslam.io.calibration import Calibration
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.optics import sighted
from jaxslam.tracking.report import History

CLEAR = 0.8
"""The share of the squares that is left where another lens fits clearly better."""
_STRETCHES, _SPAN, _VIEWS = 3, 100, 10  # of the video, in frames, and of each stretch
_STEPS, _LOOSE = 25, 1.5  # of Levenberg and Marquardt; Cauchy's loss, pixels
_PRIOR = 0.3
"""σ of the logarithm of the focal length and of k1 where nothing tells them, with that of a pixel
for a unit."""


class BetterLens(NamedTuple):
    """The lens that fits best, and how much better than the one that was given."""

    focal: float
    """Its focal lengths, as a factor."""
    k1: float
    """By how much its k1 is greater."""
    sigma: Float[np.ndarray, " 2"]
    """σ of the factor's logarithm and of k1, of independent errors."""
    left: float
    """The share of the squared residuals that is left; 1 where too few points are shared."""

    def as_summary(self, given: Calibration) -> dict[str, Json]:
        """Return an entry of summary.json; whether it is the distortion, more than the focal
        length, that was wrong at half the picture's diagonal."""
        r2 = (given.width / given.fx) ** 2 + (given.height / given.fy) ** 2
        return {
            "fx": given.fx * self.focal,
            "k1": given.distortion[0] + self.k1,
            "sigma": {"fx": given.fx * float(self.sigma[0]), "k1": float(self.sigma[1])},
            "squares_left": self.left,
            "distortion": abs(self.k1) * r2 / 4 > abs(self.focal - 1),
        }


@in_one_thread
def better_lens(history: History, points: Points, calibration: Calibration) -> BetterLens:
    """Adjust views of three stretches of the video with the points that they share, from where the
    tracker has both, with the lens that was given and with focal length and k1 free."""
    squares, information, weighed = np.zeros(2), np.eye(2) / _PRIOR**2, np.zeros(2)
    for first in np.unique(np.linspace(0, max(len(history) - _SPAN, 0), _STRETCHES).astype(int)):
        last = min(first + _SPAN, len(history)) - 1
        chosen = [history[i] for i in np.unique(np.linspace(first, last, _VIEWS).astype(int))]
        seen = [one for one in chosen if not one.lost and one.map == chosen[-1].map]
        bundle = _Bundle.of(seen, points, calibration)
        if 2 * len(bundle.view) > 1.2 * (6 * len(bundle.shifts) + bundle.places.size):
            told, free = (bundle.adjusted(freed=freed) for freed in (0.0, 1.0))
            squares += told.left, free.left
            information, weighed = information + free.known, weighed + free.known @ free.bundle.lens
    if not squares[0]:
        return BetterLens(1.0, 0.0, np.full(2, np.inf), 1.0)
    covariance = np.linalg.inv(information)
    logarithm, k1 = covariance @ weighed
    sigma = np.sqrt(np.diagonal(covariance))
    return BetterLens(float(np.exp(logarithm)), float(k1), sigma, float(squares[1] / squares[0]))


class _Bundle(NamedTuple):
    """v views of p places by n pixels: `T_cw` of each view by turns and shifts, and the logarithm
    of the factor of the focal lengths and what is added to k1."""

    turns: Float[np.ndarray, "v 3 3"]
    shifts: Float[np.ndarray, "v 3"]
    places: Float[np.ndarray, "p 3"]
    lens: Float[np.ndarray, " 2"]
    view: Int[np.ndarray, " n"]
    place: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]
    given: Calibration

    @classmethod
    def of(cls, seen: History, points: Points, calibration: Calibration) -> _Bundle:
        """The points that three views share and all have before them, from the first view."""
        sights = [one.sights for one in seen]
        count = sum((np.isin(points.numbers, list(those)) for those in sights), 0 * points.numbers)
        with np.errstate(invalid="ignore"):  # of points that are nowhere
            ahead = [(points.points - one.T_wc[:3, 3]) @ one.T_wc[:3, 2] > 0 for one in seen]
        kept = (count >= 3) & np.all(ahead, axis=0) & np.isfinite(points.points).all(axis=1)
        index = {number: i for i, number in enumerate(points.numbers[kept].tolist())}
        found = [
            [(index[n], *pixel) for n, pixel in those.items() if n in index] for those in sights
        ]
        # A camera that turned away shares nothing with the others.
        sharing = [i for i, rows in enumerate(found) if rows]
        table = np.array([(v, *row) for v, i in enumerate(sharing) for row in found[i]])
        table = table.reshape(-1, 4)
        view, place = table[:, :2].astype(int).T
        T_wc = np.array([seen[i].T_wc for i in sharing]).reshape(-1, 4, 4)
        T_wf = T_wc[0] if sharing else np.eye(4)
        places = (points.points[kept] - T_wf[:3, 3]) @ T_wf[:3, :3]
        T_cf = np.linalg.inv(T_wc) @ T_wf
        lens = np.zeros(2)
        return cls(
            T_cf[:, :3, :3], T_cf[:, :3, 3], places, lens, view, place, table[:, 2:], calibration
        )

    def camera(self, k1: float = 0.0) -> Calibration:
        """The lens, with so much more k1."""
        c, times = self.given, float(np.exp(self.lens[0]))
        more = float(self.lens[1]) + k1
        distortion = (c.distortion[0] + more, *c.distortion[1:])
        return replace(c, fx=c.fx * times, fy=c.fy * times, distortion=distortion)

    def less(self, step: Float[np.ndarray, " c"]) -> _Bundle:
        """The bundle without a step, of turn and shift of every view, of the lens and of places."""
        of_views, of_lens, of_places = np.split(
            step, [self.shifts.size * 2, self.shifts.size * 2 + 2]
        )
        turns, shifts = np.split(of_views.reshape(-1, 6), 2, axis=1)
        nudges = np.array([cv2.Rodrigues(-turn)[0] for turn in turns])
        return self._replace(
            turns=nudges @ self.turns, shifts=self.shifts - shifts, lens=self.lens - of_lens,
            places=self.places - of_places.reshape(-1, 3),
        )  # fmt: skip

    def adjusted(self, *, freed: float) -> _Linear:
        """What Levenberg and Marquardt reach, with the lens `freed` (1) or as it is (0)."""
        now, damping = _Linear.at(self, freed), 1e-3
        for _ in range(_STEPS):
            H = now.by.T @ now.by
            H += np.diag(damping * np.diagonal(H) + 1e-9)
            tried = _Linear.at(now.bundle.less(np.linalg.solve(H, now.by.T @ now.off)), freed)
            done = 0 <= now.left - tried.left < 1e-3 * now.left
            now, damping = (tried, damping / 10) if tried.left < now.left else (now, 10 * damping)
            if done:
                break
        return now


class _Linear(NamedTuple):
    """The sum of squares by Cauchy's loss at a bundle, and what is squared and its Jacobian, by
    views, lens and places, as that loss weighs them."""

    bundle: _Bundle
    left: float
    off: Float[np.ndarray, " r"]
    by: Float[np.ndarray, "r c"]

    @classmethod
    def at(cls, bundle: _Bundle, freed: float) -> _Linear:
        v, p, n = len(bundle.shifts), len(bundle.places), len(bundle.view)
        R, h = bundle.turns[bundle.view], 1e-4
        turned = np.einsum("nij,nj->ni", R, bundle.places[bundle.place])
        X = turned + bundle.shifts[bundle.view]
        seen, slopes, _ = sighted(bundle.camera(), X)
        more, fewer = (sighted(bundle.camera(k1), X).pixels for k1 in (h, -h))
        off, slopes = seen - bundle.pixels, slopes[:, :2]
        far = np.sum(off**2, axis=1, keepdims=True) / _LOOSE**2
        by = np.zeros((n, 2, 6 * v + 2 + 3 * p))
        by_view = np.concatenate([np.cross(turned[:, None], slopes), slopes], axis=2)
        centre = bundle.given.cx, bundle.given.cy
        by_lens = freed * np.stack([seen - centre, (more - fewer) / (2 * h)], axis=2)
        for first, block in (
            (6 * bundle.view, by_view),
            (np.full(n, 6 * v), by_lens),
            (6 * v + 2 + 3 * bundle.place, slopes @ R),
        ):
            columns = first[:, None] + np.arange(block.shape[2])
            by[np.arange(n)[:, None, None], np.arange(2)[:, None], columns[:, None]] = block
        prior = np.eye(2, by.shape[2], 6 * v) / _PRIOR
        weights = 1 / np.sqrt(1 + far)
        off = np.append(weights * off, bundle.lens / _PRIOR)
        by = np.concatenate([(weights[..., None] * by).reshape(2 * n, -1), prior])
        left = _LOOSE**2 * np.log1p(far).sum() + np.sum((bundle.lens / _PRIOR) ** 2)
        return cls(bundle, float(left), off, by)

    @property
    def known(self) -> Float[np.ndarray, "2 2"]:
        """What the matches tell of the lens: the inverse of its covariance."""
        H, place = self.by.T @ self.by, 2 * self.bundle.shifts.size
        covariance = np.linalg.inv(H + np.diag(1e-6 * np.diagonal(H) + 1e-9))
        variance = self.left / max(len(self.by) - len(H), 1)
        return np.linalg.inv(variance * covariance[place : place + 2, place : place + 2])
