"""The matches that agree with the filter and with one another: data association, pure functions.

All that decides is in the innovations of a predicted state: the residuals r of the matches and
their joint covariance S, measurement noise included. What the matches of a set L say of another
one is the conditional Gaussian

    r_i | r_L ~ N(S_iL S_LL⁻¹ r_L, S_ii − S_iL S_LL⁻¹ S_Li),

so that a hypothesis is tried without an update of the state, and its gate is as wide as what is
still unknown when the hypothesis is true. A landmark that was found in two places has two matches:
at most one of them is believed, as they differ by more than their noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import AnyArray, Number
from jaxslam.filters.gaussian import context_of
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.covariance import curvature, local_covariance
from jaxslam.filters.protocol import AbstractStaged, Belief
from jaxslam.linalg import cholesky
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features, Slots

GATE = 0.99
"""Share of true matches that a test lets through."""
TOLERANCE = 1.5
"""σ of what cameras and trackers of features do beyond their noise, in that."""
STARTS = 8
"""The most first matches that `sequential` tries."""
ENOUGH = 0.8
"""The share of matches that agree with a first one after which it tries no other."""
MOST_NODES = 1000
"""The most nodes of the tree of `joint_compatibility`, which grows exponentially with wrong
matches."""


class Candidates(NamedTuple):
    """m matches of p numbers each, as innovations of one predicted Gaussian."""

    residual: Float[AnyArray, "m p"]
    covariance: Float[AnyArray, "m p m p"]
    """S of all."""
    valid: Bool[AnyArray, " m"]
    landmark: Int[AnyArray, " m"]
    """The landmark of which each is a match: a number below m."""

    @property
    def gate(self) -> float:
        """χ² of one match."""
        return float(_chi2_quantile(self.residual.shape[1]))

    def distances(self) -> Float[Array, " m"]:
        """Squared Mahalanobis distance of each by itself; infinite of what is not valid."""
        own = jnp.einsum("mpmq->mpq", self.covariance)
        return jnp.where(self.valid, _squared(self.residual, own), jnp.inf)

    def without(self, match: Int[Array, ""]) -> Candidates:
        """The others, given that this one is true."""
        S = self.covariance
        gain = S[:, :, match] @ _inverse(S[match, :, match])
        residual = self.residual - gain @ self.residual[match]
        valid = self.valid & (self.landmark != self.landmark[match])
        return Candidates(residual, _eliminated(S, match), valid, self.landmark)

    def widened(self, most: float) -> Candidates:
        """The same with S as many times as large as half of the matches tell, up to `most` times:
        of a filter that may be over-confident of what all matches have in common."""
        half = jnp.nanmedian(jnp.where(self.valid, self.distances(), jnp.nan))
        times = jnp.nan_to_num(half / _chi2_quantile(self.residual.shape[1], 0.5), nan=1.0)
        return self._replace(covariance=jnp.clip(times, 1.0, most) * self.covariance)

    def best_of_each(self, distances: Float[Array, "*k m"]) -> Float[Array, "*k m"]:
        """The least of each landmark, infinite of a number that has none."""
        least = jax.vmap(lambda row: jax.ops.segment_min(row, self.landmark, len(self.landmark)))
        return least(distances.reshape(-1, len(self.landmark))).reshape(distances.shape)


Association = Callable[[Candidates], Bool[Array, " m"]]
"""Which candidates are believed."""


def candidates(
    slam: AbstractStaged,
    state: Belief,
    control: Control,
    features: Features,
    tolerance: Number | Float[AnyArray, " p"] | Float[AnyArray, "m p"] = 0.0,
    *,
    curved: bool = False,
) -> Candidates:
    """The innovations of features of a predicted state that is one Gaussian.

    `tolerance` is a σ by which each may be off beyond its noise, in the units of a measurement: one
    for all numbers, one for each of p, or those of each of m measurements.
    Of a `curved` measurement, the covariance has the terms of second order of each match by
    itself, where a `Slam` gives them: what depth does to it, of a camera that may have started
    in any direction.
    Raises ValueError for a filter whose innovations have no covariance.
    """
    _, innovation = slam.update(state, control, features)
    if innovation.covariance is None:
        raise ValueError(
            f"matches of {type(slam).__name__} cannot be tested: its innovations have no covariance"
        )
    m, p = innovation.residual.shape
    S = innovation.covariance
    variances = jnp.broadcast_to(jnp.asarray(tolerance, S.dtype) ** 2, (m, p)).ravel()
    S += variances * jnp.eye(m * p, dtype=S.dtype)
    S = S.reshape(m, p, m, p)
    if curved and isinstance(slam, AbstractSlam):
        i = jnp.arange(m)
        S = S.at[i, :, i].add(second_order(slam, state, control, features.slots))
    first_alike = jnp.argmax(features.slots == features.slots[:, None], axis=1)
    return Candidates(innovation.residual, S, innovation.used, first_alike)


def second_order(
    slam: AbstractSlam, state: Belief, control: Control, slots: Slots
) -> Float[Array, "m p p"]:
    """`½ tr(∂²h_a Q ∂²h_b Q)`, Q of what one measurement depends on (Bar-Shalom, Li, Kirubarajan,
    *Estimation with Applications to Tracking and Navigation*, 2001, §10.3.2)."""
    context = context_of(slam, control)
    hessian, local = curvature(slam.model, state, slots, context)
    Q = local_covariance(state, local, slots)
    HQ = jnp.einsum("mpij,mjk->mpik", hessian, Q)
    return jnp.einsum("mpij,mqji->mpq", HQ, HQ) / 2


def everything(found: Candidates) -> Bool[Array, " m"]:
    """All that was found."""
    return found.valid


def individual(found: Candidates) -> Bool[Array, " m"]:
    """The matches that are within their own ellipses."""
    return found.distances() < found.gate


def one_point_ransac(found: Candidates) -> Bool[Array, " m"]:
    """1-point RANSAC (Civera, Grasa, Davison, Montiel, JFR 2010), with every hypothesis tried.

    One match and the filter's prior are a complete hypothesis. The one with which most agree, and
    all these; then what agrees with these together.
    """
    votes = _distances_given_one(found) < found.gate
    low = votes[jnp.argmax(jnp.sum(votes, axis=1))]
    return low | (found.valid & (_distances_given(found, low) < found.gate))


def sequential(found: Candidates) -> Bool[Array, " m"]:
    """The match with which the others agree best, then always the one that fits best to all so
    far, as long as one fits. Then each is tested against all the others (Baarda's data snooping)
    and the worst put out until all pass, and what fits to these comes in: a first match that was
    wrong does not stay, nor what it kept out.

    From other starts the same, until most matches agree; the set with the most is the one.
    """
    distances = found.best_of_each(_distances_given_one(found))
    firsts = jnp.argsort(jnp.sum(jnp.minimum(distances, found.gate), axis=1))[:STARTS]
    enough = ENOUGH * jnp.sum(jnp.isfinite(found.best_of_each(found.distances())))

    def another(state):
        start, best = state
        kept = _grown_from(found, firsts[start])
        return start + 1, jnp.where(jnp.sum(kept) > jnp.sum(best), kept, best)

    def wanted(state):
        start, best = state
        return (start < firsts.size) & (jnp.sum(best) < enough)

    none = jnp.zeros_like(found.valid)
    return jax.lax.while_loop(wanted, another, (jnp.zeros((), int), none))[1]


def joint_compatibility(found: Candidates) -> Bool[Array, " m"]:
    """The largest set that is jointly compatible, `r_Lᵀ S_LL⁻¹ r_L < χ²(p |L|)`, by branch and
    bound (JCBB: Neira, Tardós, 2001).

    Matches are tried from the best fitting on, each first in and then out. The search ends after
    `MOST_NODES` nodes, with the best set until then.
    """
    m, p = found.residual.shape
    alone = found.distances()
    order = jnp.argsort(alone)
    within = (alone < found.gate)[order]
    S = found.covariance[order][:, :, order]
    ordered = Candidates(found.residual[order], S, within, found.landmark[order])
    bounds = jnp.asarray(_chi2_quantile(p * np.arange(1, m + 1)), found.residual.dtype)

    def step(node: _Node) -> _Node:
        W, square = _whitened(ordered, node)
        total = jnp.sum(node.squares, where=node.taken) + square
        fits = within[node.depth] & (total < bounds[jnp.sum(node.taken)])
        taken = node.taken.at[node.depth].set(fits)
        better = fits & (jnp.sum(taken) > jnp.sum(node.best))
        best = jnp.where(better, taken, node.best)
        squares = node.squares.at[node.depth].set(square)
        depth, taken = _next_branch(node.depth + 1, taken, within, jnp.sum(best))
        return _Node(depth, taken, W, squares, best, node.count + 1)

    none, zero = jnp.zeros(m, bool), jnp.zeros((), int)
    nothing = jnp.zeros_like(ordered.residual)
    W = jnp.zeros((m * p, m * p), nothing.dtype)
    start = _Node(zero, none, W, nothing[:, 0], none, zero)
    last = jax.lax.while_loop(lambda x: (x.depth < m) & (x.count < MOST_NODES), step, start)
    return none.at[order].set(last.best)


ASSOCIATIONS: dict[str, Association] = {
    "all": everything,
    "individual": individual,
    "ransac": one_point_ransac,
    "jcbb": joint_compatibility,
    "sequential": sequential,
}
"""By name."""


class _Node(NamedTuple):
    """A node of the search of `joint_compatibility`: the matches before `depth` are in or out."""

    depth: Int[Array, ""]
    taken: Bool[Array, " m"]
    whitening: Float[Array, "m*p m*p"]
    """`S_LL^(-1/2)` in the rows of what is taken."""
    squares: Float[Array, " m"]
    """What each added to the distance of those before it."""
    best: Bool[Array, " m"]
    count: Int[Array, ""]


def _whitened(found: Candidates, node: _Node):
    """The whitening with the rows of the match at `depth` too, and what it adds to the distance."""
    m, p = found.residual.shape
    W = jnp.where(jnp.repeat(node.taken, p)[:, None], node.whitening, 0.0)
    across = W @ found.covariance[:, :, node.depth].reshape(m * p, p)
    own = found.covariance[node.depth, :, node.depth] - across.T @ across
    place = jax.nn.one_hot(node.depth * p + jnp.arange(p), m * p, dtype=W.dtype)
    rows = cholesky(own).whitening @ (place - across.T @ W)
    W = jax.lax.dynamic_update_slice_in_dim(W, rows, node.depth * p, 0)
    return W, jnp.sum((rows @ found.residual.ravel()) ** 2)


def _next_branch(depth, taken, within, most):
    """Go back to the last match that was in, and put it out, until more than `most` are possible;
    the depth is m where they never are."""
    m = taken.size
    still = jnp.append(jnp.cumsum(within[::-1])[::-1], 0)

    def hopeless(branch):
        depth, taken = branch
        return jnp.sum(taken) + still[depth] <= most

    def back(branch):
        last = m - 1 - jnp.argmax(branch[1][::-1])
        return last + 1, branch[1].at[last].set(False)

    branch = jax.lax.while_loop(lambda b: hopeless(b) & jnp.any(b[1]), back, (depth, taken))
    return jnp.where(hopeless(branch), m, branch[0]), branch[1]


def _grown_from(found: Candidates, first: Array) -> Bool[Array, " m"]:
    """The matches that `sequential` keeps from one start."""
    begun = jnp.zeros_like(found.valid).at[first].set(found.valid[first])
    kept = _snooped(found, _grown(found.without(first), begun))
    return _snooped(found, kept | (found.valid & (_distances_given(found, kept) < found.gate)))


def _grown(rest: Candidates, kept: Bool[Array, " m"]) -> Bool[Array, " m"]:
    """The matches `kept` and, one after the other, the best of the rest as long as one fits."""

    def added(state):
        rest, kept = state
        best = jnp.argmin(rest.distances())
        return rest.without(best), kept.at[best].set(True)

    def fits(state):
        return jnp.any(state[0].distances() < rest.gate)

    return jax.lax.while_loop(fits, added, (rest, kept))[1]


def _distances_given_one(found: Candidates) -> Float[Array, "m m"]:
    """`[j, i]`: of match i, given that match j is true; zero of itself."""
    S, r = found.covariance, found.residual
    own = jnp.einsum("mpmq->mpq", S)
    inverse = jax.vmap(_inverse)(own)
    gain = jnp.einsum("ipjq,jqr->jipr", S, inverse)
    left = r - jnp.einsum("jipr,jr->jip", gain, r)
    covariance = own - jnp.einsum("jipr,iqjr->jipq", gain, S)
    squared = jax.vmap(_squared)(left, covariance)
    squared = jnp.where(jnp.eye(len(r), dtype=bool), 0.0, squared)
    return jnp.where(found.valid & found.valid[:, None], squared, jnp.inf)


def _distances_given(found: Candidates, believed: Bool[Array, " m"]) -> Float[Array, " m"]:
    """The distances of all, given that the believed are true; meaningless for the believed."""
    m, p = found.residual.shape
    S, r = found.covariance.reshape(m * p, m * p), found.residual.ravel()
    known = jnp.repeat(believed, p)
    factor = cholesky(jnp.where(known & known[:, None], S, jnp.eye(m * p, dtype=S.dtype)))
    half = factor.whitening @ jnp.where(known[:, None], S, 0.0)
    left = r - half.T @ (factor.whitening @ jnp.where(known, r, 0.0))
    half = half.reshape(m * p, m, p)
    own = jnp.einsum("mpmq->mpq", found.covariance) - jnp.einsum("kmp,kmq->mpq", half, half)
    return _squared(left.reshape(m, p), own)


def _snooped(found: Candidates, kept: Bool[Array, " m"]) -> Bool[Array, " m"]:
    """Those left after the worst of them, given all the others, is put out while it fails.

    With Λ = S_LL⁻¹, the distance of i given L without i is `uᵢᵀ Λᵢᵢ⁻¹ uᵢ`, u = Λ r; to put it out
    is to eliminate its block of Λ.
    """
    m, p = found.residual.shape
    known = jnp.repeat(kept, p)
    S = found.covariance.reshape(m * p, m * p)
    factor = cholesky(jnp.where(known & known[:, None], S, jnp.eye(m * p, dtype=S.dtype)))
    information = factor.inverse().reshape(m, p, m, p)

    def distances(state):
        information, kept = state
        r = jnp.where(kept[:, None], found.residual, 0.0)
        u = jnp.einsum("ipjq,jq->ip", information, r)
        squared = _squared(u, jnp.einsum("mpmq->mpq", information))
        return jnp.where(kept, squared, -jnp.inf)

    def put_out(state):
        information, kept = state
        worst = jnp.argmax(distances(state))
        return _eliminated(information, worst), kept.at[worst].set(False)

    def fails(state):
        return jnp.any(distances(state) > found.gate)

    return jax.lax.while_loop(fails, put_out, (information, kept))[1]


def _eliminated(A: Float[Array, "m p m p"], match: Int[Array, ""]) -> Float[Array, "m p m p"]:
    """`A − A_:i A_ii⁻¹ A_i:`."""
    across = A[:, :, match]
    gain = across @ _inverse(A[match, :, match])
    return A - jnp.einsum("mpq,nrq->mpnr", gain, across)


def _inverse(A: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """The inverse of a positive A; NaN for any other."""
    return cholesky(A).inverse()


def _squared(r: Float[Array, "m p"], S: Float[Array, "m p p"]) -> Float[Array, " m"]:
    """`rᵀ S⁻¹ r`; infinite where S is not positive."""
    squared = jax.vmap(lambda r, S: jnp.sum((cholesky(S).whitening @ r) ** 2))(r, S)
    return jnp.where(jnp.isnan(squared), jnp.inf, squared)


def _chi2_quantile(dof: int | np.ndarray, share: float = GATE) -> np.ndarray | np.floating:
    """The χ² value below which a true match is with this probability."""
    return 2 * scipy.special.gammaincinv(np.asarray(dof) / 2, share)
