"""The form of a filter: how its uncertainty is kept, and what every step does to it.

`Covariance` keeps a Gaussian, `Sensitivity` no distribution but derivatives, each in an
`AbstractState` of its own. A remedy is a correction of `Covariance` (`correction.py`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from jaxslam.filters.forms.blocks import (
    Blocks,
    Change,
    Model,
    NewLandmarks,
    Noise,
    Prior,
    changed_landmarks,
    composition,
    new_landmarks,
    without_auxiliary,
)
from jaxslam.filters.protocol import Belief, Moments
from jaxslam.geometry import jacobian
from jaxslam.models.observations import Features

OfCore = Callable[[PyTree], PyTree]
"""A function of the core, which is a pytree of poses and vectors, as is its value."""


class AbstractForm(eqx.Module):
    """The steps of a frame, on a state of its own."""

    @property
    def plain(self) -> bool:
        """Whether it is the extended Kalman filter in covariance form, as it is."""
        return False

    @property
    def divisible(self) -> bool:
        """Whether its state is a mean and a covariance of `x ⊞ δ`, to be divided and merged."""
        return False

    def check(self, slam: Any) -> None:
        """Raise ValueError for a filter of which this cannot be the form; any can be, here."""

    @abstractmethod
    def augment(self, state: Belief, start: int, covariance: Float[Array, "k k"]) -> Belief:
        """Give k numbers of the core, from `start`, an independent covariance (P10, P11, P15).

        Nothing may be known of them, as `marginalise` and `compose` leave them.
        """

    @abstractmethod
    def marginalise(self, state: Belief, start: int, size: int) -> Belief:
        """Forget k numbers of the core; the caller resets their mean."""

    @abstractmethod
    def update(
        self,
        model: Model,
        state: Belief,
        features: Features,
        noise: Noise,
        context: PyTree,
        considered: slice = slice(0, 0),
    ) -> tuple[Belief, PyTree]:
        """Correct by all features at once (P16, P17), and what was compared.

        `noise` is the covariance R of one measurement, or one for each feature. A feature that is
        not valid, not in the map or predicted behind the camera changes nothing. The `considered`
        numbers of the core count with their covariance but have no gain (Schmidt, 1966).
        """

    def compose(self, model: Model, state: Belief, context: PyTree) -> Belief:
        """Move the state over the motion (P18–P21)."""
        return self.reparametrise(state, composition(model, context))

    def reparametrise(self, state: Belief, variables: Change) -> Belief:
        """Write the state in other variables."""
        core, J_core = variables.core(state.core), jacobian(variables.core, state.core)
        if variables.landmark is None:
            return replace(self.transformed(state, J_core, None), core=core)
        landmarks, J = changed_landmarks(
            state, variables.view, without_auxiliary(variables.landmark)
        )
        return replace(self.transformed(state, J_core, J), core=core, landmarks=landmarks)

    @abstractmethod
    def transformed(self, state: Belief, J_core: Float[Array, "c c"], J: Blocks | None) -> Belief:
        """The uncertainty after a change of variables with these Jacobians, which are zero in empty
        slots; of the core alone where J is None."""

    def initialise(
        self,
        model: Model,
        state: Belief,
        features: Features,
        noise: Noise,
        prior: Prior,
        context: PyTree,
    ) -> Belief:
        """Insert landmarks from their first measurement (P22–P26).

        `prior` is the mean and σ of what one measurement hides, for all or one for each. All new
        landmarks share one core, so what is uncertain there (the pose of a world-centric filter,
        the calibration) correlates them with it and with one another. Whatever was in their slots
        must have been removed.
        """
        if features.slots.size == 0:
            return state
        new = new_landmarks(model, state, features, noise, prior, context)
        landmarks = state.landmarks.at[new.slots].set(new.values, mode="drop")
        active = state.active.at[new.slots].set(True, mode="drop")
        return self.with_new(replace(state, landmarks=landmarks, active=active), new)

    @abstractmethod
    def with_new(self, state: Belief, new: NewLandmarks) -> Belief:
        """The uncertainty of landmarks that were just written into their slots."""

    @abstractmethod
    def core_covariance(self, function: OfCore, state: Belief) -> Moments:
        """Value of a function of the core, and its first-order covariance in its tangent."""
