"""MonoSLAM's delayed initialisation (Davison, ICCV 2003; Davison, Reid, Molton, Stasse, PAMI 2007).

At first sight a landmark is a semi-infinite ray, a Gaussian that is correlated with the camera,
and particles for the distance along it, uniform in a range. Every later measurement weighs the
particles and corrects nothing else. Once they agree the ray becomes a Cartesian point.

A point beyond the range has no particle. While its parallax is small the farthest particles
explain it, and it may become a point there, wrong and certain of it; otherwise its ray is lost.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxslam.filters.ekf import AbstractEntry, EkfSlam, correct, insert
from jaxslam.filters.forms.state import State
from jaxslam.filters.initialisation.alternatives import (
    check_range,
    log_density,
    reweighted,
    with_entry,
)
from jaxslam.filters.protocol import Corrected
from jaxslam.landmarks import INVERSE_DEPTH_TO_CARTESIAN
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features


def _initialise(point, omega, focal):
    """A ray. Its ρ is the particles' to say: a constant without a variance until they agree."""
    return INVERSE_DEPTH_TO_CARTESIAN.initialise(point, omega, focal).at[-2].set(1.0)


def _convert(camera, landmark, covariance):
    """Convert a landmark to Cartesian as soon as ρ has a variance."""
    del camera
    point, omega = INVERSE_DEPTH_TO_CARTESIAN.homogeneous(landmark)
    position = point / omega
    known = jnp.concatenate([position, jnp.zeros_like(position), jnp.ones(1, position.dtype)])
    return jnp.where(covariance[-2, -2] > 0, known, landmark)


RAY = replace(
    INVERSE_DEPTH_TO_CARTESIAN, name="ray_to_cartesian", initialise=_initialise, convert=_convert
)
"""(C, θ, φ, ρ, 0) as long as the depth is not known, then (X, 0, …, 0, 1)."""


class DepthParticles(AbstractEntry):
    """The method's numbers; `State.memory` holds the particles' weights, one row a landmark."""

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
        check_range(self.nearest, self.farthest)
        if self.count < 2:
            raise ValueError(f"a ray needs at least 2 depth particles, not {self.count}")

    def depths(self, dtype: DTypeLike | None = None) -> Float[Array, " count"]:
        """The particles' distances along the ray, m."""
        return jnp.linspace(self.nearest, self.farthest, self.count, dtype=dtype)

    def memory(self, landmarks: int, dtype: DTypeLike) -> Float[Array, "landmarks count"]:
        return jnp.full((landmarks, self.count), 1 / self.count, dtype)

    def update(
        self, slam: EkfSlam, state: State, control: Control, features: Features
    ) -> Corrected:
        """Correct by the points; then weigh the particles of rays in the corrected state."""
        waiting = features.valid & _pending(state)[features.slots]
        points = replace(features, valid=features.valid & ~waiting)
        state, innovation = correct(slam, state, control, points)
        rays = replace(features, valid=waiting)
        likelihood, squared = self._evidence(slam, state, control, rays)
        slots = rays.places(state.active.size)
        weights = reweighted(state.memory[features.slots], likelihood)
        state = replace(state, memory=state.memory.at[slots].set(weights, mode="drop"))
        lost = jnp.all(squared > self.lost, axis=1)
        gone = jnp.zeros_like(state.active).at[slots].set(lost, mode="drop")
        return self._agreed(slam.gaussian_form.remove(state, gone)), innovation

    def initialise(self, slam: EkfSlam, state: State, features: Features) -> State:
        """Begin rays, with particles of equal weight."""
        state = insert(slam, state, features)
        slots = features.places(state.active.size)
        return replace(state, memory=state.memory.at[slots].set(1 / self.count, mode="drop"))

    def collapsed(self, state: State) -> State:
        """A pending ray with the mean and variance of its particles' inverse distance."""
        mean, variance = _moments(state.memory, 1 / self.depths(state.memory.dtype))
        return _with_inverse_depth(state, _pending(state), mean, variance)

    def initialised(self, state: State) -> Bool[Array, " landmarks"]:
        return state.active & ~_pending(state)

    def _evidence(self, slam, state, control, features):
        """Log likelihood and `rᵀ S⁻¹ r` of every particle; S is the ray's and the camera's."""

        def at(depth):
            landmarks = state.landmarks.at[:, -2].set(1 / depth)
            expected = slam.predict_features(
                replace(state, landmarks=landmarks), control, features.slots
            )
            return expected.measured, expected.covariance, expected.possible

        predicted, covariance, in_front = jax.vmap(at, out_axes=1)(self.depths(state.memory.dtype))
        residual = features.measured[:, None] - predicted
        likelihood, squared = jax.vmap(jax.vmap(log_density))(residual, covariance)
        return jnp.where(in_front, likelihood, -jnp.inf), jnp.where(in_front, squared, jnp.inf)

    def _agreed(self, state: State) -> State:
        """Give rays whose particles agree their depth; the next composition converts them.

        The depth enters as independent of the camera, as published, though it was found from the
        camera's motion: rays that finish together share an error that the filter does not know.
        """
        mean, variance = _moments(state.memory, self.depths(state.memory.dtype))
        # A particle stands for its cell of the range.
        variance += ((self.farthest - self.nearest) / (self.count - 1)) ** 2 / 12
        ready = _pending(state) & (variance < (self.agreement * mean) ** 2)
        return _with_inverse_depth(state, ready, 1 / mean, variance / mean**4)


def with_depth_particles(base: EkfSlam, farthest: int | None = None) -> EkfSlam:
    """The filter with depth particles up to `farthest`, m."""
    particles = DepthParticles() if farthest is None else DepthParticles(farthest=farthest)
    return with_entry(base, particles, RAY)


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
