"""How far a Gaussian on a pose is from draws of the posterior: moments and KL."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.geometry import Pose, difference, retract
from jaxslam.linalg import cholesky

MEAN_ITERATIONS = 4


def pose_moments(poses: Pose) -> tuple[Pose, Float[Array, "t t"], Float[Array, "s t"]]:
    """Mean of a batch of poses, covariance, and the draws in the right tangent at the mean.

    The mean is the pose at which the draws' tangent vectors have mean zero.
    """
    count = poses.parameters().shape[0]
    mean, draws = mean_pose(poses, jnp.full(count, 1 / count, poses.parameters().dtype))
    return mean, covariance(draws), draws


def mean_pose(poses: Pose, weights: Float[Array, " s"]) -> tuple[Pose, Float[Array, "s t"]]:
    """Mean of poses by weights whose sum is 1, and the poses in the right tangent at it."""

    def tangents(mean):
        return jax.vmap(lambda pose: difference(pose, mean))(poses)

    mean = jax.tree.map(lambda x: x[jnp.argmax(weights)], poses)
    for _ in range(MEAN_ITERATIONS):
        mean = retract(mean, weights @ tangents(mean))
    return mean, tangents(mean)


def covariance(draws: Float[Array, "s k"]) -> Float[Array, "k k"]:
    """Sample covariance of draws."""
    centred = draws - jnp.mean(draws, axis=0)
    return centred.T @ centred / (len(draws) - 1)


def gaussian_divergence(draws: Float[Array, "s k"], P: Float[Array, "k k"]) -> Float[Array, ""]:
    """`KL(N(m, S) ‖ N(0, P))` in nats, m and S the moments of the draws."""
    m, S = jnp.mean(draws, axis=0), covariance(draws)
    factor = cholesky(P)
    log_ratio = factor.log_det() - cholesky(S).log_det()
    return (jnp.trace(factor.solve(S)) + m @ factor.solve(m) - m.size + log_ratio) / 2


def in_base_axes(poses: Pose, estimate: Pose) -> Float[Array, "s t"]:
    """Draws of T_BC less the estimate: position along the axes of B, and `Log(R̂⁻¹ R)`."""

    def one(pose):
        turned = estimate.rotation().inverse() @ pose.rotation()
        moved = pose.translation() - estimate.translation()
        return jnp.concatenate([moved, difference(turned, type(turned).identity())])

    return jax.vmap(one)(poses)


def to_base_axes(estimate: Pose, P: Float[Array, "t t"]) -> Float[Array, "t t"]:
    """The covariance of `in_base_axes` from that of T_BC's right tangent."""
    R = estimate.rotation().as_matrix()
    n = len(R)
    turn = jnp.eye(len(P), dtype=P.dtype).at[:n, :n].set(R)
    return turn @ P @ turn.T
