"""What a tracker assumes of its camera's motion and scene, and how much it does."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp

from jaxslam.camera import Camera
from jaxslam.filters import FILTERS, Parameters, inverse_depth_prior
from jaxslam.landmarks import LANDMARKS
from jaxslam.names import chosen
from jaxslam.vision.calibration import Calibration


@dataclass(frozen=True)
class TrackerSettings:
    """What a tracker assumes and how much it does. Lengths are in the unit of `nearest_depth`:
    a single camera does not see scale, so the map's unit is whatever that prior makes it."""

    filter: str = "world"
    """Filter: a name of jaxslam.FILTERS, which may be modified, as in `robocentric+oc`.
    `recommended` is the default, the one of docs/sequences.md with the best trajectories."""
    landmarks: str = "inverse_scaling"
    """Landmark parametrization: a name of jaxslam.LANDMARKS."""
    calibration: str = "known"
    """Treatment of the calibration: white or known."""
    wanted: int = 50
    """Landmarks to keep in view."""
    spare: int = 20
    """Slots for landmarks that are out of view for a while."""
    new_per_frame: int = 8
    """Landmarks created in one frame, at the most."""
    nearest_depth: float = 1.0
    """d_min: the prior on depth reaches from here to infinity (96 %)."""
    pixel_sigma: float = 0.3
    """σ of a match, pixels."""
    focal_sigma: float = 1.0
    """σ of the focal lengths, pixels (with `white` calibration)."""
    centre_sigma: float = 1.0
    """σ of the principal point, pixels (with `white` calibration)."""
    velocity_sigma: float = 0.5
    """σ of the initial linear velocity, 1/s."""
    angular_velocity_sigma: float = 0.5
    """σ of the initial angular velocity, rad/s."""
    acceleration_sigma: float = 1.0
    """σ of the linear acceleration, 1/s²."""
    angular_acceleration_sigma: float = 2.0
    """σ of the angular acceleration, rad/s²."""
    border: int = 12
    """Pixels along the image's edge where nothing is matched or created."""
    spacing: float = 20.0
    """Least distance of a new landmark to the others, pixels."""
    patience: int = 10
    """A landmark is judged after this many searches …"""
    least_success: float = 0.5
    """… and removed when fewer of them than this share matched."""
    forget_after: int = 30
    """Frames out of view after which a landmark is removed."""
    lost_for: int = 15
    """Frames in a row without tracking after which a new map is begun."""

    def __post_init__(self) -> None:
        if self.filter == "recommended":
            object.__setattr__(self, "filter", type(self).filter)
        chosen("filter", [self.filter.partition("+")[0]], FILTERS)
        chosen("landmarks", [self.landmarks], LANDMARKS)

    @property
    def capacity(self) -> int:
        """Slots of the filter."""
        return self.wanted + self.spare

    def parameters(self, calibration: Calibration) -> Parameters:
        """The filter's numbers, float64."""
        mean, sigma = inverse_depth_prior(self.nearest_depth)
        linear, angular = self.acceleration_sigma, self.angular_acceleration_sigma
        distorted = any(calibration.distortion)
        return Parameters(
            camera=Camera(
                focal=jnp.array([calibration.fx, calibration.fy]),
                centre=jnp.array([calibration.cx, calibration.cy]),
                distortion=jnp.array(calibration.distortion) if distorted else None,
            ),
            intrinsics_sigma=jnp.array([self.focal_sigma] * 2 + [self.centre_sigma] * 2),
            measurement_sigma=jnp.asarray(self.pixel_sigma),
            motion_sigma=jnp.array([linear] * 3 + [angular] * 3),
            inverse_depth=jnp.asarray(mean),
            inverse_depth_sigma=jnp.asarray(sigma),
        )
