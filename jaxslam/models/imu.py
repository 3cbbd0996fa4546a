"""An inertial unit as a motion model: any number of readings between two frames, metres, gravity.

The readings are angular velocities ω, rad/s, and specific forces f, m/s², in the unit's axes I,
each with a bias b and white noise n of a density that data sheets have:

    Ṙ = R [ω − b_g − n_g]×,    v̇ = R (f − b_a − n_a) + g,    ṗ = v.

All readings of a step are integrated once, before any filter, to `Increments`, whose change by the
biases is kept to first order (Lupton, Sukkarieh, T-RO 2012; Forster et al., T-RO 2017): a filter's
step costs the same however many they are. Nothing is said about the world: gravity is a direction
in the unit's axes that turns with it, as in a robocentric filter (Huai, Huang, IROS 2018).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import AnyArray, Number, check_shape, number_field, optional_numbers
from jaxslam.geometry import SPATIAL, Geometry, Pose, Scalar, exp, identity, joined, log, retract
from jaxslam.models.motion import AbstractMotion

Vector = Float[Array, " 3"]
_WHITE = 12
"""Numbers of white noise in a step: the mean and the slope of each axis of both sensors."""


class Increments(eqx.Module):
    """The readings of one step, integrated without gravity and without the velocity before it."""

    seconds: Scalar
    """T, the length of the step."""
    turned: jaxlie.SO3
    """ΔR, the rotation of the unit."""
    sped: Vector
    """Δv = ∫ R f dt, m/s, in the axes of the unit before the step."""
    moved: Vector
    """Δp = ∫∫ R f dt², m, in the same axes."""
    bias: Float[Array, " 6"]
    """Biases of gyroscope and accelerometer at which the readings were integrated."""
    by_bias: Float[Array, "9 6"]
    """Derivative of (Log ΔR, Δv, Δp), on the right of ΔR, by the biases."""
    by_noise: Float[Array, "9 12"]
    """The same by the white noise, of unit density."""


class InertialState(eqx.Module):
    """What an inertial unit keeps in a filter's state, in the unit's own axes."""

    velocity: Vector
    """m/s."""
    gyroscope_bias: Vector
    """rad/s."""
    accelerometer_bias: Vector
    """m/s²."""
    down: Vector
    """The direction of gravity; its length means nothing, as that of a homogeneous point."""

    @property
    def bias(self) -> Float[Array, " 6"]:
        return jnp.concatenate([self.gyroscope_bias, self.accelerometer_bias])


def increments(
    seconds: Float[AnyArray, " m"],
    gyroscope: Float[AnyArray, "m 3"],
    accelerometer: Float[AnyArray, "m 3"],
    bias: Float[AnyArray, " 6"] | None = None,
) -> Increments:
    """Return the increments of readings that hold for so many seconds each: the control of `Imu`.

    A reading of no seconds is none. `bias` is where they are linearised, near the biases expected.

    Within a reading the specific force is turned by half the reading's rotation. The noise of one
    axis is white; of its course in a step the mean and the slope are kept, two orthonormal
    polynomials: they give the covariances of ΔR and Δv, and of Δp but for what the gyroscope's
    noise does in third order.
    """
    seconds, gyroscope, accelerometer = map(jnp.asarray, (seconds, gyroscope, accelerometer))
    bias = jnp.zeros(6, seconds.dtype) if bias is None else jnp.asarray(bias)
    rates = jnp.concatenate([gyroscope, accelerometer], axis=1) - bias
    mean, slope = _two_polynomials(seconds)
    turned, sped, moved = _integrated(seconds, rates)

    def change(off: Float[Array, " 18"]) -> Float[Array, " 9"]:
        noise = jnp.outer(mean, off[6:12]) + jnp.outer(slope, off[12:])
        to, by, at = _integrated(seconds, rates - off[:6] - noise)
        return jnp.concatenate([log(turned.inverse() @ to), by, at])

    J = jax.jacfwd(change)(jnp.zeros(18, seconds.dtype))
    return Increments(jnp.sum(seconds), turned, sped, moved, bias, J[:, :6], J[:, 6:])


def _integrated(
    seconds: Float[Array, " m"], rates: Float[Array, "m 6"]
) -> tuple[jaxlie.SO3, Vector, Vector]:
    """ΔR, Δv and Δp of readings without errors."""

    def one(carry, reading):
        turned, sped, moved = carry
        h, rates = reading
        half = exp(jaxlie.SO3, rates[:3] * h / 2)
        middle = turned @ half
        gain = middle @ rates[3:] * h
        return ((middle @ half).normalize(), sped + gain, moved + (sped + gain / 2) * h), None

    none = jnp.zeros(3, rates.dtype)
    start = identity(SPATIAL, rates.dtype).rotation(), none, none
    return jax.lax.scan(one, start, (seconds, rates))[0]


def _two_polynomials(
    seconds: Float[Array, " m"],
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Orthonormal functions of time of degree 0 and 1: `∫ φ_i φ_j dt = δ_ij`."""
    total = jnp.sum(seconds)
    middle = jnp.cumsum(seconds) - seconds / 2 - total / 2
    size = jnp.sum(seconds * middle**2)
    mean = jnp.where(total > 0, 1 / jnp.sqrt(jnp.where(total > 0, total, 1.0)), 0.0)
    slope = jnp.where(size > 0, 1 / jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)
    return jnp.full_like(seconds, mean), slope * middle


class Imu(AbstractMotion):
    """An inertial unit; the control is the `Increments` of a step.

    Noises are densities, as data sheets and Kalibr's `imu.yaml` have them. What is known of the
    start is in the unit's axes. Raises ValueError for shapes that are others.
    """

    estimates_velocity: ClassVar[bool] = True

    density: Float[AnyArray, " 2"] = number_field()
    """σ of the white noise of the gyroscope, rad/s/√Hz, and of the accelerometer, m/s²/√Hz."""
    walk: Float[AnyArray, " 2"] = number_field(default=(0.0, 0.0))
    """σ of the random walks of their biases, rad/s²/√Hz and m/s³/√Hz."""
    bias: Float[AnyArray, " 6"] = number_field(default=(0.0,) * 6)
    """Mean of the biases before the first step, rad/s and m/s²."""
    bias_sigma: Float[AnyArray, " 2"] = number_field(default=(0.01, 0.1))
    """σ of each of the gyroscope's, rad/s, and of the accelerometer's, m/s²."""
    velocity: Float[AnyArray, " 3"] = number_field(default=(0.0, 0.0, 0.0))
    """Mean of the velocity, m/s."""
    down: Float[AnyArray, " 3"] = number_field(default=(0.0, 1.0, 0.0))
    """Mean of the direction of gravity, a unit vector: at rest the opposite of the force read."""
    start_sigma: Float[AnyArray, " 2"] = number_field(default=(1.0, 0.1))
    """σ of each number of the velocity, m/s, and of gravity's direction about each axis, rad."""
    root: Float[AnyArray, "12 12"] | None = eqx.field(default=None, converter=optional_numbers)
    """R of the covariance `R Rᵀ` of velocity, biases and direction, in place of these σ."""
    camera_from_imu: Float[AnyArray, "4 4"] = number_field(
        default=tuple(tuple(float(i == j) for j in range(4)) for i in range(4))
    )
    """T_CI, the pose of the unit in the camera."""
    gravity: Number = number_field(default=9.81)
    """m/s²."""
    readings: int = eqx.field(static=True, default=40)
    """Readings of a step that a simulation draws."""

    def __check_init__(self) -> None:
        twos = dict.fromkeys(("density", "walk", "bias_sigma", "start_sigma"), (2,))
        shapes = twos | {"bias": (6,), "velocity": (3,), "down": (3,), "camera_from_imu": (4, 4)}
        for name, shape in shapes.items():
            check_shape(f"{name} of an Imu", getattr(self, name), shape)

    @property
    def geometry(self) -> Geometry:
        return SPATIAL

    @property
    def mount(self) -> Pose:
        """T_CI."""
        return jaxlie.SE3.from_matrix(jnp.asarray(self.camera_from_imu))

    @property
    def noise_sigma(self) -> Float[Array, " 18"]:
        white, walk = (jnp.repeat(jnp.asarray(x), 3) for x in (self.density, self.walk))
        return jnp.concatenate([white, white, walk])

    def start(self) -> tuple[InertialState, Float[Array, "12 12"]]:
        bias, down = jnp.asarray(self.bias), jnp.asarray(self.down)
        variables = InertialState(jnp.asarray(self.velocity), bias[:3], bias[3:], down)
        if self.root is not None:
            return variables, jnp.asarray(self.root)
        of_velocity, of_down = self.start_sigma
        sigma = jnp.repeat(jnp.stack([of_velocity, *self.bias_sigma]), 3)
        across = (jnp.eye(3, dtype=down.dtype) - jnp.outer(down, down)) * of_down
        return variables, jax.scipy.linalg.block_diag(jnp.diag(sigma), across)

    def begun(self, variables: InertialState, root: Float[Array, "12 12"]) -> Imu:
        v = variables
        return replace(self, velocity=v.velocity, bias=v.bias, down=v.down, root=root)

    def _moved(
        self, variables: InertialState, noise: Float[Array, " 18"], control: Increments
    ) -> tuple[jaxlie.SO3, Vector, Vector, Float[Array, " 6"]]:
        """ΔR, Δv and Δp of the unit, in its axes before the step, and the change of the biases.

        The biases are those of the middle of the step.
        """
        T = control.seconds
        root = jnp.where(T > 0, jnp.sqrt(jnp.where(T > 0, T, 1.0)), 0.0)
        walked = noise[_WHITE:] * root
        off = variables.bias + walked / 2 - control.bias
        error = control.by_bias @ off + control.by_noise @ noise[:_WHITE]
        pull = self.gravity * T * variables.down / jnp.linalg.norm(variables.down)
        sped = control.sped + error[3:6] + pull
        moved = control.moved + error[6:] + (variables.velocity + pull / 2) * T
        return control.turned @ exp(jaxlie.SO3, error[:3]), sped, moved, walked

    def displacement(
        self, variables: InertialState, noise: Float[Array, " 18"], control: Increments
    ) -> Pose:
        """`T_{k-1,k} = T_CI (ΔR, v T + g T²/2 + Δp) T_CI⁻¹`."""
        turned, _, moved, _ = self._moved(variables, noise, control)
        return self.mount @ joined(turned, moved) @ self.mount.inverse()

    def next(
        self, variables: InertialState, noise: Float[Array, " 18"], control: Increments
    ) -> InertialState:
        """`v ← ΔRᵀ (v + g T + Δv)`, `g ← ΔRᵀ g`, and the biases a step of their walks further."""
        turned, sped, _, walked = self._moved(variables, noise, control)
        back, down = turned.inverse(), variables.down
        return InertialState(
            velocity=back @ (variables.velocity + sped),
            gyroscope_bias=variables.gyroscope_bias + walked[:3],
            accelerometer_bias=variables.accelerometer_bias + walked[3:],
            down=back @ (down / jnp.linalg.norm(down)),
        )

    def still(self, dtype: DTypeLike | None = None) -> Increments:
        dtype = dtype or jnp.result_type(float)

        def zeros(*shape):
            return jnp.zeros(shape, dtype)

        turned = identity(SPATIAL, dtype).rotation()
        return Increments(zeros(), turned, zeros(3), zeros(3), zeros(6), zeros(9, 6), zeros(9, 12))

    def along(
        self, path: Pose, seconds: Scalar, down: Vector, key: Array
    ) -> tuple[Pose, Increments, Imu]:
        """Readings of a camera along a path of `steps · readings + 1` poses, `seconds` apart, in a
        world where gravity points `down`.

        Velocities are central differences. The poses that are returned, of every frame, are where
        the readings without errors lead from the first, and the model has a start that is off by
        its σ. Raises ValueError for fewer than three poses.
        """
        start_key, noise_key, walk_key = jax.random.split(key, 3)
        unit = jax.vmap(lambda T_WC: T_WC @ self.mount)(path)
        R, p = unit.rotation(), unit.translation()
        v = jnp.gradient(p, axis=0) / seconds
        turns = jax.vmap(log)(jax.vmap(lambda a, b: a.inverse() @ b)(*_neighbours(R)))
        half = jax.vmap(lambda a, turn: a @ exp(jaxlie.SO3, turn / 2))(_neighbours(R)[0], turns)
        pull = self.gravity * down
        forces = jax.vmap(lambda R, a: R.inverse() @ (a - pull))(
            half, jnp.diff(v, axis=0) / seconds
        )
        rates = jnp.concatenate([turns / seconds, forces], axis=1)

        normal, root = partial(jax.random.normal, dtype=rates.dtype), jnp.sqrt(seconds)
        start, told = self._true_start(unit, v[0], down, start_key)
        walked = jnp.cumsum(normal(walk_key, rates.shape), axis=0) * self.noise_sigma[_WHITE:]
        white = jnp.repeat(jnp.asarray(self.density), 3) / root
        read = rates + start.bias + walked * root + white * normal(noise_key, rates.shape)

        def of_steps(values):
            return values.reshape(-1, self.readings, *values.shape[1:])

        at = jnp.full(self.readings, seconds)
        # One step after another: their derivatives together do not fit a processor's cache.
        controls = jax.lax.map(
            lambda x: increments(at, x[:, :3], x[:, 3:], self.bias), of_steps(read)
        )
        moved = jax.vmap(lambda x: _integrated(at, x))(of_steps(rates))
        poses = self._through(moved, path, start, self.readings * seconds)
        return poses, controls, told

    def _true_start(
        self, unit: Pose, velocity: Vector, down: Vector, key: Array
    ) -> tuple[InertialState, Imu]:
        """The variables at the start of a path, and the model that is told them with their errors,
        of biases that are drawn."""
        mean, root = self.start()
        back = jax.tree.map(lambda x: x[0], unit).rotation().inverse()
        told = replace(mean, velocity=back @ velocity, down=back @ down)
        if self.root is None:  # of this direction
            root = replace(self, down=told.down).start()[1]
        off = root @ jax.random.normal(key, (12,), root.dtype)
        off = retract(jax.tree.map(jnp.zeros_like, mean), off)
        direction = told.down + off.down
        truth = replace(
            told,
            gyroscope_bias=mean.gyroscope_bias + off.gyroscope_bias,
            accelerometer_bias=mean.accelerometer_bias + off.accelerometer_bias,
        )
        told = replace(
            told,
            velocity=told.velocity - off.velocity,
            down=direction / jnp.linalg.norm(direction),
        )
        root = replace(self, down=told.down).start()[1]
        return truth, self.begun(told, root)

    def _through(
        self,
        moved: tuple[jaxlie.SO3, Vector, Vector],
        path: Pose,
        start: InertialState,
        seconds: Scalar,
    ) -> Pose:
        """The camera's pose in every frame, of readings without errors."""
        first = jax.tree.map(lambda x: x[0], path)
        none = jnp.zeros(3, start.down.dtype)
        start = replace(start, gyroscope_bias=none, accelerometer_bias=none)
        still = replace(self.still(none.dtype), seconds=seconds)
        noise = jnp.zeros(18, none.dtype)

        def move(carry, moved):
            pose, variables = carry
            turned, sped, moved = moved
            control = replace(still, turned=turned, sped=sped, moved=moved)
            pose = (pose @ self.displacement(variables, noise, control)).normalize()
            return (pose, self.next(variables, noise, control)), pose

        _, poses = jax.lax.scan(move, (first, start), moved)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, poses)


def _neighbours(batch):
    return jax.tree.map(lambda x: x[:-1], batch), jax.tree.map(lambda x: x[1:], batch)
