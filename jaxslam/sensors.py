"""What is measured of a point: its pixel, or its position relative to the sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.camera import Camera, bearing, project
from jaxslam.geometry import Geometry

Homogeneous = tuple[Float[Array, " n"], Float[Array, ""]]


@dataclass(frozen=True)
class Sensor:
    """A measurement model of one homogeneous point (X, ω) in the sensor's frame."""

    name: str
    size: Callable[[Geometry], int]
    """How many numbers a measurement has, p."""
    hidden: int
    """How many numbers of a point one measurement does not tell: the size of their prior, q."""
    measure: Callable[[Camera, Array, Array], Float[Array, " p"]]
    """`measure(camera, X, ω)`: the noise-free measurement."""
    possible: Callable[[Array], Bool[Array, ""]]
    """`possible(X)`: whether the point can be measured at all."""
    locate: Callable[[Camera, Float[Array, " p"], Float[Array, " q"]], Homogeneous]
    """`locate(camera, measurement, hidden)`: the point, the inverse of `measure`."""
    chart: Callable[[Array, Array], Float[Array, " n"]]
    """`chart(X, ω)`: coordinates in which every parametrization is nearly Gaussian."""


def _bearing_and_depth(camera, pixel, inverse_depth):
    return jnp.append(bearing(camera, pixel), 1.0), inverse_depth[0]


CAMERA = Sensor(
    name="camera",
    size=lambda geometry: geometry.pixel_dim,
    hidden=1,
    measure=lambda camera, point, omega: project(camera, point),
    possible=lambda point: point[-1] > 0,
    locate=_bearing_and_depth,
    chart=lambda point, omega: jnp.append(point[:-1], omega) / point[-1],
)
"""A pixel (P14), on the homogeneous numerator; it hides 1/z. Chart (x/z, y/z, 1/z)."""

POSITION = Sensor(
    name="position",
    size=lambda geometry: geometry.point_dim,
    hidden=0,
    measure=lambda camera, point, omega: point / omega,
    possible=lambda point: jnp.ones((), bool),
    locate=lambda camera, position, hidden: (position, jnp.ones((), position.dtype)),
    chart=lambda point, omega: point / omega,
)
"""The point in the sensor's frame, m, all around: the relative position of 2-D SLAM studies."""

SENSORS = {sensor.name: sensor for sensor in (CAMERA, POSITION)}
