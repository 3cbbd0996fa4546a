"""The base of delayed initialisations: Bayes' rule on the alternative depths of a landmark."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.filters.ekf import AbstractEntry, EkfSlam
from jaxslam.geometry import Scalar
from jaxslam.landmarks import CARTESIAN
from jaxslam.landmarks.parametrization import Parametrization


def with_entry(slam: EkfSlam, entry: AbstractEntry, landmark: Parametrization) -> EkfSlam:
    """The filter with a delayed entry, which writes a Cartesian point as `landmark`.

    Raises ValueError where the filter's landmarks are not Cartesian, or have no depth to find.
    """
    if not slam.form.plain:
        raise ValueError("a delayed initialisation is for filters in covariance form")
    if slam.landmark is not CARTESIAN:
        raise ValueError(
            f"a delayed initialisation ends in cartesian landmarks, not {slam.landmark.name}"
        )
    if slam.sensor.hidden != 1:
        raise ValueError(
            f"a delayed initialisation finds the depth that a camera hides; "
            f"{type(slam.sensor).__name__} hides none"
        )
    return replace(slam, landmark=landmark, entry=entry)


def check_range(nearest: float, farthest: float) -> None:
    """Raise ValueError unless both are depths, in order."""
    if not 0 < nearest < farthest:
        raise ValueError(
            f"depths need 0 < nearest < farthest, not nearest {nearest} and farthest {farthest}"
        )


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


def reweighted(
    weights: Float[Array, "m k"], log_likelihood: Float[Array, "m k"]
) -> Float[Array, "m k"]:
    """Bayes' rule on k alternatives; weights stay as they are where none has a likelihood."""
    best = jnp.max(jnp.where(weights > 0, log_likelihood, -jnp.inf), axis=1, keepdims=True)
    possible = jnp.isfinite(best)
    product = weights * jnp.exp(log_likelihood - jnp.where(possible, best, 0.0))
    total = jnp.sum(product, axis=1, keepdims=True)
    possible &= total > 0
    return jnp.where(possible, product / jnp.where(possible, total, 1.0), weights)
