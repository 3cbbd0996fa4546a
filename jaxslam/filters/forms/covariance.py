"""The extended Kalman filter on a core and many landmarks, its Jacobians assembled from blocks.

The steps are the paper's: `augment` (P10, P11, P15), `update` (P16, P17), `compose` (P18–P21),
`initialise` (P22–P26), and `remove`. The models and their blocks are those of
`jaxslam.filters.forms.blocks`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.forms.blocks import Blocks, NewLandmarks, indices, product
from jaxslam.filters.forms.correction import AbstractCorrection, Standard
from jaxslam.filters.forms.form import AbstractGaussian, OfCore
from jaxslam.filters.forms.state import State
from jaxslam.filters.protocol import Moments
from jaxslam.geometry import jacobian


class Covariance(AbstractGaussian):
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
        kept = state.numbers(~gone)
        covariance = jnp.where(kept[:, None] & kept[None, :], state.covariance, 0.0)
        return replace(state, active=state.active & ~gone, covariance=covariance)

    def local_covariance(self, state: State, J: Blocks, slots) -> Float[Array, "m k k"]:
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
