"""Loops: a landmark of one submap is one of another, and what the whole chain learns of it.

The posterior of the chain's white numbers y, whose prior is N(0, I), is that of a least squares
problem with few residuals c(y) of many numbers. Gauss–Newton is then in the space of the residuals,

    y ← −Jᵀ S⁻¹ (c − J y),   S = J Jᵀ + R,

(the dual form of Bell's step, SIAM J. Optim. 4, 1994), linear in the length of the chain; so is the
covariance `I − Jᵀ S⁻¹ J`. The cost of the maximum says whether the filter's covariances were right.
The filter itself does not change: only where the submaps are, and what is in them, is learnt, and a
loop that turned out wrong is one residual less.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam._numerics.arrays import Number
from jaxslam.filters.association import Candidates, joint_compatibility
from jaxslam.filters.submaps.chain import Chain, OfChain, SubmapMean, base_poses
from jaxslam.geometry import Pose, homogeneous_apply
from jaxslam.linalg import Cholesky, cholesky

STEPS = 20
"""The most steps of Gauss–Newton."""
SMALLEST = 1e-4
"""They end when no white number moves by more than this share of its σ."""
LARGEST = 3.0
"""No white number moves by more σ in one step: a chain that is off by much is curved."""
SAME = 1e-5
"""σ of the distance of a point from itself, as a share of its distance from the camera: none, but
for rounding."""
WIDEST = 9.0
"""Times the variance that a pair's error may have, so three times its σ."""
SUPPOSED = 12
"""Residuals that are as expected, before there is any."""


class Loops(eqx.Module):
    """m pairs of landmarks of two submaps each, which are the same points."""

    submaps: Int[Array, "m 2"]
    """Places in the chain, counted from the oldest submap."""
    slots: Int[Array, "m 2"]
    """The slot of each landmark in the state of its submap."""
    valid: Bool[Array, " m"]
    """A pair that is not says nothing."""


class Posterior(eqx.Module):
    """A chain with what loops say of it."""

    chain: Chain
    states: SubmapMean
    """The submaps at the maximum, a batch."""
    slope: Float[Array, "k N n"]
    """J of the loops' residuals there."""
    factor: Cholesky
    """S of the residuals."""
    cost: Float[Array, ""]
    """Twice the negative logarithm of the posterior at the maximum: χ² of `told` numbers."""
    told: Int[Array, ""]
    """Residuals that say anything."""
    converged: Bool[Array, ""]

    def unit_variance(self, cost: Number = 0.0, told: int = 0) -> Float[Array, ""]:
        """By how much more the chain's variances are than the filter says, given so many further
        residuals of this cost: the variance of unit weight of a least-squares adjustment, 1 before,
        as well known as by `SUPPOSED` residuals, and no less."""
        return jnp.maximum(1.0, (self.cost + cost + SUPPOSED) / (self.told + told + SUPPOSED))

    def marginal(self, function: OfChain) -> tuple[PyTree, Float[Array, "j j"]]:
        """Return mean and covariance of a function of all submaps' states, to first order, the
        covariance as much more as the loops tell."""
        value, rows = self.chain.linearised(function, self.states)
        rows = rows.reshape(len(rows), math.prod(self.chain.shape))
        known = self._known() @ rows.T
        return value, self.unit_variance() * (rows @ rows.T - known.T @ known)

    def cameras(self) -> tuple[Pose, Float[Array, "N t t"]]:
        """Return mean and covariance of all `base_poses`, at a cost that is linear in N."""
        poses, covariances = self.chain.cameras(
            self.states, self._known().reshape(self.slope.shape)
        )
        return poses, self.unit_variance() * covariances

    def _known(self) -> Float[Array, "k Nn"]:
        """What the loops tell, as combinations of the white numbers: `S^(−1/2) J`."""
        return self.factor.whitening @ self.slope.reshape(
            len(self.slope), math.prod(self.chain.shape)
        )


def separation(chain: Chain, loops: Loops, states: SubmapMean) -> Float[Array, "m n"]:
    """The distances of two landmarks each that should be none, as shares of their distance.

    Both are homogeneous points (X, ω) in the camera of the second, compared on the unit sphere
    with ω in units of the second's distance, in the n directions across it: a point at infinity
    has a direction, and no distance.
    """
    poses = base_poses(chain, states)

    def one(submaps, slots):
        def point(k):
            landmark = states.landmarks[submaps[k], slots[k]]
            pose = jax.tree.map(lambda x: x[submaps[k]], poses)
            return pose, *chain.slam.landmark.homogeneous(landmark)

        (T_BP, X_p, w_p), (T_BQ, X_q, w_q) = point(0), point(1)
        distance = jnp.linalg.norm(X_q) / jnp.maximum(jnp.abs(w_q), 1e-6)
        unit = jax.lax.stop_gradient(distance)
        there = homogeneous_apply(T_BQ.inverse() @ T_BP, X_p, w_p)
        first, second = _direction(there, w_p * unit), _direction(X_q, w_q * unit)
        return _across(jax.lax.stop_gradient(second)).T @ (first - second)

    # What is no pair is compared with itself, in the submap that is there for sure.
    there = jnp.where(loops.valid[:, None], loops.submaps, chain.shape[0] - 1)
    values = jax.vmap(one)(there, loops.slots)
    return jnp.where(loops.valid[:, None], values, 0.0)


def _direction(point: Float[Array, " n"], omega: Float[Array, ""]) -> Float[Array, " m"]:
    both = jnp.append(point, omega)
    return both / jnp.linalg.norm(both)


def _across(v: Float[Array, " m"]) -> Float[Array, "m m-1"]:
    """An orthonormal basis of what is orthogonal to a unit vector: Householder's reflection."""
    w = v.at[-1].add(jnp.where(v[-1] < 0, -1.0, 1.0))
    return (jnp.eye(v.size) - 2 * jnp.outer(w, w) / (w @ w))[:, :-1]


def close(chain: Chain, loops: Loops) -> Posterior:
    """Return the chain in which the landmarks of these pairs are the same."""
    return posterior(chain, lambda states: separation(chain, loops, states).ravel(), SAME)


def posterior(
    chain: Chain, residual: Callable[[SubmapMean], Float[Array, " k"]], sigma: float
) -> Posterior:
    """Return the chain in which a residual of all states is zero, but for an error of this σ, at
    the last point where it was linearised: the maximum but for `SMALLEST`."""

    def linear(y: Float[Array, "N n"]) -> tuple[Array, tuple[SubmapMean, Array, Array, Cholesky]]:
        states = chain.at(y)
        value, rows = chain.linearised(residual, states)
        J = rows.reshape(len(value), y.size)
        factor = cholesky(J @ J.T + sigma**2 * jnp.eye(len(value)))
        new = -(J.T @ factor.solve(value - J @ y.ravel())).reshape(y.shape)
        return new, (states, value, rows, factor)

    def step(carry):
        y, _, _, count = carry
        new, at = linear(y)
        farthest = jnp.max(jnp.abs(new - y))
        new = y + jnp.minimum(1.0, LARGEST / farthest) * (new - y)
        return new, at, ~(farthest < SMALLEST), count + 1

    zero = jnp.zeros(chain.shape, chain.links.root.dtype)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(linear, zero)[1])
    start = zero, nothing, jnp.asarray(True), 0
    y, (states, value, rows, factor), moved, _ = jax.lax.while_loop(
        lambda x: x[2] & (x[3] < STEPS), step, start
    )
    cost = jnp.sum(y**2) + jnp.sum((value / sigma) ** 2)
    told = jnp.sum(jnp.any(rows != 0, axis=(1, 2)))
    return Posterior(chain, states, rows, factor, cost, told, ~moved)


def agreeing(known: Posterior, loops: Loops) -> Loops:
    """Return the loops of which those are valid that are jointly compatible with all that is known,
    earlier loops included, and with one another; as much further off as half of them are, as what
    is over-confident is the way round, up to `WIDEST`."""
    m = len(loops.valid)
    value, S = known.marginal(lambda states: separation(known.chain, loops, states).ravel())
    S += SAME**2 * jnp.eye(value.size)
    same = jnp.all(loops.slots[:, None] == loops.slots, axis=-1)
    first = jnp.argmax(same & jnp.all(loops.submaps[:, None] == loops.submaps, axis=-1), axis=1)
    found = Candidates(
        value.reshape(m, -1), S.reshape(m, -1, m, value.size // m), loops.valid, first
    )
    return replace(loops, valid=joint_compatibility(found.widened(WIDEST)))
