"""What users add to the package, each in one class: a landmark, sensors, a motion with a bias, a
treatment of the calibration, a remedy. `test_additions.py` runs them."""

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxslam
from jaxslam._numerics.arrays import AnyArray, number_field
from jaxslam.filters.linear.blocks import residuals
from jaxslam.filters.linear.covariance import expected
from jaxslam.filters.linear.kalman import AbstractCorrection, kalman_update
from jaxslam.geometry import exp, homogeneous_apply


class PlainHomogeneous(jaxslam.AbstractLandmark):
    """A homogeneous point (x, y, z, ω), z = 1 where it is first seen: no pixels in it."""

    name: ClassVar[str] = "plain_homogeneous"

    def size(self, n):
        return n + 1

    def initialise(self, point, omega, focal):
        del focal
        return jnp.append(point, omega)

    def homogeneous(self, landmark):
        return landmark[:-1], landmark[-1]

    def transform(self, T_ab, landmark):
        point, omega = self.homogeneous(landmark)
        return jnp.append(homogeneous_apply(T_ab, point, omega), omega)

    def scale(self, factor, landmark):
        return landmark.at[-1].divide(factor)


class Bearing(jaxslam.AbstractSensor):
    """The direction of a point in a plane, rad, all around; it hides the inverse distance."""

    hidden: ClassVar[int] = 1
    size: ClassVar[int] = 1
    point_dim: ClassVar[int] = 2

    sigma: AnyArray = number_field()

    def measure(self, point, omega):
        return jnp.atan2(point[0], point[1])[None]

    def locate(self, measured, hidden):
        return jnp.concatenate([jnp.sin(measured), jnp.cos(measured)]), hidden[0]

    def residual(self, measured, predicted):
        difference = measured - predicted
        return jnp.atan2(jnp.sin(difference), jnp.cos(difference))

    def chart(self, point, omega):
        distance = jnp.linalg.norm(point)
        return jnp.stack([jnp.atan2(point[0], point[1]), omega / distance])


class Pixels(jaxslam.AbstractSensor):
    """A pinhole camera of one's own, with square pixels: all of its numbers in one array."""

    hidden: ClassVar[int] = 1
    size: ClassVar[int] = 2
    point_dim: ClassVar[int] = 3

    intrinsics: AnyArray = number_field()
    """f, cx, cy, pixels."""
    sigma: AnyArray = number_field()

    def measure(self, point, omega):
        return self.intrinsics[0] * point[:2] / point[2] + self.intrinsics[1:]

    def locate(self, measured, hidden):
        ideal = (measured - self.intrinsics[1:]) / self.intrinsics[0]
        return jnp.append(ideal, 1.0), hidden[0]

    def possible(self, point):
        return point[2] > 0

    def chart(self, point, omega):
        return jnp.append(point[:2], omega) / point[2]

    def perturbed(self, delta):
        return replace(self, intrinsics=self.intrinsics + delta) if delta.size else self


class BiasedVelocity(jaxslam.AbstractMotion):
    """Constant velocity, driven by white acceleration and by a constant one that is not known."""

    acceleration_sigma: AnyArray = number_field()
    velocity: AnyArray = number_field()
    velocity_sigma: AnyArray = number_field()
    bias_sigma: AnyArray = number_field()

    @property
    def geometry(self):
        return jaxslam.PLANAR if self.acceleration_sigma.size == 3 else jaxslam.SPATIAL

    @property
    def noise_sigma(self):
        return self.acceleration_sigma

    def start(self):
        velocity = jnp.asarray(self.velocity)
        root = jnp.diag(jnp.concatenate([self.velocity_sigma, self.bias_sigma]))
        return {"velocity": velocity, "bias": jnp.zeros_like(velocity)}, root[_by_name(velocity)]

    def displacement(self, variables, noise, control):
        return exp(self.geometry.group, self.next(variables, noise, control)["velocity"] * control)

    def next(self, variables, noise, control):
        moved = variables["velocity"] + (variables["bias"] + noise) * control
        return {**variables, "velocity": moved}

    def still(self, dtype=None):
        return jnp.zeros((), dtype)

    def nominal_control(self, velocity, seconds):
        return seconds


def _by_name(velocity):
    """A dictionary's numbers come in the order of its keys: the bias first."""
    t = velocity.size
    return np.r_[t : 2 * t, :t]


class DriftingFocal(jaxslam.AbstractCalibration):
    """One relative error of all focal lengths, which moves from frame to frame."""

    sigma: AnyArray = number_field()
    """At the start, one number."""
    drift: AnyArray = number_field()
    """In one step, one number."""

    @property
    def drift_sigma(self):
        return self.drift

    def next(self, delta, noise):
        return delta + noise

    def sensor(self, nominal, delta):
        camera = nominal.camera
        return replace(nominal, camera=replace(camera, focal=camera.focal * (1 + delta[0])))


class Huber(AbstractCorrection):
    """Measurements that are off by more than k σ count with less weight (Huber 1964)."""

    k: float = eqx.field(static=True, default=2.0)

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        _, residual, _, _ = residuals(model, state, features, context)
        innovation = expected(model, state, features.slots, context)[1] + noise
        sigma = jnp.sqrt(jnp.trace(innovation, axis1=1, axis2=2) / residual.shape[1])
        off = jnp.linalg.norm(residual, axis=1) / sigma / self.k
        weighted = noise * jnp.maximum(off, 1.0)[:, None, None]
        return kalman_update(model, state, None, features, weighted, context, considered)
