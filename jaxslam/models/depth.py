"""The prior on 1/z of a new landmark, whose depth a camera does not measure."""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import (
    AnyArray,
    Number,
    check_numbers,
    check_shape,
    number_field,
    optional_numbers,
)


class InverseDepth(eqx.Module):
    """`1/z = mean + σ (e_i + common c)`, with e_i of every landmark and one c, standard normal.

    c is estimated with everything else: the first landmarks inform those that follow how far away
    the scene is. Raises ValueError for numbers that are none, and for a walk of nothing in common.

    Where c walks, the scene may become another, whose depths scatter as its distance does:
    `1/z = e^(κ common c) (mean + σ e_i)` with κ = σ/mean, the same to first order in c.
    """

    mean: Float[AnyArray, ""] = number_field()
    """1/m; the paper's is 1/(2 d_min)."""
    sigma: Float[AnyArray, ""] = number_field()
    """1/m; the paper's is 1/(4 d_min)."""
    common: Float[AnyArray, ""] | None = eqx.field(converter=optional_numbers, default=None)
    """σ of c, in σ of one landmark's own part; None where landmarks have nothing in common."""
    unit: Float[AnyArray, ""] | None = eqx.field(converter=optional_numbers, default=None)
    """σ of the log of the metre in which all of this was meant, and whatever else is given: a
    filter with a unit of its own (`ScaleGauge`) claims no more of the scale, whatever it sees. None
    where it was the metre."""
    walk: Float[AnyArray, ""] | None = eqx.field(converter=optional_numbers, default=None)
    """σ by which `common c` changes from frame to frame, in σ of one landmark's own part: scenes
    change; `mean` is then positive. None where it stays."""

    def __check_init__(self) -> None:
        if self.walk is not None and self.common is None:
            raise ValueError("walk is that of a common error of depths: give its σ, common, too")
        for name in ("mean", "sigma"):
            check_shape(f"the {name} of the prior on 1/z", getattr(self, name), ())

    def with_common(self, own: Array, error: Array) -> Array:
        """1/z of landmarks that is `own` = mean + σ e_i by themselves, with the `error` common c
        of all."""
        if self.walk is None:
            return own + self.sigma * error
        return own * jnp.exp(self.sigma / self.mean * error)

    @staticmethod
    def beyond(nearest: Number) -> InverseDepth:
        """The paper's: 96 % from `nearest` (d_min, metres) to infinity. Raises ValueError."""
        check_numbers("the nearest depth", nearest, "positive")
        return InverseDepth(1 / (2 * nearest), 1 / (4 * nearest))

    @staticmethod
    def from_depths(near: Number, far: Number) -> InverseDepth:
        """Mean and σ of 1/z for depths that are uniform between `near` and `far`, metres.

        `E 1/z = log(f/n)/(f − n)` and `E 1/z² = 1/(n f)`. Raises ValueError unless 0 < near < far.
        """
        if not 0 < near < far < math.inf:
            raise ValueError(f"depths are between 0 < near < far < ∞, not {near} and {far}")
        mean = math.log(far / near) / (far - near)
        return InverseDepth(mean, math.sqrt(1 / (near * far) - mean**2))
