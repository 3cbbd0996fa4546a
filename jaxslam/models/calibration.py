"""Treatments of the uncertainty of its sensor's calibration.

A treatment adds the numbers δ to the state, by which the sensor's own are off, and says what
becomes of them. One of your own is one class with the fields and functions of
`AbstractCalibration`.
"""

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray, number_field
from jaxslam.models.sensors import AbstractSensor


class AbstractCalibration(eqx.Module):
    """A treatment. `δ ~ N(0, diag σ²)` at the start."""

    name: ClassVar[str] = "other"
    """For tables and files."""
    each_frame: ClassVar[bool] = False
    """Whether δ is drawn anew in every frame, and forgotten at its end."""
    corrected: ClassVar[bool] = True
    """Whether updates correct δ; else it counts with its covariance only (Schmidt, 1966)."""

    if TYPE_CHECKING:  # a field or a property of each treatment

        @property
        def sigma(self) -> Float[AnyArray, " k"]:
            """σ of δ."""

    @property
    def drift_sigma(self) -> Float[AnyArray, " w"]:
        """σ of the white noise by which δ moves in one step; none unless a treatment has it."""
        return np.zeros(0)

    def next(self, delta: Float[Array, " k"], noise: Float[Array, " w"]) -> Float[Array, " k"]:
        """δ after a step."""
        del noise
        return delta

    def sensor(self, nominal: AbstractSensor, delta: Float[Array, " k"]) -> AbstractSensor:
        """The sensor whose calibration is off by δ."""
        return nominal.perturbed(delta)


class Known(AbstractCalibration):
    """Exact: δ has no numbers."""

    name: ClassVar[str] = "known"

    @property
    def sigma(self) -> Float[AnyArray, " 0"]:
        return np.zeros(0)


class White(AbstractCalibration):
    """The paper's: an independent draw of every frame (P15)."""

    name: ClassVar[str] = "white"
    each_frame: ClassVar[bool] = True

    sigma: Float[AnyArray, " k"] = number_field()
    """σ of (f, c), (fx, fy, cx, cy) or (f, cx, cy), pixels (D of P15), and of the lens's k1 and k2
    unless those are known."""


class Considered(AbstractCalibration):
    """Constant and correlated with everything, but not corrected (Schmidt, 1966)."""

    name: ClassVar[str] = "consider"
    corrected: ClassVar[bool] = False

    sigma: Float[AnyArray, " k"] = number_field()
    """As `White.sigma`."""


class Estimated(AbstractCalibration):
    """Constant, and estimated with everything else."""

    name: ClassVar[str] = "estimated"

    sigma: Float[AnyArray, " k"] = number_field()
    """As `White.sigma`."""


def check_calibration(treatment: AbstractCalibration, sensor: AbstractSensor) -> None:
    """Raise ValueError unless the sensor can be off by so many numbers."""
    name, count = type(treatment).__name__, np.shape(treatment.sigma)
    try:
        treatment.sensor(sensor, jnp.zeros(count))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the calibration {name} with {count[0]} numbers does not fit the sensor "
            f"{type(sensor).__name__}: {error}"
        ) from None


TREATMENTS = {
    "white": White,
    "consider": Considered,
    "estimated": Estimated,
    "known": lambda sigma: Known(),
}
"""Treatments of a calibration whose numbers have these σ."""
