"""A covariance carried along the gauge when an update has moved the estimate.

An update at x learns nothing along N(x), since H(x) N(x) = 0. The next Jacobians, at the corrected
x⁺, are blind along N(x⁺), another direction: what was unknown would seem partly known. So read
from an error how much of it is gauge, `L` with `L N(x) = I`, and carry that much over:

    M = I + (N(x⁺) − N(x)) L,    P ← M P Mᵀ,    M N(x) = N(x⁺).

With the ordinary Jacobian Φ at x⁺, `Φ* = Φ M` has `Φ* N_{k|k-1} = N_{k+1|k}` (Hesch et al., IJRR
2014), and nothing else in the filter changes. It is the covariance's correction in T-EKF 2 of Hao,
Tian and He (arXiv:2502.05008, 2025).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.linalg import eigh
from jaxslam.models.scale import ScaleGauge
from jaxslam.slam.filter import AtOnce

_SINGULAR = 1e-12
"""Least eigenvalue of NᵀN, its columns of unit length, that counts."""
READINGS = 2
"""Of the scale, each by what the one before says of every number."""
_SUREST = 1e-4
"""Relative error below which none is surer than another."""


def check_metric(slam: Any, remedy: str) -> None:
    """Raise ValueError unless metres are the unit of the filter's state."""
    if isinstance(slam.scale, ScaleGauge):
        raise ValueError(f"{remedy} is for filters without a scale gauge")


def check_undelayed(slam: Any, remedy: str) -> None:
    """Raise ValueError unless landmarks are in the state from their first measurement on."""
    if not isinstance(slam.entry, AtOnce):
        raise ValueError(f"{remedy} is for undelayed landmarks")


def left_inverse(N: Float[Array, "n g"]) -> Float[Array, "g n"]:
    """`(NᵀN)⁻¹ Nᵀ`; without the directions that N does not have."""
    length = jnp.linalg.norm(N, axis=0)
    length = jnp.where(length > 0, length, 1.0)
    N = N / length
    values, vectors = eigh(N.T @ N)
    kept = values > _SINGULAR
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)
    return (vectors * inverse) @ vectors.T @ N.T / length[:, None]


def read_from(N: Float[Array, "n g"], count: int) -> Float[Array, "g n"]:
    """L: the gauge that the first `count` numbers of an error tell."""
    return left_inverse(N.at[count:].set(0.0))


def read_scale_too(
    N: Float[Array, "n h"], frame: Float[Array, "g n"], covariance: Float[Array, "n n"], pose: int
) -> Float[Array, "h n"]:
    """L of a frame that is read from the pose, the first numbers of an error, and of a scale, the
    last column of N: what all others say of it together, each as surely as it says it.

    How surely is the variance that it keeps when the gauge is taken from the error, by a first
    reading in which all count alike: whatever is unknown of the gauge changes no reading. So old
    landmarks count more than new ones, and the velocity of a camera at rest does not.
    """
    scale = N[:, -1]
    size = scale - N[:, :-1] @ (frame @ scale)
    size = jnp.where(jnp.arange(size.size) < pose, 0.0, size)
    L = _with_scale(N, frame, size)
    for _ in range(READINGS):
        left = jnp.maximum(_left(covariance, N, L), 0.0) + (_SUREST * size) ** 2
        L = _with_scale(N, frame, size / jnp.where(left > 0, left, 1.0))
    return L


def _with_scale(
    N: Float[Array, "n h"], frame: Float[Array, "g n"], weights: Float[Array, " n"]
) -> Float[Array, "h n"]:
    """L with `L N = I` whose scale is read by these weights, once the frame is taken away."""
    of_frame, scale = N[:, :-1], N[:, -1]
    row = weights - (weights @ of_frame) @ frame
    total = row @ scale
    row = row / jnp.where(total > 0, total, 1.0)
    return jnp.concatenate([frame - jnp.outer(frame @ scale, row), row[None]])


def _left(
    P: Float[Array, "n n"], N: Float[Array, "n h"], L: Float[Array, "h n"]
) -> Float[Array, " n"]:
    """The variances of `(I − N L) e`."""
    read = P @ L.T
    return jnp.diagonal(P) - 2 * jnp.sum(N * read, axis=1) + jnp.sum((N @ (L @ read)) * N, axis=1)


def carried(
    covariance: Float[Array, "n n"], change: Float[Array, "n g"], L: Float[Array, "g n"]
) -> Float[Array, "n n"]:
    """`M P Mᵀ` with `M = I + change L`, by products of rank g; the change is N(x⁺) − N(x)."""
    left = covariance + change @ (L @ covariance)
    covariance = left + (left @ L.T) @ change.T
    return (covariance + covariance.T) / 2
