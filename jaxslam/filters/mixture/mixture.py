"""A Gaussian sum over the initial velocity: several filters, each sure of a part of it.

What no bearing observes well, the scale, or the direction of travel straight ahead, multiplies
the inverse depths of all landmarks. A filter that is sure of it has a nearly linear problem. So
the prior on the velocity is a sum of narrower Gaussians (Alspach, Sorenson 1972), one filter runs
on each, and the likelihoods of their innovations weigh them. What accelerations add to the velocity
later is divided anew in every frame (`split_merge`), where that is wanted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxslam._numerics.arrays import cast, precision
from jaxslam._numerics.conditional import map_or_zero, map_where, zeros
from jaxslam.filters.gaussian import append_noise, composed_first
from jaxslam.filters.layer import AbstractLayer, AbstractSlam
from jaxslam.filters.linear.state import State
from jaxslam.filters.mixture.split_merge import collapsed, divided
from jaxslam.filters.mixture.sum_state import SumState, member, moments, weighed
from jaxslam.filters.protocol import Belief, Corrected
from jaxslam.geometry import difference, retract
from jaxslam.linalg import eigh
from jaxslam.models.motion import Control, check_control
from jaxslam.models.observations import Features

REACH = (2.5, 4.0)
"""The members' means are spread over at least and at most ± so many σ of the prior."""
SPACING = 0.5
"""Within these, so many σ of the prior are between them."""
OVERLAP = 0.5
"""σ of a member, in distances between neighbours."""


class Mixture(AbstractLayer):
    """A sum of Gaussians: `members` of them for each direction, across its mean, in which the
    velocity's prior is divided: one in a planar world, two, with `members²` members, in a spatial
    one. Split and merged in every frame, at most `members` for one direction.

    Raises ValueError for fewer than 3.
    """

    members: int = eqx.field(static=True, default=9)
    """The number of members for each direction; where they are split, the greatest number."""
    split: bool = eqx.field(static=True, default=True)
    """Whether members are split and merged; only the first of two directions is then divided at the
    start."""

    def __check_init__(self) -> None:
        if self.members < 3:
            raise ValueError(f"a mixture has at least 3 members, not {self.members}")

    def inside(self, state: SumState) -> Belief:
        """The likeliest member's."""
        return state.likeliest

    def init(self, slam, capacity, first, known):
        """`v = v̄ + D e`, e ~ N(0, I) = Σ w_i N(A s_i, I − (1 − σ²) A Aᵀ), for directions A."""
        dtype = precision(slam)
        inner = cast(slam.inner, dtype)
        motion = inner.motion
        variables, D = motion.start()
        n = motion.geometry.point_dim
        A = _directions(jax.tree.leaves(variables)[0][:n], D)
        A = A[:, :1] if self.split else A
        grid, weights, sigma = _division(self.members, A.shape[1])
        root = D @ (jnp.eye(len(D), dtype=dtype) - (1 - sigma) * A @ A.T)

        def begun(place):
            surer = motion.begun(retract(variables, D @ A @ place), root)
            begun = eqx.tree_at(lambda slam: slam.motion, inner, surer)
            return begun.init(capacity, first, known)

        return SumState(jax.vmap(begun)(jnp.asarray(grid, dtype)), jnp.asarray(weights, dtype))

    def step(self, slam, state, control, seen, new):
        """Every member's step; a sum that is split is divided once the frame's noise is there."""
        inner = slam.inner
        if not self.split:
            return self._measured(lambda one: inner.step(one, control, seen, new), state)
        state = divided(slam, self.predict(slam, state, control), control, seen)

        def stepped(one):
            one, innovation = self._updated(slam, one, control, seen)
            return inner.close(inner.compose(one, control), new), innovation

        return self._measured(stepped, state)

    def predict(self, slam, state, control):
        """Predict each member; a split sum composes later, in `update`, where that is first."""
        if not self.split:
            return self._each(lambda one: slam.inner.predict(one, control), state)
        check_control(slam.motion, control)
        return self._each(lambda one: append_noise(slam, one), state)

    def gaussian(self, slam, state, control):
        """The filter of one Gaussian, and the predicted sum's mean and covariance."""
        one = collapsed(state.members, state.log_weights)
        return slam.inner, composed_first(slam, one, control) if self.split else one

    def predict_features(self, slam, state, control, slots):
        """The features that the sum as one Gaussian expects."""
        inner, one = self.gaussian(slam, state, control)
        return inner.predict_features(one, control, slots)

    def update(self, slam, state, control, seen):
        """Split and merge, correct every member and weigh it."""
        if self.split:
            state = divided(slam, state, control, seen)
        return self.update_members(slam, state, control, seen)

    def update_members(
        self, slam: AbstractSlam, state: SumState, control: Control, seen: Features
    ) -> Corrected:
        """Correct every member as it is, and weigh it."""
        return self._measured(lambda one: self._updated(slam, one, control, seen), state)

    def compose(self, slam, state, control):
        """Every member's; so are the following."""
        return self._each(lambda one: slam.inner.compose(one, control), state)

    def close(self, slam, state, new):
        return self._each(lambda one: slam.inner.close(one, new), state)

    def remove(self, slam, state, gone):
        return self._each(lambda one: slam.inner.remove(one, gone), state)

    def marginal(self, slam, state, function):
        """The sum's mean and covariance, in the tangent at the value of its likeliest member."""
        each = partial(slam.inner.marginal, function=function)
        values, covariances = map_or_zero(each, state.members, state.alive)
        likeliest = SumState(values, state.log_weights).likeliest
        away = jax.vmap(difference, in_axes=(0, None))(values, likeliest)
        mean, covariance = moments(state.log_weights, away, covariances)
        return retract(likeliest, mean), covariance

    def landmark_marginal(self, slam, state, function, slots):
        """The sum's mean and covariance of every landmark."""
        each = partial(slam.inner.landmark_marginal, function=function, slots=slots)
        values, covariances = map_or_zero(each, state.members, state.alive)
        of_landmark = jax.vmap(moments, in_axes=(None, 1, 1))
        return of_landmark(state.log_weights, values, covariances)

    def pose_error(self, slam, state, T_BC):
        """The error of the sum's mean, to first order in the members' distances; its covariance."""
        of_member = jax.vmap(slam.inner.pose_error, in_axes=(0, None))
        return moments(state.log_weights, *of_member(state.members, T_BC))

    def _updated(
        self, slam: AbstractSlam, one: State, control: Control, seen: Features
    ) -> Corrected:
        if self.split:
            one = composed_first(slam, one, control)
        return slam.inner.update(one, control, seen)

    def _each(self, function: Callable[[PyTree], PyTree], state: SumState) -> SumState:
        if self.split:
            return replace(state, members=map_where(function, state.members, state.alive))
        return replace(state, members=jax.vmap(function)(state.members))

    def _measured(self, step: Callable[[Belief], Corrected], state: SumState) -> Corrected:
        """Every member after a step with measurements, weighed by what it did not expect."""
        if not self.split:
            members, innovations = jax.vmap(step)(state.members)
        else:
            told = jax.eval_shape(step, member(state.members, 0))[1]
            both = state.members, zeros(told, len(state.log_weights))
            members, innovations = map_where(lambda both: step(both[0]), both, state.alive)
        return weighed(members, state.log_weights, innovations)


def _directions(linear: Float[Array, " n"], D: Float[Array, "v v"]) -> Float[Array, "v m"]:
    """Orthonormal directions of e that turn the linear velocity, the first of the numbers whose
    root is D, and do not change the speed."""
    n = linear.size
    still = jnp.linalg.norm(linear) == 0
    speed = jnp.where(still, jnp.eye(len(D))[0].astype(D.dtype), D[:n].T @ linear)
    speed = speed[:, None] / jnp.maximum(jnp.linalg.norm(speed), jnp.finfo(D.dtype).tiny)
    by_linear = D[:n].T
    projected = by_linear - speed @ (speed.T @ by_linear)
    _, vectors = eigh(projected @ projected.T)
    return vectors[:, :-n:-1]


def _division(members: int, directions: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Means and log weights of the members of N(0, I), and their σ; the sum's variance is 1."""
    reach = np.clip(SPACING * (members - 1) / 2, *REACH)
    line = np.linspace(-reach, reach, members)
    wanted = min(OVERLAP * (line[1] - line[0]), 0.9)
    log_weight = -(line**2) / (2 * (1 - wanted**2))
    weight = np.exp(log_weight - np.logaddexp.reduce(log_weight))
    sigma = np.sqrt(1 - weight @ line**2)
    grid = np.array(list(itertools.product(line, repeat=directions)))
    weights = np.array([sum(w) for w in itertools.product(log_weight, repeat=directions)])
    return grid, weights - np.logaddexp.reduce(weights), float(sigma)
