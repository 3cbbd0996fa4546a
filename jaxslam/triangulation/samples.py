"""Distributions of a point as samples: how they are drawn, and how far they are from one another.

Everything here is of one point (x, z), in metres, and exact for the samples at hand.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Float, Int, UInt32

from jaxslam.triangulation.views import NOISE_DIM

Values = Float[np.ndarray, " n"]
Sampler = Callable[[Any, Any, Array], tuple[Array, Array, Array]]
"""`sampler(choice, data, normal)`: from standard normal numbers, a homogeneous point (X, ω) and
the logarithm of its weight. The choice is hashable and compiled in; the data are arrays."""

_CHUNK = 2**16
"""Samples that are computed at once: memory beyond the result is bounded by it."""


class Samples(NamedTuple):
    """Points in the second camera; one at or beyond infinity has infinite coordinates."""

    x: Values
    z: Values
    weight: Values

    @property
    def beyond_infinity(self) -> float:
        """Share of the points that are at infinity or beyond (ω ≤ 0)."""
        return float(self.weight[np.isinf(self.z)].sum() / self.weight.sum())

    @property
    def effective(self) -> float:
        """The effective number of samples, `(Σw)² / Σw²`."""
        return float(self.weight.sum() ** 2 / (self.weight**2).sum())


class Marginal(NamedTuple):
    """The distribution of one coordinate: the share of it up to and with each sorted value."""

    values: Values
    shares: Values


class Distance(NamedTuple):
    """The distance between two distributions of one coordinate."""

    ks: float
    """Kolmogorov and Smirnov's: the largest difference of the distribution functions."""
    wasserstein: float
    """Wasserstein-1: the area between the distribution functions, m."""


def draw(sampler: Sampler, choice: Any, data: Any, count: int, seed: int) -> Samples:
    """`count` samples of a sampler, chunk by chunk."""
    # A chunk of its own size for small counts: a program for each, but no work to throw away.
    size = min(count, _CHUNK)
    shift = jax.random.bits(jax.random.key(seed), (NOISE_DIM,), jnp.uint32)
    chunks = [_chunk(sampler, choice, data, shift, start, size) for start in range(0, count, size)]
    x, z, log_weight = (np.concatenate(part)[:count] for part in zip(*chunks, strict=True))
    return Samples(x, z, np.exp(log_weight - log_weight.max()))


@partial(jax.jit, static_argnames=("sampler", "choice", "size"))
def _chunk(sampler, choice, data, shift, start, size):
    normals = standard_normals(shift, start + jnp.arange(size))
    points, omegas, log_weights = jax.vmap(sampler, in_axes=(None, None, 0))(choice, data, normals)
    # Beyond infinity a point is where its ray ends, not behind the camera where X/ω would be.
    seen = omegas > 0
    safe = jnp.where(seen, omegas, 1.0)[:, None]
    x, z = jnp.where(seen[:, None], points / safe, jnp.sign(points) * jnp.inf).T
    return x, z, log_weights


def standard_normals(shift: UInt32[Array, " d"], indices: Int[Array, " n"]) -> Float[Array, "n d"]:
    """Points i of an evenly spread sequence: quasi-random, ten times fewer do for the same error.

    Kronecker's sequence `frac(shift + i α)` with α_j = φ^-j, φ the root of φ^(d+1) = φ + 1
    (Roberts 2018), shifted at random (Cranley, Patterson 1976), through the normal quantile.
    """
    phi = 2.0
    for _ in range(60):
        phi = (1 + phi) ** (1 / (shift.size + 1))
    alpha = np.round(phi ** -np.arange(1.0, shift.size + 1) * 2**32).astype(np.uint32)
    # Integers wrap at 2³², which is frac() without rounding, in single precision too.
    turns = shift + indices.astype(jnp.uint32)[:, None] * alpha
    uniform = (turns.astype(float) + 0.5) / 2.0**32
    eps = jnp.finfo(uniform.dtype).eps
    return ndtri(jnp.clip(uniform, eps, 1 - eps))


def marginal(values: Values, weight: Values) -> Marginal:
    """Sort one coordinate of weighted samples."""
    order = np.argsort(values)
    shares = np.cumsum(weight[order])
    return Marginal(values[order], shares / shares[-1])


def quantiles(of: Marginal, probabilities: Values) -> Values:
    """The smallest values with at least these shares up to and with them."""
    # A share of 1 is met by rounding or not: the last value has it whatever.
    found = np.searchsorted(of.shares, probabilities)
    return of.values[np.minimum(found, of.values.size - 1)]


def distance(a: Marginal, b: Marginal, farthest: float) -> Distance:
    """Kolmogorov–Smirnov and Wasserstein-1 distances, exact for the samples.

    For Wasserstein's a value beyond ±`farthest` counts as that. The mean of |z| does not exist
    when 1/z is Gaussian; of its samples it would be whatever the outermost of them is.
    """
    values = np.sort(np.concatenate([a.values, b.values]), kind="stable")
    apart = np.abs(shares_up_to(a, values) - shares_up_to(b, values))
    lengths = np.diff(np.clip(values, -farthest, farthest))
    return Distance(float(apart.max()), float(apart[:-1] @ lengths))


def shares_up_to(of: Marginal, values: Values) -> Values:
    """The distribution function at some values."""
    return np.append(0.0, of.shares)[np.searchsorted(of.values, values, side="right")]
