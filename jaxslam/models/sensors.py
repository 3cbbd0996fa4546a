"""Measurement models of a point: its pixel, its position, or range and bearing from the sensor.

A sensor has the camera's axes: x right, y down, z ahead; a planar point is (x, z). A bearing is
atan2(x, z), zero ahead and positive to the right. σ is in the unit of the measurement: pixels, m,
or (m, rad).

A sensor is data: its numbers can be batched, perturbed by the uncertainty of its calibration and
differentiated. One of your own is one class with the functions of `AbstractSensor`.
"""

from abc import abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray, Number, check_shape, number_field, optional_numbers
from jaxslam.geometry import Homogeneous, Point, exp, homogeneous_apply
from jaxslam.models.camera import Camera, project, ray
from jaxslam.models.motion import geometry_of

Measurement = Float[Array, " p"]


class FieldOfView(eqx.Module):
    """The part of a simulated world that a sensor sees."""

    range: Float[AnyArray, " 2"] = number_field(default=(0.0, 1e9))
    """Least and greatest distance, m; not of a camera. All is seen by default."""
    visible_depth: Number = 0.1
    """Least depth z, m, of a camera."""
    image: Float[AnyArray, " p"] | None = eqx.field(converter=optional_numbers, default=None)
    """Size of the picture of a camera, pixels."""

    def __check_init__(self) -> None:
        check_shape("range", self.range, (2,))
        if isinstance(self.range, np.ndarray) and self.range[0] >= self.range[1]:
            raise ValueError(f"range needs a least and a greatest one, not {self.range}")


class AbstractSensor(eqx.Module):
    """A measurement model of one homogeneous point (X, ω) in the sensor's frame."""

    hidden: ClassVar[int] = 0
    """The count of numbers of a point that one measurement hides: the size of their prior, q."""

    if TYPE_CHECKING:  # a field or a property of each sensor

        @property
        def sigma(self) -> Float[AnyArray, ""] | Float[AnyArray, " p"]:
            """σ of what is measured, one for all its numbers or one each."""

        @property
        def size(self) -> int:
            """The size p of a measurement."""

        @property
        def point_dim(self) -> int:
            """Coordinates of the points it measures: 2 in a planar world, 3 in a spatial one."""

    @abstractmethod
    def measure(self, point: Point, omega: Number) -> Measurement:
        """The noise-free measurement."""

    @abstractmethod
    def locate(self, measured: Measurement, hidden: Float[Array, " q"]) -> Homogeneous:
        """The point, from a measurement and what that hides: the inverse of `measure`."""

    def possible(self, point: Point) -> Bool[Array, ""]:
        """Whether the point can be measured at all; any can, unless a sensor says otherwise."""
        del point
        return jnp.ones((), bool)

    def visible(self, point: Point, measured: Measurement, view: FieldOfView) -> Bool[Array, ""]:
        """Whether a simulation measures the point, whose noise-free measurement is this: what is
        possible and in range, unless a sensor says otherwise."""
        del measured
        distance = jnp.linalg.norm(point)
        in_range = (distance >= view.range[0]) & (distance <= view.range[1])
        return in_range & self.possible(point)

    @property
    def view(self) -> FieldOfView:
        """What a simulation takes it to see where nothing else is said: all that is possible."""
        return FieldOfView()

    def chart(self, point: Point, omega: Number) -> Point:
        """Coordinates in which every parametrization is nearly Gaussian; the point's own here."""
        return point / omega

    def residual(self, measured: Measurement, predicted: Measurement) -> Measurement:
        """The residual of a measurement; a sensor of angles wraps them."""
        return measured - predicted

    @property
    def noise(self) -> Float[Array, "p p"]:
        """R of one measurement, where it depends on nothing."""
        return jnp.diag(jnp.broadcast_to(jnp.asarray(self.sigma), self.size) ** 2)

    def noise_at(self, measured: Float[Array, " p"]) -> Float[Array, "p p"]:
        """R of this measurement; the constant `noise`, unless a sensor says otherwise.

        A filter asks for it where the measurement is, a simulation where the noise-free one is.
        """
        del measured
        return self.noise

    @property
    def focal(self) -> Float[AnyArray, ""]:
        """The unit in which landmarks in pixels are written; 1 where there are no pixels."""
        return np.ones(())

    @property
    def rolling(self) -> bool:
        """Whether its rows are exposed one after another, so that its velocity counts."""
        return False

    def moving(self, velocity: Float[Array, " t"]) -> "AbstractSensor":
        """The sensor at a velocity, linear and angular, in its own axes; where `rolling`."""
        raise NotImplementedError(f"{type(self).__name__} does not say what its velocity changes")

    def perturbed(self, delta: Float[Array, " k"]) -> "AbstractSensor":
        """The sensor with the error δ of its calibration; of an empty δ, the sensor itself.

        Raises ValueError for any other δ of a sensor without a calibration.
        """
        if delta.size:
            raise ValueError(f"{type(self).__name__} has no calibration that could be uncertain")
        return self


class Pinhole(AbstractSensor):
    """A pixel (P14), on the homogeneous numerator; it hides one over the lens's depth.

    That is z, and the chart (x/z, y/z, 1/z) for an ideal lens; of a fisheye, the distance.
    """

    hidden: ClassVar[int] = 1

    camera: Camera
    """What turns directions into pixels."""
    sigma: Float[AnyArray, ""] | Float[AnyArray, " p"] = number_field()
    """σ of a measured pixel."""
    line: Number | None = None
    """Seconds from the exposure of one row to that of the next (of a 1-D camera, one pixel), of a
    rolling shutter: a frame's time and pose are those of the row of the principal point."""
    velocity: Float[Array, " t"] | None = None
    """That of the camera during a frame, in its own axes, as `moving` has it."""

    def __check_init__(self) -> None:
        check_shape("a pixel's sigma", self.sigma, (), (self.size,))

    @property
    def size(self) -> int:
        return self.camera.focal.shape[-1]

    @property
    def point_dim(self) -> int:
        return self.size + 1

    def measure(self, point: Point, omega: Number) -> Measurement:
        """`u = π(Exp(−τ(u) ν) X)`, τ the time of the row and ν the velocity, by two substitutions:
        what they leave is a thousandth of what the readout moves a pixel by."""
        pixel = project(self.camera, point)
        if self.velocity is None:
            return pixel
        for _ in range(2):
            pixel = project(self.camera, self._moved(point, omega, -self._delay(pixel)))
        return pixel

    def locate(self, measured: Measurement, hidden: Float[Array, " 1"]) -> Homogeneous:
        point, omega = ray(self.camera, measured), hidden[0]
        return self._moved(point, omega, self._delay(measured)), omega

    def _delay(self, pixel: Measurement) -> Number:
        """Seconds from the exposure of the frame's row to that of a pixel's."""
        return 0.0 if self.line is None else self.line * (pixel[-1] - self.camera.centre[-1])

    def _moved(self, point: Point, omega: Number, seconds: Number) -> Point:
        """The point as the camera of so many seconds before has it."""
        if self.velocity is None:
            return point
        group = geometry_of(self.velocity, "the velocity of a camera").group
        return homogeneous_apply(exp(group, seconds * self.velocity), point, jnp.asarray(omega))

    @property
    def rolling(self) -> bool:
        return self.line is not None

    def moving(self, velocity: Float[Array, " t"]) -> "Pinhole":
        return replace(self, velocity=velocity)

    def possible(self, point: Point) -> Bool[Array, ""]:
        return self.camera.lens.sees(point)

    def visible(self, point: Point, measured: Measurement, view: FieldOfView) -> Bool[Array, ""]:
        """Seen by the lens, inside the picture, and not too near."""
        image = 2 * self.camera.centre if view.image is None else view.image
        inside = jnp.all((measured >= 0) & (measured < image))
        far = self.camera.lens.depth(point) > view.visible_depth
        return inside & far & self.possible(point)

    @property
    def view(self) -> FieldOfView:
        """A picture of twice the principal point."""
        return FieldOfView(image=2 * self.camera.centre)

    def chart(self, point: Point, omega: Number) -> Point:
        """Where the lens shows it, at unit focal length, and its inverse depth."""
        lens = self.camera.lens
        return jnp.append(lens.distort(point), omega / lens.depth(point))

    @property
    def focal(self) -> Float[AnyArray, ""]:
        return self.camera.focal[..., 0]

    def perturbed(self, delta: Float[Array, " k"]) -> "Pinhole":
        """Intrinsics moved by δ, as `Camera.perturbed` has it (P15)."""
        return replace(self, camera=self.camera.perturbed(delta))


class Position(AbstractSensor):
    """The point in the sensor's frame, m, all around: the relative position of 2-D SLAM studies."""

    sigma: Float[AnyArray, ""] | Float[AnyArray, " n"] = number_field()
    """σ of each coordinate, m."""
    point_dim: int = eqx.field(static=True, default=2)
    """2 in the plane, 3 in space."""

    def __check_init__(self) -> None:
        check_shape("a position's sigma", self.sigma, (), (self.point_dim,))

    @property
    def size(self) -> int:
        return self.point_dim

    def measure(self, point: Point, omega: Number) -> Measurement:
        return point / omega

    def locate(self, measured: Measurement, hidden: Float[Array, " 0"]) -> Homogeneous:
        del hidden
        return measured, jnp.ones((), measured.dtype)


class RangeBearing(AbstractSensor):
    """Distance, m, and direction, rad, of a point in a plane: `(|p|, atan2(x, z))`, all around."""

    sigma: Float[AnyArray, " 2"] = number_field()
    """σ of range and bearing, m and rad."""
    size: ClassVar[int] = 2
    point_dim: ClassVar[int] = 2

    def __check_init__(self) -> None:
        check_shape("the sigma of range and bearing", self.sigma, (2,))

    def measure(self, point: Point, omega: Number) -> Measurement:
        x, z = point / omega
        return jnp.stack([jnp.hypot(x, z), jnp.atan2(x, z)])

    def locate(self, measured: Measurement, hidden: Float[Array, " 0"]) -> Homogeneous:
        del hidden
        distance, angle = measured
        point = distance * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        return point, jnp.ones((), measured.dtype)

    def residual(self, measured: Measurement, predicted: Measurement) -> Measurement:
        difference = measured - predicted
        angle = difference[1]
        return difference.at[1].set(jnp.atan2(jnp.sin(angle), jnp.cos(angle)))


def noises(
    sensor: AbstractSensor, measured: Float[AnyArray, "m p"]
) -> Float[Array, "p p"] | Float[Array, "m p p"]:
    """R of each measurement; one for all, which is factored once, where none depends on what is
    measured."""
    if type(sensor).noise_at is AbstractSensor.noise_at:
        return sensor.noise
    return jax.vmap(sensor.noise_at)(measured)
