"""The steps of an extended Kalman filter on a covariance, its Jacobians assembled from blocks.

They are the paper's: `augmented` (P10, P11, P15), `composed` (P18–P21), `initialised` (P22–P26),
and `removed`; the update (P16, P17) is in `kalman`. Each is a pure function of a `State`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.linear.blocks import (
    Blocks,
    Change,
    Landmark,
    Model,
    Noise,
    Prior,
    changed_landmarks,
    composition,
    indices,
    local_jacobians,
    new_landmarks,
    observe,
    product,
    without_auxiliary,
)
from jaxslam.filters.linear.state import State
from jaxslam.filters.protocol import EachMoments, Moments
from jaxslam.geometry import jacobian, nudge
from jaxslam.models.observations import Features, Slots


def empty(core: PyTree, landmarks: Float[Array, "capacity d"]) -> State:
    """A state that is exactly known, of slots that hold no landmark yet."""
    capacity = landmarks.shape[0]
    state = State(core, landmarks, jnp.zeros(capacity, bool), jnp.zeros((0, 0), landmarks.dtype))
    n = state.core_dim + landmarks.size
    return replace(state, covariance=jnp.zeros((n, n), landmarks.dtype))


def augmented(state: State, start: int, covariance: Float[Array, "k k"]) -> State:
    """Give k numbers of the core, from `start`, an independent covariance (P10, P11, P15).

    Nothing may be known of them, as `marginalised` and `composed` leave them.
    """
    if covariance.size == 0:
        return state
    part = slice(start, start + covariance.shape[0])
    return replace(state, covariance=state.covariance.at[part, part].set(covariance))


def marginalised(state: State, start: int, size: int) -> State:
    """Forget k numbers of the core; the caller resets their mean."""
    if size == 0:
        return state
    part = slice(start, start + size)
    covariance = state.covariance.at[part, :].set(0.0).at[:, part].set(0.0)
    return replace(state, covariance=covariance)


def composed(model: Model, state: State, context: PyTree) -> State:
    """Move the state over the motion (P18–P21)."""
    return reparametrised(state, composition(model, state, context))


def reparametrised(state: State, variables: Change) -> State:
    """Write the state in other variables."""
    core, J_core = variables.core(state.core), jacobian(variables.core, state.core)
    if variables.landmark is None:
        return replace(_transformed(state, J_core, None), core=core)
    landmarks, J = changed_landmarks(state, variables.view, without_auxiliary(variables.landmark))
    return replace(_transformed(state, J_core, J), core=core, landmarks=landmarks)


def _transformed(state: State, J_core: Float[Array, "c c"], J: Blocks | None) -> State:
    """`P ← J P Jᵀ`, of Jacobians that are zero in empty slots; of the core alone without J."""
    half = product(J_core, J, state.covariance)
    return replace(state, covariance=product(J_core, J, half.T))


def initialised(
    model: Model, state: State, features: Features, noise: Noise, prior: Prior, context: PyTree
) -> State:
    """Insert landmarks from their first measurement: `P ← J diag(P, R, σ²) Jᵀ` (P22–P26).

    `noise` is R of one measurement, or one of each; `prior` is the mean and σ of what one
    measurement hides, for all or for each. All new landmarks share one core, so what is uncertain
    there (the pose of a world-centric filter, the calibration) correlates them with it and with
    one another. Whatever was in their slots must have been removed.
    """
    if features.slots.size == 0:
        return state
    new = new_landmarks(model, state, features, noise, prior, context)
    own = new.root @ jnp.swapaxes(new.root, 1, 2)
    return with_landmarks(state, new.slots, new.values, new.J, own)


def with_landmarks(
    state: State,
    slots: Slots,
    values: Float[Array, "m d"],
    J: Blocks,
    own: Float[Array, "m d d"] | Float[Array, "m d m d"],
) -> State:
    """The state with landmarks in these slots: off by J of the core's error, and by their own,
    independent of one another or with a joint covariance. What is out of bounds is dropped."""
    c, index = state.core_dim, indices(slots, state)

    def with_rows(P):
        rows = J.by_view @ (J.view_by_core @ P[:c])
        return P.at[index.ravel()].set(rows.reshape(index.size, -1), mode="drop")

    covariance = with_rows(with_rows(state.covariance).T)
    if own.ndim == 3:
        place = index[:, :, None], index[:, None, :]
    else:
        place = index[:, :, None, None], index[None, None]
    return replace(
        state,
        landmarks=state.landmarks.at[slots].set(values, mode="drop"),
        active=state.active.at[slots].set(True, mode="drop"),
        covariance=covariance.at[place].add(own, mode="drop"),
    )


def removed(state: State, gone: Bool[AnyArray, " capacity"]) -> State:
    """Marginalise landmarks and free their slots."""
    kept = state.numbers(~gone)
    covariance = jnp.where(kept[:, None] & kept[None, :], state.covariance, 0.0)
    return replace(state, active=state.active & ~gone, covariance=covariance)


def local_covariance(state: State, J: Blocks, slots: Slots) -> Float[Array, "m k k"]:
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


def core_moments(function: Callable[[PyTree], PyTree], state: State) -> Moments:
    """Value of a function of the core, and its first-order covariance in its tangent."""
    c = state.core_dim
    J = jacobian(function, state.core)
    return function(state.core), J @ state.covariance[:c, :c] @ J.T


def expected(
    model: Model, state: State, slots: Slots, context: PyTree
) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]:
    """The predicted measurements, their covariances without noise, and which are possible."""
    predicted, in_front, H = observe(model, state, slots, context)
    return predicted, local_covariance(state, H, slots), in_front


def landmark_moments(
    view: Callable[[PyTree], PyTree], function: Landmark, state: State, slots: Slots
) -> EachMoments:
    """Values and first-order covariances of `function(view(core), landmark)`, slot by slot."""
    value, _, J = local_jacobians(
        view, without_auxiliary(function), state.core, state.landmarks[slots]
    )
    return value, local_covariance(state, J, slots)


def converted(model: Model, state: State, context: PyTree) -> State:
    """Write landmarks in the form that the model now prefers."""
    c, (capacity, d) = state.core_dim, state.landmarks.shape
    blocks = state.covariance[c:, c:].reshape(capacity, d, capacity, d)
    own = blocks[jnp.arange(capacity), :, jnp.arange(capacity), :]

    def convert(view, landmark, covariance):
        return model.convert(view, landmark, covariance, context), None

    def view(core):
        return model.view(core, context)

    landmarks, J = changed_landmarks(state, view, convert, own)
    state = _transformed(state, jnp.eye(c, dtype=state.landmarks.dtype), J)
    return replace(state, landmarks=landmarks)


def joint_covariance(state: State, slot: Int[Array, ""]) -> Float[Array, "k k"]:
    """The joint covariance of the core and one landmark, k = c + d numbers."""
    c, d = state.core_dim, state.landmarks.shape[1]
    index = jnp.concatenate([jnp.arange(c), c + slot * d + jnp.arange(d)])
    return state.covariance[index[:, None], index]


def curvature(
    model: Model, state: State, slots: Slots, context: PyTree
) -> tuple[Float[Array, "m p k k"], Blocks]:
    """Second derivatives of every landmark's measurement by what it depends on, the view and the
    landmark's own numbers, and the Jacobian of these by the state."""
    context = model.given(state.core, context)
    view = model.view(state.core, context)
    view_by_core = jacobian(lambda core: model.view(core, context), state.core)
    v, d, m = len(view_by_core), state.landmarks.shape[1], slots.size

    def measured(delta, landmark):
        return model.observe(nudge(view, delta[:v]), landmark + delta[v:], context)[0]

    zero = jnp.zeros(v + d, state.landmarks.dtype)
    hessian = jax.vmap(lambda landmark: jax.jacfwd(jax.jacfwd(measured))(zero, landmark))
    eye = jnp.broadcast_to(jnp.eye(v + d, dtype=zero.dtype), (m, v + d, v + d))
    return hessian(state.landmarks[slots]), Blocks(view_by_core, eye[:, :, :v], eye[:, :, v:])
