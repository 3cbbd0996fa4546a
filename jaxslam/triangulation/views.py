"""Two views of one point: the world of the paper's Figs 1 and 2, as plain data.

The world is planar and its camera 1-D, `u = f x/z + c`. The second view is a baseline to the right
of the first, without a rotation and exactly known, so that the depth z is the same in both. The
point is written (x, z) in the second camera, the current one, where a robocentric filter has it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray, cast
from jaxslam._runtime.lookup import suggestion
from jaxslam.filters.slam import Slam
from jaxslam.geometry import PLANAR
from jaxslam.landmarks import AbstractLandmark
from jaxslam.models.calibration import Estimated, Known, White
from jaxslam.models.camera import Camera, project
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import BUILT_IN

_MATCHED = BUILT_IN["matched"].fields
CALIBRATIONS = {"white": White, "shared": Estimated, "known": lambda sigma: Known()}
"""What the true intrinsics are, and how a filter that knows this treats them: drawn anew in each
view, drawn once for both views, or exactly known."""
NOISE_DIM = 6
"""Numbers that two measurements can depend on: two pixel errors and two errors of (f, c)."""


@dataclass(frozen=True)
class TwoViews:
    """A point, two cameras that see it, and what is known of them. Metres and pixels."""

    depth: float = 15.0
    """True z of the point, m."""
    baseline: float = 0.6
    """Sideways motion between the views, exactly known, m."""
    pixel: float = _MATCHED["centre"][0]
    """Where the first view sees the point: the principal point is on the axis."""
    nearest_depth: float = 1.0
    """d_min, m: the filters' prior on 1/z is N(1/(2 d_min), (1/(4 d_min))²)."""
    calibration: str = "white"
    """`white`: intrinsics drawn in each view; `shared`: once for both; `known`: exact."""
    width: float = _MATCHED["image"][0]
    """Of the picture, pixels."""
    focal: float = _MATCHED["focal"][0]
    """Length, pixels."""
    centre: float = _MATCHED["centre"][0]
    """The principal point, pixels."""
    focal_sigma: float = _MATCHED["focal_sigma"]
    """σ of the focal length, pixels."""
    centre_sigma: float = _MATCHED["centre_sigma"]
    """σ of the principal point, pixels."""
    pixel_sigma: float = _MATCHED["pixel_sigma"]
    """σ of a measured pixel."""

    def __post_init__(self) -> None:
        _check(self)

    @property
    def pixels(self) -> tuple[float, float]:
        """The pixels at which both views see the point, with the nominal camera and no noise."""
        return self.pixel, self.pixel - self.focal * self.baseline / self.depth

    @property
    def point(self) -> tuple[float, float]:
        """(x, z) of the point in the second camera, m."""
        return (self.pixels[1] - self.centre) / self.focal * self.depth, self.depth

    def given(self, pixels: Float[Array, " 2"]) -> Given:
        """The data of an estimate from these two measured pixels."""
        sigma = np.array([self.focal_sigma, self.centre_sigma])
        sensor = Pinhole(Camera([self.focal], [self.centre]), self.pixel_sigma)
        depth = InverseDepth.beyond(self.nearest_depth)
        return cast(Given(sensor, sigma, depth, np.array(self.baseline), pixels), float)


class Given(eqx.Module):
    """Two measured pixels, and the numbers of those who know the noise exactly."""

    sensor: Pinhole
    intrinsics_sigma: Float[AnyArray, " 2"]
    """σ of (f, c), pixels."""
    depth: InverseDepth
    """The prior on 1/z."""
    baseline: Float[AnyArray, ""]
    """m."""
    pixels: Float[AnyArray, " 2"]

    def filter(self, calibration: str, landmark: AbstractLandmark) -> Slam:
        """The paper's filter; the motion has no acceleration, and one step takes a second."""
        still = jnp.zeros(PLANAR.tangent_dim)
        return Slam(
            motion=ConstantVelocity(still, still.at[0].set(self.baseline), still),
            sensor=self.sensor,
            landmark=landmark,
            calibration=CALIBRATIONS[calibration](self.intrinsics_sigma),
            depth=self.depth,
        )


def errors(
    calibration: str, given: Given, normal: Float[Array, f" {NOISE_DIM}"]
) -> tuple[Float[Array, " 2"], Float[Array, "2 2"]]:
    """Pixel error and intrinsics' error (δf, δc) of both views, from standard normal numbers.

    How the errors of the two views are correlated is said here and nowhere else.
    """
    pixel = given.sensor.sigma * normal[:2]
    by_view = {
        "white": normal[2:6].reshape(2, 2),
        "shared": jnp.tile(normal[2:4], (2, 1)),
        "known": jnp.zeros((2, 2), normal.dtype),
    }[calibration]
    return pixel, by_view * given.intrinsics_sigma


def measure(views: TwoViews, count: int, seed: int) -> Float[Array, "count 2"]:
    """Measured pixels of the point, `count` times: measurement i draws from `seed` and i alone.

    They err as the filters expect: by the true intrinsics of each view and by the pixel noise.
    """
    given, (x, z) = views.given(jnp.zeros(2)), views.point
    points = jnp.array([[x + views.baseline, z], [x, z]])

    def one(index):
        normal = jax.random.normal(jax.random.fold_in(jax.random.key(seed), index), (NOISE_DIM,))
        pixel_errors, intrinsics_errors = errors(views.calibration, given, normal)
        cameras = jax.vmap(given.sensor.camera.perturbed)(intrinsics_errors)
        return jax.vmap(project)(cameras, points)[:, 0] + pixel_errors

    return jax.vmap(one)(jnp.arange(count))


_POSITIVE = ("depth", "baseline", "nearest_depth", "width", "focal", "pixel_sigma")
_NOT_NEGATIVE = ("focal_sigma", "centre_sigma")


def _check(views: TwoViews) -> None:
    """Raise ValueError, naming the field, unless both views can see the point."""
    for field, value in dataclasses.asdict(views).items():
        if field == "calibration":
            continue
        if not math.isfinite(value):
            raise ValueError(f"{field} is {value}; it must be finite")
        if field in _POSITIVE and value <= 0:
            raise ValueError(f"{field} must be positive, not {value}")
        if field in _NOT_NEGATIVE and value < 0:
            raise ValueError(f"{field} must not be negative, not {value}")
    if views.calibration not in CALIBRATIONS:
        raise ValueError(
            f"unknown calibration {views.calibration!r}"
            f"{suggestion(views.calibration, CALIBRATIONS)}; known: {', '.join(CALIBRATIONS)}"
        )
    if not 0 <= views.pixel < views.width:
        raise ValueError(f"pixel must be in the image, from 0 to {views.width:g}: {views.pixel:g}")
    if views.pixels[1] < 0:
        least = views.focal * views.baseline / views.pixel if views.pixel else math.inf
        raise ValueError(
            f"the second view does not see a point at depth {views.depth:g} and pixel "
            f"{views.pixel:g} from a baseline of {views.baseline:g}: depth must be at least "
            f"{least:.4g}, or the pixel larger"
        )
