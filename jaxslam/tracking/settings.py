"""The settings of a tracker: what it assumes of motion and scene, and how much it does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxslam._numerics.arrays import check_numbers
from jaxslam._runtime.lookup import lookup
from jaxslam.filters.association import ASSOCIATIONS, TOLERANCE
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.words import FILTERS, make_filter
from jaxslam.io.calibration import LENS_SIGMA, Calibration
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.calibration import TREATMENTS, AbstractCalibration
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import AbstractMotion, ConstantVelocity
from jaxslam.models.sensors import Pinhole
from jaxslam.tracking.optics import camera_of

FIT = 36.0
"""The variance of a match by what it would be if its window's residual were white: distances from
epipolar lines, rendered and real, are 5 to 8 times that σ at every quality of fit."""
UNSTATED = 0.003
"""σ of the focal lengths of a calibration that states none, as a share of them: of boards it is 1
to 3 ‰, of what a data set publishes up to 12 ‰ (docs/sequences.md)."""
METRIC = "world"
"""The filter where a target says how long a metre is."""
INERTIAL = "robocentric+drift20"
"""The filter where an inertial unit does: `recommended` for its motion, and landmarks drift."""
POSITIVE = "wanted", "new_per_frame", "nearest_depth", "pixel_sigma", "patience", "spacing"
"""Numbers of which 0 makes no sense."""


@dataclass(frozen=True)
class TrackerSettings:
    """The assumptions of a tracker and how much it does.

    Lengths are in the unit of `nearest_depth`: a single camera does not see scale, so the map's
    unit is whatever that prior makes it. Raises ValueError for names that are not known, and for
    numbers that make no sense.
    """

    filter: str = "recommended+walk3+drift20"
    """Filter: a name of jaxslam.FILTERS, which may be modified, as in `robocentric+oc`.
    `recommended` is the default: it finds by itself how the camera starts, and its claims are true
    most often (docs/sequences.md)."""
    landmarks: str = "inverse_scaling"
    """Landmark parametrization: a name of jaxslam.LANDMARKS."""
    calibration: str | None = None
    """The treatment of the calibration: a name of TREATMENTS. By default it is estimated, with the
    σ that it states, that of a guess, or else 0.3 % of the focal length and 0.15 % of the width."""
    association: str = "sequential"
    """Which matches are believed: a name of jaxslam.filters.association.ASSOCIATIONS."""
    tolerance: float = TOLERANCE
    """σ of what cameras and patches do beyond their noise, in `pixel_sigma`: matches are tested
    with it, and weighed without."""
    wanted: int = 50
    """Landmarks to keep in view."""
    spare: int = 30
    """Slots for landmarks that are out of view. They stay until new ones need the slots: then
    those searched in vain go first, then the longest unseen and least known."""
    new_per_frame: int = 8
    """The most landmarks created in one frame."""
    nearest_depth: float = 1.0
    """d_min: the prior on depth reaches from here to infinity (96 %)."""
    unit_sigma: float = 1.0
    """σ of the log of the unit of length, for filters with a scale of their own (`scale_gauge`):
    it is unknown in metres."""
    pixel_sigma: float = 0.3
    """σ of a match whose window fits, pixels; of the others it is larger (`noise_factors`)."""
    readout: float = 0.0
    """Seconds from the exposure of the first row to that of the last, of a rolling shutter; 0 of a
    global one. A frame's time and pose are those of its middle row."""
    focal_sigma: float = 1.0
    """σ of the focal lengths, pixels, of a calibration that states none and is treated as named."""
    centre_sigma: float = 1.0
    """σ of the principal point, pixels, of the same."""
    velocity_sigma: float = 0.5
    """σ of the initial linear velocity, 1/s."""
    angular_velocity_sigma: float = 1.0
    """σ of the initial angular velocity, rad/s."""
    acceleration_sigma: float = 1.0
    """σ of the linear acceleration, 1/s²."""
    angular_acceleration_sigma: float = 6.0
    """σ of the angular acceleration, rad/s²: a hand's, as in the scenarios `handheld-NAME`."""
    border: int = 12
    """Pixels along the image's edge where nothing is matched or created."""
    spacing: float = 20.0
    """Least distance of a new landmark to the others, pixels."""
    absent_after: int = 5
    """A landmark that so many searches in a row did not find counts as in view no more, and
    keeps no new one away."""
    patience: int = 10
    """The number of latest searches, about, over which a landmark's success is averaged."""
    least_success: float = 0.35
    """The share of them that must find a landmark for it to stay; at first, all count as found."""
    lost_for: int = 15
    """Frames in a row without tracking after which a new map is initialised."""

    def __post_init__(self) -> None:
        if self.filter == "recommended":
            object.__setattr__(self, "filter", type(self).filter)
        lookup("filter", [self.filter.partition("+")[0]], FILTERS)
        lookup("landmarks", [self.landmarks], LANDMARKS)
        lookup("association", [self.association], ASSOCIATIONS)
        if self.calibration is not None:
            lookup("calibration", [self.calibration], TREATMENTS)
        if not 0 <= self.readout <= 1:
            raise ValueError(f"readout is a time from 0 to 1 s, such as 20ms, not {self.readout} s")
        for name, value in vars(self).items():
            check_numbers(name, value, "positive" if name in POSITIVE else "not negative")

    @property
    def capacity(self) -> int:
        """Slots of the filter."""
        return self.wanted + self.spare

    @property
    def depth(self) -> InverseDepth:
        """The prior on the depth of new landmarks."""
        return replace(InverseDepth.beyond(self.nearest_depth), unit=self.unit_sigma)

    def noise_factors(self, variances: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return by how much more variance than that of `pixel_sigma` matches have whose windows
        tell these, pixels²."""
        return np.maximum(FIT * variances / self.pixel_sigma**2, 1.0)

    def noisier(
        self, variances: Float[np.ndarray, " k"], factors: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, " k"]:
        """Return the variances of windows whose noise has these factors beside those of
        `noise_factors`."""
        return np.maximum(variances, self.pixel_sigma**2 / FIT) * factors

    def make_filter(
        self, calibration: Calibration, motion: AbstractMotion | None = None
    ) -> AbstractFilter:
        """The filter that is named, with these numbers, or with a motion of another kind. Raises
        ValueError."""
        accelerations = [self.acceleration_sigma] * 3 + [self.angular_acceleration_sigma] * 3
        velocities = [self.velocity_sigma] * 3 + [self.angular_velocity_sigma] * 3
        return make_filter(
            self.filter,
            motion=motion or ConstantVelocity(accelerations, [0.0] * 6, velocities),
            sensor=Pinhole(
                camera_of(calibration),
                self.pixel_sigma,
                self.readout / calibration.height if self.readout else None,
            ),
            landmark=LANDMARKS[self.landmarks],
            calibration=self.treatment(calibration),
            depth=self.depth,
        )

    def treatment(self, calibration: Calibration) -> AbstractCalibration:
        """Return what the filter makes of a calibration, with the σ that it states or else with
        these; where no treatment is named with `UNSTATED`, by which both focal lengths are off."""
        c, named = calibration, self.calibration
        if c.guessed:
            sigma = [*c.sigma[1:], *LENS_SIGMA]
        elif c.sigma or named:
            sigma = list(c.sigma) or [self.focal_sigma] * 2 + [self.centre_sigma] * 2
        else:
            sigma = UNSTATED * np.array([max(c.fx, c.fy), c.width / 2, c.width / 2])
        return TREATMENTS[named or "estimated"](sigma)
