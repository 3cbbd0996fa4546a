"""The start of an inertial unit in motion, from pixels of a window: all of them at once.

A filter that linearises at its own estimate does not find a velocity of which only σ 1 m/s is
known. Here poses are what the readings make of the unknown start, so that pixels tell velocity,
biases and gravity by nonlinear least squares, as in visual-inertial initialisation (Campos et al.,
ICRA 2020).
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray
from jaxslam._runtime.programs import Program
from jaxslam.geometry import SPATIAL, Pose, difference, identity, retract
from jaxslam.linalg import cholesky
from jaxslam.models.camera import Camera, project, ray
from jaxslam.models.depth import InverseDepth
from jaxslam.models.imu import Imu, Increments, InertialState

MOST = 30
"""Steps of a search."""
LEAST = 0.1
"""The fall of the cost with which it ends."""
ROBUST = 2.0
"""σ of an error from which on its square counts no more."""


class InertialWindow(eqx.Module):
    """What is known of a window. Its unknowns, each with the prior N(0, 1), are those of the start,
    the noise of all steps, and of every corner its inverse depth and the error of its first pixel.
    """

    imu: Imu
    controls: Increments
    """Those of all steps."""
    camera: Camera
    depth: InverseDepth
    pixels: Float[AnyArray, "frames m 2"]
    pixel_sigma: Float[AnyArray, ""]

    @property
    def size(self) -> int:
        """The number of unknowns."""
        frames, m, _ = self.pixels.shape
        return len(self.imu.start()[1]) + 18 * (frames - 1) + 3 * m

    def path(self, x: Float[Array, " n"]) -> tuple[Pose, InertialState]:
        """The cameras after every step, in the first one, and the variables at the end."""
        mean, root = self.imu.start()
        steps, k = len(self.pixels) - 1, len(root)
        noise = x[k : k + 18 * steps].reshape(steps, 18) * self.imu.noise_sigma

        def move(carry, step):
            pose, now = carry
            pose = pose @ self.imu.displacement(now, *step)
            return (pose, self.imu.next(now, *step)), pose

        start = identity(SPATIAL, x.dtype), retract(mean, root @ x[:k])
        (_, end), poses = jax.lax.scan(move, start, (noise, self.controls))
        return poses, end

    def errors(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        """All errors by their σ; zero of what was not seen."""
        poses, _ = self.path(x)
        own = x[-3 * self.pixels.shape[1] :].reshape(-1, 3)
        first = self.pixels[0] + self.pixel_sigma * own[:, 1:]
        rays = jax.vmap(lambda pixel: ray(self.camera, pixel))(first)
        omega = self.depth.mean + self.depth.sigma * own[:, :1]

        def seen(pose):
            back = pose.inverse()
            points = jax.vmap(lambda point: back.rotation() @ point)(rays)
            return jax.vmap(lambda X: project(self.camera, X))(points + omega * back.translation())

        off = (jax.vmap(seen)(poses) - self.pixels[1:]) / self.pixel_sigma
        return jnp.concatenate([x, jnp.where(jnp.isfinite(off), off, 0.0).ravel()])


class Reached(NamedTuple):
    """Unknowns, with Huber's cost, and the quadratic that it is near them."""

    cost: jax.Array
    x: jax.Array
    information: jax.Array
    gradient: jax.Array


def minimum(window: InertialWindow, velocity: np.ndarray) -> Reached:
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
def _linearised(window: InertialWindow, x: jax.Array) -> Reached:
    errors, J = window.errors(x), jax.jacfwd(window.errors)(x)
    size = jnp.abs(errors)
    cost = jnp.where(size < ROBUST, size**2, ROBUST * (2 * size - ROBUST))
    weights = jnp.minimum(ROBUST / jnp.maximum(size, ROBUST), 1.0)
    weighted = J.T * weights
    return Reached(jnp.sum(cost), x, weighted @ J, weighted @ errors)


@Program
def _nearer(at: Reached, damping: jax.Array) -> jax.Array:
    A = at.information + damping * jnp.diag(jnp.diagonal(at.information))
    return at.x - cholesky(A).solve(at.gradient)


@Program
def at_end(window: InertialWindow, at: Reached) -> tuple[InertialState, jax.Array]:
    """The variables at the end, and a root of their covariance."""
    end = window.path(at.x)[1]
    J = jax.jacfwd(lambda x: difference(window.path(x)[1], end))(at.x)
    return end, jnp.linalg.qr(cholesky(at.information).whitening @ J.T, mode="r").T
