"""Random programs by the native backend and by XLA; `native_fuzz.py` runs more."""

import jax
import jax.numpy as jnp
import native_fuzz
import numpy as np
import pytest

from jaxslam.native import batched
from jaxslam.native.build import compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C++ compiler")
ULPS = 64
"""XLA's own log1p is 39 from NumPy's and its sinh 14; the native functions are within 3."""
SPECIAL = [np.nan, np.inf, -np.inf, -0.0, 0.0, 1.0, -1.0, 1e-300, 20.0, -750.0, 1e22, 0.5]


@pytest.mark.parametrize(
    "case", [*range(3), *(pytest.param(i, marks=pytest.mark.slow) for i in range(3, 8))]
)
def test_random_programs_are_the_same_to_the_bit(case):
    """More of them reach pairs of operations that three do not have."""
    outcome = native_fuzz.check(case, operations=8)
    assert outcome.kind == "right", outcome.text
    assert outcome.certain >= 5  # runs


def test_transcendental_functions_are_the_same_to_some_last_bits():
    """Special numbers are the very same."""
    rng = np.random.default_rng(0)
    x = np.concatenate([SPECIAL, rng.normal(size=200), rng.normal(size=200) * 5])[:, None]

    def curves(shared, x):
        y = jnp.flip(x * shared)
        return *(f(x) for f in native_fuzz.CURVES), jnp.arctan2(x, y), jnp.abs(x) ** y

    found = batched(curves, np.full(1, 0.7), x)(np.full(1, 0.7), x)
    wanted = jax.vmap(curves, (None, 0))(np.full(1, 0.7), x)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_array_max_ulp(np.nan_to_num(a), np.nan_to_num(np.asarray(b)), ULPS)
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b))


def test_cube_roots_are_numpys():
    """XLA's own are off by 101 of the last bits at 1e-300."""
    x = np.concatenate([SPECIAL, np.random.default_rng(0).normal(size=200)])[:, None]
    found = batched(lambda _, x: jnp.cbrt(x), np.ones(1), x)(np.ones(1), x)
    np.testing.assert_array_max_ulp(np.nan_to_num(found), np.nan_to_num(np.cbrt(x)), 3)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(x))
