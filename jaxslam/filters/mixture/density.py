"""The density of a small Gaussian, of which there are many."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.geometry import Scalar


def log_density(
    residual: Float[Array, " p"], covariance: Float[Array, "p p"]
) -> tuple[Scalar, Scalar]:
    """`log N(r; 0, S)` without its constant, and `rᵀ S⁻¹ r`.

    One coordinate after another, each given those before it: S is tiny and there are many.
    """
    zero = jnp.zeros((), residual.dtype)
    squared, log_determinant = zero, zero
    while residual.size:
        (first, *_), variance = residual, covariance[0, 0]
        squared += first**2 / variance
        log_determinant += jnp.log(variance)
        gain = covariance[1:, 0] / variance
        residual = residual[1:] - gain * first
        covariance = covariance[1:, 1:] - jnp.outer(gain, covariance[0, 1:])
    return -(squared + log_determinant) / 2, squared
