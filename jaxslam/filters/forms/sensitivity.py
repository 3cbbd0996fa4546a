"""The steps of a filter as a function of whitened variables, with its derivatives.

A form for `EkfSlam` that keeps no distribution. All that is random in some frames is made of
independent standard normal numbers y: the state before them, the noise of every step, the pixel
and the inverse depth with which a landmark enters. The steps then are a deterministic function
x(y), of which this form keeps the value and what `S = ∂x/∂y` follows from; an update only
compares, `A = ∂h/∂y = H S`. With the whitened residuals r,

    −log p(y | z) = ½ |y|² + ½ Σ |r_k(y)|² + const.

No step lets a landmark depend on another: by the errors before the frames, of the core and of the
landmark itself, and by the noise, the derivatives are sparse and cheap to carry along. The root of
the covariance before, which is dense, makes S and A of them where they are asked for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.filters.forms.blocks import (
    Blocks,
    NewLandmarks,
    indices,
    product,
    residuals,
    shifted,
    small_products,
)
from jaxslam.filters.forms.form import AbstractForm, OfCore
from jaxslam.filters.forms.state import AbstractState
from jaxslam.filters.protocol import Moments
from jaxslam.geometry import difference, jacobian, retract
from jaxslam.linalg import cholesky
from jaxslam.models.observations import Slots


class Distribution(AbstractState):
    """A state `x0 ⊞ (m + L y)` with y ~ N(0, I)."""

    offset: Float[Array, " n"]
    root: Float[Array, "n n"]
    """L; rows and columns of zeros where a slot is empty."""

    def by_variables(self, by_shared: Float[Array, "k r"]) -> Float[Array, "k N"]:
        """Derivatives by y, from those by the error of the core before and by the noise."""
        c = self.core_dim
        return jnp.concatenate([by_shared[:, :c] @ self.root[:c], by_shared[:, c:]], axis=1)


class Derivative(NamedTuple):
    """The derivative of k numbers for each of m landmarks, in blocks as sparse as they are."""

    by_shared: Float[Array, "m k r"]
    """By the error of the core before the frames, and by their noise."""
    by_own: Float[Array, "m k d"]
    """By the landmark's own error before, or by the variables with which it entered."""
    slots: Slots

    def by_variables(self, before: Distribution) -> Float[Array, "mk N"]:
        """The derivative by y."""
        (m, k, d), capacity, c = self.by_own.shape, before.active.size, before.core_dim
        here = self.slots[:, None] == jnp.arange(capacity)
        own = jnp.where(here[:, None, :, None], self.by_own[:, :, None], 0.0)
        shared = self.by_shared.reshape(m * k, -1)
        first = jnp.concatenate([shared[:, :c], own.reshape(m * k, -1)], axis=1)
        # The variables of a slot that is empty are those of what enters.
        free = jnp.concatenate([jnp.zeros(c, bool), jnp.repeat(~before.active, d)])
        root = before.root + jnp.diag(free.astype(before.root.dtype))
        return jnp.concatenate([first @ root, shared[:, c:]], axis=1)


class Point(AbstractState):
    """The state at one y. Variables: n of the state before, then those of each frame's noise.

    A landmark that enters takes the first of the n that its slot has: they are free, since an
    empty slot has none.
    """

    by_shared: Float[Array, "n r"]
    """∂x by the error of the core before, and by the frames' noise."""
    by_own: Float[Array, "capacity d d"]
    """∂x of every landmark by its own error before, or by the variables with which it entered."""
    variables: Float[Array, " N"]
    """y."""
    used: Int[Array, ""]
    """How many of the variables have been used: the next noise begins there."""
    memory: PyTree = ()

    def sensitivity(self, before: Distribution) -> Float[Array, "n N"]:
        """S, where the frames began with this distribution."""
        c, (capacity, d) = self.core_dim, self.landmarks.shape
        shared = self.by_shared[c:].reshape(capacity, d, -1)
        landmarks = Derivative(shared, self.by_own, jnp.arange(capacity))
        core = before.by_variables(self.by_shared[:c])
        return jnp.concatenate([core, landmarks.by_variables(before)])


class WhitenedResiduals(NamedTuple):
    """A frame's measurements, whitened by R; zero where one is not used."""

    predicted: Float[Array, "m p"]
    """Not whitened."""
    residual: Float[Array, " mp"]
    """r = R^−½ (z − h)."""
    slope: Derivative
    """R^−½ ∂h, of which A = R^−½ ∂h/∂y is made."""
    used: Bool[Array, " m"]


class Sensitivity(AbstractForm):
    """The steps as a function of whitened variables."""

    before: Distribution
    """With which the frames began."""
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
        noise = state.core_dim + state.used - self.before.offset.size + jnp.arange(k)
        return replace(
            state,
            core=retract(state.core, delta),
            by_shared=state.by_shared.at[start + jnp.arange(k), noise].set(sigma),
            used=state.used + k,
        )

    def marginalise(self, state: Point, start: int, size: int) -> Point:
        """Forget k numbers of the core; the caller resets their value."""
        return replace(state, by_shared=state.by_shared.at[start : start + size].set(0.0))

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        """Compare with the features seen; the state stays as it is."""
        del considered
        predicted, residual, used, H = residuals(model, state, features, context)
        D, c, slots = state.by_shared, state.core_dim, features.slots
        landmarks = D[c:].reshape(*state.landmarks.shape, -1)
        shared = H.by_view @ (H.view_by_core @ D[:c])
        shared += small_products(H.by_landmark, landmarks[slots])
        own = small_products(H.by_landmark, state.by_own[slots])
        whitening = cholesky(noise).whitening.astype(shared.dtype)
        return state, WhitenedResiduals(
            predicted,
            (residual @ whitening.T).ravel(),
            Derivative(whitening @ shared, whitening @ own, slots),
            used,
        )

    def transformed(self, state: Point, J_core: Float[Array, "c c"], J: Blocks | None) -> Point:
        """`S ← J S`."""
        by_own = state.by_own if J is None else small_products(J.by_landmark, state.by_own)
        return replace(state, by_shared=product(J_core, J, state.by_shared), by_own=by_own)

    def with_new(self, state: Point, new: NewLandmarks) -> Point:
        """Landmarks as the filter begins them, and off by what the variables of their slots say.

        The deviation is linear in them, with a σ that does not depend on the rest of the state.
        Were it differentiated by the scale of a gauge, the maximum of the posterior would be off
        by about N σ_λ² after N landmarks: the score of an amplitude has no mean of zero.
        """
        slots, J, (_, d, k) = new.slots, new.J, new.root.shape
        index = indices(slots, state)
        own = state.variables[index[:, :k]]
        away = small_products(new.root, own[:, :, None])[:, :, 0]
        shared = J.by_view @ (J.view_by_core @ state.by_shared[: state.core_dim])
        free = jnp.pad(new.root, ((0, 0), (0, 0), (0, d - k)))
        return replace(
            state,
            landmarks=state.landmarks.at[slots].add(away, mode="drop"),
            by_shared=state.by_shared.at[index].set(shared, mode="drop"),
            by_own=state.by_own.at[slots].set(free, mode="drop"),
        )

    def core_covariance(self, function: OfCore, state: Point) -> Moments:
        """Value of a function of the core, and the covariance that y ~ N(0, I) gives it."""
        core = self.before.by_variables(state.by_shared[: state.core_dim])
        root = jacobian(function, state.core) @ core
        return function(state.core), root @ root.T


def begin(before: Distribution, variables: Float[Array, " N"]) -> Point:
    """The state before the frames."""
    n, c, d = before.offset.size, before.core_dim, before.landmarks.shape[1]
    delta = before.offset + before.root @ variables[:n]
    start = shifted(before, delta)

    def moved(further):
        return difference(retract(before.core, delta[:c] + further), start.core)

    J = jax.jacfwd(moved)(jnp.zeros(c, delta.dtype))
    by_shared = jnp.pad(J, ((0, n - c), (0, variables.size - n)))
    by_own = jnp.where(before.active[:, None, None], jnp.eye(d, dtype=delta.dtype), 0.0)
    own = by_shared, by_own, variables, jnp.asarray(n)
    return Point(start.core, start.landmarks, before.active, *own)
