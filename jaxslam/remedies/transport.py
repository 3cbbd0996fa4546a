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


def check_plain(slam: Any, remedy: str) -> None:
    """Raise ValueError unless the filter has undelayed landmarks and metres for its unit."""
    if isinstance(slam.scale, ScaleGauge):
        raise ValueError(f"{remedy} is for filters without a scale gauge, which needs no remedy")
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


def carried(
    covariance: Float[Array, "n n"], change: Float[Array, "n g"], L: Float[Array, "g n"]
) -> Float[Array, "n n"]:
    """`M P Mᵀ` with `M = I + change L`, by products of rank g; the change is N(x⁺) − N(x)."""
    left = covariance + change @ (L @ covariance)
    covariance = left + (left @ L.T) @ change.T
    return (covariance + covariance.T) / 2
