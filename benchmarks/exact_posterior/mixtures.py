"""How far a sum of Gaussians on a pose is from draws of the posterior: cross-entropy and KL.

Densities are those of the right tangent at a Gaussian's own mean. The tangents at two means have
the same volume but for the square of the angle between a draw and the mean.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import digamma, gammaln, logsumexp
from jaxtyping import Array, Float, Int

from exact_posterior.moments import covariance, mean_pose, pose_moments
from jaxslam.filters.mixture.density import log_density
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import camera_pose
from jaxslam.filters.slam import Slam
from jaxslam.geometry import Pose, difference
from jaxslam.linalg import cholesky

NEIGHBOUR = 8
"""Whose distance the entropy is estimated by; more than the copies that draws may have."""


class PoseMixture(eqx.Module):
    """`Σ w_i N(T_i, P_i)`: Gaussians on a pose, by right perturbations."""

    means: Pose
    """T_i, a batch of m."""
    covariances: Float[Array, "m t t"]
    """P_i: position in camera axes, m, then orientation, rad."""
    weights: Float[Array, " m"]
    """They sum to 1."""


def filter_mixture(slam: AbstractFilter, state: Any) -> PoseMixture:
    """T_BC as a filter has it: a Gaussian of every member of its sum; of another filter, one."""
    if isinstance(slam, Slam) and slam.mixture is not None:
        members = state if slam.start is None else state.sum
        of_member = jax.vmap(partial(camera_pose, slam.one))
        return PoseMixture(*of_member(members.members), jnp.exp(members.log_weights))
    mean, P = jax.tree.map(lambda x: x[None], camera_pose(slam, state))
    return PoseMixture(mean, P, jnp.ones(1, P.dtype))


def component_log_densities(mixture: PoseMixture, poses: Pose) -> Float[Array, "s m"]:
    """`log w_i N(T ⊟ T_i; 0, P_i)` of every pose T and every Gaussian."""

    def one(mean, P, weight, pose):
        value, _ = log_density(difference(pose, mean), P)
        constant = len(P) / 2 * math.log(2 * math.pi)
        return jnp.where(weight > 0, jnp.log(weight) + value - constant, -jnp.inf)

    of_pose = jax.vmap(one, in_axes=(0, 0, 0, None))
    return jax.vmap(partial(of_pose, mixture.means, mixture.covariances, mixture.weights))(poses)


def cross_entropy(draws: Pose, mixture: PoseMixture) -> Float[Array, ""]:
    """`−E log q` over the draws, q the mixture's density; nats."""
    return -jnp.mean(logsumexp(component_log_densities(mixture, draws), axis=1))


def entropy(draws: Float[Array, "s k"], neighbour: int = NEIGHBOUR) -> Float[Array, ""]:
    """`−E log p` of the density p that the draws are from, by the distances of neighbours.

    The estimate of Kozachenko and Leonenko (1987) after whitening by the draws' covariance:
    `ψ(s) − ψ(k) + log c + n E log d`, d the distance to the k-th neighbour and c the volume of the
    unit ball in n dimensions. Of a few hundred draws it is right to about 0.1. Raises
    ValueError unless there are more draws than `neighbour`.
    """
    count, n = draws.shape
    if not 1 <= neighbour < count:
        raise ValueError(
            f"neighbour must be 1 to {count - 1}, one less than draws, not {neighbour}"
        )
    factor = cholesky(covariance(draws))
    white = draws @ factor.whitening.T

    def log_distance(draw):
        squared = jnp.sum((white - draw) ** 2, axis=1)
        return jnp.log(-jax.lax.top_k(-squared, neighbour + 1)[0][-1]) / 2

    ball = n / 2 * math.log(math.pi) - gammaln(n / 2 + 1)
    near = jnp.mean(jax.lax.map(log_distance, white, batch_size=64))
    return digamma(count) - digamma(neighbour) + ball + n * near + factor.log_det() / 2


def mixture_divergence(draws: Pose, mixture: PoseMixture) -> Float[Array, ""]:
    """`KL(p ‖ q)` in nats, p the density of the draws and q the mixture's."""
    _, _, tangents = pose_moments(draws)
    return cross_entropy(draws, mixture) - entropy(tangents)


def mixture_of_modes(draws: Pose, labels: Int[Array, " s"], count: int) -> PoseMixture:
    """The sum of Gaussians with weight, mean and covariance of the draws of each label: the best
    that a filter with so many Gaussians, one for a mode, could have.

    A label of no draws has weight 0; one of fewer than the pose has degrees of freedom has no
    covariance of full rank, and the mixture no density.
    """

    def one(label):
        of_label = (labels == label).astype(draws.parameters().dtype)
        share = jnp.mean(of_label)
        own = of_label / jnp.maximum(jnp.sum(of_label), 1)
        mean, away = mean_pose(draws, own)
        return mean, (away * own[:, None]).T @ away, share

    return PoseMixture(*jax.vmap(one)(jnp.arange(count)))
