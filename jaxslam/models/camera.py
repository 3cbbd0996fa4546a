"""Pinhole cameras, 1-D for the planar world and 2-D for the spatial one, by the same functions.

A camera is data: it can be batched, perturbed by its calibration's uncertainty and
differentiated. Pixels are (u,) or (u, v); points are (x, z) or (x, y, z) in the camera frame.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray, check_shape, numbers, optional_numbers
from jaxslam.geometry import Point

Pixel = Float[Array, " p"]
"""A pixel, or normalised coordinates."""
UNDISTORT_ITERATIONS = 8
"""Newton steps of `undistort`: quadratic convergence wherever the model can be inverted."""


class Camera(eqx.Module):
    """Intrinsics: `u = f x/z + c` after the lens's distortion.

    `distortion` holds OpenCV's k1, k2, p1, p2, k3, or is None for an ideal lens (and always is
    None for the 1-D camera).
    """

    focal: Float[AnyArray, " p"] = eqx.field(converter=numbers)
    """Pixels; one of each coordinate."""
    centre: Float[AnyArray, " p"] = eqx.field(converter=numbers)
    """The principal point, pixels."""
    distortion: Float[AnyArray, " 5"] | None = eqx.field(converter=optional_numbers, default=None)

    def __check_init__(self) -> None:
        check_shape("the camera's focal", self.focal, (1,), (2,))
        check_shape("the camera's centre", self.centre, np.shape(self.focal))
        if self.distortion is not None:
            check_shape("the camera's distortion", self.distortion, (5,))

    @property
    def intrinsics(self) -> Float[Array, " k"]:
        """(f, c) of the 1-D camera, (fx, fy, cx, cy) of the 2-D one, in pixels."""
        return jnp.concatenate([self.focal, self.centre])

    def perturbed(self, delta: Float[Array, " k"]) -> Camera:
        """The camera with its intrinsics moved by δ; an empty δ means that they are known.

        Of a 2-D camera δ may also be of (f, cx, cy): fx and fy are off by the same number.
        """
        if delta.size == 0:
            return self
        if delta.size == 3 and np.shape(self.focal) == (2,):
            delta = delta[jnp.array([0, 0, 1, 2])]
        focal, centre = jnp.split(self.intrinsics + delta, 2)
        return replace(self, focal=focal, centre=centre)


def project(camera: Camera, point: Point) -> Pixel:
    """Pixel of a point of the camera frame: `u = f d(x/z) + c`, d the distortion (P14).

    The point may be the numerator of a homogeneous one: its scale, and so a point at infinity,
    does not matter. At z = 0, where no pixel exists, the result and its derivative are finite
    but meaningless; callers test `point[-1] > 0`.
    """
    depth = jnp.where(point[-1] == 0, 1.0, point[-1])
    return camera.focal * distort(point[:-1] / depth, camera.distortion) + camera.centre


def bearing(camera: Camera, pixel: Pixel) -> Pixel:
    """Normalised image coordinates (x/z) or (x/z, y/z) of a pixel, the inverse of `project`."""
    return undistort((pixel - camera.centre) / camera.focal, camera.distortion)


def distort(ideal: Pixel, distortion: Float[AnyArray, " 5"] | None) -> Pixel:
    """OpenCV's radial-tangential model on normalised coordinates (x/z, y/z)."""
    if distortion is None:
        return ideal
    k1, k2, k3 = distortion[0], distortion[1], distortion[4]
    swapped = distortion[3:1:-1]  # (p2, p1)
    r2 = ideal @ ideal
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return ideal * (radial + 2 * swapped @ ideal) + r2 * swapped


def undistort(distorted: Pixel, distortion: Float[AnyArray, " 5"] | None) -> Pixel:
    """Inverse of `distort` by Newton's method; meaningless beyond the image that the model maps."""
    return distorted if distortion is None else _undistorted(distorted, distortion)


@jax.custom_jvp
def _undistorted(distorted: Pixel, distortion: Float[AnyArray, " 5"]) -> Pixel:
    def step(ideal, _):
        return ideal - _undone(ideal, distortion, distort(ideal, distortion) - distorted), None

    return jax.lax.scan(step, distorted, length=UNDISTORT_ITERATIONS)[0]


@_undistorted.defjvp
def _(primals, tangents):
    """Of an implicit function: its own Newton step, not the derivatives of all."""
    (_, distortion), (moved, by_distortion) = primals, tangents
    ideal = _undistorted(*primals)
    _, lens = jax.jvp(lambda d: distort(ideal, d), (distortion,), (by_distortion,))
    return ideal, _undone(ideal, distortion, moved - lens)


def _undone(ideal: Pixel, distortion: Float[AnyArray, " 5"], change: Pixel) -> Pixel:
    """By how much the ideal pixel changes where the distorted one does so: J⁻¹ of the change."""
    (a, b), (c, d) = jax.jacfwd(distort)(ideal, distortion)
    by = jnp.stack([d * change[0] - b * change[1], a * change[1] - c * change[0]])
    return by / (a * d - b * c)
