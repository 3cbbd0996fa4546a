"""The size of the process noise, found while the filter runs.

The accelerations of a hand are unknown. σ of the linear ones and of the angular ones are
each the one that was given times a factor of a grid; every factor has a weight. What a frame's
measurements say of one frame's acceleration is next to nothing, and of the velocity much: so every
factor has a Kalman filter of the velocity alone, as small as that, which is fed with what each
update of the whole filter has learned of it,

    Λ = V⁺⁻¹ − V⁻⁻¹,  η = V⁺⁻¹ v⁺ − V⁻⁻¹ v⁻,

and is weighed by how well it had foreseen that (multiple models: Magill 1965). The filter goes on
with the root of the weighted mean of σ². What is long ago fades from the weights.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import precision
from jaxslam._numerics.linalg import cholesky, eigh
from jaxslam.filters.ekf import EkfSlam, ekf_inside
from jaxslam.filters.protocol import AbstractStaged, Belief, Corrected
from jaxslam.filters.wrappers.wrapper import AbstractWrapper, with_motion
from jaxslam.geometry import jacobian
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Capacity, Features

MEMORY = 100
"""Frames after which what they said of the noise has faded to 1/e."""
FACTORS = 2.0 ** np.arange(-4, 5)
"""The factors of σ; so far may it be from what was given."""
TOLD = np.log(3.0)
"""σ of the log of what was given."""


class NoiseState(eqx.Module):
    """The filter's own state, and what is believed of its noise."""

    inner: Belief
    log_weights: Float[Array, "2 factors"]
    """Of the factors of the linear and of the angular σ."""
    velocity: Float[Array, "factors t"]
    covariance: Float[Array, "factors t t"]
    """Of the velocity, if the noise is so many times as large."""
    before: tuple[Float[Array, " t"], Float[Array, "t t"]]
    """What the filter had predicted of the velocity."""


class AdaptiveProcessNoise(AbstractWrapper):
    """`base` with a process noise whose two sizes are estimated."""

    base: AbstractStaged
    memory: int = eqx.field(static=True, default=MEMORY)

    def __check_init__(self) -> None:
        motion = self._inner.motion
        if not motion.has_velocity:
            raise ValueError(
                f"the noise fitted is of a velocity, which {type(motion).__name__} lacks"
            )
        if self.memory < 1:
            raise ValueError(f"noise is remembered for 1 frame at least, not {self.memory}")

    def base_state(self, state: NoiseState) -> Belief:
        return state.inner

    def with_base_state(self, state: NoiseState, inner: Belief) -> NoiseState:
        return replace(state, inner=inner)

    def init(self, capacity: int | Capacity, first: Features | None = None) -> NoiseState:
        inner = self.base.init(capacity, first)
        velocity, covariance = self._velocity(inner)
        log_weights = jnp.tile(_prior(precision(self._inner)), (2, 1))
        every = jax.tree.map(
            lambda x: jnp.tile(x, (FACTORS.size, *(1,) * x.ndim)), (velocity, covariance)
        )
        return NoiseState(inner, log_weights, *every, (velocity, covariance))

    def predict(self, state: NoiseState, control: Control) -> NoiseState:
        """Predict the base filter, and every factor's velocity too."""
        state = self._begun_anew(state)
        factors = self._factors(state)
        foreseen = jax.vmap(partial(_foreseen, self._inner.motion, control))
        before = _foreseen(self._inner.motion, control, factors, *self._velocity(state.inner))
        return NoiseState(
            self.fitted(state).predict(state.inner, control),
            state.log_weights,
            *foreseen(jnp.asarray(FACTORS, factors.dtype), state.velocity, state.covariance),
            before,
        )

    def update(self, state: NoiseState, control: Control, seen: Features) -> Corrected:
        inner, innovation = self.fitted(state).update(state.inner, control, seen)
        return replace(state, inner=inner), innovation

    def compose(self, state: NoiseState, control: Control) -> NoiseState:
        """Compose, and learn from what the velocity has become."""
        state = replace(state, inner=self.fitted(state).compose(state.inner, control))
        return self._learned(state)

    def close(self, state: NoiseState, new: Features) -> NoiseState:
        return replace(state, inner=self.fitted(state).close(state.inner, new))

    def fitted(self, state: NoiseState) -> AbstractStaged:
        """The base filter with the σ that is believed now."""
        motion = self._inner.motion
        sigma = self._factors(state) * jnp.asarray(motion.noise_sigma)
        return with_motion(self.base, replace(motion, noise_sigma=sigma, noise_told=False))

    @property
    def _inner(self) -> EkfSlam:
        return ekf_inside(self.base, "noise is fitted")

    @property
    def _groups(self) -> tuple[slice, slice]:
        """Linear and angular numbers of a velocity."""
        geometry = self._inner.motion.geometry
        return slice(0, geometry.point_dim), slice(geometry.point_dim, geometry.tangent_dim)

    def _velocity(self, inner: Belief) -> tuple[Float[Array, " t"], Float[Array, "t t"]]:
        return self.base.marginal(inner, lambda view: view.core.motion)

    def _factors(self, state: NoiseState) -> Float[Array, " t"]:
        """The factors of σ: the roots of the mean variances."""
        linear, angular = jnp.sqrt(jnp.exp(state.log_weights) @ jnp.asarray(FACTORS**2))
        (_, n), (_, t) = ((part.start, part.stop) for part in self._groups)
        return jnp.where(jnp.arange(t) < n, linear, angular)

    def _begun_anew(self, state: NoiseState) -> NoiseState:
        """The state with the velocity given at first, if the camera has not moved."""
        velocity, root = self._inner.motion.start()
        moving = self.moving(state)
        return replace(
            state,
            velocity=jnp.where(moving, state.velocity, velocity),
            covariance=jnp.where(moving, state.covariance, root @ root.T),
        )

    def _learned(self, state: NoiseState) -> NoiseState:
        fading = 1 - 1 / self.memory
        after, told_first = self._velocity(state.inner), _prior(state.log_weights.dtype)

        def of(part, log_weights):
            told = _told(*((v[part], V[part, part]) for v, V in (state.before, after)))
            heard = jax.vmap(partial(_heard, told))
            evidence, v, V = heard(state.velocity[:, part], state.covariance[:, part, part])
            learned = self.moving(state) & jnp.all(jnp.isfinite(evidence))
            evidence = jnp.where(learned, evidence, 0.0)
            faded = fading * log_weights + (1 - fading) * told_first
            return jax.nn.log_softmax(faded + evidence), v, V

        both = [of(*data) for data in zip(self._groups, state.log_weights, strict=True)]
        weights, velocities, covariances = zip(*both, strict=True)
        return replace(
            state,
            log_weights=jnp.stack(weights),
            velocity=jnp.concatenate(velocities, axis=1),
            covariance=jax.vmap(jax.scipy.linalg.block_diag)(*covariances),
        )


def _foreseen(motion: AbstractMotion, control: Control, factors, velocity, covariance):
    """Mean and covariance one step on, with so many times the noise that was given."""
    zero = jnp.zeros_like(velocity)
    slope = jacobian(lambda noise: motion.next(velocity, noise, control), zero)
    root = slope * factors * motion.noise_sigma
    return motion.next(velocity, zero, control), covariance + root @ root.T


def _prior(dtype: DTypeLike) -> Float[Array, " factors"]:
    return jax.nn.log_softmax(jnp.asarray(-((np.log(FACTORS) / TOLD) ** 2) / 2, dtype))


class Told(NamedTuple):
    """The likelihood of the velocity in an update: `exp(ηᵀ v − ½ vᵀ Λ v)`, v from a place."""

    place: Float[Array, " d"]
    vector: Float[Array, " d"]
    information: Float[Array, "d d"]


def _told(before, after) -> Told:
    """The information that an update gained; zero in directions in which it gained none."""
    (v, V), (now, P) = before, after
    W = cholesky(V).whitening
    shares, vectors = eigh(W @ P @ W.T)
    axes = W.T @ vectors  # V⁻¹ = axes axesᵀ, P⁻¹ = axes diag(1/shares) axesᵀ
    gained = 1 / jnp.clip(shares, 1e-9, 1.0) - 1
    along = jnp.where(gained > 1e-9, axes.T @ (now - v), 0.0)
    return Told(now, axes @ along, (axes * gained) @ axes.T)


def _heard(told: Told, v: Float[Array, " d"], V: Float[Array, "d d"]):
    """The log likelihood of what an update learned, and the velocity after it."""
    d, prior = v - told.place, cholesky(V)
    information = prior.inverse()
    after = cholesky(information + told.information)
    vector = information @ d + told.vector
    mean = after.solve(vector)
    squares = vector @ mean - d @ information @ d
    return (squares - prior.log_det() - after.log_det()) / 2, told.place + mean, after.inverse()
