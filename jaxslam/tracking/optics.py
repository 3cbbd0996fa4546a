"""The lens of a calibration for any number of pixels and points: rays, pixels and their slopes."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree

from jaxslam._runtime.programs import Program
from jaxslam.io.calibration import MODELS, Calibration
from jaxslam.models.camera import Camera, project, ray
from jaxslam.models.lens import LENSES, Ideal
from jaxslam.tracking.pose_with_covariance import Places, Positions

LEAST = 128
"""Rows for which the programs are compiled at least; more have twice as many."""
STEEP = 0.4
"""Cosine of the angle from the axis, of which a picture of an ideal pinhole shows no more: what
lies beyond has errors there that are many times those of its pixel."""


class Sighted(NamedTuple):
    """What a lens makes of points in the camera frame."""

    pixels: Float[np.ndarray, "n 2"]
    slopes: Float[np.ndarray, "n 3 3"]
    """The derivative of (u, v, depth) by the point."""
    seen: Bool[np.ndarray, " n"]
    """Whether the lens sees it."""


def camera_of(calibration: Calibration) -> Camera:
    """The camera with a calibration's numbers; a guessed one's may turn out to be distorted."""
    c, names = calibration, MODELS[calibration.model].split()
    lens = LENSES[c.model](**dict(zip(names, c.distortion, strict=True)))
    plain = c.model == "pinhole" and not (c.guessed or any(c.distortion))
    return Camera((c.fx, c.fy), (c.cx, c.cy), Ideal() if plain else lens)


def rays(calibration: Calibration, pixels: Places) -> Positions:
    """The points of depth 1 that pixels show."""
    return _of_rows(_rays, calibration, pixels)


def sighted(calibration: Calibration, points: Positions) -> Sighted:
    """What the lens makes of points in the camera frame, which may be numerators of homogeneous
    ones."""
    return Sighted(*_of_rows(_sighted, calibration, points))


def on_pinhole(calibration: Calibration, pixels: Places) -> tuple[Places, Bool[np.ndarray, " n"]]:
    """Where an ideal pinhole with the calibration's matrix would have these pixels, for methods
    that know no other lens, and which of them are within its view."""
    X = rays(calibration, pixels)
    within = X[:, 2] > STEEP * np.linalg.norm(X, axis=1)
    flat = X[:, :2] / np.where(within, X[:, 2], 1.0)[:, None]
    camera = camera_of(calibration)
    return flat * camera.focal + camera.centre, within


@Program
def _rays(camera: Camera, pixels: jax.Array) -> jax.Array:
    return jax.vmap(partial(ray, camera))(pixels)


@Program
def _sighted(camera: Camera, points: jax.Array) -> tuple[jax.Array, ...]:
    def one(point):
        def both(point):
            pixel = project(camera, point)
            return jnp.append(pixel, camera.lens.depth(point)), (pixel, camera.lens.sees(point))

        slopes, (pixel, seen) = jax.jacfwd(both, has_aux=True)(point)
        return pixel, slopes, seen

    return jax.vmap(one)(points)


def _of_rows(program: Program, calibration: Calibration, rows: np.ndarray) -> PyTree:
    size = max(LEAST, 1 << (len(rows) - 1).bit_length())
    padded = np.ones((size, rows.shape[1]))
    padded[: len(rows)] = rows
    with jax.enable_x64(True):
        found = jax.device_get(program(camera_of(calibration), padded))
    return jax.tree.map(lambda x: x[: len(rows)], found)
