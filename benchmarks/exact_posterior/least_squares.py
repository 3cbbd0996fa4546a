"""Nonlinear least squares: optimistix's Levenberg–Marquardt, its linear systems solved in JAX."""

from __future__ import annotations

import lineax
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jaxslam.linalg import Cholesky, cholesky


class NormalCholesky(lineax.AbstractLinearSolver):
    """`min |A x − b|²` for a flat x by `AᵀA = L Lᵀ`: lineax's own solvers call LAPACK.

    It squares the condition of A, which does no harm to damped steps on residuals that hold the
    whitened unknowns themselves. It cannot be differentiated through.
    """

    def init(
        self, operator: lineax.AbstractLinearOperator, options: dict[str, PyTree]
    ) -> tuple[Float[Array, "m n"], Cholesky]:
        del options
        A = operator.as_matrix()
        return A, cholesky(A.T @ A)

    def compute(self, state, vector, options):
        del options
        A, normal = state
        b, _ = ravel_pytree(vector)
        return normal.solve(A.T @ b), lineax.RESULTS.successful, {}

    def transpose(self, state, options):
        raise NotImplementedError("the solution of these least squares is not differentiated")

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self) -> bool:
        return True


def levenberg_marquardt(tolerance: float) -> optimistix.LevenbergMarquardt:
    """Return a solver for `optimistix.least_squares`; the tolerance is relative and absolute."""
    return optimistix.LevenbergMarquardt(
        rtol=tolerance, atol=tolerance, linear_solver=NormalCholesky()
    )
