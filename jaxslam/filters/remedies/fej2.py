"""FEJ2 (Chen, Geneva, Huang: FEJ2: A Consistent Visual-Inertial State Estimator Design, ICRA 2022).

The residual of the best estimate is `r = H x̃ + n` with H of the best estimate, and the first
estimates have another, H₁: `r = H₁ x̃ + (H − H₁) x̃ + n`. FEJ leaves the middle term out. FEJ2 keeps
of r what that term cannot change, the left null space of the columns of `D = H − H₁`. N is that of
first estimates.

Here D is that of the core, which is all of it for Cartesian landmarks whose position is measured.
(Of a pixel, D of the landmarks has as many columns that differ as there are pixels: nothing would
be left of a frame.) The projection is a noise of R that is without bound in the span of D: an
update without those directions, which are not counted in `nis`, and are in `nis_dof`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import jax.numpy as jnp

from jaxslam.filters.linear.blocks import masked, observe
from jaxslam.filters.linear.kalman import noise_matrix
from jaxslam.filters.remedies.first_estimates import AbstractFirstEstimates


class ProjectedFirstEstimates(AbstractFirstEstimates):
    """First estimates without the directions of a residual in which they are wrong."""

    name: ClassVar[str] = "fej2"

    def noise(self, model, state, seen, R, at):
        first = replace(state, landmarks=state.first)
        _, in_front, H = observe(model, state, seen.slots, at)
        _, was_in_front, H_first = observe(model, first, seen.slots, at)
        used = seen.valid & in_front & was_in_front & state.active[seen.slots]
        R = noise_matrix(R, used)
        D = masked(H, used).by_view - masked(H_first, used).by_view
        D = (D @ H.view_by_core).reshape(len(R), -1)
        length = jnp.linalg.norm(D, axis=0)
        D = D / jnp.where(length > 0, length, 1.0)
        without_bound = jnp.trace(R) / len(R) / jnp.sqrt(jnp.finfo(R.dtype).eps)
        return R + without_bound * D @ D.T
