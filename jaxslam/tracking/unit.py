"""The place of a map in the world, and its one unit of length.

While the filter has no unit that lasts, the map's is carried over by its landmarks: they do not
move.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxslam.tracking.estimator import CameraReport
from jaxslam.tracking.observations import Prediction
from jaxslam.tracking.pose_with_covariance import (
    PoseWithCovariance,
    Positions,
    Spreads,
    Transform,
    carried,
    positive,
)

Nearness = Mapping[int, float]
"""By a landmark's number: one by its distance from where the map begins, in the filter's unit."""


def nearness(numbers: Mapping[int, int], points: Positions) -> Nearness:
    """Return the nearness of landmarks, whose numbers are given by their slots, at points in the
    frame in which the map begins."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # at infinity, or nowhere
        near = 1 / np.linalg.norm(points, axis=1)
    return {number: float(near[slot]) for slot, number in numbers.items()}


def lengthened(before: Nearness, now: Nearness, among: Iterable[int]) -> float:
    """Log of by how much longer the filter's unit is now than it was before.

    Pixels of a camera that starts to move determine the products t ω. The mean of the ω is taken to
    be the same, over the landmarks `among` these that are known both times. Zero where there is
    none.
    """
    pairs = np.array([(before[n], now[n]) for n in among if n in before and n in now])
    old, new = pairs[np.isfinite(pairs).all(axis=1)].sum(axis=0) if len(pairs) else (0.0, 0.0)
    return float(np.log(new / old)) if old > 0 and new > 0 else 0.0


@dataclass(frozen=True)
class MapInWorld:
    """The place where a map begins in the world, that of the camera, and the unit of both."""

    origin: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    """Where the map begins."""
    camera: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    log_unit: float = 0.0
    """Log of the filter's unit in the map's."""
    log_scale: float = 0.0
    """The log of the map's unit in metres, as the filter believes it to be."""
    sigma_log_scale: float | None = None
    """σ of that log, where the filter is uncertain of it."""
    unit_fixed: bool = True
    """Whether the filter keeps its unit from here on."""
    near: Nearness = field(default_factory=dict)
    """The nearness of all landmarks, as long as the filter's unit is not fixed."""
    told: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    """A camera from where the map begins, as the filter had it when a loop closed."""
    known: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    """The same camera as it was known then."""
    here: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    """The camera from where the map begins, as the filter has it now."""

    @property
    def unit(self) -> float:
        """The filter's unit of length in the map's."""
        return float(np.exp(self.log_unit))

    def begun(self, report: CameraReport) -> MapInWorld:
        """What the filter says of the first camera of a map: the metre is the unit."""
        return replace(self, log_unit=float(report.log_scale))._reported(report)

    def followed(self, report: CameraReport, near: Nearness, found: Iterable[int]) -> MapInWorld:
        """What the filter says of its camera; how `near` the landmarks are to it now, by the
        numbers of those that were found again, tells what became of its unit."""
        longer = 0.0 if self.unit_fixed else lengthened(self.near, near, found)
        return replace(self, log_unit=self.log_unit + longer)._reported(report)

    def corrected(self, T_bc: Transform, covariance: Float[np.ndarray, "6 6"]) -> MapInWorld:
        """What a loop says of the present camera, in the filter's unit."""
        known = PoseWithCovariance(T_bc, covariance).scaled(self.unit)
        return replace(self, told=self.here, known=known)._with_camera(self.here)

    def restarted(self) -> MapInWorld:
        """What comes begins where the camera is."""
        nothing = PoseWithCovariance()
        return replace(self, origin=self.camera, told=nothing, known=nothing)

    def expected(self, view: Prediction) -> Prediction:
        """Return what the filter expects, in the world and in the map's unit."""
        T_wc = view.T_wc.copy()
        T_wc[:3, 3] *= self.unit
        T_wc = self.origin.T_wc @ self._moved @ T_wc
        return view._replace(T_wc=T_wc, omegas=view.omegas / self.unit)

    def points(
        self, points: Positions, covariances: Spreads
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The filter's points in the world with their covariances, and with those that are given
        where the map begins."""
        moved = PoseWithCovariance(self._moved)
        points, covariances = moved.points(points * self.unit, covariances * self.unit**2)
        _, in_map = PoseWithCovariance(self.origin.T_wc).points(points, covariances)
        return *self.origin.points(points, covariances), in_map

    def _reported(self, report: CameraReport) -> MapInWorld:
        here = PoseWithCovariance(report.T_wc, report.covariance).scaled(self.unit)
        variance = float(report.variance)
        return replace(
            self._with_camera(here),
            unit_fixed=bool(report.unit_fixed),
            log_scale=float(report.log_scale) - self.log_unit,
            sigma_log_scale=float(np.sqrt(variance)) if variance > 0 else None,
        )

    @property
    def _moved(self) -> Transform:
        """By how much a loop moved what is here, from where the map begins."""
        return self.known.T_wc @ np.linalg.inv(self.told.T_wc)

    def _with_camera(self, here: PoseWithCovariance) -> MapInWorld:
        """Where the filter has its camera, from where the map begins.

        Of what it did not know when a loop closed, that is left which was not known then.
        """
        T_now, T_told = here.T_wc, self.told.T_wc
        T = np.linalg.inv(T_now) @ T_told
        since = positive(here.covariance - carried(self.told.covariance, T))
        covariance = since + carried(self.known.covariance, T)
        camera = self.origin.then(PoseWithCovariance(self._moved @ T_now, covariance))
        return replace(self, here=here, camera=camera)


@dataclass(frozen=True)
class Join:
    """A map in the world and in the unit of another, in which its camera was known again."""

    map: int
    """The number of the map that is joined."""
    to: int
    """The number of the other map."""
    step: int
    """The frame, counted from 0, whose camera is in the other map."""
    moved: Transform
    """The motion of that camera since the frame before, in the map's own unit."""
    log_ratio: float
    """The log of the map's unit in that of the other."""
    sigma: float
    """σ of the log of the unit."""
