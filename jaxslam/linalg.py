"""Factorisations of small matrices, written in JAX: batched by `vmap`, differentiable, no LAPACK.

jaxlib's batched LAPACK kernels wait inside XLA's thread pool for pieces of work that only the same
pool can do: two at once hang for ever on two cores (docs/faq.md). These functions take one
real matrix, in float32 or float64, and raise nothing: what has no solution is NaN.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray

__all__ = ("Cholesky", "SemidefiniteRoot", "cholesky", "eigh", "inverse", "semidefinite_root")

LEAF = 32
"""Rows of what is factored column by column; of more, the halves are, and joined by products."""
LARGE = 256
"""Rows from which on blocks are in a loop: more arithmetic, and a program that does not grow."""
UNROLLED = 4
"""Rows up to which the loops over them are written out."""
SWEEPS = 10
"""Sweeps of Jacobi's method over all pairs, which converges quadratically from about the fourth
on."""


class Cholesky(NamedTuple):
    """The factorisation `A = L Lᵀ`, which is all NaN unless A is positive definite."""

    root: Float[Array, "n n"]
    """L, lower triangular."""
    whitening: Float[Array, "n n"]
    """L⁻¹: `A⁻¹ = L⁻ᵀ L⁻¹`."""

    @property
    def positive(self) -> Bool[Array, ""]:
        """Whether A is positive definite."""
        return jnp.all(~jnp.isnan(jnp.diagonal(self.root)))

    def solve(self, b: Float[AnyArray, "n ..."]) -> Float[Array, "n ..."]:
        """Return `A⁻¹ b` for one right-hand side, or for several as columns."""
        return self.whitening.T @ (self.whitening @ b)

    def inverse(self) -> Float[Array, "n n"]:
        """Return A⁻¹, which is symmetric."""
        return self.whitening.T @ self.whitening

    def log_det(self) -> Float[Array, ""]:
        """Return the natural logarithm of det A."""
        return 2 * jnp.sum(jnp.log(jnp.diagonal(self.root)))


@jax.custom_jvp
def cholesky(A: Float[AnyArray, "n n"]) -> Cholesky:
    """Return Cholesky's L, with `A = L Lᵀ`, and L⁻¹.

    A is symmetric, and its lower triangle alone is read. L⁻¹ costs a third more than L alone, and
    turns what would be substitutions into products of matrices. The derivative, of any order and in
    both modes, is Murray's (arXiv 1602.07527, eq. 8).
    """
    root, whitening = _factored(jnp.asarray(A))
    positive = jnp.all(jnp.diagonal(root) > 0)
    return Cholesky(*(jnp.where(positive, x, jnp.nan) for x in (root, whitening)))


@cholesky.defjvp
def _(primals, tangents):
    """`dL = L Φ`, `dL⁻¹ = −Φ L⁻¹`, Φ the lower half of `L⁻¹ dA L⁻ᵀ` (Murray 2016, eq. 8)."""
    (A,), (dA,) = primals, tangents
    L, W = cholesky(A)
    whitened = W @ ((dA + dA.T) / 2) @ W.T
    half = jnp.tril(whitened) - jnp.diag(jnp.diagonal(whitened)) / 2
    return Cholesky(L, W), Cholesky(L @ half, -half @ W)


def _factored(A: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """L and L⁻¹ by halves: products of matrices, and leaves."""
    n = A.shape[0]
    if n == 0:
        return A, A
    if n <= LEAF:
        return _factored_by_columns(A)
    if n > LARGE:
        return _factored_by_blocks(A)
    h = n // 2
    L, W = _factored(A[:h, :h])
    below = A[h:, :h] @ W.T
    # A product with L⁻¹ is wrong by the condition of L; one refinement makes it as good as
    # substitution, which matters where A is nearly singular.
    below += (A[h:, :h] - below @ L.T) @ W.T
    L_rest, W_rest = _factored(A[h:, h:] - below @ below.T)
    none = jnp.zeros((h, n - h), A.dtype)
    return (
        jnp.block([[L, none], [below, L_rest]]),
        jnp.block([[W, none], [-W_rest @ (below @ W), W_rest]]),
    )


def _factored_by_blocks(A: Float[Array, "n n"]) -> tuple[Array, Array]:
    """L by block columns of `LEAF`, each from all those before it, and L⁻¹ by block rows."""
    n, b = A.shape[0], LEAF
    more = -n % b
    A = jnp.pad(A, (0, more)) + jnp.diag((jnp.arange(n + more) >= n).astype(A.dtype))
    row = jnp.arange(n + more)[:, None]

    def block(k, both):
        L, W = both
        start = k * b
        before = jax.lax.dynamic_slice_in_dim(L, start, b)
        left = jax.lax.dynamic_slice_in_dim(A, start, b, axis=1) - L @ before.T
        own, inverse = _factored_by_columns(jax.lax.dynamic_slice_in_dim(left, start, b))
        below = left @ inverse.T
        below += (left - below @ own.T) @ inverse.T  # as in `_factored`
        column = jnp.where(row < start, 0.0, below)
        column = jax.lax.dynamic_update_slice_in_dim(column, own, start, axis=0)
        rows = -inverse @ (before @ W)
        rows = jax.lax.dynamic_update_slice_in_dim(rows, inverse, start, axis=1)
        return (
            jax.lax.dynamic_update_slice_in_dim(L, column, start, axis=1),
            jax.lax.dynamic_update_slice_in_dim(W, rows, start, axis=0),
        )

    L, W = jax.lax.fori_loop(0, len(A) // b, block, (jnp.zeros_like(A), jnp.zeros_like(A)))
    return L[:n, :n], W[:n, :n]


def _factored_by_columns(A: Float[Array, "n n"]) -> tuple[Array, Array]:
    """L column by column from the left, and then L⁻¹ row by row."""
    n = A.shape[0]
    index = jnp.arange(n)

    def column(k, L):
        left = jnp.where(index >= k, A[:, k] - L @ L[k], 0.0)
        return L.at[:, k].set(left / jnp.sqrt(left[k]))

    loop = partial(jax.lax.fori_loop, 0, n, init_val=jnp.zeros_like(A), unroll=n <= UNROLLED)
    L = loop(column)

    def row(k, W):
        return W.at[k].set(((index == k) - L[k] @ W) / L[k, k])

    return L, loop(row)


class SemidefiniteRoot(NamedTuple):
    """The factorisation `P = L Lᵀ` of a covariance of any rank."""

    root: Float[Array, "n n"]
    whitening: Float[Array, "n n"]
    """Solves `L y = b` for b in the range of L; zero for what has no variance."""


def semidefinite_root(P: Float[Array, "n n"], jitter: float = 0.0) -> SemidefiniteRoot:
    """Return Cholesky's L of a covariance of any rank, to the precision of rounding.

    What is factored are the correlations, with `jitter` added to their diagonal, or rounding's
    where that is more. What has no variance has zeros in L and in its inverse.
    """
    variance = jnp.diagonal(P)
    none = variance <= 0
    sigma = jnp.sqrt(jnp.where(none, 0.0, variance))
    unit = jnp.where(none, 1.0, sigma)
    jitter = max(jitter, 10 * sigma.size * float(jnp.finfo(P.dtype).eps))
    correlation = P / (unit[:, None] * unit) + jnp.diag(jnp.where(none, 1.0, jitter))
    L, W = cholesky(correlation)
    return SemidefiniteRoot(sigma[:, None] * L, W / unit)


symmetric_part_p = Primitive("symmetric_part")
"""A primitive, so that a compiler may have a rule for it: half of A is enough."""


def symmetric_part(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return `(A + Aᵀ) / 2` of what is symmetric but for rounding."""
    return symmetric_part_p.bind(A)


def _symmetric_parts(A: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    return (A + jnp.swapaxes(A, -1, -2)) / 2


def _batched(arguments: tuple[Array], axes: tuple[int]) -> tuple[Array, int]:
    return symmetric_part_p.bind(jnp.moveaxis(arguments[0], axes[0], 0)), 0


symmetric_part_p.def_impl(jax.jit(_symmetric_parts))
symmetric_part_p.def_abstract_eval(lambda A: A)
mlir.register_lowering(symmetric_part_p, mlir.lower_fun(_symmetric_parts, multiple_results=False))
ad.deflinear2(symmetric_part_p, lambda cotangent, _: [symmetric_part_p.bind(cotangent)])
batching.primitive_batchers[symmetric_part_p] = _batched


def eigh(A: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return the eigenvalues of a symmetric A, the least first, and its eigenvectors as columns.

    Jacobi's method (Golub, Van Loan, Matrix Computations, §8.5) needs n²/2 rotations a sweep, one
    after the other: it is for a few rows. Derivatives are those of the rotations; they are not
    defined where two eigenvalues are equal.
    """
    n = A.shape[0]
    if n == 1:
        return A[0], jnp.ones_like(A)
    first, second = (jnp.asarray(i) for i in np.triu_indices(n, 1))

    def rotated(k, carry):
        A, V = carry
        p, q = first[k % first.size], second[k % first.size]
        turn = _annihilating(A[p, p], A[p, q], A[q, q])
        both = jnp.stack([p, q])
        A = A.at[both].set(turn.T @ A[both])
        A = A.at[:, both].set(A[:, both] @ turn)
        return A, V.at[:, both].set(V[:, both] @ turn)

    start = (A + A.T) / 2, jnp.eye(n, dtype=A.dtype)
    turns = 1 if n == 2 else SWEEPS * first.size  # one rotation is exact
    A, V = jax.lax.fori_loop(0, turns, rotated, start, unroll=n == 2)
    values = jnp.diagonal(A)
    order = jnp.argsort(values)
    return values[order], V[:, order]


def _annihilating(a, b, c) -> Float[Array, "2 2"]:
    """The rotation J for which `Jᵀ [a b; b c] J` is diagonal (Golub, Van Loan, §8.5.2)."""
    away, square = jnp.abs(c - a), (c - a) ** 2 + 4 * b**2
    none = square == 0
    length = away + jnp.sqrt(jnp.where(none, 1.0, square))
    tangent = jnp.where(c >= a, 2.0, -2.0) * b / length
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    return cosine * jnp.array([[1.0, tangent], [-tangent, 1.0]])


def inverse(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return A⁻¹ of any regular matrix, by Gauss–Jordan elimination with row pivoting.

    It is not finite where A is singular. What is positive definite has its `Cholesky.inverse`.
    """
    n = A.shape[0]
    index = jnp.arange(n)

    def eliminated(k, both):
        pivot = jnp.argmax(jnp.where(index >= k, jnp.abs(both[:, k]), -1.0))
        row = both[pivot]
        both = both.at[pivot].set(both[k])
        row = row / row[k]
        return (both - both[:, k, None] * row).at[k].set(row)

    both = jnp.concatenate([A, jnp.eye(n, dtype=A.dtype)], axis=1)
    return jax.lax.fori_loop(0, n, eliminated, both)[:, n:]
