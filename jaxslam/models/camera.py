"""Cameras, 1-D for the planar world and 2-D for the spatial one, by the same functions.

A camera is data: it can be batched, perturbed by its calibration's uncertainty and
differentiated. Pixels are (u,) or (u, v); points are (x, z) or (x, y, z) in the camera frame.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray, check_numbers, check_shape, numbers
from jaxslam.geometry import Point
from jaxslam.models.lens import AbstractLens, Ideal

Pixel = Float[Array, " p"]
"""A pixel."""


class Camera(eqx.Module):
    """Intrinsics, `u = f d(X) + c`, and the lens d; a 1-D camera's is ideal, `x/z`."""

    focal: Float[AnyArray, " p"] = eqx.field(converter=numbers)
    """Pixels; one of each coordinate."""
    centre: Float[AnyArray, " p"] = eqx.field(converter=numbers)
    """The principal point, pixels."""
    lens: AbstractLens = Ideal()
    """What turns directions into places on a plane at unit focal length."""

    def __check_init__(self) -> None:
        check_shape("the camera's focal", self.focal, (1,), (2,))
        check_shape("the camera's centre", self.centre, np.shape(self.focal))
        check_numbers("the camera's focal", self.focal, "positive")

    @property
    def intrinsics(self) -> Float[Array, " k"]:
        """(f, c) of the 1-D camera, (fx, fy, cx, cy) of the 2-D one, in pixels; then the lens's k1
        and k2, if it has any."""
        lens = map(jnp.atleast_1d, self.lens.coefficients)
        return jnp.concatenate([self.focal, self.centre, *lens])

    def perturbed(self, delta: Float[Array, " k"]) -> Camera:
        """The camera with its intrinsics moved by δ; an empty δ means that they are known.

        δ is of (f, c), of (fx, fy, cx, cy), or of (f, cx, cy), where fx and fy are off by the same
        number; then, where the lens is not known, of its k1 and k2. Raises ValueError for others.
        """
        if delta.size == 0:
            return self
        count = np.shape(self.focal)[0]
        if count == 2 and delta.size % 2:
            delta = jnp.append(delta[:1], delta)
        focal, centre, of_lens = jnp.split(delta, [count, 2 * count])
        return Camera(self.focal + focal, self.centre + centre, self.lens.perturbed(of_lens))


def project(camera: Camera, point: Point) -> Pixel:
    """Pixel of a point of the camera frame: `u = f d(X) + c`, d the lens (P14).

    The point may be the numerator of a homogeneous one: its scale, and so a point at infinity,
    does not matter. Of a point that the lens does not see, the result and its derivative are
    finite but meaningless; callers test `camera.lens.sees(point)`.
    """
    return camera.focal * camera.lens.distort(point) + camera.centre


def ray(camera: Camera, pixel: Pixel) -> Point:
    """The point of depth 1 that a pixel shows, the inverse of `project`: (x/z, y/z, 1) of a
    perspective lens, a unit vector of a fisheye."""
    return camera.lens.undistort((pixel - camera.centre) / camera.focal)
