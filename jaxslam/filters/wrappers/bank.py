"""A Gaussian sum over the initial velocity: a bank of filters, each sure of a part of it.

What no bearing observes well, the scale, or the direction of travel straight ahead, multiplies
the inverse depths of all landmarks. A filter that is sure of it has a nearly linear problem. So
the prior on the velocity is a sum of narrower Gaussians (Alspach, Sorenson 1972), one filter runs
on each, and the likelihoods of their innovations weigh them.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import cast, precision
from jaxslam._numerics.linalg import cholesky, eigh
from jaxslam.filters.ekf import EkfSlam, ekf_inside
from jaxslam.filters.initialisation.alternatives import log_density
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.wrappers.wrapper import with_motion
from jaxslam.geometry import Pose, difference, retract
from jaxslam.models.observations import Capacity, Features, Innovation, Status

REACH = (2.5, 4.0)
"""The members' means are spread over ± so many σ of the prior, at the least and at the most."""
SPACING = 0.5
"""Within these, so many σ of the prior are between them."""
OVERLAP = 0.5
"""σ of a member, in distances between neighbours."""
ALONG = ("speed", "direction")
BEHIND = 1e-4
"""What a member, by its mean sure that a landmark is behind the camera, leaves for its being seen;
as much as a residual of four σ has beyond it."""


class BankState(eqx.Module):
    """The members' states, a batch, and the logarithms of their weights."""

    members: Any
    log_weights: Float[Array, " members"]

    @property
    def alive(self) -> Bool[Array, " members"]:
        """Members that weigh anything."""
        return jnp.isfinite(self.log_weights)


class Bank(AbstractFilter):
    """`count` filters `base` for each direction in which the velocity's prior is divided.

    Raises ValueError for fewer than 3, another division, and a base that has no velocity or no
    covariance of its innovation.
    """

    base: AbstractFilter
    """An `EkfSlam`, or what is built around one."""
    count: int = eqx.field(static=True)
    along: Literal["speed", "direction"] = eqx.field(static=True, default="speed")
    """`speed`: along the mean velocity, which is the scale. `direction`: across it, which is one
    direction in a planar world and two, with `count²` members, in a spatial one."""

    def __check_init__(self) -> None:
        if self.count < 3:
            raise ValueError(f"a Gaussian sum has at least 3 members, not {self.count}")
        if self.along not in ALONG:
            raise ValueError(f"unknown division {self.along!r}; known: {', '.join(ALONG)}")
        inner = self._inner
        if not inner.gaussian_form.innovation_covariance:
            raise ValueError(
                "a Gaussian sum weighs its members by the covariance of the innovation, "
                f"which {type(inner.form).__name__.lower()} does not have"
            )
        if not inner.motion.has_velocity:
            raise ValueError(
                f"a Gaussian sum divides a velocity: {type(inner.motion).__name__} has none"
            )

    def init(self, capacity: int | Capacity, first: Features | None = None) -> BankState:
        """`v = v̄ + D e`, e ~ N(0, I) = Σ w_i N(A s_i, I − (1 − σ²) A Aᵀ), for directions A."""
        dtype = precision(self.base)
        base = cast(self.base, dtype)
        motion = cast(self._inner.motion, dtype)
        velocity, D = motion.start()
        A = self._directions(velocity, D)
        grid, weights, sigma = self._division(A.shape[1])
        root = D @ (jnp.eye(len(D), dtype=dtype) - (1 - sigma) * A @ A.T)

        def member(place):
            mean = velocity + D @ A @ place
            begun = replace(motion, velocity=mean, velocity_sigma=root)
            return with_motion(base, begun).init(capacity, first)

        return BankState(jax.vmap(member)(jnp.asarray(grid, dtype)), jnp.asarray(weights, dtype))

    def step(
        self, state: BankState, control: Any, seen: Features, new: Features
    ) -> tuple[BankState, Innovation]:
        """Every member's step; weights by the likelihoods of the innovations."""
        step = jax.vmap(self.base.step, in_axes=(0, None, None, None))
        members, innovations = step(state.members, control, seen, new)
        return self._weighed(members, state.log_weights, innovations)

    def marginal(self, state: BankState, function, slots: Int[Array, " m"] | None = None):
        """The sum's mean and covariance: of a value, in the tangent at its likeliest member."""
        values, covariances = jax.vmap(lambda member: self.base.marginal(member, function, slots))(
            state.members
        )
        if slots is not None:
            of_each = jax.vmap(moments, in_axes=(None, 1, 1))
            return of_each(state.log_weights, values, covariances)
        likeliest = jax.tree.map(lambda x: x[jnp.argmax(state.log_weights)], values)
        away = jax.vmap(difference, in_axes=(0, None))(values, likeliest)
        mean, covariance = moments(state.log_weights, away, covariances)
        return retract(likeliest, mean), covariance

    def in_map(self, state: BankState) -> Bool[Array, " capacity"]:
        """The likeliest member's."""
        return self.base.in_map(self.likeliest(state))

    def pose_error(self, state: BankState, T_BC: Pose) -> tuple[Float[Array, " t"], Array]:
        """Of the sum's mean, to first order in the members' distances, with its covariance."""
        errors, covariances = jax.vmap(self.base.pose_error, in_axes=(0, None))(state.members, T_BC)
        return moments(state.log_weights, errors, covariances)

    def likeliest(self, state: BankState) -> Any:
        """The state of the member of the greatest weight."""
        return jax.tree.map(lambda x: x[jnp.argmax(state.log_weights)], state.members)

    @property
    def unwrapped(self) -> AbstractFilter:
        return self.base.unwrapped

    @property
    def _inner(self) -> EkfSlam:
        return ekf_inside(self.base, "a Gaussian sum is")

    def _weighed(
        self, members: Any, log_weights: Array, innovations: Innovation
    ) -> tuple[BankState, Innovation]:
        after = jax.nn.log_softmax(log_weights + log_likelihoods(innovations))
        # The sum fails with the likeliest member, as one that has failed is weighed no more.
        status = innovations.status[jnp.argmax(after)]
        return BankState(members, after), _mixed(innovations, log_weights, status)

    def _each(self, function, state: BankState, *data: Any) -> BankState:
        members = jax.vmap(lambda member: function(member, *data))(state.members)
        return BankState(members, state.log_weights)

    def _directions(self, velocity, D) -> Float[Array, "v m"]:
        """Orthonormal directions of e: the one that changes the speed most, or those that turn
        the velocity and do not change the speed."""
        n = self._inner.motion.geometry.point_dim
        linear = jnp.zeros_like(velocity).at[:n].set(velocity[:n])
        still = jnp.linalg.norm(linear) == 0
        along = D.T @ jnp.where(still, jnp.eye(velocity.size)[0].astype(D.dtype), linear)
        along = along[:, None] / jnp.maximum(jnp.linalg.norm(along), jnp.finfo(D.dtype).tiny)
        if self.along == "speed":
            return along
        by_linear = D.T[:, :n]
        projected = by_linear - along @ (along.T @ by_linear)
        _, vectors = eigh(projected @ projected.T)
        return vectors[:, :-n:-1]

    def _division(self, directions: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Means and log weights of the members of N(0, I), and their σ; the sum's variance is 1."""
        reach = np.clip(SPACING * (self.count - 1) / 2, *REACH)
        line = np.linspace(-reach, reach, self.count)
        wanted = min(OVERLAP * (line[1] - line[0]), 0.9)
        log_weight = -(line**2) / (2 * (1 - wanted**2))
        weight = np.exp(log_weight - np.logaddexp.reduce(log_weight))
        sigma = np.sqrt(1 - weight @ line**2)
        grid = np.array(list(itertools.product(line, repeat=directions)))
        weights = np.array([sum(w) for w in itertools.product(log_weight, repeat=directions)])
        return grid, weights - np.logaddexp.reduce(weights), float(sigma)


def log_likelihoods(innovations: Innovation) -> Float[Array, " members"]:
    """Of every member `log N(r; 0, S)` of all that is measured, up to a constant of them all.

    A landmark that is measured and predicted behind the camera has no residual: that is no merit,
    and without it the density is of fewer numbers than another member's. In its place stands the
    least density that a member with the landmark in front gives it, times `BEHIND`. A member that
    has diverged has none.
    """
    assert innovations.covariance is not None, "members in information form have no S"
    assert innovations.log_det is not None, "nor its determinant"
    k, m, p = innovations.residual.shape
    joint = -(innovations.nis + innovations.log_det) / 2
    blocks = innovations.covariance.reshape(k, m, p, m, p)
    blocks = jnp.einsum("kmpmq->kmpq", blocks)
    alone, _ = jax.vmap(jax.vmap(log_density))(innovations.residual, blocks)
    in_front = innovations.used & jnp.isfinite(alone)
    least = jnp.min(jnp.where(in_front, alone, jnp.inf), axis=0)
    instead = jnp.where(jnp.isfinite(least), least + np.log(BEHIND), 0.0)
    behind = jnp.sum(jnp.where(innovations.used, 0.0, instead - alone), axis=1)
    total = joint + behind
    return jnp.where(jnp.isfinite(total), total, -jnp.inf)


def moments(log_weights, means, covariances):
    """Mean and covariance of a sum of Gaussians; one without weight may be anything."""
    weights = jnp.exp(log_weights)
    used = weights > 0
    means = jnp.where(used[:, None], means, 0.0)
    covariances = jnp.where(used[:, None, None], covariances, 0.0)
    mean = weights @ means
    away = means - mean
    spread = away[:, :, None] * away[:, None, :]
    return mean, jnp.tensordot(weights, covariances + spread, axes=1)


def _mixed(innovations: Innovation, log_weights, status) -> Innovation:
    """The sum's innovation: its first two moments, without members that have failed."""
    failed = innovations.status >= Status.NOT_POSITIVE
    healthy = jax.nn.log_softmax(jnp.where(failed, -jnp.inf, log_weights))
    log_weights = jnp.where(jnp.any(failed), healthy, log_weights)
    m, p = innovations.residual.shape[1:]
    residual, covariance = moments(
        log_weights, innovations.residual.reshape(-1, m * p), innovations.covariance
    )
    weights = jnp.exp(log_weights)
    used = jnp.any(innovations.used, axis=0)
    sure = jnp.where(weights[:, None, None] > 0, innovations.predicted, 0.0)
    predicted = jnp.tensordot(weights, sure, axes=1)
    factor = cholesky(covariance)
    whitened = factor.whitening @ residual
    return Innovation(
        predicted, residual.reshape(m, p), covariance, used, whitened @ whitened, status,
        factor.log_det(),
    )  # fmt: skip
