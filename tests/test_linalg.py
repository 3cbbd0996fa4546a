"""Factorisations in JAX against NumPy's; and no program of the package may call LAPACK."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.linalg import LARGE, LEAF, cholesky, eigh, inverse, semidefinite_root, symmetric_part

SIZES = (1, 5, LEAF, LEAF + 1, 2 * LEAF + 3, LARGE + 9)


def _positive(n, seed=0):
    half = np.random.default_rng(seed).normal(size=(n, n + 3))
    return half @ half.T


@pytest.mark.parametrize("n", SIZES)
def test_cholesky_is_numpys_and_its_inverse_whitens(n):
    A = _positive(n)
    root, whitening = jax.jit(cholesky)(A)
    np.testing.assert_allclose(root, np.linalg.cholesky(A), rtol=0, atol=1e-12 * n)
    np.testing.assert_allclose(whitening @ A @ whitening.T, np.eye(n), rtol=0, atol=1e-10)
    assert np.all(np.triu(whitening, 1) == 0)


def test_cholesky_solves_and_has_the_determinant():
    A, b = _positive(12), np.arange(12.0)

    @jax.jit
    def read(A, b):
        factor = cholesky(A)
        return factor.solve(b), factor.inverse(), factor.log_det()

    solved, inverted, log_det = read(A, b)
    np.testing.assert_allclose(solved, np.linalg.solve(A, b), rtol=1e-9)
    np.testing.assert_allclose(inverted, np.linalg.inv(A), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(A)[1], rtol=1e-12)


@pytest.mark.parametrize("n", [45, 75])
def test_what_is_nearly_singular_has_a_factor(n):
    """As the information of a window is: ten directions are known 10⁷ times as well as others."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(100, 10, n)) * 10.0 ** (7 - 2 * rng.uniform(size=(100, 10, 1)))
    information = np.eye(n) + np.swapaxes(A, 1, 2) @ A
    np.linalg.cholesky(information)  # raises where there is none
    assert np.isfinite(jax.jit(jax.vmap(cholesky))(information).whitening).all()


@pytest.mark.parametrize("n", [2, 5, LEAF + 8])
def test_cholesky_of_what_is_not_positive_is_nan_throughout(n):
    A = np.stack([np.diag(np.r_[np.ones(n - 1), least]) for least in (0.0, -1e-3)])
    factor, log_det = jax.jit(jax.vmap(lambda A: (cholesky(A), cholesky(A).log_det())))(A)
    assert np.isnan(factor.root).all()
    assert np.isnan(factor.whitening).all()
    assert np.isnan(log_det).all()


@pytest.mark.parametrize("n", [4, 9])
def test_cholesky_has_the_derivatives_of_central_differences(n):
    A, dA = _positive(n), _positive(n, seed=1)
    step, factored = 1e-6, jax.jit(cholesky)

    @jax.jit
    def derived(A):
        _, tangent = jax.jvp(cholesky, (A,), (dA,))
        return tangent, jax.grad(lambda A: cholesky(A).log_det())(A)

    tangent, gradient = derived(A)
    above, below = factored(A + step * dA), factored(A - step * dA)
    for got, plus, minus in zip(tangent, above, below, strict=True):
        expected = (plus - minus) / (2 * step)
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(gradient, np.linalg.inv(A), rtol=1e-9, atol=1e-12)


def test_semidefinite_root_has_any_rank_and_solves_in_its_range():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(5, 3)) * np.array([1, 10, 1e-3])
    half[1] = 0
    root, whitening = jax.jit(semidefinite_root)(half @ half.T)
    np.testing.assert_allclose(root @ root.T, half @ half.T, rtol=0, atol=1e-10)
    assert not np.any(root[1])
    assert not np.any(root[:, 1])
    b = half @ rng.normal(size=3)
    np.testing.assert_allclose(root @ (whitening @ b), b, rtol=0, atol=1e-6)


@pytest.mark.parametrize("n", [LEAF, 105])
def test_large_semidefinite_matrices_have_roots_too(n):
    """Of a fifth of their rows, and of scales far apart: the jitter is only rounding's size."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(100, n, n // 5)) * 10.0 ** rng.uniform(-4, 2, size=(100, n, 1))
    P = half @ np.swapaxes(half, 1, 2)
    root = np.asarray(jax.jit(jax.vmap(semidefinite_root))(P).root)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    away = (root @ np.swapaxes(root, 1, 2) - P) / sigma[:, :, None] / sigma[:, None, :]
    np.testing.assert_allclose(away, 0, atol=1e-11)


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_eigh_is_numpys(n):
    A = _positive(n) - 3 * np.eye(n)
    values, vectors = jax.jit(eigh)(A)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), rtol=0, atol=1e-12 * n**2)
    np.testing.assert_allclose(A @ vectors, vectors * values, rtol=0, atol=1e-11)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), rtol=0, atol=1e-13)


def test_eigh_of_equal_or_sorted_values_is_exact_and_has_derivatives():
    @jax.jit
    def found(A):
        return eigh(A), jax.jvp(lambda A: eigh(A)[0].sum(), (A,), (_positive(3),))[1]

    for A in (np.zeros((3, 3)), np.eye(3), np.diag([3.0, 1.0, 2.0])):
        (values, vectors), slope = found(A)
        np.testing.assert_array_equal(values, np.sort(np.diagonal(A)))
        np.testing.assert_array_equal(np.abs(vectors).sum(axis=0), 1)
        np.testing.assert_allclose(slope, np.trace(_positive(3)), rtol=1e-12)


def test_eigenvectors_turn_with_a_perturbation_of_a_diagonal():
    A, dA = np.diag([1.0, 2.0, 4.0]), _positive(3)
    turn = jax.jit(lambda A: jax.jvp(lambda A: eigh(A)[1], (A,), (dA,))[1])(A)
    gaps = np.diagonal(A)[None, :] - np.diagonal(A)[:, None] + np.eye(3)
    expected = dA / gaps * (1 - np.eye(3))
    np.testing.assert_allclose(turn, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 6, 13])
def test_inverse_is_numpys_and_needs_no_good_pivots(n):
    A = np.random.default_rng(n).normal(size=(n, n))
    A[0, 0] = 0 if n > 1 else 2.0
    inverted = jax.jit(inverse)
    np.testing.assert_allclose(inverted(A) @ A, np.eye(n), rtol=0, atol=1e-10)
    if n > 1:  # of a singular matrix it is not finite
        assert not np.isfinite(inverted(np.ones((n, n)))).all()


def test_symmetric_part_is_the_mean_with_the_transpose_batched_and_differentiated():
    """A primitive of its own, with its rules for `vmap`, `jvp`, `grad` and `jit`."""
    A = np.random.default_rng(4).normal(size=(3, 3, 3))

    def mean(A):
        return (A + A.T) / 2

    of_last_axis = partial(jax.vmap, in_axes=2, out_axes=1)
    for transform in (jax.jit, jax.vmap, of_last_axis, jax.jacfwd, jax.jacrev):
        given = jnp.asarray(A if transform in (jax.vmap, of_last_axis) else A[0])
        both = [jax.jit(transform(function))(given) for function in (symmetric_part, mean)]
        np.testing.assert_array_equal(*both)
