"""What of a pose's error is not one of scale, which pictures alone do not tell.

The truth of another scale, `T(s) = (R, s t)`, explains them as well as the true one, s = 1. The
error against it that is the smallest in the filter's own metric is its error *beyond scale*.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.arrays import AnyArray
from jaxslam.geometry import Pose, Scalar, retract, scaled, zero_tangent
from jaxslam.linalg import cholesky

STEPS = 3
"""Of Gauss–Newton in s: an error that is affine in s, as those of the package are, needs one."""
SCALES = (1e-3, 1e3)
"""Least and greatest s that is tried: a reversed path is best explained by none, s = 0."""
NOTICEABLE = 0.01
"""Displacement from which on it can be said to be reversed, m."""


PoseError = Callable[[Pose], tuple[Float[Array, " t"], Float[Array, "t t"]]]
"""The error against a true T_BC, and its covariance: an `AbstractFilter.pose_error` of a state."""


class BeyondScale(NamedTuple):
    """Of one pose with t degrees of freedom, where `e(s)ᵀ P⁻¹ e(s)` is the smallest."""

    nees: Scalar
    """That smallest value: χ² with t − 1 degrees of freedom for a consistent filter."""
    log_scale: Scalar
    """log ŝ: the estimate's scale relative to the truth's."""
    sigma: Scalar
    """What the filter claims of log ŝ, `(gᵀ P⁻¹ g)^(−1/2)` with g = de/d log s; infinite where
    nothing depends on s."""


def beyond_scale(
    pose_error: PoseError, truth: Pose, truth_sigma: Float[AnyArray, " t"] | None = None
) -> BeyondScale:
    """The smallest NEES over the scale of a true T_BC, of an error and covariance against any.

    P is that against the truth itself (of a Gaussian sum it depends on the pose, a little). Of a
    truth that is itself known with σ only, in the camera's axes, it is `P + J(s) diag(σ²) J(s)ᵀ`,
    J(s) of e(s) by the true pose.
    """
    P = pose_error(truth)[1]
    fixed = cholesky(P).whitening

    def error(s: Scalar, truth: Pose) -> Float[Array, " t"]:
        return pose_error(scaled(truth, s))[0]

    def whitening(s: Scalar) -> Float[Array, "t t"]:
        if truth_sigma is None:
            return fixed
        J = jax.jacfwd(lambda delta: error(s, retract(truth, delta)))(zero_tangent(truth))
        root = J * jnp.asarray(truth_sigma)
        return cholesky(P + root @ root.T).whitening

    def whitened(s: Scalar) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
        """The error against T(s) and its derivative by s, both whitened."""
        W = whitening(s)
        return jax.jvp(lambda s: W @ error(s, truth), (s,), (one,))

    s = one = jnp.ones((), truth.translation().dtype)
    for _ in range(STEPS):
        e, slope = whitened(s)
        curvature = slope @ slope
        step = (slope @ e) / jnp.where(curvature > 0, curvature, 1.0)
        s = jnp.clip(s - step, *SCALES).astype(one.dtype)
    e, slope = whitened(s)
    return BeyondScale(e @ e, jnp.log(s), 1 / (s * jnp.sqrt(slope @ slope)))


def reversal(estimate: Pose, truth: Pose) -> Scalar:
    """1 if the estimated displacement from the origin points away from the true one, else 0; NaN
    unless the true one is `NOTICEABLE`."""
    true = truth.translation()
    against = (estimate.translation() @ true < 0).astype(true.dtype)
    return jnp.where(true @ true > NOTICEABLE**2, against, jnp.nan)
