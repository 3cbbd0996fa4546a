"""How a new landmark enters a filter: at once, or after a delay until its depth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters import ekf
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.landmarks import CARTESIAN
from jaxslam.landmarks.parametrization import Parametrization

if TYPE_CHECKING:
    from jaxslam.filters.slam import Parameters, SlamFilter


class Initialisation(Protocol):
    """What a method does with new landmarks and with those that it has not finished.

    A *landmark* has one number for everybody outside; inside, it may own several slots of the
    state. What a method remembers beside the Gaussian is `State.memory`.
    """

    def slots(self, landmarks: int) -> int:
        """How many slots of the state so many landmarks need."""
        ...

    def memory(self, landmarks: int, dtype: Any) -> Any:
        """The memory of an empty map."""
        ...

    def update(
        self,
        slam_filter: SlamFilter,
        state: State,
        parameters: Parameters,
        control: Array,
        features: Features,
    ) -> tuple[State, Innovation]:
        """Correct by the features of landmarks, finished or not."""
        ...

    def initialise(
        self, slam_filter: SlamFilter, state: State, parameters: Parameters, features: Features
    ) -> State:
        """Begin new landmarks, seen from the current camera."""
        ...

    def reported(self, state: State) -> State:
        """The state with one slot, and one Gaussian, a landmark."""
        ...

    def settled(self, state: State) -> Bool[Array, " landmarks"]:
        """Which landmarks are in the map as one Gaussian."""
        ...


@dataclass(frozen=True)
class Undelayed:
    """A landmark is a Gaussian from its first measurement on (P22–P26)."""

    def slots(self, landmarks: int) -> int:
        return landmarks

    def memory(self, landmarks: int, dtype: Any) -> Any:
        del landmarks, dtype
        return ()

    def update(self, slam_filter, state, parameters, control, features):
        return slam_filter.correct(state, parameters, control, features)

    def initialise(self, slam_filter, state, parameters, features):
        return slam_filter.insert(state, parameters, features)

    def reported(self, state: State) -> State:
        return state

    def settled(self, state: State) -> Bool[Array, " landmarks"]:
        return state.active


UNDELAYED = Undelayed()


def with_initialisation(
    slam_filter: SlamFilter, initialisation: Initialisation, landmark: Parametrization
) -> SlamFilter:
    """The filter with another initialisation, which writes a Cartesian point as `landmark`.

    Raises ValueError where the filter's landmarks are not Cartesian, or have no depth to find.
    """
    model = slam_filter.model
    if slam_filter.engine is not ekf:
        raise ValueError("a delayed initialisation is for filters in covariance form")
    if model.landmark is not CARTESIAN:
        raise ValueError(
            f"a delayed initialisation ends in cartesian landmarks, not {model.landmark.name}"
        )
    if model.rig.sensor.hidden != 1:
        raise ValueError(
            f"a delayed initialisation finds the depth that a camera hides; "
            f"the sensor {model.rig.sensor.name} hides none"
        )
    model = replace(model, landmark=landmark)
    return replace(slam_filter, model=model, initialisation=initialisation)


def check_range(nearest: float, farthest: float) -> None:
    """Raise ValueError unless both are depths, in order."""
    if not 0 < nearest < farthest:
        raise ValueError(
            f"depths need 0 < nearest < farthest, not nearest {nearest} and farthest {farthest}"
        )


def log_density(
    residual: Float[Array, " p"], covariance: Float[Array, "p p"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`log N(r; 0, S)` without its constant, and `rᵀ S⁻¹ r`.

    One coordinate after another, each given those before it: S is tiny and there are many.
    """
    zero = jnp.zeros((), residual.dtype)
    squared, log_determinant = zero, zero
    while residual.size:
        (first, *_), variance = residual, covariance[0, 0]
        squared += first**2 / variance
        log_determinant += jnp.log(variance)
        gain = covariance[1:, 0] / variance
        residual = residual[1:] - gain * first
        covariance = covariance[1:, 1:] - jnp.outer(gain, covariance[0, 1:])
    return -(squared + log_determinant) / 2, squared


def reweighted(
    weights: Float[Array, "m k"], log_likelihood: Float[Array, "m k"]
) -> Float[Array, "m k"]:
    """Bayes' rule on k alternatives; weights stay as they are where none has a likelihood."""
    best = jnp.max(jnp.where(weights > 0, log_likelihood, -jnp.inf), axis=1, keepdims=True)
    possible = jnp.isfinite(best)
    product = weights * jnp.exp(log_likelihood - jnp.where(possible, best, 0.0))
    total = jnp.sum(product, axis=1, keepdims=True)
    possible &= total > 0
    return jnp.where(possible, product / jnp.where(possible, total, 1.0), weights)
