"""MonoSLAM's delayed initialisation (Davison, ICCV 2003; Davison, Reid, Molton, Stasse, PAMI 2007).

At first sight a landmark is a semi-infinite ray, a Gaussian that is correlated with the camera,
and particles for the distance along it, uniform in a range. Every later measurement weighs the
particles and corrects nothing else. Once they agree the ray becomes a Cartesian point.

A point beyond the range has no particle. While its parallax is small the farthest particles
explain it, and it may become a point there, wrong and certain of it; otherwise its ray is lost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import Number
from jaxslam.filters.gaussian import correct
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.covariance import removed
from jaxslam.filters.linear.state import State
from jaxslam.filters.mixture.density import log_density
from jaxslam.filters.protocol import AbstractFilter, Corrected
from jaxslam.filters.rivals.delayed import AbstractDelayed, Delayed, around, reweighted
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar
from jaxslam.landmarks import AbstractLandmark, InverseDepthToCartesian
from jaxslam.landmarks.landmark import Parameters, ParametersCovariance
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features

_RAY = InverseDepthToCartesian()


class RayToCartesian(AbstractLandmark):
    """(C, θ, φ, ρ, 0) as long as the depth is not known, then (X, 0, …, 0, 1)."""

    name: ClassVar[str] = "ray_to_cartesian"
    converts: ClassVar[bool] = True

    def size(self, n: int) -> int:
        return _RAY.size(n)

    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Parameters:
        """A ray. Its ρ is the particles' to say: a constant without a variance until they agree."""
        return _RAY.initialise(point, omega, focal).at[-2].set(1.0)

    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        return _RAY.transform(T_ab, landmark)

    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        return _RAY.homogeneous(landmark)

    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        return _RAY.scale(factor, landmark)

    def convert(
        self, camera: Point, landmark: Parameters, covariance: ParametersCovariance
    ) -> Parameters:
        """Cartesian as soon as ρ has a variance."""
        del camera
        point, omega = _RAY.homogeneous(landmark)
        position = point / omega
        known = jnp.concatenate([position, jnp.zeros_like(position), jnp.ones(1, position.dtype)])
        return jnp.where(covariance[-2, -2] > 0, known, landmark)


class DepthParticles(AbstractDelayed):
    """A filter whose new landmarks are rays with particles for their depth; one row of the weights
    a landmark."""

    slam: AbstractSlam
    """The filter around one Gaussian, of `RayToCartesian` landmarks (`with_depth_particles`)."""
    nearest: float = eqx.field(static=True, default=0.5)
    farthest: float = eqx.field(static=True, default=5.0)
    """The range of distances along a ray, m."""
    count: int = eqx.field(static=True, default=100)
    """Particles of a ray. Where a step of the camera separates the pixels of neighbouring ones by
    many σ, none may explain a measurement between them."""
    agreement: float = eqx.field(static=True, default=0.3)
    """A ray becomes a point where σ_d / mean_d is below this."""
    lost: float = eqx.field(static=True, default=25.0)
    """A ray is dropped at a measurement whose `rᵀ S⁻¹ r` is above this for every particle."""

    def __check_init__(self) -> None:
        if self.count < 2:
            raise ValueError(f"a ray needs at least 2 depth particles, not {self.count}")

    def depths(self, dtype: DTypeLike | None = None) -> Float[Array, " count"]:
        """The particles' distances along the ray, m."""
        return jnp.linspace(self.nearest, self.farthest, self.count, dtype=dtype)

    def even(self, landmarks: int, dtype: DTypeLike) -> Float[Array, "landmarks count"]:
        return jnp.full((landmarks, self.count), 1 / self.count, dtype)

    def update(self, state: Delayed, control: Control, features: Features) -> Corrected:
        """Correct by the points; then weigh the particles of rays in the corrected state."""
        one, weights = state.gaussian, state.weights
        waiting = features.valid & _pending(one)[features.slots]
        points = replace(features, valid=features.valid & ~waiting)
        one, innovation = correct(self.slam, one, control, points)
        rays = replace(features, valid=waiting)
        likelihood, squared = self._evidence(one, control, rays, weights.dtype)
        slots = rays.places(one.active.size)
        after = reweighted(weights[features.slots], likelihood)
        weights = weights.at[slots].set(after, mode="drop")
        lost = jnp.all(squared > self.lost, axis=1)
        gone = jnp.zeros_like(one.active).at[slots].set(lost, mode="drop")
        return self._agreed(Delayed(removed(one, gone), weights)), innovation

    def begin(self, state: Delayed, features: Features) -> Delayed:
        """Begin rays, with particles of equal weight."""
        slots = features.places(state.gaussian.active.size)
        weights = state.weights.at[slots].set(1 / self.count, mode="drop")
        return Delayed(self.slam.close(state.gaussian, features), weights)

    def collapsed(self, state: Delayed) -> State:
        """A pending ray with the mean and variance of its particles' inverse distance."""
        mean, variance = _moments(state.weights, 1 / self.depths(state.weights.dtype))
        one = state.gaussian
        return _with_inverse_depth(one, _pending(one), mean, variance)

    def _evidence(self, one: State, control, features, dtype):
        """Log likelihood and `rᵀ S⁻¹ r` of every particle; S is the ray's and the camera's."""

        def at(depth):
            landmarks = one.landmarks.at[:, -2].set(1 / depth)
            expected = self.slam.predict_features(
                replace(one, landmarks=landmarks), control, features.slots
            )
            return expected.measured, expected.covariance, expected.possible

        predicted, covariance, in_front = jax.vmap(at, out_axes=1)(self.depths(dtype))
        residual = features.measured[:, None] - predicted
        likelihood, squared = jax.vmap(jax.vmap(log_density))(residual, covariance)
        return jnp.where(in_front, likelihood, -jnp.inf), jnp.where(in_front, squared, jnp.inf)

    def _agreed(self, state: Delayed) -> Delayed:
        """Give rays whose particles agree their depth; the next composition converts them.

        The depth enters as independent of the camera, as published, though it was found from the
        camera's motion: rays that finish together share an error that the filter does not know.
        """
        one = state.gaussian
        mean, variance = _moments(state.weights, self.depths(state.weights.dtype))
        # A particle stands for its cell of the range.
        variance += ((self.farthest - self.nearest) / (self.count - 1)) ** 2 / 12
        ready = _pending(one) & (variance < (self.agreement * mean) ** 2)
        known = _with_inverse_depth(one, ready, 1 / mean, variance / mean**4)
        return replace(state, gaussian=known)


def with_depth_particles(slam: AbstractFilter, farthest: int | None = None) -> DepthParticles:
    """The filter of Cartesian landmarks with depth particles up to `farthest`, m."""
    rays = replace(around(slam), landmark=RayToCartesian())
    return DepthParticles(rays) if farthest is None else DepthParticles(rays, farthest=farthest)


def _pending(state: State) -> Bool[Array, " landmarks"]:
    return state.active & (state.landmarks[:, -1] < 0.5)


def _moments(weights, values):
    """Mean and variance, row by row."""
    mean = weights @ values
    return mean, jnp.sum(weights * (values - mean[:, None]) ** 2, axis=1)


def _with_inverse_depth(state: State, which, mean, variance) -> State:
    """ρ and its own variance for some rays."""
    capacity, d = state.landmarks.shape
    place = state.core_dim + jnp.arange(capacity) * d + d - 2
    own = jnp.where(which, variance, state.covariance[place, place])
    rho = jnp.where(which, mean, state.landmarks[:, -2])
    return replace(
        state,
        landmarks=state.landmarks.at[:, -2].set(rho),
        covariance=state.covariance.at[place, place].set(own),
    )
