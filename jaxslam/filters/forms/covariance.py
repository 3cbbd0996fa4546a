"""The extended Kalman filter on a core and many landmarks, its Jacobians assembled from blocks.

The steps are the paper's: `augment` (P10, P11, P15), `update` (P16, P17), `compose` (P18–P21),
`initialise` (P22–P26), and `remove`. The models and their blocks are those of
`jaxslam.filters.forms.blocks`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.forms.blocks import (
    Blocks,
    Landmark,
    Model,
    NewLandmarks,
    Noise,
    changed_landmarks,
    indices,
    local_jacobians,
    observe,
    product,
    without_auxiliary,
)
from jaxslam.filters.forms.correction import AbstractCorrection, Standard
from jaxslam.filters.forms.form import AbstractForm, OfCore
from jaxslam.filters.forms.state import State
from jaxslam.filters.protocol import EachMoments, Moments
from jaxslam.geometry import jacobian, nudge
from jaxslam.models.observations import Slots


class Covariance(AbstractForm):
    """Mean and covariance: the extended Kalman filter."""

    correction: AbstractCorrection = Standard()

    @property
    def plain(self) -> bool:
        """Whether an update is that of the extended Kalman filter, and nothing else."""
        return isinstance(self.correction, Standard) and self.correction.steps == 1

    @property
    def divisible(self) -> bool:
        return self.correction.divisible

    def check(self, slam: Any) -> None:
        """Raise ValueError for a filter that cannot be corrected so."""
        self.correction.check(slam)

    def empty(self, core: PyTree, landmarks: Float[Array, "capacity d"]) -> State:
        """A state that is exactly known, of slots that hold no landmark yet."""
        capacity = landmarks.shape[0]
        state = State(
            core, landmarks, jnp.zeros(capacity, bool), jnp.zeros((0, 0), landmarks.dtype)
        )
        n = state.core_dim + landmarks.size
        state = replace(state, covariance=jnp.zeros((n, n), landmarks.dtype))
        return self.correction.remember(state, jnp.arange(capacity))

    def augment(self, state: State, start: int, covariance: Float[Array, "k k"]) -> State:
        if covariance.size == 0:
            return state
        part = slice(start, start + covariance.shape[0])
        return replace(state, covariance=state.covariance.at[part, part].set(covariance))

    def marginalise(self, state: State, start: int, size: int) -> State:
        if size == 0:
            return state
        part = slice(start, start + size)
        covariance = state.covariance.at[part, :].set(0.0).at[:, part].set(0.0)
        return replace(state, covariance=covariance)

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        return self.correction.update(model, state, features, noise, context, considered)

    def transformed(self, state: State, J_core: Float[Array, "c c"], J: Blocks | None) -> State:
        """`P ← J P Jᵀ`."""
        half = product(J_core, J, state.covariance)
        return replace(state, covariance=product(J_core, J, half.T))

    def with_new(self, state: State, new: NewLandmarks) -> State:
        """`P ← J diag(P, R, σ²) Jᵀ` (P22–P26)."""
        c, index = state.core_dim, indices(new.slots, state)
        own = new.root @ jnp.swapaxes(new.root, 1, 2)

        def with_rows(P):
            rows = new.J.by_view @ (new.J.view_by_core @ P[:c])
            return P.at[index.ravel()].set(rows.reshape(index.size, -1), mode="drop")

        covariance = with_rows(with_rows(state.covariance).T)
        covariance = covariance.at[index[:, :, None], index[:, None, :]].add(own, mode="drop")
        return self.correction.remember(replace(state, covariance=covariance), new.slots)

    def remove(self, state: State, gone: Bool[AnyArray, " capacity"]) -> State:
        """Marginalise landmarks and free their slots."""
        kept = state.numbers(~gone)
        covariance = jnp.where(kept[:, None] & kept[None, :], state.covariance, 0.0)
        return replace(state, active=state.active & ~gone, covariance=covariance)

    def local_covariance(self, state: State, J: Blocks, slots: Slots) -> Float[Array, "m k k"]:
        """`J P Jᵀ` of every landmark's own rows: the diagonal blocks only."""
        c, (capacity, d) = state.core_dim, state.landmarks.shape
        P = state.covariance
        P_view = J.view_by_core @ P[:c, :c] @ J.view_by_core.T
        P_cross = (P[c:, :c] @ J.view_by_core.T).reshape(capacity, d, -1)[slots]
        P_landmark = P[c:, c:].reshape(capacity, d, capacity, d)[slots, :, slots, :]

        def one(by_view, by_landmark, P_cross, P_landmark):
            cross = by_landmark @ P_cross @ by_view.T
            own = by_landmark @ P_landmark @ by_landmark.T
            return by_view @ P_view @ by_view.T + cross + cross.T + own

        return jax.vmap(one)(J.by_view, J.by_landmark, P_cross, P_landmark)

    def core_covariance(self, function: OfCore, state: State) -> Moments:
        c = state.core_dim
        J = jacobian(function, state.core)
        return function(state.core), J @ state.covariance[:c, :c] @ J.T

    def predict_features(
        self, model: Model, state: State, slots: Slots, noise: Noise, context: PyTree
    ) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]:
        """The predicted features: measurements, covariances of their innovations, possible
        or not. These are the centres and the search ellipses of active search."""
        predicted, in_front, H = observe(model, state, slots, context)
        return predicted, self.local_covariance(state, H, slots) + noise, in_front

    def landmark_covariance(
        self, view: Callable[[PyTree], PyTree], function: Landmark, state: State, slots: Slots
    ) -> EachMoments:
        """Values and first-order covariances of `function(view(core), landmark)`, slot by slot."""
        value, _, J = local_jacobians(
            view, without_auxiliary(function), state.core, state.landmarks[slots]
        )
        return value, self.local_covariance(state, J, slots)

    def convert(self, model: Model, state: State, context: PyTree) -> State:
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

    def joint_covariance(self, state: State, slot: Int[Array, ""]) -> Float[Array, "k k"]:
        """The joint covariance of the core and one landmark, k = c + d numbers."""
        c, d = state.core_dim, state.landmarks.shape[1]
        index = jnp.concatenate([jnp.arange(c), c + slot * d + jnp.arange(d)])
        return state.covariance[index[:, None], index]


def curvature(
    form: Covariance, model: Model, state: State, slots: Slots, context: PyTree
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
