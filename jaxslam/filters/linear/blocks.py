"""The base of the filter: one-landmark models, and their Jacobians in blocks.

Every model is a function of ONE landmark and of a *view*, the few quantities of the core that a
landmark depends on (the relative pose of the camera, its calibration). `jax.jacfwd` sees v + d
inputs for a landmark and c once for the view; the chain rule and the blocks' places are slices,
gathers and scatters. Nothing here knows what a pose, a camera or a parametrization is: a `Model`
supplies the functions, and core and view are any pytrees of poses and vectors.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.tracing import gathers_are_free
from jaxslam.filters.linear.state import AbstractState, State
from jaxslam.geometry import difference, jacobian, nudge, retract, zero_tangent
from jaxslam.linalg import cholesky
from jaxslam.models.observations import Features, Slots

Landmark = Callable[[PyTree, Array], Array]
Noise = Float[Array, "p p"] | Float[Array, "m p p"]
"""R of one measurement, or one of each of m; in an update a joint one, m·p × m·p, too."""
Prior = tuple[Float[Array, "*m q"], Float[Array, "*m q"]]
"""Mean and σ of what one measurement hides, for all landmarks or for each."""

S = TypeVar("S", bound=AbstractState)

DENSE = 200
"""Numbers up to which a product with all of J's zeros is faster than gathering what is not zero."""


class Blocks(NamedTuple):
    """Jacobian of k numbers for each of m landmarks; row block j touches the core and slot j.

    The whole matrix is J = [by_view · view_by_core, …, by_landmark at its slot, …].
    """

    view_by_core: Float[Array, "v c"]
    by_view: Float[Array, "m k v"]
    by_landmark: Float[Array, "m k d"]


@runtime_checkable
class Model(Protocol):
    """Pure functions on the core and one landmark; `context` is whatever data they need."""

    def given(self, core: PyTree, context: PyTree) -> PyTree:
        """The context in which functions of the core are differentiated at this one: with what
        their Jacobians are to take as data."""
        ...

    @property
    def moves_landmarks(self) -> bool:
        """Whether composition changes landmarks (robocentric) or leaves them (world)."""
        ...

    def compose_core(self, core: PyTree, context: PyTree) -> PyTree:
        """The core after the motion."""
        ...

    def view(self, core: PyTree, context: PyTree) -> PyTree:
        """The part of the core that the functions below need."""
        ...

    def compose_landmark(self, view: PyTree, landmark: Array, context: PyTree) -> Array:
        """One landmark after the motion, seen from before it; where `moves_landmarks`."""
        ...

    def observe(self, view: PyTree, landmark: Array, context: PyTree) -> tuple[Array, Array]:
        """The predicted measurement, and whether one is possible (in front of the camera)."""
        ...

    def residual(self, measured: Array, predicted: Array) -> Array:
        """The difference of a measurement from its prediction."""
        ...

    def initialise(self, view: PyTree, measured: Array, hidden: Array, context: PyTree) -> Array:
        """A landmark from its first measurement and what that hides, of which a prior is given."""
        ...

    def convert(self, view: PyTree, landmark: Array, covariance: Array, context: PyTree) -> Array:
        """The same landmark in another form, where its covariance recommends it."""
        ...


class NewLandmarks(NamedTuple):
    """Landmarks of first measurements."""

    values: Float[Array, "m d"]
    slots: Slots
    """Out of bounds for what is not valid."""
    J: Blocks
    """Their Jacobians, of which `by_landmark` is the identity: the error of one is J of the core's
    and its own."""
    root: Float[Array, "m d p+q"]
    """`J diag(R, σ²)^½` by measurement and prior."""


class Change(NamedTuple):
    """A change of variables: new coordinates of the core, and of one landmark seen from the old.

    The core's function may set parts of itself to a constant: their rows of its Jacobian are then
    zero, which marginalises them.
    """

    core: Callable[[PyTree], PyTree]
    view: Callable[[PyTree], PyTree]
    """What of the old core a landmark's change depends on."""
    landmark: Landmark | None
    """`landmark(view, parameters)`; None where landmarks stay as they are."""


def composition(model: Model, state: State, context: PyTree) -> Change:
    """The motion as a change of variables: the core's (P18, P19), and a landmark's."""
    context = model.given(state.core, context)

    def landmark(view, landmark):
        return model.compose_landmark(view, landmark, context)

    return Change(
        core=lambda core: model.compose_core(core, context),
        view=lambda core: model.view(core, context),
        landmark=landmark if model.moves_landmarks else None,
    )


def residuals(
    model: Model, state: State, features: Features, context: PyTree
) -> tuple[Float[Array, "m p"], Float[Array, "m p"], Bool[Array, " m"], Blocks]:
    """Predictions, residuals, which features are used, and H; zero where one is not."""
    predicted, in_front, H = observe(model, state, features.slots, context)
    used = features.valid & in_front & state.active[features.slots]
    difference = jax.vmap(model.residual)(features.measured, predicted)
    residual = jnp.where(used[:, None], difference, 0.0)
    return predicted, residual, used, masked(H, used)


def observe(
    model: Model, state: State, slots: Slots, context: PyTree
) -> tuple[Float[Array, "m p"], Bool[Array, " m"], Blocks]:
    """Predicted measurements, whether they are possible, and H."""
    context = model.given(state.core, context)
    return local_jacobians(
        lambda core: model.view(core, context),
        lambda view, landmark: model.observe(view, landmark, context),
        state.core,
        state.landmarks[slots],
    )


def new_landmarks(
    model: Model, state: State, features: Features, noise: Noise, prior: Prior, context: PyTree
) -> NewLandmarks:
    """Landmarks of first measurements (P22–P26), with their errors."""
    mean, sigma = (jnp.broadcast_to(x, (features.slots.size, x.shape[-1])) for x in prior)
    view = model.view(state.core, context)
    view_by_core = jacobian(lambda core: model.view(core, context), state.core)

    def one(measured, mean, sigma, root):
        def landmark(delta, measured, hidden):
            value = model.initialise(nudge(view, delta), measured, hidden, context)
            return value, value

        (J_view, J_measured, J_hidden), value = jax.jacfwd(
            landmark, argnums=(0, 1, 2), has_aux=True
        )(zero_tangent(view), measured, mean)
        return value, J_view, jnp.concatenate([J_measured @ root, J_hidden * sigma], axis=1)

    each = None if noise.ndim == 2 else 0
    root = (cholesky(noise) if each is None else jax.vmap(cholesky)(noise)).root
    new, J_view, own = jax.vmap(one, in_axes=(0, 0, 0, each))(features.measured, mean, sigma, root)
    m, d = new.shape
    identity = jnp.broadcast_to(jnp.eye(d, dtype=new.dtype), (m, d, d))
    slots = features.places(state.active.size)
    return NewLandmarks(new, slots, Blocks(view_by_core, J_view, identity), own)


def indices(slots: Slots, state: State) -> Int[Array, "m d"]:
    """The places of the landmarks in these slots in the state's error; out of bounds stays so."""
    d = state.landmarks.shape[1]
    return state.core_dim + slots[:, None] * d + jnp.arange(d)


def local_jacobians(view, function, core, landmarks, *data) -> tuple[Array, PyTree, Blocks]:
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


def changed_landmarks(state, view, function, *data) -> tuple[Float[Array, "capacity d"], Blocks]:
    """All landmarks after a `function` as `local_jacobians` asks for; as they are, with Jacobians
    of zero, in slots that hold none."""
    values, _, J = local_jacobians(view, function, state.core, state.landmarks, *data)
    return jnp.where(state.active[:, None], values, state.landmarks), masked(J, state.active)


def without_auxiliary(function: Landmark) -> Callable[[PyTree, Array], tuple[Array, None]]:
    """A function of view and landmark in the form that `local_jacobians` asks for."""
    return lambda view, landmark: (function(view, landmark), None)


def masked(J: Blocks, mask: Bool[Array, " m"]) -> Blocks:
    """The blocks where the mask holds, zero elsewhere."""
    mask = mask[:, None, None]
    return J._replace(
        by_view=jnp.where(mask, J.by_view, 0.0), by_landmark=jnp.where(mask, J.by_landmark, 0.0)
    )


def placed(J: Blocks, slots: Slots, capacity: int) -> Float[Array, "mk n"]:
    """The blocks in their places: dense, since products with it are then plain and fast."""
    m, k, d = J.by_landmark.shape
    here = slots[:, None] == jnp.arange(capacity)
    own = jnp.where(here[:, None, :, None], J.by_landmark[:, :, None], 0.0)
    shared = J.by_view @ J.view_by_core
    return jnp.concatenate([shared.reshape(m * k, -1), own.reshape(m * k, capacity * d)], axis=1)


def observed(J: Blocks, slots: Slots, B: Float[Array, "n r"]) -> Float[Array, "mk r"]:
    """`J B` of blocks in these slots, of more than `DENSE` numbers without the zeros."""
    c, d = J.view_by_core.shape[1], J.by_landmark.shape[-1]
    if len(B) <= DENSE and not gathers_are_free():
        return placed(J, slots, (len(B) - c) // d) @ B
    own = B[c:].reshape(-1, d, B.shape[1])[slots]
    by_view = J.by_view.reshape(-1, J.by_view.shape[-1]) @ (J.view_by_core @ B[:c])
    return by_view + small_products(J.by_landmark, own).reshape(by_view.shape)


def product(
    J_core: Float[Array, "c c"], J: Blocks | None, B: Float[Array, "n r"]
) -> Float[Array, "n r"]:
    """`J B` of a change of the core and of every landmark in order, without the zeros; of the core
    alone where J is None."""
    c = len(J_core)
    if J is None:
        return jnp.concatenate([J_core @ B[:c], B[c:]])
    by_view = small_products(J.by_view, J.view_by_core @ B[:c])
    d = J.by_landmark.shape[-1]
    by_landmark = small_products(J.by_landmark, B[c:].reshape(-1, d, B.shape[1]))
    below = (by_view + by_landmark).reshape(-1, B.shape[1])
    return jnp.concatenate([J_core @ B[:c], below])


def small_products(A: Float[Array, "*m k j"], B: Float[Array, "*#m j r"]) -> Float[Array, "*m k r"]:
    """`A B` for a small j as a sum over j, which XLA fuses to one vectorised loop.

    Its batched product calls a matrix product for every small pair: twice the time on a CPU.
    """
    return functools.reduce(
        operator.add, (A[..., i, None] * B[..., i, None, :] for i in range(A.shape[-1]))
    )


def plus(state: S, delta: Float[Array, " n"]) -> S:
    """`x ⊞ δ` for the core and all landmarks."""
    c = state.core_dim
    return replace(
        state,
        core=retract(state.core, delta[:c]),
        landmarks=state.landmarks + delta[c:].reshape(state.landmarks.shape),
    )


def minus(state: AbstractState, origin: AbstractState) -> Float[Array, " n"]:
    """`state ⊟ origin`, the inverse of `plus`."""
    landmarks = (state.landmarks - origin.landmarks).ravel()
    return jnp.concatenate([difference(state.core, origin.core), landmarks])
