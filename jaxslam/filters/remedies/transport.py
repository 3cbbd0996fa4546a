"""A covariance carried along the gauge when an update has moved the estimate.

An update at x learns nothing along N(x), since H(x) N(x) = 0. The next Jacobians, at the corrected
x⁺, are blind along N(x⁺), another direction: what was unknown would seem partly known. So read
from an error how much of it is gauge, `L` with `L N(x) = I`, and carry that much over:

    M = I + (N(x⁺) − N(x)) L,    P ← M P Mᵀ,    M N(x) = N(x⁺).

With the ordinary Jacobian Φ at x⁺, `Φ* = Φ M` has `Φ* N_{k|k-1} = N_{k+1|k}` (Hesch et al., IJRR
2014), and nothing else in the filter changes. For Cartesian landmarks in the base frame M is the
`T(x⁺)⁻¹ T(x)` of Hao, Tian and He (arXiv:2502.05008, 2025), whose error `T(x) δ` has a constant N.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.linalg import eigh

_SINGULAR = 1e-12
"""Least eigenvalue of NᵀN, its columns of unit length, that counts."""
READINGS = 2
"""Estimates of the scale from landmarks, after a first one in which all count alike."""
_SUREST = 1e-4
"""Relative error below which none is surer than another."""


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
    """The gauge L that is read from the first `count` numbers of an error."""
    return left_inverse(N.at[count:].set(0.0))


def read_scale_too(
    N: Float[Array, "n h"],
    frame: Float[Array, "g n"],
    covariance: Float[Array, "n n"],
    velocity: slice,
    landmarks: slice,
) -> Float[Array, "h n"]:
    """L of a frame that is read from the pose, and of a scale, the last column of N: as far as the
    camera moves it is read from its velocity, else from the landmarks.

    Landmarks count by the variance that they keep when the gauge is taken from their errors, and
    the velocity by what it keeps across itself: whatever is unknown of the gauge changes no
    reading. (To count everything by its variance is measurably worse than the velocity alone.)
    """
    scale, place = N[:, -1], jnp.arange(N.shape[0])
    size = scale - N[:, :-1] @ (frame @ scale)

    def of(part: slice, weight: Array | float = 1.0) -> Float[Array, "h n"]:
        inside = (place >= part.start) & (place < part.stop)
        return _with_scale(N, frame, jnp.where(inside, size / weight, 0.0))

    by_landmarks = of(landmarks)
    for _ in range(READINGS):
        left = jnp.maximum(_left(covariance, N, by_landmarks), 0.0) + (_SUREST * size) ** 2
        by_landmarks = of(landmarks, jnp.where(left > 0, left, 1.0))
    by_velocity, speed = of(velocity), jnp.sum(size[velocity] ** 2)
    unknown = jnp.sum(_left(covariance, N, by_velocity)[velocity])
    moves = speed / jnp.where(speed > 0, speed + jnp.maximum(unknown, 0.0), 1.0)
    return moves * by_velocity + (1 - moves) * by_landmarks


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
