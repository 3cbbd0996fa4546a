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

from dataclasses import replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.arrays import AnyArray
from jaxslam.forms.blocks import shifted
from jaxslam.forms.state import Features, Innovation, State
from jaxslam.geometry import difference, jacobian, log
from jaxslam.linalg import cholesky, eigh
from jaxslam.models.motion import check_control
from jaxslam.slam.filter import EkfSlam, append_noise, check_one_gaussian, composed_first
from jaxslam.slam.model import COMPOSED, Context
from jaxslam.slam.protocol import AbstractStaged, Expected
from jaxslam.wrappers.bank import Bank, BankState, moments

SPLIT = 0.8
"""Halves of a split member are ± so many of its σ from its mean."""


class Mixture(Bank, AbstractStaged):
    """`count` filters `base`; begun as the sum over the direction of the velocity (`along`), or
    over the speed. Raises ValueError as `Bank` does, and for a base of several Gaussians."""

    base: EkfSlam  # ty: ignore[incompatible-mutable-override]
    along: Literal["speed", "direction"] = eqx.field(static=True, default="direction")

    def __check_init__(self) -> None:
        check_one_gaussian(self.base, "a mixture", remedies=True)

    @property
    def rounds(self) -> int:
        """Splits in a frame, at the most."""
        return max(1, self.count // 3)

    def step(
        self, state: BankState, control: Any, seen: Features, new: Features
    ) -> tuple[BankState, Innovation]:
        """Every member's step, the sum divided anew once the frame's noise is appended."""
        return AbstractStaged.step(self, state, control, seen, new)

    def predict(self, state: BankState, control: Any) -> BankState:
        """Append this step's noise; `update` divides the sum and composes, where that is first."""
        check_control(self.base.motion, control)
        return self._each(lambda member: append_noise(self.base, member), state)

    def gaussian(self, state: BankState, control: Any) -> tuple[EkfSlam, State]:
        """The base filter, and the predicted sum's mean and covariance."""
        one = collapsed(state.members, state.log_weights)
        return self.base, composed_first(self.base, one, control)

    def predict_features(self, state: BankState, control: Any, slots: Int[Array, " m"]) -> Expected:
        """Of the sum as one Gaussian."""
        base, one = self.gaussian(state, control)
        return base.predict_features(one, control, slots)

    def update(
        self, state: BankState, control: Any, seen: Features
    ) -> tuple[BankState, Innovation]:
        """Divide the sum anew, correct every member and weigh it."""
        return self.corrected(self._divided(state, control, seen), control, seen)

    def corrected(
        self, state: BankState, control: Any, seen: Features
    ) -> tuple[BankState, Innovation]:
        """Correct every member as it is, and weigh it."""

        def updated(member):
            member = composed_first(self.base, member, control)
            return self.base.update(member, control, seen)

        members, innovations = jax.vmap(updated)(state.members)
        return self._weighed(members, state.log_weights, innovations)

    def compose(self, state: BankState, control: Any) -> BankState:
        """Every member's; so are the following."""
        return self._each(lambda member: self.base.compose(member, control), state)

    def close(self, state: BankState, new: Features) -> BankState:
        return self._each(lambda member: self.base.close(member, new), state)

    def remove(self, state: BankState, gone: Bool[AnyArray, " capacity"]) -> BankState:
        return self._each(lambda member: self.base.remove(member, gone), state)

    def _directions(self, velocity, D) -> Float[Array, "v 1"]:
        """One, so that there are `count` members in space too: the rest is left to the splits."""
        return super()._directions(velocity, D)[:, :1]

    def _divided(self, state: BankState, control: Any, seen: Features) -> BankState:
        def displacement(core):
            # Of the logarithm: a turn is not to be split for what it does to the translation.
            moved = log(self.base.model.displacement(core, Context(control)))
            return moved[: self.base.motion.geometry.point_dim]

        cost = self._root_of_cost(state, seen)

        def pixels(core):
            return cost @ displacement(core)

        def once(_, state):
            return _split_and_merged(pixels, state)

        return jax.lax.fori_loop(0, self.rounds, once, state)

    def _root_of_cost(self, state: BankState, seen: Features) -> Float[Array, "n n"]:
        """C with `CᵀC = M` of the landmarks that are seen, at the likeliest member."""
        base, model, likeliest = self.base, self.base.model, self.likeliest(state)

        def view_of(core):
            return model.view(core, COMPOSED)

        def inverse_depth(view, landmark):
            return model.camera_point(view, landmark)[1][None]

        _, variances = base.gaussian_form.landmark_covariance(
            view_of, inverse_depth, likeliest, seen.slots
        )
        view = view_of(likeliest.core)
        sensor = model.sensor_of(view)

        def by_point(landmark):
            point, omega = model.camera_point(view, landmark)
            return jax.jacfwd(lambda point: sensor.measure(point, omega))(point)

        slopes = jax.vmap(by_point)(likeliest.landmarks[seen.slots])
        counted = jnp.where(seen.valid, variances[:, 0, 0], 0.0)
        M = jnp.einsum("m,mpi,mpj->ij", counted, slopes, slopes)
        # Nearly singular where one landmark is seen, and zero where none is.
        n = base.motion.geometry.point_dim
        M = M / jnp.maximum(jnp.trace(M), jnp.finfo(M.dtype).tiny)
        return cholesky(M + 1e-6 * jnp.eye(n, dtype=M.dtype)).root.T


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
    merged = collapsed(_of(members, both), log_weights[both])

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


def collapsed(members: State, log_weights: Float[Array, " k"]) -> State:
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
