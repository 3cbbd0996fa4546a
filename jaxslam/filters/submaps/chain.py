"""Submaps in a row as one Gaussian: every number of every submap, and what is learnt of it later.

A submap froze the joint Gaussian of its numbers z_h. A part of them went on, the separator s_h, and
the next submap says of it `s_h = g(z_{h+1})`: landmarks seen from its base, the velocity there.
With the Cholesky factor L of the covariance, s_h in front of the rest,

    z_h = m_h ⊞ L [W (g(z_{h+1}) − s̄_h); e_h],   W L_ss = 1,   e_h ~ N(0, I),

so that the chain is a function of white numbers: those of the rests, e_h, and all of the newest
z_N. The Jacobian of anything by these numbers is one pass from the oldest submap to the newest.

The filter linearised elsewhere than the chain: what the next submap says of s_h has an error of
second order, many σ in directions that are known far better than each number, and W would carry it
on. L is therefore that of the covariance with a further variance of every number, `LINEARISATION`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.blocks import minus, plus
from jaxslam.filters.linear.state import AbstractState
from jaxslam.filters.submaps.handover import Frozen, SubmapsState
from jaxslam.geometry import Pose, difference, identity, retract
from jaxslam.linalg import semidefinite_root
from jaxslam.models.frame import KeyframePose

LINEARISATION = 1e-3
"""Variance of the error of second order of each number of a submap, as a share of its own."""


class SubmapMean(AbstractState):
    """The mean of a submap, or a batch of them."""


OfChain = Callable[[SubmapMean], PyTree]
"""A function of the means of all submaps, a batch: a vector, or a pytree of poses and vectors."""


class Link(eqx.Module):
    """One submap of a chain, or a batch of all."""

    state: SubmapMean
    """As it was frozen; nothing is known in one that stands for none."""
    numbers: Int[Array, "*N slots"]
    """As `Frozen` has them."""
    first: Bool[Array, "*N"]
    """Whether the chain begins with it."""
    order: Int[Array, "*N n"]
    """The numbers of the state, those of the separator in front."""
    free: Bool[Array, "*N n"]
    """Whether each of these is not the separator's."""
    root: Float[Array, "*N n n"]
    """L, with `L Lᵀ` the covariance in that order."""
    whitening: Float[Array, "*N n n"]
    """L⁻¹."""

    def plus(self, told: Float[Array, " n"], y: Float[Array, " n"]) -> SubmapMean:
        """Return the mean for the correction of its separator, and white numbers of its own."""
        white = jnp.where(self.free, y, self.whitening @ told)
        delta = jnp.zeros_like(y).at[self.order].set(self.root @ white)
        return plus(self.state, delta)

    def by_white(self) -> Float[Array, "n n"]:
        """Return the Jacobian of the mean's numbers by the white ones."""
        return jnp.zeros_like(self.root).at[self.order].set(self.root)


class Chain(eqx.Module):
    """N submaps, the oldest first; the last is the one that is going on."""

    slam: AbstractSlam
    links: Link

    @property
    def shape(self) -> tuple[int, int]:
        """(N, n)."""
        N, n = self.links.order.shape
        return N, n

    def at(self, y: Float[Array, "N n"]) -> SubmapMean:
        """Return the means of all submaps for white numbers y; as they were frozen for none."""

        def earlier(later: SubmapMean, data):
            link, y, newest = data
            state = link.plus(jnp.where(newest, 0.0, self._told(link, later)), y)
            return state, state

        N, _ = self.shape
        last = jax.tree.map(lambda x: x[-1], self.links.state)
        data = self.links, y, jnp.arange(N) == N - 1
        return jax.lax.scan(earlier, last, data, reverse=True)[1]

    def _told(self, link: Link, later: SubmapMean) -> Float[Array, " n"]:
        """`g(z_{h+1}) − s̄_h`, in order; zero of what is not the separator's."""
        frozen, core = link.state, later.core
        back = jax.vmap(partial(self.slam.landmark.transform, core.pose.keyframe_from_camera))
        seen = replace(
            frozen.core,
            motion=core.base_motion,
            log_scale=core.log_scale,
            calibration=core.calibration,
            depth_error=core.depth_error,
        )
        now = replace(frozen, core=seen, landmarks=back(later.landmarks))
        return jnp.where(link.free, 0.0, minus(now, frozen)[link.order])

    def _onwards(
        self, above: Float[Array, "k n"], link: Link, later: SubmapMean
    ) -> tuple[Float[Array, "k n"], Float[Array, "k n"]]:
        """Return the Jacobians by a submap's white numbers, and by the numbers of the one that is
        `later`, of what has the one `above` by the submap's own."""
        white = above @ link.by_white()
        zero = jnp.zeros(above.shape[1], above.dtype)
        _, pull = jax.vjp(lambda delta: self._told(link, plus(later, delta)), zero)
        (through,) = jax.vmap(pull)(jnp.where(link.free, 0.0, white) @ link.whitening)
        return jnp.where(link.free, white, 0.0), through

    def rows(self, states: SubmapMean, by_states: Float[Array, "k N n"]) -> Float[Array, "k N n"]:
        """Return the Jacobian by the white numbers of what has this one by the submaps' numbers."""

        def onwards(older: Float[Array, "k n"], data) -> tuple[Array, Array]:
            own, after, by_state = data
            return self._onwards(older + by_state, own, after)[::-1]

        by_states = jnp.swapaxes(by_states, 0, 1)
        none, data = jnp.zeros_like(by_states[0]), (self.links, _next(states), by_states)
        _, rows = jax.lax.scan(onwards, none, data)
        return jnp.swapaxes(rows, 0, 1)

    def linearised(
        self, function: OfChain, states: SubmapMean
    ) -> tuple[PyTree, Float[Array, "k N n"]]:
        """Return the value of a function at these states, and its Jacobian by the white numbers."""
        value = function(states)

        def moved(delta: Float[Array, "N n"]) -> Float[Array, " k"]:
            return difference(function(jax.vmap(plus)(states, delta)), value)

        return value, self.rows(states, jax.jacrev(moved)(jnp.zeros(self.shape)))

    def cameras(
        self, states: SubmapMean, known: Float[Array, "k N n"]
    ) -> tuple[Pose, Float[Array, "N t t"]]:
        """Return `base_poses` and the covariance of each, less that of the k white `known` numbers.

        From the oldest submap on, a camera's error is one of older white numbers, of covariance C,
        and R times the submap's numbers; from the newest back, these have the covariance V.
        """
        known = jnp.swapaxes(known, 0, 1)
        zero = jnp.zeros(self.shape[1], known.dtype)
        start = identity(self.slam.motion.geometry, known.dtype)
        t = start.tangent_dim

        def onwards(carry, data):
            T, R, C, X = carry
            own, state, after, known = data
            T_BC = _camera(T, state, own.first)

            def moved(nudge, delta):
                there = _camera(retract(T, nudge), plus(state, delta), own.first)
                return difference(there, T_BC)

            A, E = jax.jacrev(moved, (0, 1))(jnp.zeros(t, known.dtype), zero)
            R, C, X = A @ R + E, A @ C @ A.T, A @ X
            free, through = self._onwards(R, own, after)
            return (T_BC, through, C + free @ free.T, X + free @ known.T), (T_BC, R, C, X)

        def back(carry, data):
            V, Y = carry
            own, after, known, R, C, X = data
            B = own.by_white()
            by_told = jnp.where(own.free, 0.0, B) @ own.whitening
            F = by_told @ jax.jacfwd(lambda delta: self._told(own, plus(after, delta)))(zero)
            B = jnp.where(own.free, B, 0.0)
            V, Y = B @ B.T + F @ V @ F.T, B @ known.T + F @ Y
            less = X + R @ Y
            return (V, Y), C + R @ V @ R.T - less @ less.T

        (_, k, n), after = known.shape, _next(states)
        nothing = (jnp.zeros(size, known.dtype) for size in ((t, n), (t, t), (t, k)))
        data = self.links, states, after, known
        _, (poses, R, C, X) = jax.lax.scan(onwards, (start, *nothing), data)
        nothing = jnp.zeros((n, n), known.dtype), jnp.zeros((n, k), known.dtype)
        data = self.links, after, known, R, C, X
        return poses, jax.lax.scan(back, nothing, data, reverse=True)[1]


def _next(states: PyTree) -> PyTree:
    """The submap after each, and the newest after itself."""
    return jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), states)


def chain(slam: AbstractSlam, state: SubmapsState, count: int) -> Chain:
    """Return the chain of the latest `count` submaps of a filter and the one that goes on.

    In a batch of runs all have one length: what a run does not have are links that say nothing.
    Raises ValueError for more than the state keeps.
    """
    if (submaps := slam.frame.handed_over) is None:
        raise ValueError(f"a filter with frame=Submaps(…) has a chain, not a {slam.frame.name} one")
    history = submaps.history
    if not 0 <= count <= history:
        raise ValueError(f"the state keeps {history} submaps, not {count}")
    _, newest = slam.inner.gaussian(state.inner, None)
    place = state.count - count + jnp.arange(count)
    frozen = jax.tree.map(lambda x: x[place % history], state.frozen)
    last = Frozen(newest, jnp.zeros_like(state.numbers, bool), state.numbers)
    frozen = jax.tree.map(lambda all, one: jnp.concatenate([all, one[None]]), frozen, last)
    return chained(slam.one, frozen, jnp.append(place >= 0, True))


def chained(slam: AbstractSlam, frozen: Frozen, there: Bool[Array, " N"]) -> Chain:
    """Return submaps as a chain, the oldest first, of which the first may be none (`there`)."""
    N = len(there)
    newest, first = jnp.arange(N) == N - 1, there & (jnp.cumsum(there) == 1)
    return Chain(slam, jax.vmap(partial(link, slam))(frozen, there, newest, first))


def link(
    slam: AbstractSlam,
    frozen: Frozen,
    there: Bool[Array, ""],
    newest: Bool[Array, ""],
    first: Bool[Array, ""],
) -> Link:
    """Return a submap as a link of a chain, which may stand for none, be the one that goes on, and
    be the first."""
    nowhere = KeyframePose.at(identity(slam.motion.geometry, frozen.state.landmarks.dtype))
    state = frozen.state
    known = there & state.numbers(state.active)
    P = jnp.where(known[:, None] & known, state.covariance, 0.0)
    pose = jax.tree.map(partial(jnp.where, there), state.core.pose, nowhere)
    mean = SubmapMean(replace(state.core, pose=pose), state.landmarks, state.active & there)
    separator = _separator(slam, frozen) & known & ~newest
    order = jnp.argsort(~separator, stable=True)
    factor = semidefinite_root(P[order][:, order], LINEARISATION)
    return Link(mean, frozen.numbers, first, order, ~separator[order], *factor)


def _separator(slam: AbstractSlam, frozen: Frozen) -> Bool[Array, " n"]:
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


def base_poses(chain: Chain, states: SubmapMean) -> Pose:
    """Return T_BC of the last camera of every submap, a batch, in the unit of the states: of all
    but the last the next one's base K, and of the last the camera's now."""

    def onwards(T: Pose, data: tuple[SubmapMean, Bool[Array, ""]]) -> tuple[Pose, Pose]:
        T_BC = _camera(T, *data)
        return T_BC, T_BC

    start = identity(chain.slam.motion.geometry, states.landmarks.dtype)
    return jax.lax.scan(onwards, start, (states, chain.links.first))[1]


def _camera(T_BK: Pose, state: SubmapMean, first: Bool[Array, ""]) -> Pose:
    """The last camera of a submap whose base is K, unless it is the first and has its own."""
    held: KeyframePose = state.core.pose
    start = jax.tree.map(partial(jnp.where, first), held.base_from_keyframe, T_BK)
    return (start @ held.keyframe_from_camera).normalize()
