"""Tests of landmarks that drift."""

import jax
import numpy as np
import pytest
from cases import Case, quick_jit, quick_rows


@pytest.mark.parametrize("landmark", quick_rows(1, ["inverse_scaling", "inverse_depth"]))
def test_a_feature_is_expected_by_so_much_less_surely(landmark):
    """`H (P + H⁺ share² R H⁺ᵀ) Hᵀ + R` is `S + share² R`."""
    of = Case("matched-6dof", 1, steps=1, landmarks=4)
    first, known, _ = of.frames(0)
    seen = jax.tree.map(lambda x: x[0], known)

    def compared(name):
        slam = of.filter(name, landmark)

        def run(first, seen):
            state = slam.predict(slam.init(of.capacity, first), of.controls()[0])
            return slam.update(state, of.controls()[0], seen)[1]

        return quick_jit(run)(first, seen), slam.sensor.noise

    (fixed, R), (drifting, _) = compared("robocentric"), compared("robocentric+drift30")
    m, p = fixed.used.size, len(R)
    more = np.asarray(drifting.covariance - fixed.covariance).reshape(m, p, m, p)
    assert fixed.used.all()
    expected = np.einsum("ij,kl->ikjl", np.eye(m), 0.3**2 * R)
    np.testing.assert_allclose(more, expected, atol=1e-9)
    assert drifting.nis < fixed.nis
