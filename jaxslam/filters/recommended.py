"""The filters to begin with: the paper's, and the best that was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.remedies.observability_constrained import ObservabilityConstrained
from jaxslam.filters.slam import Piece, Slam
from jaxslam.filters.window.start import FromWindow, Schedule
from jaxslam.geometry import PLANAR
from jaxslam.landmarks import Cartesian
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.scale import ScaleGauge
from jaxslam.models.sensors import AbstractSensor


def paper(motion: AbstractMotion, sensor: AbstractSensor, **pieces: Piece) -> Slam:
    """The filter of the paper: robocentric, composed after the update, of Inverse Scaling points
    that are used without delay. Other `pieces` are those of `Slam`. Raises ValueError."""
    return Slam(motion, sensor, **pieces)


def recommended(motion: AbstractMotion, sensor: AbstractSensor, **pieces: Piece) -> Slam:
    """The best filter that was measured for this motion and sensor (docs/which-filter.md).

    For a camera whose motion is a velocity it is robocentric, with a unit of length of its own,
    since no pixel observes the metre, and an error that is common to all depths, σ half of one
    landmark's. As scenes change, that error walks by 0.03 of one landmark's in a frame. One
    linearisation is not enough while the direction of travel is unknown: so it is a Gaussian sum
    over the velocity's direction, of at most 17 members in a plane and 9 in space, which ends in
    one Gaussian. Its covariance is carried along the gauge (`+oc`): without that, thousands of
    frames make the scale seem known.

    Where the velocity's mean is less than √3 σ of it, the same with a start that looks for the
    motion in a window of frames, of at most 5 and 3 members, and a common error that stays.

    For a camera with an inertial unit (`Imu`) it is robocentric in the same unit of length, whose
    size the unit observes, and the same sum, of 9 members: while the velocity is as unknown as the
    depths, the filter in metres is over-confident. Nothing has to be carried along the base frame.

    For a camera with odometry it is the paper's filter, with the same common error of depths, and
    an update of six steps of Gauss–Newton that ends at the mean of the posterior. Parallax is a
    product of the displacement and 1/z: one linearisation is too sure of a new landmark's, and the
    maximum of the posterior is at too long a displacement.

    For a sensor that measures metres: the paper's filter, of Cartesian points. What nothing
    observes is the base frame alone, whose directions do not move with a robocentric estimate: a
    remedy has nothing to repair, and world-centric filters with one were more over-confident.

    Other `pieces` are those of `Slam`, and take the place of these. Raises ValueError.
    """
    planar = motion.geometry is PLANAR
    depth = pieces.pop("depth", InverseDepth.beyond(1.0))
    learned: dict[str, float | None] = {}
    chosen: dict[str, Piece] = {}
    if not sensor.hidden:
        chosen["landmark"] = Cartesian()
    elif motion.has_velocity:
        learned = {"common": 0.5, "walk": 0.03}
        chosen["scale"], chosen["correction"] = ScaleGauge(), ObservabilityConstrained()
        chosen["mixture"] = Mixture(17 if planar else 9)
        if not _velocity_is_known(motion):
            learned["walk"] = None
            chosen["mixture"] = Mixture(5 if planar else 3)
            chosen["start"] = FromWindow(Schedule.of(motion.geometry, None if planar else 8))
    elif motion.estimates_velocity:
        chosen["scale"], chosen["mixture"] = ScaleGauge(), Mixture(9)
    else:
        learned = {"common": 0.5, "walk": 0.03}
        chosen["correction"] = Kalman(steps=6, mean=True)
    if depth.common is None:
        depth = replace(depth, **learned)
    return Slam(motion, sensor, depth=depth, **{**chosen, **pieces})


def _velocity_is_known(motion: AbstractMotion) -> bool:
    """Whether the velocity's mean is more than √3 σ of it in its own direction."""
    n = motion.geometry.point_dim
    mean, root = (np.asarray(x)[:n] for x in motion.start())
    return bool(mean @ mean > 3 * np.linalg.norm(mean @ root))
