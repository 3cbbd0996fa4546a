"""The state of a filter: a core on a manifold, landmarks of fixed capacity, one covariance."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.arrays import AnyArray
from jaxslam.geometry import tangent_dim


class State(eqx.Module):
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
    """What an `AbstractEntry` remembers of landmarks beside the Gaussian: any pytree."""

    @property
    def core_dim(self) -> int:
        """c, the size of the core's tangent."""
        return tangent_dim(self.core)


class Features(eqx.Module):
    """Measurements of landmarks: j is of the one in `slots[j]`, and counts where `valid[j]`.

    Of one frame, or of some.
    """

    slots: Int[AnyArray, "*frames m"]
    measured: Float[AnyArray, "*frames m p"]
    """What the sensor says of each: of a camera a pixel, (u,) or (u, v)."""
    valid: Bool[AnyArray, "*frames m"]


class Status(IntEnum):
    """What became of an update, the worse the greater."""

    OK = 0
    SOLVER_FAILED = 1
    """An iteration ended before its goal; the result is what it had."""
    NOT_POSITIVE = 2
    """A covariance is not positive definite: what follows from it means nothing."""
    DIVERGED = 3
    """The mean or the covariance is not finite."""


class Innovation(eqx.Module):
    """What an update compared: the residual of every feature and their joint covariance S.

    Features that were not used (not valid, or predicted behind the camera) have a zero residual
    and an identity block in S, so that they add nothing to `nis`.
    """

    predicted: Float[Array, "m p"]
    residual: Float[Array, "m p"]
    covariance: Float[Array, "m*p m*p"] | None
    """S; None where the form of the filter has no use for it."""
    used: Bool[Array, " m"]
    nis: Float[Array, ""]
    """Normalised innovation squared `rᵀ S⁻¹ r`, χ² with `nis_dof` degrees of freedom."""
    status: Int[Array, ""]
    """A `Status`."""
    log_det: Float[Array, ""] | None = None
    """log det S; None where the form of the filter has no use for it."""

    @property
    def nis_dof(self) -> Int[Array, ""]:
        """How many numbers were compared."""
        return self.residual.shape[-1] * jnp.sum(self.used)


def judged(positive: Bool[Array, ""], *finite: Array) -> Int[Array, ""]:
    """The `Status` of an update whose matrix was factored, and whose results are these arrays."""
    healthy = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in finite]))
    status = jnp.where(positive, Status.OK, Status.NOT_POSITIVE)
    # Without a factor nothing is finite: that is the cause, and the first to be told.
    return jnp.where(healthy | ~positive, status, Status.DIVERGED)
