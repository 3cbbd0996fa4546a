"""The steps of a filter as a function of whitened variables, with its derivatives.

A form for `EkfSlam` that keeps no distribution. All that is random in some frames is made of
independent standard normal numbers y: the state before them, the noise of every step, the pixel
and the inverse depth with which a landmark enters. The steps then are a deterministic function
x(y), of which this form keeps the value and `S = ∂x/∂y`; an update only compares,
`A = ∂h/∂y = H S`. With the whitened residuals r,

    −log p(y | z) = ½ |y|² + ½ Σ |r_k(y)|² + const.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.forms.blocks import (
    Change,
    Model,
    indices,
    local_jacobians,
    masked,
    new_landmarks,
    residuals,
    rows,
    small_products,
    without_auxiliary,
)
from jaxslam.forms.form import AbstractForm
from jaxslam.forms.state import Features
from jaxslam.geometry import difference, jacobian, retract, tangent_dim
from jaxslam.linalg import cholesky


class Distribution(eqx.Module):
    """A state `x0 ⊞ (m + L y)` with y ~ N(0, I)."""

    core: Any
    landmarks: Float[Array, "capacity d"]
    active: Bool[Array, " capacity"]
    offset: Float[Array, " n"]
    root: Float[Array, "n n"]
    """L; rows and columns of zeros where a slot is empty."""


class Point(eqx.Module):
    """The state at one y. Variables: n of the state before, then those of each frame's noise.

    A landmark that enters takes the first of the n that its slot has: they are free, since an
    empty slot has none.
    """

    core: Any
    landmarks: Float[Array, "capacity d"]
    active: Bool[Array, " capacity"]
    sensitivity: Float[Array, "n N"]
    """S."""
    variables: Float[Array, " N"]
    """y."""
    used: Int[Array, ""]
    """How many of the variables have been used: the next noise begins there."""
    memory: Any = ()

    @property
    def core_dim(self) -> int:
        return tangent_dim(self.core)


class Compared(NamedTuple):
    """A frame's measurements, whitened by R; zero where one is not used."""

    predicted: Float[Array, "m p"]
    """Not whitened."""
    residual: Float[Array, " mp"]
    """r = R^−½ (z − h)."""
    slope: Float[Array, "mp N"]
    """A = R^−½ ∂h/∂y."""
    used: Bool[Array, " m"]


class Sensitivity(AbstractForm):
    """The steps as a function of whitened variables."""

    happened: Bool[Array, ""]
    """Whether the frame is there: else nothing is random in it."""

    def augment(self, state: Point, start: int, covariance: Float[Array, "k k"]) -> Point:
        """The next k variables, scaled by the σ of a diagonal covariance."""
        k = covariance.shape[0]
        if k == 0:
            return state
        sigma = jnp.where(self.happened, jnp.sqrt(jnp.diagonal(covariance)), 0.0)
        drawn = sigma * jax.lax.dynamic_slice(state.variables, (state.used,), (k,))
        delta = jnp.zeros(state.core_dim, drawn.dtype).at[start : start + k].set(drawn)
        own = state.used + jnp.arange(k)
        return replace(
            state,
            core=retract(state.core, delta),
            sensitivity=state.sensitivity.at[start + jnp.arange(k), own].set(sigma),
            used=state.used + k,
        )

    def marginalise(self, state: Point, start: int, size: int) -> Point:
        """Forget k numbers of the core; the caller resets their value."""
        return replace(state, sensitivity=state.sensitivity.at[start : start + size].set(0.0))

    def know(self, state: Point, start: int, size: int) -> Point:
        """Nothing to do: what does not depend on the variables is known."""
        del start, size
        return state

    def update(
        self,
        model: Model,
        state: Point,
        features: Features,
        noise: Float[Array, "p p"],
        context: Any,
        considered: slice = slice(0, 0),
    ) -> tuple[Point, Compared]:
        """Compare with the features seen; the state stays as it is."""
        del considered
        predicted, residual, used, H = residuals(model, state, features, context)
        S, c = state.sensitivity, state.core_dim
        own = S[c:].reshape(*state.landmarks.shape, -1)[features.slots]
        A = H.by_view @ (H.view_by_core @ S[:c]) + H.by_landmark @ own
        whitening = cholesky(noise).whitening
        return state, Compared(
            predicted,
            (residual @ whitening.T).ravel(),
            (whitening.astype(A.dtype) @ A).reshape(residual.size, -1),
            used,
        )

    def change(self, state: Point, variables: Change) -> Point:
        """Write the state in other variables, `S ← J S`."""
        S, c = state.sensitivity, state.core_dim
        core, J_core = variables.core(state.core), jacobian(variables.core, state.core)
        above = J_core @ S[:c]
        if variables.landmark is None:
            return replace(state, core=core, sensitivity=jnp.concatenate([above, S[c:]]))
        moved, _, J = local_jacobians(
            variables.view, without_auxiliary(variables.landmark), state.core, state.landmarks
        )
        below = rows(masked(J, state.active), S)
        return replace(
            state,
            core=core,
            landmarks=jnp.where(state.active[:, None], moved, state.landmarks),
            sensitivity=jnp.concatenate([above, below]),
        )

    def initialise(
        self,
        model: Model,
        state: Point,
        features: Features,
        noise: Float[Array, "p p"],
        prior: tuple[Float[Array, "*m q"], Float[Array, "*m q"]],
        context: Any,
    ) -> Point:
        """Landmarks as the filter begins them, and off by what the variables of their slots say.

        The deviation is linear in them, with a σ that does not depend on the rest of the state.
        Were it differentiated by the scale of a gauge, the maximum of the posterior would be off
        by about N σ_λ² after N landmarks: the score of an amplitude has no mean of zero.
        """
        if features.slots.size == 0:
            return state
        new, J, root = new_landmarks(model, state, features, noise, prior, context)
        k = root.shape[-1]
        own = state.variables[indices(features.slots, state)[:, :k]]
        new = new + small_products(root, own[:, :, None])[:, :, 0]

        S, c, capacity = state.sensitivity, state.core_dim, state.active.size
        slots = jnp.where(features.valid, features.slots, capacity)  # out of bounds: dropped
        index = indices(slots, state)
        S = S.at[index].set(J.by_view @ (J.view_by_core @ S[:c]), mode="drop")
        S = S.at[index[:, :, None], index[:, None, :k]].add(root, mode="drop")
        return replace(
            state,
            landmarks=state.landmarks.at[slots].set(new, mode="drop"),
            active=state.active.at[slots].set(True, mode="drop"),
            sensitivity=S,
        )

    def core_covariance(self, function: Callable[[Any], Any], state: Point) -> tuple[Any, Array]:
        """Value of a function of the core, and the covariance that y ~ N(0, I) gives it."""
        root = jacobian(function, state.core) @ state.sensitivity[: state.core_dim]
        return function(state.core), root @ root.T


def begin(before: Distribution, variables: Float[Array, " N"]) -> Point:
    """The state before the frames."""
    n, c = before.offset.size, tangent_dim(before.core)
    delta = before.offset + before.root @ variables[:n]
    core = retract(before.core, delta[:c])

    def moved(further):
        return difference(retract(before.core, delta[:c] + further), core)

    J = jax.jacfwd(moved)(jnp.zeros(c, delta.dtype))
    root = before.root.at[:c].set(J @ before.root[:c])
    landmarks = before.landmarks + delta[c:].reshape(before.landmarks.shape)
    sensitivity = jnp.pad(root, ((0, 0), (0, variables.size - n)))
    return Point(core, landmarks, before.active, sensitivity, variables, jnp.asarray(n))
