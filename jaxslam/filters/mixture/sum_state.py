"""Weighted members of a Gaussian sum: their moments, their likelihoods, and their innovation."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.filters.mixture.density import log_density
from jaxslam.filters.protocol import Belief, Corrected
from jaxslam.linalg import cholesky
from jaxslam.models.observations import Innovation, Status

BEHIND = 1e-4
"""What a member, by its mean sure that a landmark is behind the camera, leaves for its being seen;
as much as a residual of four σ has beyond it."""


class SumState(eqx.Module):
    """The members' states, a batch, and the logarithms of their weights."""

    members: Belief
    log_weights: Float[Array, " members"]

    @property
    def alive(self) -> Bool[Array, " members"]:
        """Members that weigh anything."""
        return jnp.isfinite(self.log_weights)

    @property
    def likeliest(self) -> Belief:
        """The state of the member of the greatest weight."""
        return member(self.members, jnp.argmax(self.log_weights))


def member(members: PyTree, k: int | slice | Int[Array, ""]) -> PyTree:
    """The k-th of a batch, or those of a slice."""
    return jax.tree.map(lambda x: x[k], members)


def weighed(
    members: Belief, log_weights: Float[Array, " members"], innovations: Innovation
) -> Corrected:
    """The members weighed by the likelihoods of their innovations, and the sum's innovation."""
    after = jax.nn.log_softmax(log_weights + log_likelihoods(innovations))
    # The sum fails with the likeliest member, as one that has failed is weighed no more.
    status = innovations.status[jnp.argmax(after)]
    return SumState(members, after), mixed(innovations, log_weights, status)


def log_likelihoods(innovations: Innovation) -> Float[Array, " members"]:
    """The `log N(r; 0, S)` of all that is measured, member by member, up to a common constant.

    A landmark that is measured and predicted behind the camera has no residual: that is no merit,
    and without it the density is of fewer numbers than another member's. In its place stands the
    least density that a member with the landmark in front gives it, times `BEHIND`. A member that
    has diverged has none.
    """
    assert innovations.covariance is not None, "a sum weighs its members by S"
    assert innovations.log_det is not None, "and by its determinant"
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


def moments(
    log_weights: Float[Array, " k"], means: Float[Array, "k n"], covariances: Float[Array, "k n n"]
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Mean and covariance of a sum of Gaussians; one without weight may be anything."""
    weights = jnp.exp(log_weights)
    used = weights > 0
    means = jnp.where(used[:, None], means, 0.0)
    covariances = jnp.where(used[:, None, None], covariances, 0.0)
    mean = weights @ means
    away = means - mean
    spread = away[:, :, None] * away[:, None, :]
    return mean, jnp.tensordot(weights, covariances + spread, axes=1)


def mixed(
    innovations: Innovation, log_weights: Float[Array, " members"], status: Int[Array, ""]
) -> Innovation:
    """The sum's innovation: its first two moments, without members that have failed."""
    assert innovations.covariance is not None, "a sum weighs its members by S"
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
