"""Submaps in a row as one Gaussian: every number of every submap, and what is learnt of it later.

A submap froze the joint Gaussian of its numbers z_h. A part of them went on, the separator s_h, and
the next submap says of it `s_h = g(z_{h+1})`: landmarks seen from its base, the velocity there.
With the Cholesky factor L of the covariance, s_h in front of the rest,

    z_h = m_h ⊞ L [W (g(z_{h+1}) − s̄_h); e_h],   W L_ss = 1,   e_h ~ N(0, I),

so that the chain is a function of white numbers: those of the rests, e_h, and all of the newest
z_N. The Jacobian of anything by these numbers is one pass from the oldest submap to the newest.

The filter linearised elsewhere than the chain does, so that what the next submap says of s_h has an
error of second order. Some directions of s_h are known ten thousand times better than each of its
numbers; there that error is many σ, and W would carry it on, from submap to submap. L is therefore
that of the covariance with a variance of its own for every number, `LINEARISATION`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.linalg import semidefinite_root
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.forms.blocks import apart, shifted
from jaxslam.filters.forms.state import State
from jaxslam.filters.submaps.handover import Frozen, Submaps, SubmapsState
from jaxslam.geometry import Pose, difference, identity
from jaxslam.models.coordinates import KeyframePose

LINEARISATION = 1e-4
"""Variance of the error of second order of each number of a submap, as a share of its variance."""

OfChain = Callable[[State], PyTree]
"""A function of the states of all submaps, a batch: a vector, or a pytree of poses and vectors."""


class Link(eqx.Module):
    """One submap of a chain, or a batch of all."""

    state: State
    """As it was frozen; nothing is known in one that stands for none."""
    numbers: Int[Array, "*N slots"]
    """As `Frozen` has them."""
    first: Bool[Array, "*N"]
    """Whether the chain begins with it."""
    order: Int[Array, "*N n"]
    """The numbers of the state, those of the separator in front."""
    free: Bool[Array, "*N n"]
    """Of these which are not the separator's."""
    root: Float[Array, "*N n n"]
    """L of the covariance in that order …"""
    whitening: Float[Array, "*N n n"]
    """… and its inverse."""

    def shifted(self, told: Float[Array, " n"], y: Float[Array, " n"]) -> State:
        """Return the state for what is told of its separator, and for white numbers of its own."""
        white = jnp.where(self.free, y, self.whitening @ told)
        delta = jnp.zeros_like(y).at[self.order].set(self.root @ white)
        return shifted(self.state, delta)

    def by_white(self) -> Float[Array, "n n"]:
        """Return the Jacobian of the state's numbers by the white ones."""
        return jnp.zeros_like(self.root).at[self.order].set(self.root)


class Chain(eqx.Module):
    """N submaps, the oldest first; the last is the one that is going on."""

    slam: EkfSlam
    links: Link

    @property
    def shape(self) -> tuple[int, int]:
        """(N, n)."""
        N, n = self.links.order.shape
        return N, n

    def at(self, y: Float[Array, "N n"]) -> State:
        """Return the states of all submaps for white numbers y; as they were frozen for none."""

        def earlier(later: State, data: tuple[Link, Array, Array]) -> tuple[State, State]:
            link, y, newest = data
            state = link.shifted(jnp.where(newest, 0.0, self._told(later, link)), y)
            return state, state

        N, _ = self.shape
        last = jax.tree.map(lambda x: x[-1], self.links.state)
        data = self.links, y, jnp.arange(N) == N - 1
        return jax.lax.scan(earlier, last, data, reverse=True)[1]

    def _told(self, later: State, link: Link) -> Float[Array, " n"]:
        """`g(z_{h+1}) − s̄_h`, in order; zero of what is not the separator's."""
        frozen, core = link.state, later.core
        T_KC = core.pose.keyframe_from_camera
        back = jax.vmap(lambda landmark: self.slam.landmark.transform(T_KC, landmark))
        seen = replace(
            frozen.core,
            motion=core.base_motion,
            log_scale=core.log_scale,
            calibration=core.calibration,
            depth_error=core.depth_error,
        )
        now = replace(frozen, core=seen, landmarks=back(later.landmarks))
        return jnp.where(link.free, 0.0, apart(now, frozen)[link.order])

    def rows(self, states: State, by_states: Float[Array, "k N n"]) -> Float[Array, "k N n"]:
        """Return the Jacobian by the white numbers of what has this one by the submaps' numbers."""

        def later(above: Float[Array, "k n"], data) -> tuple[Array, Array]:
            own, before, state, by_state = data
            # `above` is by the numbers of the submap before: this one says of a part what it is.
            _, pull = jax.vjp(lambda delta: self._told(shifted(state, delta), before), zero)
            white = jnp.where(before.free, 0.0, above @ before.by_white())
            (through,) = jax.vmap(pull)(white @ before.whitening)
            total = by_state + through
            return total, jnp.where(own.free, total @ own.by_white(), 0.0)

        k, _, n = by_states.shape
        zero = jnp.zeros(n, by_states.dtype)
        # Before the oldest there is none: nothing is `above` it.
        before = jax.tree.map(lambda x: jnp.concatenate([x[:1], x[:-1]]), self.links)
        data = self.links, before, states, jnp.swapaxes(by_states, 0, 1)
        _, rows = jax.lax.scan(later, jnp.zeros((k, n), by_states.dtype), data)
        return jnp.swapaxes(rows, 0, 1)

    def linearised(self, function: OfChain, states: State) -> tuple[PyTree, Float[Array, "k N n"]]:
        """Return the value of a function at these states, and its Jacobian by the white numbers."""
        value = function(states)

        def moved(delta: Float[Array, "N n"]) -> Float[Array, " k"]:
            return difference(function(jax.vmap(shifted)(states, delta)), value)

        return value, self.rows(states, jax.jacrev(moved)(jnp.zeros(self.shape)))


def chain(
    slam: Submaps, state: SubmapsState, count: int, linearisation: float = LINEARISATION
) -> Chain:
    """Return the chain of the latest `count` submaps of a filter and the one that goes on; of a
    problem that is linear, with a `linearisation` of 0.

    In a batch of runs all have one length: what a run does not have are links that say nothing.
    Raises ValueError for more than the state keeps.
    """
    if not 0 <= count <= slam.history:
        raise ValueError(f"the state keeps {slam.history} submaps, not {count}")
    _, newest = slam.base.gaussian(state.inner, None)
    place = state.count - count + jnp.arange(count)
    frozen = jax.tree.map(lambda x: x[place % slam.history], state.frozen)
    last = Frozen(newest, jnp.zeros_like(state.numbers, bool), state.numbers)
    frozen = jax.tree.map(lambda all, one: jnp.concatenate([all, one[None]]), frozen, last)
    return chained(slam.ekf, frozen, jnp.append(place >= 0, True), linearisation)


def chained(
    slam: EkfSlam, frozen: Frozen, there: Bool[Array, " N"], linearisation: float = LINEARISATION
) -> Chain:
    """Return submaps as a chain, the oldest first, of which the first may be none (`there`)."""
    N = len(there)
    newest, first = jnp.arange(N) == N - 1, there & (jnp.cumsum(there) == 1)
    one = partial(link, slam, linearisation=linearisation)
    return Chain(slam, jax.vmap(one)(frozen, there, newest, first))


def link(
    slam: EkfSlam,
    frozen: Frozen,
    there: Bool[Array, ""],
    newest: Bool[Array, ""],
    first: Bool[Array, ""],
    linearisation: float = LINEARISATION,
) -> Link:
    """Return a submap as a link of a chain, which may stand for none, be the one that goes on, and
    be the first."""
    nowhere = KeyframePose.at(identity(slam.motion.geometry, frozen.state.landmarks.dtype))
    state = frozen.state
    known = there & state.numbers(state.active)
    state = replace(
        state,
        core=replace(
            state.core, pose=jax.tree.map(partial(jnp.where, there), state.core.pose, nowhere)
        ),
        active=state.active & there,
        covariance=jnp.where(known[:, None] & known, state.covariance, 0.0),
    )
    separator = _separator(slam, frozen) & known & ~newest
    order = jnp.argsort(~separator, stable=True)
    factor = semidefinite_root(state.covariance[order][:, order], linearisation)
    return Link(state, frozen.numbers, first, order, ~separator[order], *factor)


def _separator(slam: EkfSlam, frozen: Frozen) -> Bool[Array, " n"]:
    """Which numbers of a submap go on."""
    state = frozen.state
    constant = ["motion", "log_scale", "depth_error"]
    if not slam.calibration.each_frame:
        constant.append("calibration")
    own = jnp.zeros(state.core_dim, bool)
    for name in constant:
        own = own.at[state.core.part(name)].set(True)
    carried = jnp.repeat(frozen.carried & state.active, state.landmarks.shape[1])
    return jnp.concatenate([own, carried])


def base_poses(chain: Chain, states: State) -> Pose:
    """Return T_BC of the last camera of every submap, a batch, in the unit of the states: of all
    but the last the next one's base K, and of the last the camera's now."""

    def onwards(T_BK: Pose, data: tuple[KeyframePose, Bool[Array, ""]]) -> tuple[Pose, Pose]:
        held, first = data
        start = jax.tree.map(partial(jnp.where, first), held.base_from_keyframe, T_BK)
        T_BC = (start @ held.keyframe_from_camera).normalize()
        return T_BC, T_BC

    start = identity(chain.slam.motion.geometry, states.landmarks.dtype)
    return jax.lax.scan(onwards, start, (states.core.pose, chain.links.first))[1]
