"""A Gaussian sum that divides itself anew in every frame.

The sum of `Bank` is divided at the start, and what accelerations add to the velocity later is not.
Here, in every frame, the member whose linearisation costs most is split, and the two whose merger
costs least are merged (split and merge: Ueda et al. 2000; for filters Faubel et al. 2009).

What costs is the product of the camera's displacement t with inverse depths. In a measurement
h(X − ω t), with X and ω as they are at the estimate, errors of both neglect `−(∂h/∂X) δt δω`. So a
member's cost is the squared pixels `tr(M P_t)`, with its own variance P_t of the displacement and

    M = Σᵢ σ_ωᵢ² (∂h/∂X)ᵀ (∂h/∂X),   over the landmarks i in view.

Splits and mergers keep the sum's mean and covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters.bank import Bank, BankState, moments
from jaxslam.filters.blocks import shifted
from jaxslam.filters.filter import step_in_stages
from jaxslam.filters.slam import Context, Parameters, SlamFilter, check_one_gaussian
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import difference, jacobian
from jaxslam.linalg import cholesky, eigh

SPLIT = 0.8
"""Halves of a split member are ± so many of its σ from its mean."""


@dataclass(frozen=True)
class SplitAndMerge(Bank):
    """`count` filters `base`; begun as the sum over the direction of the velocity."""

    base: SlamFilter
    along: str = "direction"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.base, SlamFilter):
            raise ValueError("a mixture is of filters, not of windows or of other sums")
        check_one_gaussian(self.base, "a mixture")

    def _directions(self, velocity, D) -> Float[Array, "v 1"]:
        """One, so that there are `count` members in space too: the rest is left to the splits."""
        return super()._directions(velocity, D)[:, :1]

    @property
    def rounds(self) -> int:
        """Splits in a frame, at the most."""
        return max(1, self.count // 3)

    @property
    def gaussian_filter(self) -> SlamFilter:
        return self.base

    def step(
        self,
        state: BankState,
        parameters: Parameters,
        control: Array,
        seen: Features,
        new: Features,
    ) -> tuple[BankState, Innovation]:
        """Every member's step, the sum divided anew once the frame's noise is appended."""
        return step_in_stages(self, state, parameters, control, seen, new)

    def predict(self, state: BankState, parameters: Parameters, control: Array) -> BankState:
        """Append this step's noise; `update` divides the sum and composes, where that is first."""
        del control
        return self._each(self.base.append_noise, state, parameters)

    def predicted_gaussian(self, state: BankState, parameters: Parameters, control: Array) -> State:
        """A predicted state as one Gaussian of `base`, for its functions."""
        one = _collapsed(state.members, state.log_weights)
        return self.base.composed_first(one, parameters, control)

    def update(
        self, state: BankState, parameters: Parameters, control: Array, features: Features
    ) -> tuple[BankState, Innovation]:
        """Divide the sum anew, correct every member and weigh it."""
        state = self._divided(state, parameters, control, features)

        def updated(member):
            member = self.base.composed_first(member, parameters, control)
            return self.base.update(member, parameters, control, features)

        members, innovations = jax.vmap(updated)(state.members)
        return self._weighed(members, state.log_weights, innovations)

    def compose(self, state: BankState, parameters: Parameters, control: Array) -> BankState:
        """Every member's; so are the following."""
        return self._each(self.base.compose, state, parameters, control)

    def initialise(self, state: BankState, parameters: Parameters, features: Features) -> BankState:
        return self._each(self.base.initialise, state, parameters, features)

    def finish(self, state: BankState) -> BankState:
        return self._each(self.base.finish, state)

    def remove(self, state: BankState, gone: Bool[Array, " capacity"]) -> BankState:
        return self._each(self.base.remove, state, gone)

    def landmarks_in_world(self, state: BankState, parameters: Parameters, slots: Array):
        return self._landmarks(self.base.landmarks_in_world, state, parameters, slots)

    def _divided(
        self, state: BankState, parameters: Parameters, control: Array, seen: Features
    ) -> BankState:
        def displacement(core):
            return self.base.model.displacement(core, Context(parameters, control)).translation()

        cost = self._root_of_cost(state, parameters, seen)

        def pixels(core):
            return cost @ displacement(core)

        def once(_, state):
            return _split_and_merged(pixels, state)

        return jax.lax.fori_loop(0, self.rounds, once, state)

    def _root_of_cost(
        self, state: BankState, parameters: Parameters, seen: Features
    ) -> Float[Array, "n n"]:
        """C with `CᵀC = M` of the landmarks that are seen, at the likeliest member."""
        base, sensor = self.base, self.rig.sensor
        likeliest = self.reported(state)
        view_of = base.composed_view(parameters)

        def inverse_depth(view, landmark):
            return base.model.camera_point(view, landmark)[1][None]

        _, variances = base.engine.landmark_covariance(
            view_of, inverse_depth, likeliest, seen.slots
        )
        view = view_of(likeliest.core)
        camera = view.camera(Context(parameters, None))

        def by_point(landmark):
            point, omega = base.model.camera_point(view, landmark)
            return jax.jacfwd(lambda point: sensor.measure(camera, point, omega))(point)

        slopes = jax.vmap(by_point)(likeliest.landmarks[seen.slots])
        counted = jnp.where(seen.valid, variances[:, 0, 0], 0.0)
        M = jnp.einsum("m,mpi,mpj->ij", counted, slopes, slopes)
        # Nearly singular where one landmark is seen, and zero where none is.
        n = self.rig.geometry.point_dim
        M = M / jnp.maximum(jnp.trace(M), jnp.finfo(M.dtype).tiny)
        return cholesky(M + 1e-6 * jnp.eye(n, dtype=M.dtype)).root.T


def with_mixture(base: SlamFilter, count: int | None) -> SplitAndMerge:
    """The Gaussian sum that divides itself anew in every frame; 9 members by default."""
    return SplitAndMerge(base, 9 if count is None else count)


def _split_and_merged(pixels, state: BankState) -> BankState:
    """The member of the greatest cost split, and two of the others merged, if that is a gain.

    The cost of the sum is `Σ w tr(P)` of the members' `pixels(core)`. A split lessens it by
    `w δ² λ` with the greatest eigenvalue λ; a merger adds `wᵢ wⱼ/(wᵢ + wⱼ) |pᵢ − pⱼ|²`.
    """
    members, log_weights = state.members, state.log_weights
    weights = jnp.exp(log_weights)
    values, by_core = jax.vmap(lambda core: (pixels(core), jacobian(pixels, core)))(members.core)
    c = by_core.shape[-1]
    costs = jnp.einsum("kic,kcd,kid->k", by_core, members.covariance[:, :c, :c], by_core)
    split = jnp.argmax(jnp.where(weights > 0, weights * costs, 0.0))
    parent = _of(members, split)
    halves, gain = _halves(parent, by_core[split])

    tiny, index = jnp.finfo(weights.dtype).tiny, jnp.arange(weights.size)
    shared = weights[:, None] * weights / jnp.maximum(weights[:, None] + weights, tiny)
    apart = jnp.sum((values[:, None] - values) ** 2, axis=-1)
    loss = jnp.where(shared > 0, shared * apart, 0.0)
    pair = (index[:, None] < index) & (index[:, None] != split) & (index != split)
    i, j = jnp.unravel_index(jnp.argmin(jnp.where(pair, loss, jnp.inf)), loss.shape)
    both = jnp.stack([i, j])
    merged = _collapsed(_of(members, both), log_weights[both])

    gained = weights[split] * gain > loss[i, j]
    slots = jnp.stack([i, j, split])
    new = jax.tree.map(lambda one, two: jnp.concatenate([one[None], two]), merged, halves)
    half = log_weights[split] - jnp.log(2.0)
    new = BankState(new, jnp.stack([jnp.logaddexp(*log_weights[both]), half, half]))

    def put(old, new):
        kept = gained.reshape((1,) * new.ndim)
        return old.at[slots].set(jnp.where(kept, new, old[slots]))

    return jax.tree.map(put, state, new)


def _of(members: Any, k: Array) -> Any:
    return jax.tree.map(lambda x: x[k], members)


def _halves(parent: State, by_core: Float[Array, "n c"]) -> tuple[State, Array]:
    """N(x, P) as ½ N(x + δ c, P − δ² c cᵀ) + ½ N(x − δ c, …), with `c = P g/√(gᵀ P g)`.

    g is the combination of the `n` functions of the core that varies most. Returned are both
    halves, a batch, and `δ² gᵀ P g`.
    """
    c = by_core.shape[-1]
    slopes = parent.covariance[:, :c] @ by_core.T
    values, vectors = eigh(by_core @ slopes[:c])
    variance = jnp.maximum(values[-1], 0.0)
    sigma = jnp.sqrt(jnp.maximum(variance, jnp.finfo(variance.dtype).tiny))
    away = SPLIT * slopes @ vectors[:, -1] / sigma
    smaller = parent.covariance - jnp.outer(away, away)

    def half(sign):
        return replace(shifted(parent, sign * away), covariance=smaller)

    return jax.vmap(half)(jnp.array([-1.0, 1.0], away.dtype)), SPLIT**2 * variance


def _collapsed(members: State, log_weights: Float[Array, " k"]) -> State:
    """The Gaussian with the mean and the covariance of a sum, of any total weight.

    The mean is to first order in the members' distances from the likeliest.
    """
    likeliest = jnp.argmax(log_weights)
    centre = _of(members, likeliest)
    total = jax.nn.logsumexp(log_weights)
    alone = jnp.where(jnp.arange(log_weights.size) == likeliest, 0.0, -jnp.inf)
    log_weights = jnp.where(jnp.isfinite(total), log_weights - total, alone)

    def away(member):
        landmarks = (member.landmarks - centre.landmarks).ravel()
        return jnp.concatenate([difference(member.core, centre.core), landmarks])

    mean, covariance = moments(log_weights, jax.vmap(away)(members), members.covariance)
    return replace(shifted(centre, mean), covariance=covariance)
