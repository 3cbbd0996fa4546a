"""The form of a filter: how its uncertainty is kept, and what every step does to it.

`Covariance` keeps P, `Information` its inverse, `Sensitivity` no distribution but derivatives, each
in an `AbstractState` of its own. A remedy is a correction of `Covariance` (`correction.py`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.forms.blocks import (
    Blocks,
    Change,
    Landmark,
    Model,
    NewLandmarks,
    Noise,
    Prior,
    changed_landmarks,
    composition,
    local_jacobians,
    new_landmarks,
    observe,
    without_auxiliary,
)
from jaxslam.filters.protocol import Belief, EachMoments, Moments
from jaxslam.geometry import jacobian, nudge
from jaxslam.models.observations import Features, Slots

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

    def set_exact(self, state: Belief, start: int, size: int) -> Belief:
        """Numbers of the core that are known exactly: nothing to do where nothing was unknown."""
        del start, size
        return state

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


class AbstractGaussian(AbstractForm):
    """A form that keeps a Gaussian: what it says can be asked at any time."""

    innovation_covariance: ClassVar[bool] = True
    """Whether its innovations have S: a likelihood is of no use without."""

    @abstractmethod
    def empty(self, core: PyTree, landmarks: Float[Array, "capacity d"]) -> Belief:
        """A state of slots that hold no landmark yet, and a core that is still to be augmented."""

    @abstractmethod
    def remove(self, state: Belief, gone: Bool[AnyArray, " capacity"]) -> Belief:
        """Marginalise landmarks and free their slots."""

    @abstractmethod
    def local_covariance(self, state: Belief, J: Blocks, slots: Slots) -> Float[Array, "m k k"]:
        """`J P Jᵀ` of every landmark's own rows: the diagonal blocks only."""

    def predict_features(
        self, model: Model, state: Belief, slots: Slots, noise: Noise, context: PyTree
    ) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]:
        """The predicted features: measurements, covariances of their innovations, possible
        or not. These are the centres and the search ellipses of active search."""
        predicted, in_front, H = observe(model, state, slots, context)
        return predicted, self.local_covariance(state, H, slots) + noise, in_front

    def landmark_covariance(
        self, view: Callable[[PyTree], PyTree], function: Landmark, state: Belief, slots: Slots
    ) -> EachMoments:
        """Values and first-order covariances of `function(view(core), landmark)`, slot by slot."""
        value, _, J = local_jacobians(
            view, without_auxiliary(function), state.core, state.landmarks[slots]
        )
        return value, self.local_covariance(state, J, slots)

    def convert(self, model: Model, state: Belief, context: PyTree) -> Belief:
        """Write landmarks in the form that the model now prefers."""
        c, (capacity, d) = state.core_dim, state.landmarks.shape
        blocks = state.covariance[c:, c:].reshape(capacity, d, capacity, d)
        own = blocks[jnp.arange(capacity), :, jnp.arange(capacity), :]

        def converted(view, landmark, covariance):
            return model.convert(view, landmark, covariance, context), None

        def view(core):
            return model.view(core, context)

        landmarks, J = changed_landmarks(state, view, converted, own)
        state = self.transformed(state, jnp.eye(c, dtype=state.landmarks.dtype), J)
        return replace(state, landmarks=landmarks)

    def joint_covariance(self, state: Belief, slot: Int[Array, ""]) -> Float[Array, "k k"]:
        """The joint covariance of the core and one landmark, k = c + d numbers."""
        c, d = state.core_dim, state.landmarks.shape[1]
        index = jnp.concatenate([jnp.arange(c), c + slot * d + jnp.arange(d)])
        return state.covariance[index[:, None], index]


def curvature(
    form: AbstractGaussian, model: Model, state: Belief, slots: Slots, context: PyTree
) -> tuple[Float[Array, "m p k k"], Float[Array, "m k k"]]:
    """Second derivatives of every landmark's measurement by what it depends on, the view and the
    landmark's own numbers, and the covariance of these."""
    view = model.view(state.core, context)
    view_by_core = jacobian(lambda core: model.view(core, context), state.core)
    v, d, m = len(view_by_core), state.landmarks.shape[1], slots.size

    def measured(delta, landmark):
        return model.observe(nudge(view, delta[:v]), landmark + delta[v:], context)[0]

    zero = jnp.zeros(v + d, state.landmarks.dtype)
    hessian = jax.vmap(lambda landmark: jax.jacfwd(jax.jacfwd(measured))(zero, landmark))
    eye = jnp.broadcast_to(jnp.eye(v + d, dtype=zero.dtype), (m, v + d, v + d))
    itself = Blocks(view_by_core, eye[:, :, :v], eye[:, :, v:])
    return hessian(state.landmarks[slots]), form.local_covariance(state, itself, slots)
