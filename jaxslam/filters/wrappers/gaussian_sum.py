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
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam._numerics.arrays import AnyArray, cast, precision
from jaxslam._numerics.conditional import map_or_zero, map_where, zeros
from jaxslam.filters.ekf import (
    EkfSlam,
    append_noise,
    check_one_gaussian,
    composed_first,
    ekf_inside,
)
from jaxslam.filters.protocol import (
    AbstractStaged,
    Belief,
    Corrected,
    EachMoments,
    Expected,
    Moments,
    OfCamera,
    OfLandmark,
    PoseError,
)
from jaxslam.filters.wrappers.split_merge import collapsed, divided
from jaxslam.filters.wrappers.sum_state import SumState, member, moments, weighed
from jaxslam.filters.wrappers.wrapper import AbstractWrapper, with_motion
from jaxslam.geometry import Pose, difference, retract
from jaxslam.linalg import eigh
from jaxslam.models.motion import Control, check_control
from jaxslam.models.observations import Capacity, Features, Slots

REACH = (2.5, 4.0)
"""The members' means are spread over ± so many σ of the prior, at the least and at the most."""
SPACING = 0.5
"""Within these, so many σ of the prior are between them."""
OVERLAP = 0.5
"""σ of a member, in distances between neighbours."""


class GaussianSum(AbstractWrapper):
    """`members` filters `base` for each direction, across its mean, in which the velocity's prior
    is divided: one in a planar world, two, with `members²` members, in a spatial one. Split and
    merged in every frame, at most `members` for one direction.

    Raises ValueError for fewer than 3, and a base that has no velocity, or, to be split, is more
    than one Gaussian.
    """

    base: AbstractStaged
    members: int = eqx.field(static=True)
    split: bool = eqx.field(static=True, default=True)
    """Whether members are split and merged; only the first of two directions is then divided at the
    start, and `base` is an `EkfSlam`."""

    def __check_init__(self) -> None:
        super().__check_init__()
        if self.split:
            check_one_gaussian(self.base, "a mixture", corrected=True)
        if self.members < 3:
            raise ValueError(f"a Gaussian sum has at least 3 members, not {self.members}")
        motion = self._ekf.motion
        if not motion.has_velocity:
            raise ValueError(f"a Gaussian sum divides a velocity: {type(motion).__name__} has none")

    @property
    def _ekf(self) -> EkfSlam:
        return ekf_inside(self.base, "a Gaussian sum is")

    def base_state(self, state: SumState) -> Belief:
        """The likeliest member's."""
        return state.likeliest

    @property
    def rounds(self) -> int:
        """Splits in a frame, at the most: each takes up to three members."""
        return max(1, self.members // 3)

    def init(self, capacity: int | Capacity, first: Features | None = None) -> SumState:
        """`v = v̄ + D e`, e ~ N(0, I) = Σ w_i N(A s_i, I − (1 − σ²) A Aᵀ), for directions A."""
        dtype = precision(self.base)
        base = cast(self.base, dtype)
        motion = cast(self._ekf.motion, dtype)
        velocity, D = motion.start()
        A = _directions(velocity, D, motion.geometry.point_dim)
        A = A[:, :1] if self.split else A
        grid, weights, sigma = _division(self.members, A.shape[1])
        root = D @ (jnp.eye(len(D), dtype=dtype) - (1 - sigma) * A @ A.T)

        def begun(place):
            mean = velocity + D @ A @ place
            surer = replace(motion, velocity=mean, velocity_sigma=root)
            return with_motion(base, surer).init(capacity, first)

        return SumState(jax.vmap(begun)(jnp.asarray(grid, dtype)), jnp.asarray(weights, dtype))

    def step(self, state: SumState, control: Control, seen: Features, new: Features) -> Corrected:
        """Every member's step; a sum that is split is divided once the frame's noise is there."""
        if not self.split:
            return self._measured(lambda one: self.base.step(one, control, seen, new), state)
        state = self._divided(self.predict(state, control), control, seen)

        def stepped(one):
            one, innovation = self._updated(one, control, seen)
            return self.base.close(self.base.compose(one, control), new), innovation

        return self._measured(stepped, state)

    def predict(self, state: SumState, control: Control) -> SumState:
        """Predict each member; a split sum composes later, in `update`, where that is first."""
        if not self.split:
            return self._each(lambda one: self.base.predict(one, control), state)
        check_control(self._ekf.motion, control)
        return self._each(lambda one: append_noise(self._ekf, one), state)

    def gaussian(self, state: SumState, control: Control) -> tuple[AbstractStaged, Belief]:
        """The base filter, and the predicted sum's mean and covariance."""
        if self.split:
            one = collapsed(state.members, state.log_weights)
            return self.base, composed_first(self._ekf, one, control)
        base, _ = self.base.gaussian(state.likeliest, control)
        members = jax.vmap(lambda one: self.base.gaussian(one, control)[1])(state.members)
        return base, collapsed(members, state.log_weights)

    def predict_features(self, state: SumState, control: Control, slots: Slots) -> Expected:
        """The features that the sum as one Gaussian expects."""
        base, one = self.gaussian(state, control)
        return base.predict_features(one, control, slots)

    def update(self, state: SumState, control: Control, seen: Features) -> Corrected:
        """Split and merge, correct every member and weigh it."""
        if self.split:
            state = self._divided(state, control, seen)
        return self.update_members(state, control, seen)

    def update_members(self, state: SumState, control: Control, seen: Features) -> Corrected:
        """Correct every member as it is, and weigh it."""
        return self._measured(lambda one: self._updated(one, control, seen), state)

    def compose(self, state: SumState, control: Control) -> SumState:
        """Every member's; so are the following."""
        return self._each(lambda one: self.base.compose(one, control), state)

    def close(self, state: SumState, new: Features) -> SumState:
        return self._each(lambda one: self.base.close(one, new), state)

    def remove(self, state: SumState, gone: Bool[AnyArray, " capacity"]) -> SumState:
        return self._each(lambda one: self.base.remove(one, gone), state)

    def marginal(self, state: SumState, function: OfCamera) -> Moments:
        """The sum's mean and covariance, in the tangent at the value of its likeliest member."""
        each = partial(self.base.marginal, function=function)
        values, covariances = map_or_zero(each, state.members, state.alive)
        likeliest = SumState(values, state.log_weights).likeliest
        away = jax.vmap(difference, in_axes=(0, None))(values, likeliest)
        mean, covariance = moments(state.log_weights, away, covariances)
        return retract(likeliest, mean), covariance

    def landmark_marginal(self, state: SumState, function: OfLandmark, slots: Slots) -> EachMoments:
        """The sum's mean and covariance of every landmark."""
        each = partial(self.base.landmark_marginal, function=function, slots=slots)
        values, covariances = map_or_zero(each, state.members, state.alive)
        of_landmark = jax.vmap(moments, in_axes=(None, 1, 1))
        return of_landmark(state.log_weights, values, covariances)

    def pose_error(self, state: SumState, T_BC: Pose) -> PoseError:
        """The error of the sum's mean, to first order in the members' distances; its covariance."""
        errors, covariances = jax.vmap(self.base.pose_error, in_axes=(0, None))(state.members, T_BC)
        return moments(state.log_weights, errors, covariances)

    def _divided(self, state: SumState, control: Control, seen: Features) -> SumState:
        return divided(self._ekf, state, control, seen, self.rounds)

    def _updated(self, one: Belief, control: Control, seen: Features) -> Corrected:
        if self.split:
            one = composed_first(self._ekf, one, control)
        return self.base.update(one, control, seen)

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
            both = state.members, zeros(told, self.members)
            members, innovations = map_where(lambda both: step(both[0]), both, state.alive)
        return weighed(members, state.log_weights, innovations)


def _directions(
    velocity: Float[Array, " v"], D: Float[Array, "v v"], n: int
) -> Float[Array, "v m"]:
    """Orthonormal directions of e that turn the velocity, of n linear numbers, and do not change
    the speed."""
    linear = jnp.zeros_like(velocity).at[:n].set(velocity[:n])
    still = jnp.linalg.norm(linear) == 0
    speed = D.T @ jnp.where(still, jnp.eye(velocity.size)[0].astype(D.dtype), linear)
    speed = speed[:, None] / jnp.maximum(jnp.linalg.norm(speed), jnp.finfo(D.dtype).tiny)
    by_linear = D.T[:, :n]
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
