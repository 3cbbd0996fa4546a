"""The state of a filter: a core on a manifold, landmarks of fixed capacity, one covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.geometry import tangent_dim


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """Mean and covariance. Everything has a fixed shape; `active` says which slots hold a landmark.

    The error is ordered (core, landmark 0, landmark 1, …), n = c + capacity · d numbers. Rows and
    columns of inactive slots are zero.
    """

    core: Any
    """Pytree of poses and vectors, whose tangent has c numbers."""
    landmarks: Float[Array, "capacity d"]
    active: Bool[Array, " capacity"]
    covariance: Float[Array, "n n"]
    memory: Any = ()
    """What an `Initialisation` remembers of landmarks beside the Gaussian: any pytree."""

    @property
    def core_dim(self) -> int:
        """c, the size of the core's tangent."""
        return tangent_dim(self.core)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Features:
    """Measurements of landmarks: j is of the one in `slots[j]`, and counts where `valid[j]`."""

    slots: Int[Array, " m"]
    measured: Float[Array, "m p"]
    valid: Bool[Array, " m"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Innovation:
    """What an update compared: the residual of every feature and their joint covariance S.

    Features that were not used (not valid, or predicted behind the camera) have a zero residual
    and an identity block in S, so that they add nothing to `nis`.
    """

    predicted: Float[Array, "m p"]
    residual: Float[Array, "m p"]
    covariance: Float[Array, "mp mp"] | None
    """S; None where the form of the filter has no use for it."""
    used: Bool[Array, " m"]
    nis: Float[Array, ""]
    """Normalised innovation squared `rᵀ S⁻¹ r`, χ² with `nis_dof` degrees of freedom."""

    @property
    def nis_dof(self) -> Int[Array, ""]:
        """How many numbers were compared."""
        return self.residual.shape[-1] * jnp.sum(self.used)
