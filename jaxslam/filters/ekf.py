"""The extended Kalman filter on a core and many landmarks, its Jacobians assembled from blocks.

Every model is a function of ONE landmark and of a *view*, the few quantities of the core that a
landmark depends on (the relative pose of the camera, its calibration). `jax.jacfwd` sees v + d
inputs for a landmark and c once for the view; the chain rule and the blocks' places are slices,
gathers and scatters. Nothing here knows what a pose, a camera or a parametrization is: a `Model`
supplies the functions, and core and view are any pytrees of poses and vectors.

The steps are the paper's: `augment` (P10, P11, P15), `update` (P16, P17), `compose` (P18–P21),
`initialise` (P22–P26), and `remove`.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import jacobian, nudge, retract, zero_tangent


class Blocks(NamedTuple):
    """Jacobian of k numbers for each of m landmarks; row block j touches the core and slot j.

    The whole matrix is J = [by_view · view_by_core, …, by_landmark at its slot, …].
    """

    view_by_core: Float[Array, "v c"]
    by_view: Float[Array, "m k v"]
    by_landmark: Float[Array, "m k d"]


class Model(Protocol):
    """Pure functions on the core and one landmark; `context` is whatever data they need."""

    @property
    def moves_landmarks(self) -> bool:
        """Whether composition changes landmarks (robocentric) or leaves them (world)."""
        ...

    def compose_core(self, core: Any, context: Any) -> Any:
        """The core after the motion."""
        ...

    def view(self, core: Any, context: Any) -> Any:
        """What the functions below need of the core."""
        ...

    def compose_landmark(self, view: Any, landmark: Array, context: Any) -> Array:
        """One landmark after the motion, seen from before it; where `moves_landmarks`."""
        ...

    def observe(self, view: Any, landmark: Array, context: Any) -> tuple[Array, Array]:
        """The predicted measurement, and whether one is possible (in front of the camera)."""
        ...

    def initialise(self, view: Any, measured: Array, hidden: Array, context: Any) -> Array:
        """A landmark from its first measurement and what that hides, of which a prior is given."""
        ...

    def convert(self, view: Any, landmark: Array, covariance: Array, context: Any) -> Array:
        """The same landmark in another form, where its covariance recommends it."""
        ...


def augment(state: State, start: int, covariance: Float[Array, "k k"]) -> State:
    """Give k numbers of the core, from `start`, an independent covariance (P10, P11, P15).

    Their rows and columns must be zero, as `marginalise` and `compose` leave them.
    """
    if covariance.size == 0:
        return state
    part = slice(start, start + covariance.shape[0])
    return replace(state, covariance=state.covariance.at[part, part].set(covariance))


def marginalise(state: State, start: int, size: int) -> State:
    """Forget k numbers of the core: zero rows and columns; the caller resets their mean."""
    if size == 0:
        return state
    part = slice(start, start + size)
    covariance = state.covariance.at[part, :].set(0.0).at[:, part].set(0.0)
    return replace(state, covariance=covariance)


def update(
    model: Model,
    state: State,
    features: Features,
    noise: Float[Array, "*m p p"],
    context: Any,
    considered: slice = slice(0, 0),
) -> tuple[State, Innovation]:
    """The Kalman update by all features at once (P16, P17), in Joseph form.

    `noise` is the covariance R of one measurement, or one for each feature. A feature that is not
    valid, not in the map or predicted behind the camera changes nothing. The `considered` numbers
    of the core count with their covariance but have no gain (Schmidt, 1966).
    """
    predicted, residual, used, H = _residuals(model, state, features, context)
    P = state.covariance
    R = _noise_matrix(noise, used)
    HP = H @ P
    S = HP @ H.T + R
    # L⁻¹ of S = L Lᵀ is small, and products with it are several times faster than solving for
    # the wide HP; Joseph's form keeps P positive whatever rounding does to K.
    whitening = solve_triangular(
        jnp.linalg.cholesky(S), jnp.eye(S.shape[0], dtype=S.dtype), lower=True
    )
    K = ((HP.T @ whitening.T) @ whitening).at[considered].set(0.0)
    whitened = whitening @ residual.ravel()

    # Joseph's (I - KH) P (I - KH)ᵀ + K R Kᵀ, multiplied out from the left: two products of
    # rank m, and none of n × n matrices.
    left = P - K @ HP
    covariance = left + (K @ R - left @ H.T) @ K.T
    state = _shifted(state, K @ residual.ravel())
    state = replace(state, covariance=(covariance + covariance.T) / 2)
    return state, Innovation(predicted, residual, S, used, whitened @ whitened)


def update_mean(
    model: Model,
    state: State,
    features: Features,
    noise: Float[Array, "p p"],
    context: Any,
    considered: slice = slice(0, 0),
) -> State:
    """The mean that `update` would give, with the covariance left as it is."""
    _, residual, used, H = _residuals(model, state, features, context)
    HP = H @ state.covariance
    S = HP @ H.T + _noise_matrix(noise, used)
    delta = HP.T @ jnp.linalg.solve(S, residual.ravel())
    return _shifted(state, delta.at[considered].set(0.0))


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

    def view(core):
        return model.view(core, context)

    def move_landmark(view, landmark):
        return model.compose_landmark(view, landmark, context), None

    core, J_core = move_core(state.core), jacobian(move_core, state.core)
    if not model.moves_landmarks:
        return _transformed(state, core, J_core, state.landmarks, None)
    moved, _, J = _local_jacobians(view, move_landmark, state.core, state.landmarks)
    return _transformed(state, core, J_core, moved, J)


def convert(model: Model, state: State, context: Any) -> State:
    """Write landmarks in the form that the model now prefers, `P ← J P Jᵀ`."""
    c, (capacity, d) = state.core_dim, state.landmarks.shape
    blocks = state.covariance[c:, c:].reshape(capacity, d, capacity, d)
    own = blocks[jnp.arange(capacity), :, jnp.arange(capacity), :]

    def converted(view, landmark, covariance):
        return model.convert(view, landmark, covariance, context), None

    value, _, J = _local_jacobians(
        lambda core: model.view(core, context), converted, state.core, state.landmarks, own
    )
    J_core = jnp.eye(c, dtype=state.covariance.dtype)
    return _transformed(state, state.core, J_core, value, J)


def _transformed(state: State, core: Any, J_core: Array, landmarks: Array, J: Blocks | None):
    """The state after a change of variables, of the core alone where J is None."""
    c = state.core_dim
    if J is not None:
        J = _masked(J, state.active)
        landmarks = jnp.where(state.active[:, None], landmarks, state.landmarks)

    def rows(P):
        below = P[c:] if J is None else _rows(J, P)
        return jnp.concatenate([J_core @ P[:c], below])

    return replace(state, core=core, landmarks=landmarks, covariance=rows(rows(state.covariance).T))


def initialise(
    model: Model,
    state: State,
    features: Features,
    noise: Float[Array, "p p"],
    prior: tuple[Float[Array, "*m q"], Float[Array, "*m q"]],
    context: Any,
) -> State:
    """Insert landmarks from their first measurement, `P ← J diag(P, R, σ²) Jᵀ` (P22–P26).

    `prior` is the mean and σ of what one measurement hides, for all or one for each. All new
    landmarks share one core, so what is uncertain there (the pose of a world-centric filter, the
    calibration) correlates them with it and with one another. Whatever was in their slots must
    have been removed.
    """
    if features.slots.size == 0:
        return state
    c, (capacity, d) = state.core_dim, state.landmarks.shape
    mean, sigma = (jnp.broadcast_to(x, (features.slots.size, x.shape[-1])) for x in prior)

    view = model.view(state.core, context)
    view_by_core = jacobian(lambda core: model.view(core, context), state.core)

    def one(measured, mean, sigma):
        def landmark(delta, measured, hidden):
            value = model.initialise(nudge(view, delta), measured, hidden, context)
            return value, value

        (J_view, J_measured, J_hidden), value = jax.jacfwd(
            landmark, argnums=(0, 1, 2), has_aux=True
        )(zero_tangent(view), measured, mean)
        own = J_measured @ noise @ J_measured.T + (J_hidden * sigma**2) @ J_hidden.T
        return value, J_view, own

    new, J_view, own = jax.vmap(one)(features.measured, mean, sigma)
    slots = jnp.where(features.valid, features.slots, capacity)  # out of bounds: dropped
    index = c + slots[:, None] * d + jnp.arange(d)

    def with_rows(P):
        rows = J_view @ (view_by_core @ P[:c])
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
    view: Callable[[Any], Any],
    function: Callable[[Any, Array], Array],
    state: State,
    slots: Int[Array, " m"],
) -> tuple[Float[Array, "m k"], Float[Array, "m k k"]]:
    """Values and first-order covariances of `function(view(core), landmark)`, slot by slot."""
    value, _, J = _local_jacobians(
        view,
        lambda view, landmark: (function(view, landmark), None),
        state.core,
        state.landmarks[slots],
    )
    return value, _local_covariance(state, J, slots)


def core_covariance(function: Callable[[Any], Any], state: State) -> tuple[Any, Array]:
    """Value of a function of the core, and its first-order covariance in the value's tangent."""
    c = state.core_dim
    J = jacobian(function, state.core)
    return function(state.core), J @ state.covariance[:c, :c] @ J.T


def _residuals(model, state, features, context):
    """Predictions, residuals, which features are used, and H; zero where one is not."""
    predicted, in_front, H = _observe(model, state, features.slots, context)
    used = features.valid & in_front & state.active[features.slots]
    residual = jnp.where(used[:, None], features.measured - predicted, 0.0)
    return predicted, residual, used, _placed(_masked(H, used), features.slots, state.active.size)


def _observe(model, state, slots, context):
    return _local_jacobians(
        lambda core: model.view(core, context),
        lambda view, landmark: model.observe(view, landmark, context),
        state.core,
        state.landmarks[slots],
    )


def _local_jacobians(view, function, core, landmarks, *data) -> tuple[Array, Any, Blocks]:
    """Values, auxiliary outputs and blocks of `function(view, landmark) → (value, auxiliary)`.

    `data` are further arguments of the function, one for each landmark: not differentiated.
    """
    view_by_core, view = jacobian(view, core), view(core)

    def one(landmark, *data):
        def moved(delta, landmark):
            value, auxiliary = function(nudge(view, delta), landmark, *data)
            return value, (value, auxiliary)

        J, (value, auxiliary) = jax.jacfwd(moved, argnums=(0, 1), has_aux=True)(
            zero_tangent(view), landmark
        )
        return value, auxiliary, J

    value, auxiliary, (by_view, by_landmark) = jax.vmap(one)(landmarks, *data)
    return value, auxiliary, Blocks(view_by_core, by_view, by_landmark)


def _masked(J: Blocks, mask: Bool[Array, " m"]) -> Blocks:
    mask = mask[:, None, None]
    return J._replace(
        by_view=jnp.where(mask, J.by_view, 0.0),
        by_landmark=jnp.where(mask, J.by_landmark, 0.0),
    )


def _noise_matrix(noise, used):
    """Block-diagonal R, with an identity block where a feature is not used."""
    m, p = used.size, noise.shape[-1]
    blocks = jnp.where(used[:, None, None], noise, jnp.eye(p, dtype=noise.dtype))
    R = jnp.zeros((m, p, m, p), noise.dtype)
    return R.at[jnp.arange(m), :, jnp.arange(m), :].set(blocks).reshape(m * p, m * p)


def _placed(J: Blocks, slots: Int[Array, " m"], capacity: int) -> Float[Array, "mk n"]:
    """The blocks in their places: dense, since products with it are then plain and fast."""
    m, k, d = J.by_landmark.shape
    here = slots[:, None] == jnp.arange(capacity)
    own = jnp.where(here[:, None, :, None], J.by_landmark[:, :, None], 0.0)
    shared = J.by_view @ J.view_by_core
    return jnp.concatenate([shared.reshape(m * k, -1), own.reshape(m * k, capacity * d)], axis=1)


def _rows(J: Blocks, B: Float[Array, "n r"]) -> Float[Array, "nl r"]:
    """`J B` for every landmark in order, without the zeros: J has a block for each."""
    c, d = J.view_by_core.shape[1], J.by_landmark.shape[-1]
    by_view = _outer_products(J.by_view, J.view_by_core @ B[:c])
    by_landmark = _outer_products(J.by_landmark, B[c:].reshape(-1, d, B.shape[1]))
    return (by_view + by_landmark).reshape(-1, B.shape[1])


def _outer_products(A: Float[Array, "*m k j"], B: Float[Array, "*m j r"]) -> Float[Array, "*m k r"]:
    """`A B` for a small j as a sum over j, which XLA fuses to one vectorised loop.

    Its batched product calls a matrix product for every small pair: twice the time on a CPU.
    """
    return functools.reduce(
        operator.add, (A[..., i, None] * B[..., i, None, :] for i in range(A.shape[-1]))
    )


def _local_covariance(state: State, J: Blocks, slots) -> Float[Array, "m k k"]:
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


def _shifted(state: State, delta: Float[Array, " n"]) -> State:
    """`x ⊞ δ` for the core and all landmarks."""
    c = state.core_dim
    return replace(
        state,
        core=retract(state.core, delta[:c]),
        landmarks=state.landmarks + delta[c:].reshape(state.landmarks.shape),
    )
