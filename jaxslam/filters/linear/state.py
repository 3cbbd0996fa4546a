"""The state of one Gaussian: a core on a manifold, landmarks of fixed capacity, a covariance."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam.geometry import tangent_dim


class AbstractState(eqx.Module):
    """A mean. Everything has a fixed shape.

    The error is ordered (core, landmark 0, landmark 1, …), n = c + capacity · d numbers.
    """

    core: PyTree
    """Poses and vectors, whose tangent has c numbers."""
    landmarks: Float[Array, "capacity d"]
    active: Bool[Array, " capacity"]
    """Which slots hold a landmark."""

    @property
    def core_dim(self) -> int:
        """c, the size of the core's tangent."""
        return tangent_dim(self.core)

    def numbers(self, slots: Bool[AnyArray, " capacity"]) -> Bool[Array, " n"]:
        """Whether each number of the error is the core's, or of a landmark in these slots."""
        own = jnp.repeat(slots, self.landmarks.shape[1])
        return jnp.concatenate([jnp.ones(self.core_dim, bool), own])


class State(AbstractState):
    """Mean and covariance; rows and columns of inactive slots are zero."""

    covariance: Float[Array, "n n"]
    first: Float[Array, "capacity d"] | None = None
    """Landmarks as they were inserted; where a correction is by first estimates."""
