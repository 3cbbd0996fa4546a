"""The state of a filter: a core on a manifold, landmarks of fixed capacity, one covariance."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.geometry import tangent_dim


class State(eqx.Module):
    """Mean and covariance. Everything has a fixed shape; `active` says which slots hold a landmark.

    The error is ordered (core, landmark 0, landmark 1, …), n = c + capacity · d numbers. Rows and
    columns of inactive slots are zero.
    """

    core: PyTree
    """Pytree of poses and vectors, whose tangent has c numbers."""
    landmarks: Float[Array, "capacity d"]
    active: Bool[Array, " capacity"]
    covariance: Float[Array, "n n"]
    memory: PyTree = ()
    """What an `AbstractEntry` remembers of landmarks beside the Gaussian: any pytree."""

    first: Float[Array, "capacity d"] | None = None
    """Landmarks as they were inserted; where a correction is by first estimates."""

    @property
    def core_dim(self) -> int:
        """c, the size of the core's tangent."""
        return tangent_dim(self.core)
