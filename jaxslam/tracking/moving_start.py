"""The start of an inertial unit in motion, by the pictures of a window: all of them at once.

A filter that linearises at its own estimate does not find a velocity of which only σ 1 m/s is
known. Here poses are what the readings make of the unknown start, so that corners, tracked through
the window (Lucas, Kanade 1981), tell velocity, biases and gravity by nonlinear least squares, as in
visual-inertial initialisation (Campos et al., ICRA 2020). What is returned is the unit at the
window's end; no later measurement is used twice.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray
from jaxslam._runtime.programs import Program
from jaxslam.filters.window.modes import directions
from jaxslam.geometry import SPATIAL, Pose, difference, identity, retract
from jaxslam.io.calibration import Calibration
from jaxslam.io.source import Source, selected
from jaxslam.linalg import cholesky
from jaxslam.models.camera import Camera, project, ray
from jaxslam.models.depth import InverseDepth
from jaxslam.models.imu import Imu, Increments, InertialState
from jaxslam.tracking.corners import bare_corners
from jaxslam.tracking.inertial import Inertial
from jaxslam.tracking.optics import camera_of
from jaxslam.tracking.patches import Picture
from jaxslam.tracking.settings import TrackerSettings

WINDOW = 1.5
"""Its seconds."""
STEPS = 12
"""Steps of a window: pictures between are used to track corners alone."""
SURE = 0.04
"""σ of the velocity, m/s, with which a filter starts."""
SPEED = 0.7
"""m/s, in every direction in which the search starts, besides the start from rest."""
DIRECTIONS = 6
TRACKED = 2.0
"""σ of a corner that is tracked from picture to picture, in that of a match."""
FEWEST = 8
"""Corners that are seen to the end."""
MOST = 30
"""Steps of the search from each."""
LEAST = 0.1
"""The fall of the cost with which it ends."""
ROBUST = 2.0
"""σ of a pixel from which on its square counts no more."""


def begun(source: Source, inertial: Inertial, settings: TrackerSettings) -> tuple[Source, Inertial]:
    """The part of a video, and the unit with its start there, from which a tracker goes on: all of
    it where the unit is at rest in the beginning, and else what follows the window.

    Raises ValueError where the window does not tell the start.
    """
    if not inertial.why_moving:
        return source, inertial
    last = int(np.searchsorted(source.times, source.times[0] + WINDOW))
    which = np.unique(np.linspace(0, last, STEPS + 1).round().astype(int))
    times = source.times[: last + 1][which[which < len(source.times)]]
    pictures = [frame.image for frame in itertools.islice(source, last + 1)]
    try:
        if last >= len(source.times):
            raise ValueError(f"the video is shorter than {WINDOW} s")
        controls = [inertial.control(*map(float, step)) for step in itertools.pairwise(times)]
        with jax.enable_x64(True):
            seen = tracks(pictures, settings)[which]
            imu = start_in_motion(inertial.imu, controls, seen, source.calibration, settings)
    except ValueError as error:
        told = f"{inertial.why_moving}, and its start in motion is not found: {error}"
        raise ValueError(f"{source.name}: {told}; begin elsewhere, as by --start") from None
    return selected(source, start=float(times[-1] - times[0])), replace(inertial, imu=imu)


def tracks(
    pictures: Sequence[Picture], settings: TrackerSettings
) -> Float[np.ndarray, "frames m 2"]:
    """Pixels of corners of the first picture in all; NaN from where they are lost."""
    flow = partial(cv2.calcOpticalFlowPyrLK, winSize=(15, 15), maxLevel=4)
    corners = bare_corners(pictures[0], settings).astype(np.float32)
    found = [corners]
    for before, after in itertools.pairwise(pictures):
        known = np.nan_to_num(found[-1])
        there, ok, _ = flow(before, after, known, None)
        back, again, _ = flow(after, before, there, None)
        same = np.linalg.norm(back - known, axis=1) < 0.5  # pixels
        good = (ok & again)[:, 0].astype(bool) & same & np.isfinite(found[-1]).all(axis=1)
        found.append(np.where(good[:, None], there, np.nan).astype(np.float32))
    return np.array(found, float)


def start_in_motion(
    imu: Imu,
    controls: Sequence[Increments],
    seen: Float[np.ndarray, "frames m 2"],
    calibration: Calibration,
    settings: TrackerSettings,
) -> Imu:
    """The model with the start that a window tells, at its end, from the start of `imu` at its
    first frame; controls lead from each frame to the next, in which these pixels are `seen`.

    Raises ValueError where too little is seen, or the velocity stays too uncertain.
    """
    some = np.isfinite(seen[-1]).all(axis=1)
    if some.sum() < FEWEST:
        raise ValueError(f"only {some.sum()} corners are seen through the window")
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *controls)
    pixels, sigma = seen[:, some], np.asarray(TRACKED * settings.pixel_sigma)
    window = Window(imu, stacked, camera_of(calibration), settings.depth, pixels, sigma)
    starts = np.zeros(3), *SPEED * directions(3, DIRECTIONS)
    best = min((_solved(window, velocity) for velocity in starts), key=lambda one: one.cost)
    now, root = _at_end(window, best)
    if (off := float(jnp.linalg.norm(root[:3], axis=1).max())) > SURE:
        raise ValueError(f"at the window's end the velocity is known to {off:.2g} m/s only")
    return imu.begun(now, root)


class Window(eqx.Module):
    """What is known of a window. Its unknowns, each with the prior N(0, 1), are those of the start,
    the noise of all steps, and of every corner its inverse depth and the error of its first pixel.
    """

    imu: Imu
    controls: Increments
    """Of all steps."""
    camera: Camera
    depth: InverseDepth
    pixels: Float[AnyArray, "frames m 2"]
    pixel_sigma: Float[AnyArray, ""]

    @property
    def size(self) -> int:
        """The number of unknowns."""
        frames, m, _ = self.pixels.shape
        return 12 + 18 * (frames - 1) + 3 * m

    def path(self, x: Float[Array, " n"]) -> tuple[Pose, InertialState]:
        """The cameras after every step, in the first one, and the variables at the end."""
        mean, root = self.imu.start()
        steps = len(self.pixels) - 1
        noise = x[12 : 12 + 18 * steps].reshape(steps, 18) * self.imu.noise_sigma

        def move(carry, step):
            pose, now = carry
            pose = pose @ self.imu.displacement(now, *step)
            return (pose, self.imu.next(now, *step)), pose

        start = identity(SPATIAL, x.dtype), retract(mean, root @ x[:12])
        (_, end), poses = jax.lax.scan(move, start, (noise, self.controls))
        return poses, end

    def errors(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        """All errors by their σ; zero of what was not seen."""
        poses, _ = self.path(x)
        own = x[12 + 18 * (len(self.pixels) - 1) :].reshape(-1, 3)
        first = self.pixels[0] + self.pixel_sigma * own[:, 1:]
        rays = jax.vmap(lambda pixel: ray(self.camera, pixel))(first)
        omega = self.depth.mean + self.depth.sigma * own[:, :1]

        def seen(pose):
            back = pose.inverse()
            points = jax.vmap(lambda point: back.rotation() @ point)(rays)
            return jax.vmap(lambda X: project(self.camera, X))(points + omega * back.translation())

        off = (jax.vmap(seen)(poses) - self.pixels[1:]) / self.pixel_sigma
        return jnp.concatenate([x, jnp.where(jnp.isfinite(off), off, 0.0).ravel()])


class Found(NamedTuple):
    """Unknowns, with Huber's cost, and the quadratic that it is near them."""

    cost: jax.Array
    x: jax.Array
    information: jax.Array
    gradient: jax.Array


def _solved(window: Window, velocity: np.ndarray) -> Found:
    """The minimum near a velocity, by Levenberg–Marquardt."""
    start = np.zeros(window.size)
    start[:3] = velocity / window.imu.start_sigma[0]
    best, damping = _linearised(window, start), 1e-3
    for _ in range(MOST):
        there = _linearised(window, _nearer(best, np.asarray(damping)))
        fall = float(best.cost - there.cost)
        best, damping = (there, damping / 10) if fall > 0 else (best, damping * 10)
        if 0 < fall < LEAST:
            break
    return best


@Program
def _linearised(window: Window, x: jax.Array) -> Found:
    errors, J = window.errors(x), jax.jacfwd(window.errors)(x)
    size = jnp.abs(errors)
    cost = jnp.where(size < ROBUST, size**2, ROBUST * (2 * size - ROBUST))
    weights = jnp.minimum(ROBUST / jnp.maximum(size, ROBUST), 1.0)
    weighted = J.T * weights
    return Found(jnp.sum(cost), x, weighted @ J, weighted @ errors)


@Program
def _nearer(at: Found, damping: jax.Array) -> jax.Array:
    A = at.information + damping * jnp.diag(jnp.diagonal(at.information))
    return at.x - cholesky(A).solve(at.gradient)


@Program
def _at_end(window: Window, at: Found) -> tuple[InertialState, jax.Array]:
    """The variables at the end, and a root of their covariance."""
    end = window.path(at.x)[1]
    J = jax.jacfwd(lambda x: difference(window.path(x)[1], end))(at.x)
    return end, jnp.linalg.qr(cholesky(at.information).whitening @ J.T, mode="r").T
