"""The observations of a filter and what it says of them: features, innovation, status."""

from __future__ import annotations

from enum import IntEnum
from numbers import Integral
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import AnyArray, number_field
from jaxslam.geometry import Scalar

Slots = Int[Array, " m"]
"""Places of landmarks in the state; one out of bounds is none."""


class Capacity(NamedTuple):
    """The capacity of a state; an `int` stands for as many of each."""

    landmarks: int
    """In the map: slots 0, …, landmarks − 1."""
    seen: int
    """In one frame, of landmarks in the map."""
    new: int
    """In one frame, of new ones."""

    @staticmethod
    def of(capacity: int | Capacity) -> Capacity:
        """Raises ValueError for a number that is not a capacity."""
        made = (
            capacity if isinstance(capacity, Capacity) else Capacity(capacity, capacity, capacity)
        )
        for name, count in made._asdict().items():
            if not isinstance(count, Integral) or count < 0 or (name == "landmarks" and count < 1):
                raise ValueError(f"a capacity is of so many {name}, a whole number, not {count!r}")
        return made


class Features(eqx.Module):
    """Measurements of landmarks: j is of the one in `slots[j]`, and counts where `valid[j]`.

    Of one frame, or of some.
    """

    slots: Int[AnyArray, "*frames m"]
    measured: Float[AnyArray, "*frames m p"]
    """What the sensor says of each: of a camera a pixel, (u,) or (u, v)."""
    valid: Bool[AnyArray, "*frames m"]
    noise_factor: Float[AnyArray, "*frames m"] | None = None
    """κ of each: its noise in an update is κ R, R the sensor's, as where a patch fits badly; None
    is 1."""

    @property
    def factors(self) -> Float[Array, "*frames m"]:
        """Every κ."""
        factors = 1.0 if self.noise_factor is None else self.noise_factor
        return jnp.broadcast_to(jnp.asarray(factors, self.measured.dtype), self.valid.shape)

    def places(self, count: int) -> Int[Array, "*frames m"]:
        """The slots, and `count`, which is out of bounds, for what is not valid."""
        return jnp.where(self.valid, self.slots, count)


class PriorMap(eqx.Module):
    """Landmarks that are known before frame 0: surveyed beacons, or a map of yesterday.

    `X ~ N(points, covariance)` in the base frame B, metres, in the slots that hold them.
    """

    slots: Int[AnyArray, " m"] = eqx.field(converter=jnp.asarray)
    points: Float[AnyArray, "m n"] = number_field()
    covariance: Float[AnyArray, "m*n m*n"] = number_field()
    """Joint, as a map of yesterday has it; of points that are independent block-diagonal."""


class Status(IntEnum):
    """The outcome of an update, the worse the greater."""

    OK = 0
    NOT_POSITIVE = 2
    """A covariance is not positive definite: what follows from it means nothing."""
    DIVERGED = 3
    """The mean or the covariance is not finite."""


class Innovation(eqx.Module):
    """The innovation of an update: the residual of every feature and their joint covariance S.

    Features that were not used (not valid, or predicted behind the camera) have a zero residual
    and an identity block in S, so that they add nothing to `nis`.
    """

    predicted: Float[Array, "m p"]
    residual: Float[Array, "m p"]
    covariance: Float[Array, "m*p m*p"] | None
    """S; None where the form of the filter has no use for it."""
    used: Bool[Array, " m"]
    nis: Scalar
    """Normalised innovation squared `rᵀ S⁻¹ r`, χ² with `nis_dof` degrees of freedom."""
    status: Int[Array, ""]
    """A `Status`."""
    log_det: Scalar | None = None
    """log det S; None where the form of the filter has no use for it."""

    @property
    def nis_dof(self) -> Int[Array, ""]:
        """The number of numbers that were compared."""
        return self.residual.shape[-1] * jnp.sum(self.used)


def judged(positive: Bool[Array, ""], *finite: Array) -> Int[Array, ""]:
    """The `Status` of an update whose matrix was factored, and whose results are these arrays."""
    healthy = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in finite]))
    status = jnp.where(positive, Status.OK, Status.NOT_POSITIVE)
    # Without a factor nothing is finite: that is the cause, and the first to be reported.
    return jnp.where(healthy | ~positive, status, Status.DIVERGED)
