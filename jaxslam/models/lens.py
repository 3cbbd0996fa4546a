"""Lenses: where on a plane at unit focal length a point is seen, and which ray is seen there.

A lens lays directions out on a plane, x/z of a perspective one and the angle from the axis of a
fisheye, and bends that plane by its coefficients. One of your own is one class with the functions
of `AbstractLens`, or with that of `AbstractBent`.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray, Number, number_field
from jaxslam.geometry import Point, Scalar

Place = Float[Array, " p"]
"""On the plane at unit focal length, (x,) or (x, y)."""
STRAIGHTEN_ITERATIONS = 8
"""Newton steps of `undistort`: quadratic convergence wherever the model can be inverted."""


class AbstractLens(eqx.Module):
    """A lens, by default a perspective one, whose rays have z = 1."""

    @abstractmethod
    def distort(self, point: Point) -> Place:
        """Where the lens shows a point; meaningless of one that it does not see."""

    @abstractmethod
    def undistort(self, place: Place) -> Point:
        """The inverse of `distort`: the point of depth 1 that is seen there."""

    @property
    def coefficients(self) -> tuple[Number, ...]:
        """k1 and k2, which may be uncertain; none of a lens without."""
        return ()

    def perturbed(self, delta: Float[Array, " k"]) -> AbstractLens:
        """The lens with its coefficients moved by δ; of an empty δ, the lens itself.

        Raises ValueError for any other δ of a lens without.
        """
        if delta.size:
            raise ValueError(f"{type(self).__name__} has no coefficients that could be uncertain")
        return self

    def flat(self, point: Point) -> Place:
        """Where an ideal lens of the kind shows a point: x/z. The scale of the point does not
        matter. At z = 0 the result and its derivative are finite but meaningless."""
        return point[:-1] / jnp.where(point[-1] == 0, 1.0, point[-1])

    def ray(self, flat: Place) -> Point:
        """The inverse of `flat`: the point of depth 1 on that ray."""
        return jnp.append(flat, 1.0)

    def depth(self, point: Point) -> Scalar:
        """The depth of a point, which no pixel shows: z."""
        return point[-1]

    def sees(self, point: Point) -> Bool[Array, ""]:
        """Whether the lens shows the point: before the camera."""
        return point[-1] > 0


class Ideal(AbstractLens):
    """`x/z`: no distortion; of any dimension."""

    def distort(self, point: Point) -> Place:
        return self.flat(point)

    def undistort(self, place: Place) -> Point:
        return self.ray(place)


class AbstractBent(AbstractLens):
    """A lens that bends the plane of an ideal one of its kind."""

    k1: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of r² (of a fisheye, θ²), no unit."""
    k2: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of r⁴ (θ⁴)."""

    @abstractmethod
    def bent(self, flat: Place) -> Place:
        """Where the lens shows what an ideal one would show there."""

    @property
    def coefficients(self) -> tuple[Number, ...]:
        return self.k1, self.k2

    def perturbed(self, delta: Float[Array, " k"]) -> AbstractLens:
        """Raises ValueError for a δ of more or fewer than k1 and k2."""
        if delta.size == 0:
            return self
        dk1, dk2 = delta
        return replace(self, k1=self.k1 + dk1, k2=self.k2 + dk2)

    def distort(self, point: Point) -> Place:
        return self.bent(self.flat(point))

    def undistort(self, place: Place) -> Point:
        """By Newton's method; meaningless beyond the part of the plane that the model maps."""
        return self.ray(_straightened(self, place))

    def sees(self, point: Point) -> Bool[Array, ""]:
        """Before the camera, and nowhere beyond the angle from which on the model would fold the
        picture back."""
        return (point[-1] > 0) & self.unfolded(self.flat(point))

    def unfolded(self, flat: Place) -> Bool[Array, ""]:
        """Whether what is farther out there is shown farther out."""
        return jax.jvp(self.bent, (flat,), (flat,))[1] @ flat >= 0


class AbstractTangential(AbstractBent):
    """A lens with a radial part and the tangential one of Brown (1966)."""

    p1: Float[AnyArray, ""] = number_field(default=0.0)
    """A coefficient of the tangential part."""
    p2: Float[AnyArray, ""] = number_field(default=0.0)
    """A coefficient of the tangential part."""
    k3: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of r⁶."""

    @abstractmethod
    def radial(self, r2: Scalar) -> Scalar:
        """By what a place at the distance r of the axis is farther out."""

    def polynomial(self, r2: Scalar) -> Scalar:
        """`1 + k1 r² + k2 r⁴ + k3 r⁶`."""
        return 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))

    def bent(self, flat: Place) -> Place:
        """`x (radial + 2 s·x) + s r²` with s = (p2, p1)."""
        r2, swapped = flat @ flat, jnp.stack([self.p2, self.p1])
        return flat * (self.radial(r2) + 2 * swapped @ flat) + r2 * swapped


class RadialTangential(AbstractTangential):
    """OpenCV's five numbers, ROS's `plumb_bob`, Kalibr's `radtan` (Brown, 1966)."""

    def radial(self, r2: Scalar) -> Scalar:
        return self.polynomial(r2)


class Rational(AbstractTangential):
    """OpenCV's eight numbers, ROS's `rational_polynomial`, for wide lenses."""

    k4: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of r² in the denominator."""
    k5: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of r⁴ in the denominator."""
    k6: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of r⁶ in the denominator."""

    def radial(self, r2: Scalar) -> Scalar:
        """The polynomial divided by `1 + k4 r² + k5 r⁴ + k6 r⁶`."""
        return self.polynomial(r2) / (1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))


class Fisheye(AbstractBent):
    """Kannala and Brandt's (TPAMI 2006), OpenCV's `fisheye`, Kalibr's `equi`: an equidistant lens,
    which may see more than a half-space. Its rays have unit length, and depth is the distance."""

    k3: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of θ⁶."""
    k4: Float[AnyArray, ""] = number_field(default=0.0)
    """The coefficient of θ⁸."""

    def bent(self, flat: Place) -> Place:
        """`x (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, θ = |x|."""
        t2 = flat @ flat
        return flat * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))

    def flat(self, point: Point) -> Place:
        """`(x, y) θ/r`, r = |(x, y)| and θ = atan2(r, z), the angle from the axis."""
        z, r2 = point[-1], point[:-1] @ point[:-1]
        axial = r2 <= 1e-8 * jnp.maximum(z, 0.0) ** 2
        r = jnp.sqrt(jnp.where(axial, 1.0, r2))
        ahead = jnp.where(axial & (z > 0), z, 1.0)
        near = (1 - r2 / (3 * ahead**2)) / ahead
        return point[:-1] * jnp.where(axial, near, jnp.atan2(r, z) / r)

    def ray(self, flat: Place) -> Point:
        t2 = flat @ flat
        axial = t2 <= 1e-8
        t = jnp.sqrt(jnp.where(axial, 1.0, t2))
        sine = jnp.where(axial, 1 - t2 / 6, jnp.sin(t) / t)
        return jnp.append(sine * flat, jnp.where(axial, 1 - t2 / 2, jnp.cos(t)))

    def depth(self, point: Point) -> Scalar:
        """The distance of a point."""
        return jnp.linalg.norm(point)

    def sees(self, point: Point) -> Bool[Array, ""]:
        """Not within 8° of straight behind, where directions have no place, and nowhere beyond the
        angle from which on the model would fold the picture back."""
        return (point[-1] > -0.99 * self.depth(point)) & self.unfolded(self.flat(point))


LENSES: dict[str, type[AbstractLens]] = {
    "pinhole": RadialTangential,
    "rational": Rational,
    "fisheye": Fisheye,
}
"""Lenses by the `model` of a calibration file."""


@jax.custom_jvp
def _straightened(lens: AbstractBent, bent: Place) -> Place:
    def step(flat, _):
        return flat - _undone(lens, flat, lens.bent(flat) - bent), None

    return jax.lax.scan(step, bent, length=STRAIGHTEN_ITERATIONS)[0]


@_straightened.defjvp
def _(primals, tangents):
    """Of an implicit function: its own Newton step, not the derivatives of all."""
    (lens, _), (by_lens, moved) = primals, tangents
    flat = _straightened(*primals)
    _, changed = jax.jvp(lambda lens: lens.bent(flat), (lens,), (by_lens,))
    return flat, _undone(lens, flat, moved - changed)


def _undone(lens: AbstractBent, flat: Place, change: Place) -> Place:
    """By how much the ideal place changes where the distorted one does so: J⁻¹ of the change."""
    (a, b), (c, d) = jax.jacfwd(lens.bent)(flat)
    by = jnp.stack([d * change[0] - b * change[1], a * change[1] - c * change[0]])
    return by / (a * d - b * c)
