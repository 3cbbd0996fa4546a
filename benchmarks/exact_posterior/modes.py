"""Which mode of a posterior a draw belongs to, and how much of the posterior every mode has."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float

from exact_posterior.mixtures import PoseMixture
from exact_posterior.moments import covariance
from jaxslam.geometry import Pose
from jaxslam.linalg import cholesky, eigh

LEAST_SHARE = 0.05
"""Of the draws, that make a mode one to speak of."""
DEEPEST_VALLEY = 0.5
"""Two sides are two modes where the density between them is at most this share of the lesser's."""
ITERATIONS = 20
"""Of the division in two."""


def reversed_draws(T_BC: Pose) -> Bool[Array, " s"]:
    """Which draws of a pose lie on the other side of the origin than most of them do.

    The pixels of (t, v, ω) are those of −(t, v, ω), so that a mode which rivals the best one has
    its displacement reversed. The sides are those of the line that displacements are nearest to.
    """
    return T_BC.translation() @ main_direction(T_BC) < 0


def main_direction(T_BC: Pose) -> Float[Array, " n"]:
    """Unit vector along the line that displacements are nearest to, to the side of most draws."""
    displacements = T_BC.translation()
    _, axes = eigh(displacements.T @ displacements / len(displacements))
    axis = axes[:, -1]
    return jnp.where(jnp.mean(displacements @ axis < 0) > 0.5, -axis, axis)


def share_against(mixture: PoseMixture, direction: Float[Array, " n"]) -> Float[Array, ""]:
    """How much of a sum of Gaussians has a displacement t of `tᵀd < 0`, d the direction.

    A right perturbation moves t by the mean's rotation of it, to first order.
    """
    n = direction.size
    along = mixture.means.translation() @ direction
    turned = jnp.einsum("kij,i->kj", mixture.means.rotation().as_matrix(), direction)
    variance = jnp.einsum("ki,kij,kj->k", turned, mixture.covariances[:, :n, :n], turned)
    shares = ndtr(-along / jnp.sqrt(variance))
    return jnp.sum(jnp.where(mixture.weights > 0, mixture.weights * shares, 0.0))


def halves(tangents: Float[Array, "s k"]) -> Bool[Array, " s"]:
    """Which draws are in the lesser of two groups, each of which is nearest to its own mean.

    Distances are those of Mahalanobis by the covariance of all draws: by them the best division in
    two is across the modes, if there are two that are well apart, whatever the units. The best of
    those that begin at either side of 0 in each coordinate.
    """
    centred = tangents - jnp.mean(tangents, axis=0)
    white = centred @ cholesky(covariance(tangents)).whitening.T
    groups, costs = jax.vmap(lambda start: _divided(white, start), in_axes=1)(white > 0)
    return _lesser(groups[jnp.argmin(costs)])


def _divided(
    points: Float[Array, "s k"], start: Bool[Array, " s"]
) -> tuple[Bool[Array, " s"], Float[Array, ""]]:
    """Two means from a first division, and the mean squared distance to them."""

    def squared(group):
        return jnp.sum((points - _mean(points, group)) ** 2, axis=1)

    def nearer(_, group):
        return squared(group) < squared(~group)

    group = jax.lax.fori_loop(0, ITERATIONS, nearer, start)
    return group, jnp.mean(jnp.minimum(squared(group), squared(~group)))


def _lesser(group: Bool[Array, " s"]) -> Bool[Array, " s"]:
    return group ^ (jnp.mean(group) > 0.5)


def _mean(points: Float[Array, "s ..."], group: Bool[Array, " s"]) -> Array:
    weights = group / jnp.maximum(jnp.sum(group), 1)
    return weights.astype(points.dtype) @ points


def valley(points: Float[Array, "s k"], group: Bool[Array, " s"]) -> Float[Array, ""]:
    """Density half-way between the means of a group and of the rest over that at the group's; 0 for
    two sharp modes, and about 1 or more where there is but one.

    Counted along the line through both, in windows of a third of their distance.
    """
    line = _mean(points, ~group) - _mean(points, group)
    along = points @ line / jnp.maximum(line @ line, jnp.finfo(points.dtype).tiny)
    start = _mean(along, group)

    def near(centre):
        return jnp.mean(jnp.abs(along - start - centre) < 1 / 6)

    return near(0.5) / jnp.maximum(near(0.0), 1 / along.size)


def second_mode(points: Float[Array, "s k"], group: Bool[Array, " s"]) -> Float[Array, ""]:
    """Weight of a group of draws as a mode; 0 where no valley is between it and the rest."""
    apart = valley(points, group) <= DEEPEST_VALLEY
    return jnp.where(apart, jnp.mean(group, dtype=points.dtype), 0.0)
