"""The extended Kalman filter on a core and many landmarks, its Jacobians assembled from blocks.

Every model is a function of the core and ONE landmark, so that `jax.jacfwd` only ever sees
c + d inputs; the blocks are put into place by slices, gathers and scatters. Nothing here knows
what a pose, a camera or a parametrization is: a `Model` supplies the functions, and the core is
any pytree of poses and vectors.

The steps are the paper's: `augment` (P10, P11, P15), `update` (P16, P17), `compose` (P18–P21),
`initialise` (P22–P26), and `remove`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import difference, retract, tangent_dim


Blocks = tuple[Float[Array, "m k c"], Float[Array, "m k d"]]
"""Jacobians of one quantity of k numbers for m landmarks, by the core and by the landmark."""


class Model(Protocol):
    """Pure functions on the core and one landmark; `context` is whatever data they need."""

    @property
    def moves_landmarks(self) -> bool:
        """Whether composition changes landmarks (robocentric) or leaves them (world)."""
        ...

    def compose_core(self, core: Any, context: Any) -> Any:
        """The core after the motion."""
        ...

    def compose_landmark(self, core: Any, landmark: Array, context: Any) -> Array:
        """One landmark after the motion, given the core before it; where `moves_landmarks`."""
        ...

    def observe(self, core: Any, landmark: Array, context: Any) -> tuple[Array, Array]:
        """The predicted measurement, and whether one is possible (in front of the camera)."""
        ...

    def initialise(self, core: Any, pixel: Array, inverse_depth: Array, context: Any) -> Array:
        """A landmark from its first measurement and its prior."""
        ...


def augment(state: State, start: int, covariance: Float[Array, "k k"]) -> State:
    """Give k numbers of the core, from `start`, an independent covariance (P10, P11, P15).

    Their rows and columns must be zero, as `marginalise` and `compose` leave them.
    """
    part = slice(start, start + covariance.shape[0])
    return replace(state, covariance=state.covariance.at[part, part].set(covariance))


def marginalise(state: State, start: int, size: int) -> State:
    """Forget k numbers of the core: zero rows and columns; the caller resets their mean."""
    part = slice(start, start + size)
    covariance = state.covariance.at[part, :].set(0.0).at[:, part].set(0.0)
    return replace(state, covariance=covariance)


def update(
    model: Model, state: State, features: Features, noise: Float[Array, "p p"], context: Any
) -> tuple[State, Innovation]:
    """The Kalman update by all features at once (P16, P17), in Joseph form.

    `noise` is the covariance R of one measurement. A feature that is not valid, not in the map
    or predicted behind the camera changes nothing.
    """
    predicted, in_front, H = _observe(model, state, features.slots, context)
    used = features.valid & in_front & state.active[features.slots]
    H = _masked(H, used)
    residual = jnp.where(used[:, None], features.pixels - predicted, 0.0)

    P, slots = state.covariance, features.slots
    R = _noise_matrix(noise, used)
    PHt = _times_transpose(P, H, slots)
    S = _times_transpose(PHt.T, H, slots) + R
    factor = jnp.linalg.cholesky(S)
    K = cho_solve((factor, True), PHt.T).T
    whitened = solve_triangular(factor, residual.ravel(), lower=True)

    # Joseph's (I - KH) P (I - KH)ᵀ + K R Kᵀ, multiplied out from the left: two products of
    # rank m, and none of n × n matrices.
    left = P - K @ PHt.T
    covariance = left + (K @ R - _times_transpose(left, H, slots)) @ K.T
    state = _shifted(state, K @ residual.ravel())
    state = replace(state, covariance=(covariance + covariance.T) / 2)
    return state, Innovation(predicted, residual, S, used, whitened @ whitened)


def predict_features(
    model: Model, state: State, slots: Int[Array, " m"], noise: Float[Array, "p p"], context: Any
) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]:
    """Where landmarks should be seen: pixels, covariances of their innovations, in front or not.

    These are the centres and the search ellipses of active search.
    """
    predicted, in_front, H = _observe(model, state, slots, context)
    return predicted, _local_covariance(state, H, slots) + noise, in_front


def compose(model: Model, state: State, context: Any) -> State:
    """Move the state over the motion, `P ← J P Jᵀ` (P18–P21).

    The core's function may set parts of itself to a constant (the acceleration that has been
    used): their rows of J are then zero, which marginalises them.
    """

    def move_core(core):
        return model.compose_core(core, context)

    def move_landmark(core, landmark):
        return model.compose_landmark(core, landmark, context), None

    core = move_core(state.core)
    J_core = core_jacobian(move_core, state.core)
    c = state.core_dim
    if not model.moves_landmarks:

        def rows(P):
            return jnp.concatenate([J_core @ P[:c], P[c:]])

        return replace(state, core=core, covariance=rows(rows(state.covariance).T))

    landmarks, _, J = _local_jacobians(move_landmark, state.core, state.landmarks)
    J_lc, J_ll = _masked(J, state.active)

    def rows(P):
        moved = jnp.einsum("idc,cn->idn", J_lc, P[:c]) + jnp.einsum(
            "ide,ien->idn", J_ll, P[c:].reshape(*landmarks.shape, -1)
        )
        return jnp.concatenate([J_core @ P[:c], moved.reshape(P[c:].shape)])

    return replace(
        state,
        core=core,
        landmarks=jnp.where(state.active[:, None], landmarks, state.landmarks),
        covariance=rows(rows(state.covariance).T),
    )


def initialise(
    model: Model,
    state: State,
    features: Features,
    noise: Float[Array, "p p"],
    inverse_depth: tuple[Float[Array, ""], Float[Array, ""]],
    context: Any,
) -> State:
    """Insert landmarks from their first measurement, `P ← J diag(P, R, σ²) Jᵀ` (P22–P26).

    `inverse_depth` is the prior's mean and σ. All new landmarks share one core, so what is
    uncertain there (the pose of a world-centric filter, the calibration) correlates them with
    it and with one another. Whatever was in their slots must have been removed.
    """
    if features.slots.size == 0:
        return state
    c, (capacity, d) = state.core_dim, state.landmarks.shape
    mean, sigma = inverse_depth

    def one(pixel):
        def landmark(delta, pixel, depth):
            value = model.initialise(retract(state.core, delta), pixel, depth, context)
            return value, value

        (J_core, J_pixel, J_depth), value = jax.jacfwd(
            landmark, argnums=(0, 1, 2), has_aux=True
        )(jnp.zeros(c, pixel.dtype), pixel, mean)
        own = J_pixel @ noise @ J_pixel.T + sigma**2 * jnp.outer(J_depth, J_depth)
        return value, J_core, own

    new, J_core, own = jax.vmap(one)(features.pixels)
    slots = jnp.where(features.valid, features.slots, capacity)  # out of bounds: dropped
    index = c + slots[:, None] * d + jnp.arange(d)

    def with_rows(P):
        rows = J_core @ P[:c]
        return P.at[index.ravel()].set(rows.reshape(index.size, -1), mode="drop")

    covariance = with_rows(with_rows(state.covariance).T)
    return replace(
        state,
        landmarks=state.landmarks.at[slots].set(new, mode="drop"),
        active=state.active.at[slots].set(True, mode="drop"),
        covariance=covariance.at[index[:, :, None], index[:, None, :]].add(own, mode="drop"),
    )


def remove(state: State, gone: Bool[Array, " capacity"]) -> State:
    """Marginalise landmarks and free their slots."""
    kept = jnp.repeat(~gone, state.landmarks.shape[1])
    kept = jnp.concatenate([jnp.ones(state.core_dim, bool), kept])
    covariance = jnp.where(kept[:, None] & kept[None, :], state.covariance, 0.0)
    return replace(state, active=state.active & ~gone, covariance=covariance)


def landmark_covariance(
    function: Callable[[Any, Array], Array], state: State, slots: Int[Array, " m"]
) -> tuple[Float[Array, "m k"], Float[Array, "m k k"]]:
    """Values and first-order covariances of a function of the core and one landmark."""
    value, _, J = _local_jacobians(
        lambda core, landmark: (function(core, landmark), None),
        state.core,
        state.landmarks[slots],
    )
    return value, _local_covariance(state, J, slots)


def core_covariance(function: Callable[[Any], Any], state: State) -> tuple[Any, Array]:
    """Value of a function of the core, and its first-order covariance in the value's tangent."""
    c = state.core_dim
    J = core_jacobian(function, state.core)
    return function(state.core), J @ state.covariance[:c, :c] @ J.T


def core_jacobian(function: Callable[[Any], Any], core: Any) -> Float[Array, "k c"]:
    """Jacobian of `δ ↦ f(core ⊞ δ) ⊟ f(core)` at δ = 0."""
    value = function(core)
    return jax.jacfwd(lambda delta: difference(function(retract(core, delta)), value))(
        _zero_tangent(core)
    )


def _zero_tangent(core):
    dtype = jnp.result_type(*jax.tree.leaves(core))
    return jnp.zeros(tangent_dim(core), dtype)


def _observe(model, state, slots, context):
    def function(core, landmark):
        return model.observe(core, landmark, context)

    return _local_jacobians(function, state.core, state.landmarks[slots])


def _local_jacobians(function, core, landmarks) -> tuple[Array, Any, Blocks]:
    """Values, auxiliary outputs and blocks of `function(core, landmark) → (value, auxiliary)`."""

    def one(landmark):
        def moved(delta, landmark):
            value, auxiliary = function(retract(core, delta), landmark)
            return value, (value, auxiliary)

        J, (value, auxiliary) = jax.jacfwd(moved, argnums=(0, 1), has_aux=True)(
            _zero_tangent(core), landmark
        )
        return value, auxiliary, J

    return jax.vmap(one)(landmarks)


def _masked(blocks: Blocks, mask: Bool[Array, " m"]) -> Blocks:
    J_core, J_landmark = (jnp.where(mask[:, None, None], block, 0.0) for block in blocks)
    return J_core, J_landmark


def _noise_matrix(noise, used):
    """Block-diagonal R, with an identity block where a feature is not used."""
    m, p = used.size, noise.shape[0]
    blocks = jnp.where(used[:, None, None], noise, jnp.eye(p, dtype=noise.dtype))
    R = jnp.zeros((m, p, m, p), noise.dtype)
    return R.at[jnp.arange(m), :, jnp.arange(m), :].set(blocks).reshape(m * p, m * p)


def _times_transpose(B: Float[Array, "r n"], H: Blocks, slots) -> Float[Array, "r mk"]:
    """`B Hᵀ` for the sparse H of which each row touches the core and one landmark."""
    H_core, H_landmark = H
    c, d = H_core.shape[-1], H_landmark.shape[-1]
    B_landmarks = B[:, c:].reshape(B.shape[0], -1, d)[:, slots]
    product = jnp.einsum("rc,mkc->rmk", B[:, :c], H_core) + jnp.einsum(
        "rmd,mkd->rmk", B_landmarks, H_landmark
    )
    return product.reshape(B.shape[0], -1)


def _local_covariance(state: State, J: Blocks, slots) -> Float[Array, "m k k"]:
    """`J P Jᵀ` of every landmark's own rows: the diagonal blocks only."""
    c, (capacity, d) = state.core_dim, state.landmarks.shape
    P = state.covariance
    P_lc = P[c:, :c].reshape(capacity, d, c)[slots]
    P_ll = P[c:, c:].reshape(capacity, d, capacity, d)[slots, :, slots, :]

    def one(J_core, J_landmark, P_lc, P_ll):
        cross = J_landmark @ P_lc @ J_core.T
        own = J_landmark @ P_ll @ J_landmark.T
        return J_core @ P[:c, :c] @ J_core.T + cross + cross.T + own

    return jax.vmap(one)(*J, P_lc, P_ll)


def _shifted(state: State, delta: Float[Array, " n"]) -> State:
    """`x ⊞ δ` for the core and all landmarks."""
    c = state.core_dim
    return replace(
        state,
        core=retract(state.core, delta[:c]),
        landmarks=state.landmarks + delta[c:].reshape(state.landmarks.shape),
    )
