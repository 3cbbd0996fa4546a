"""Motion models of a camera: the displacement between two frames, driven by white noise.

A model says what a *control* makes of the variables that it keeps in the state and of this step's
noise. The control is data: the seconds of the step, or the odometry's reading. A model of your own
is one class with the functions of `AbstractMotion`.

Velocities and displacements are in the camera's axes, x right, y down, z ahead: (x, z, θ) in the
plane, with θ turning from x towards z, that is to the left; (x, y, z, about x, about y, about z) in
space. A cart that drives ahead at v and turns left at ω has the velocity (0, v, ω). Where a log has
x ahead and y left, as ROS does, a planar velocity (vx, vy, ω) is (−vy, vx, ω) here.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from jaxslam._numerics.arrays import AnyArray, Number, check_shape, number_field
from jaxslam.geometry import GEOMETRIES, Geometry, Pose, Scalar, exp, joined

Tangent = Float[Array, " t"]
"""A velocity, or a displacement: linear, then angular."""
Variables = PyTree
"""The variables of a model in the state: poses and vectors."""
Control = PyTree
"""A model's input for one step, or for each of some."""


class AbstractMotion(eqx.Module):
    """A motion model. What it keeps in the state is any pytree of poses and vectors."""

    has_velocity: ClassVar[bool] = False
    """Whether its variables are a velocity, linear and angular, and nothing that it is given is in
    metres: then the scale is free."""
    estimates_velocity: ClassVar[bool] = False
    """Whether its variables begin with a linear velocity, which a Gaussian sum can divide."""

    if TYPE_CHECKING:  # a field or a property of each model

        @property
        def geometry(self) -> Geometry:
            """The world it is for."""

        @property
        def noise_sigma(self) -> Float[AnyArray, " q"]:
            """σ of the white noise of one step (Q of P11)."""

        @property
        def readings(self) -> int:
            """Poses of a step along which a simulation reads it; of one that has `along`."""

    def start(self) -> tuple[Variables, Float[Array, "v v"]]:
        """The variables before the first step, and a root of their covariance, `P = R Rᵀ`."""
        return (), jnp.zeros((0, 0))

    def begun(self, variables: Variables, root: Float[Array, "v v"]) -> AbstractMotion:
        """The model that starts so; of one whose variables are known to start with."""
        raise NotImplementedError(f"{type(self).__name__} does not say where else it could start")

    @abstractmethod
    def displacement(
        self, variables: Variables, noise: Float[Array, " q"], control: Control
    ) -> Pose:
        """T_{k-1,k}, the pose of C_k in C_{k-1}."""

    def next(self, variables: Variables, noise: Float[Array, " q"], control: Control) -> Variables:
        """The variables after the step; as they were, unless a model says otherwise."""
        del noise, control
        return variables

    @abstractmethod
    def still(self, dtype: DTypeLike | None = None) -> Control:
        """The control with which nothing moves."""

    def nominal_control(self, velocity: Float[Array, " t"], seconds: Number) -> Control:
        """The control of a step at a constant velocity: what a simulation gives the model."""
        raise NotImplementedError(f"{type(self).__name__} does not say how to simulate it")

    def reading(self, control: Control, noise: Float[Array, " q"]) -> Control:
        """What a simulation tells a filter of this control. Of a model that says so the noise is of
        the reading, and the truth moves by the control exactly; of others it moves the truth."""
        del noise
        return control

    def along(
        self, path: Pose, seconds: Scalar, down: Float[Array, " n"] | None, key: Array
    ) -> tuple[Pose, Control, AbstractMotion]:
        """What a simulation draws along a path of T_WC that are `seconds` apart: the true poses of
        frames, the control of every step, and the model with this run's start. Only of a model
        that says so; `down` is the direction of gravity in W, the model's own where it is None."""
        raise NotImplementedError(f"{type(self).__name__} does not say how it is read along a path")

    def enlarged(
        self, variables: Variables, noise: Float[Array, " q"], factor: Scalar
    ) -> tuple[Variables, Float[Array, " q"]]:
        """Variables and noise in a unit of length that is 1/factor; a model that is given metres
        has no other."""
        del factor
        return variables, noise


def geometry_of(tangent: Float[AnyArray, " t"], what: str) -> Geometry:
    """The world in which a pose has so many degrees of freedom. Raises ValueError."""
    for geometry in GEOMETRIES.values():
        if np.shape(tangent) == (geometry.tangent_dim,):
            return geometry
    raise ValueError(
        f"{what} has shape {np.shape(tangent)}; it needs 3 numbers (x, z, θ) in a planar world or "
        "6 (x, y, z, and about them) in a spatial one"
    )


class ConstantVelocity(AbstractMotion):
    """Constant velocity with white acceleration; the control is Δt in seconds (P8, P9)."""

    has_velocity: ClassVar[bool] = True
    estimates_velocity: ClassVar[bool] = True

    noise_sigma: Float[AnyArray, " t"] = number_field()
    """σ of the acceleration, m/s² and rad/s², in the camera's axes."""
    velocity: Float[AnyArray, " t"] = number_field()
    """Mean of the velocity before the first step, m/s and rad/s, in the camera's axes."""
    velocity_sigma: Float[AnyArray, " t"] | Float[AnyArray, "t t"] = number_field()
    """σ of each of its numbers, or a root R of its covariance `R Rᵀ`."""

    def __check_init__(self) -> None:
        t = self.geometry.tangent_dim
        check_shape("the velocity", self.velocity, (t,))
        check_shape("the velocity's sigma", self.velocity_sigma, (t,), (t, t))

    @property
    def geometry(self) -> Geometry:
        return geometry_of(self.noise_sigma, "the sigma of an acceleration")

    def start(self) -> tuple[Tangent, Float[Array, "t t"]]:
        sigma = jnp.asarray(self.velocity_sigma)
        return jnp.asarray(self.velocity), jnp.diag(sigma) if sigma.ndim == 1 else sigma

    def begun(self, variables: Tangent, root: Float[Array, "t t"]) -> ConstantVelocity:
        return replace(self, velocity=variables, velocity_sigma=root)

    def displacement(self, variables: Tangent, noise: Tangent, control: Number) -> Pose:
        """`T_{k-1,k} = Exp((v + a Δt) Δt)` (P9)."""
        return exp(self.geometry.group, self.next(variables, noise, control) * control)

    def next(self, variables: Tangent, noise: Tangent, control: Number) -> Tangent:
        """`v_k = v_{k-1} + a Δt` (P8), linear then angular, in the camera's own frame."""
        return variables + noise * control

    def still(self, dtype: DTypeLike | None = None) -> Scalar:
        return jnp.zeros((), dtype)

    def nominal_control(self, velocity: Tangent, seconds: Number) -> Number:
        return seconds

    def enlarged(
        self, variables: Tangent, noise: Tangent, factor: Scalar
    ) -> tuple[Tangent, Tangent]:
        n = self.geometry.point_dim

        def one(rates):
            return jnp.concatenate([factor * rates[:n], rates[n:]])

        return one(variables), one(noise)


class Odometry(AbstractMotion):
    """Odometry; the control is its reading u of a step, m and rad, with white error w."""

    noise_sigma: Float[AnyArray, " t"] = number_field()
    """σ of the reading of one step, m and rad, in the camera's axes."""

    @property
    def geometry(self) -> Geometry:
        return geometry_of(self.noise_sigma, "the sigma of an odometry")

    def displacement(
        self, variables: tuple[()], noise: Tangent, control: Float[AnyArray, " t"]
    ) -> Pose:
        """`T_{k-1,k} = (R = Exp(θ), t = ρ)` with (ρ, θ) = u + w: move straight, then turn."""
        del variables
        moved, turned = jnp.split(control + noise, [self.geometry.point_dim])
        return joined(exp(self.geometry.rotation_group, turned), moved)

    def still(self, dtype: DTypeLike | None = None) -> Tangent:
        return jnp.zeros(self.geometry.tangent_dim, dtype)

    def nominal_control(self, velocity: Tangent, seconds: Number) -> Tangent:
        return velocity / (1 / seconds)  # at 10 Hz 0.8 m/s is 0.08 m, and no rounding more

    def reading(self, control: Tangent, noise: Tangent) -> Tangent:
        """`u = (ρ, θ) − w`."""
        return control - noise


def check_control(motion: AbstractMotion, control: Control) -> None:
    """Raise ValueError unless a control has the structure and shapes that the model asks for."""
    wanted = jax.eval_shape(motion.still)
    found = jax.tree.structure(control), [np.shape(x) for x in jax.tree.leaves(control)]
    if found != (jax.tree.structure(wanted), [x.shape for x in jax.tree.leaves(wanted)]):
        raise ValueError(
            f"the control of {type(motion).__name__} is {_described(wanted)}, "
            f"not {_described(control)}"
        )


def _described(control: Control) -> str:
    shapes = [str(np.shape(x)) for x in jax.tree.leaves(control)]
    kind = "an array" if len(shapes) == 1 else f"{type(control).__name__} with arrays"
    return f"{kind} of shape {', '.join(shapes)}"
