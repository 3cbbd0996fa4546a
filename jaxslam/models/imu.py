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

from jaxslam._numerics.arrays import (
    AnyArray,
    Number,
    check_numbers,
    check_shape,
    number_field,
    optional_numbers,
)
from jaxslam.geometry import (
    SPATIAL,
    Geometry,
    Pose,
    Scalar,
    exp,
    joined,
    log,
    retract,
    step_tangents,
)
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
    by_clock: Float[Array, " 9"]
    """The same by a shift of the whole step to later readings, 1/s."""


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
    mount: Float[Array, " m"]
    """The tangent by which T_CI is off, on its right, m and rad; empty where that is known."""
    clock: Float[Array, " c"]
    """Seconds by which the unit's clock is ahead, beside what is known; empty where nothing is."""

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
    noise does in third order. Raises ValueError for other shapes and seconds below 0.
    """
    seconds, gyroscope, accelerometer = map(jnp.asarray, (seconds, gyroscope, accelerometer))
    check_shape("seconds", seconds, (seconds.size,))
    check_numbers("seconds", seconds, "not negative")
    check_shape("gyroscope", gyroscope, (seconds.size, 3))
    check_shape("accelerometer", accelerometer, (seconds.size, 3))
    bias = jnp.zeros(6, seconds.dtype) if bias is None else jnp.asarray(bias)
    rates, forces = gyroscope - bias[:3], accelerometer - bias[3:]
    turned, sped, moved = _integrated(seconds, rates, forces)
    total = jnp.sum(seconds)
    slope = _slope(seconds, total)

    def change(off: Float[Array, " 6"], sloped: Float[Array, " 6"], later: Scalar) -> Array:
        """Of errors that stay in the step, and of their slopes, in both sensors; and of a step
        that begins and ends so many seconds later."""
        read = jnp.concatenate([rates, forces], axis=1) - off - jnp.outer(slope, sloped)
        last = jnp.max(jnp.flatnonzero(seconds, size=len(seconds)))
        held = seconds.at[0].add(-later).at[last].add(later)
        to, by, at = _integrated(held, read[:, :3], read[:, 3:])
        return jnp.concatenate([log(turned.inverse() @ to), by, at])

    none = jnp.zeros(6, seconds.dtype)
    by_bias, by_slope, by_clock = jax.jacfwd(change, (0, 1, 2))(none, none, none[0])
    by_mean = by_bias / jnp.sqrt(jnp.where(total > 0, total, 1.0))
    by_noise = jnp.concatenate([by_mean, by_slope], axis=1)
    return Increments(total, turned, sped, moved, bias, by_bias, by_noise, by_clock)


def _integrated(
    seconds: Float[Array, " m"], rates: Float[Array, "m 3"], forces: Float[Array, "m 3"]
) -> tuple[jaxlie.SO3, Vector, Vector]:
    """ΔR, Δv and Δp of readings without errors."""

    def one(carry, reading):
        turned, sped, moved = carry
        h, rate, force = reading
        half = exp(jaxlie.SO3, rate * h / 2)
        middle = turned @ half
        gain = middle @ force * h
        return ((middle @ half).normalize(), sped + gain, moved + (sped + gain / 2) * h), None

    none = jnp.zeros(3, rates.dtype)
    start = jaxlie.SO3(jnp.array([1.0, 0.0, 0.0, 0.0], rates.dtype)), none, none
    (turned, sped, moved), _ = jax.lax.scan(one, start, (seconds, rates, forces))
    return turned, sped, moved


def _slope(seconds: Float[Array, " m"], total: Scalar) -> Float[Array, " m"]:
    """The straight line in time φ with `∫ φ dt = 0` and `∫ φ² dt = 1`; 0 for one reading."""
    middle = jnp.cumsum(seconds) - seconds / 2 - total / 2
    size = jnp.sum(seconds * middle**2)
    return jnp.where(size > 0, middle / jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)


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
    root: Float[AnyArray, "v v"] | None = eqx.field(default=None, converter=optional_numbers)
    """R of the covariance `R Rᵀ` of velocity, biases, direction, mount and clock, in place of all
    σ."""
    camera_from_imu: Float[AnyArray, "4 4"] = number_field(
        default=tuple(tuple(float(i == j) for j in range(4)) for i in range(4))
    )
    """T_CI, the pose of the unit in the camera."""
    mount_sigma: Float[AnyArray, " m"] = number_field(default=())
    """σ of its position, m, and rotation, rad, about the unit's axes, where they are estimated."""
    clock_sigma: Float[AnyArray, " c"] = number_field(default=())
    """σ of the offset between the clocks of unit and camera, s, where it is estimated; simulations
    have no offset."""
    gravity: Number = number_field(default=9.81)
    """m/s²."""
    readings: int = eqx.field(static=True, default=40)
    """Readings of a step that a simulation draws."""

    def __check_init__(self) -> None:
        twos = dict.fromkeys(("density", "walk", "bias_sigma", "start_sigma"), (2,))
        shapes = twos | {"bias": (6,), "velocity": (3,), "down": (3,), "camera_from_imu": (4, 4)}
        for name, shape in shapes.items():
            check_shape(f"{name} of an Imu", getattr(self, name), shape)
        check_shape("mount_sigma of an Imu", self.mount_sigma, (0,), (6,))
        check_shape("clock_sigma of an Imu", self.clock_sigma, (0,), (1,))

    @property
    def geometry(self) -> Geometry:
        return SPATIAL

    def mount(self, off: Float[Array, " m"]) -> Pose:
        """T_CI, on the right of which is what it is off by."""
        known = jaxlie.SE3.from_matrix(jnp.asarray(self.camera_from_imu))
        return known @ exp(jaxlie.SE3, off) if off.size else known

    @property
    def noise_sigma(self) -> Float[Array, " 18"]:
        white, walk = (jnp.repeat(jnp.asarray(x), 3) for x in (self.density, self.walk))
        return jnp.concatenate([white, white, walk])

    def start(self) -> tuple[InertialState, Float[Array, "v v"]]:
        numbers = self.velocity, self.bias, self.down, self.mount_sigma, self.clock_sigma
        velocity, bias, down, *rest = map(jnp.asarray, numbers)
        variables = InertialState(velocity, bias[:3], bias[3:], down, *map(jnp.zeros_like, rest))
        if self.root is not None:
            return variables, jnp.asarray(self.root)
        of_velocity, of_down = self.start_sigma
        sigma = jnp.repeat(jnp.stack([of_velocity, *self.bias_sigma]), 3)
        across = (jnp.eye(3, dtype=down.dtype) - jnp.outer(down, down)) * of_down
        diagonal = map(jnp.diag, (sigma, *rest))
        return variables, jax.scipy.linalg.block_diag(next(diagonal), across, *diagonal)

    def begun(self, variables: InertialState, root: Float[Array, "v v"]) -> Imu:
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
        error += control.by_clock * jnp.sum(variables.clock)
        pull = self.gravity * T * variables.down / jnp.linalg.norm(variables.down)
        sped = control.sped + error[3:6] + pull
        moved = control.moved + error[6:] + (variables.velocity + pull / 2) * T
        return control.turned @ exp(jaxlie.SO3, error[:3]), sped, moved, walked

    def displacement(
        self, variables: InertialState, noise: Float[Array, " 18"], control: Increments
    ) -> Pose:
        """`T_{k-1,k} = T_CI (ΔR, v T + g T²/2 + Δp) T_CI⁻¹`."""
        turned, _, moved, _ = self._moved(variables, noise, control)
        T_CI = self.mount(variables.mount)
        return T_CI @ joined(turned, moved) @ T_CI.inverse()

    def next(
        self, variables: InertialState, noise: Float[Array, " 18"], control: Increments
    ) -> InertialState:
        """`v ← ΔRᵀ (v + g T + Δv)`, `g ← ΔRᵀ g`, and the biases a step of their walks further."""
        turned, sped, _, walked = self._moved(variables, noise, control)
        back, down = turned.inverse(), variables.down
        return replace(
            variables,
            velocity=back @ (variables.velocity + sped),
            gyroscope_bias=variables.gyroscope_bias + walked[:3],
            accelerometer_bias=variables.accelerometer_bias + walked[3:],
            down=back @ (down / jnp.linalg.norm(down)),
        )

    def enlarged(
        self, variables: InertialState, noise: Float[Array, " 18"], factor: Scalar
    ) -> tuple[InertialState, Float[Array, " 18"]]:
        """The velocity in another unit of length; what drives it stays in metres."""
        return replace(variables, velocity=factor * variables.velocity), noise

    def still(self, dtype: DTypeLike | None = None) -> Increments:
        dtype = dtype or jnp.result_type(float)
        turned = jaxlie.SO3(jnp.array([1.0, 0.0, 0.0, 0.0], dtype))
        shapes = (), (3,), (3,), (6,), (9, 6), (9, 12), (9,)
        seconds, *rest = (jnp.zeros(shape, dtype) for shape in shapes)
        return Increments(seconds, turned, *rest)

    def along(
        self, path: Pose, seconds: Scalar, down: Vector | None, key: Array
    ) -> tuple[Pose, Increments, Imu]:
        """Readings of a camera along a path of `steps · readings + 1` poses, `seconds` apart, in a
        world where gravity points `down`, or where it is the model's mean at the first pose.

        Velocities are central differences. The poses that are returned, of every frame, are where
        the readings without errors lead from the first, and the model has a start that is off by
        its σ. Raises ValueError for fewer than three poses.
        """
        start_key, mount_key, noise_key, walk_key = jax.random.split(key, 4)
        sigma = jnp.asarray(self.mount_sigma)
        off = sigma * jax.random.normal(mount_key, sigma.shape, sigma.dtype)
        unit = jax.vmap(lambda T_WC: T_WC @ self.mount(off))(path)
        R, p = unit.rotation(), unit.translation()
        v = jnp.asarray(jnp.gradient(p, axis=0)) / seconds
        turns, before = step_tangents(R), jax.tree.map(lambda x: x[:-1], R)
        half = jax.vmap(lambda a, turn: a @ exp(jaxlie.SO3, turn / 2))(before, turns)
        if down is None:
            down = jax.tree.map(lambda x: x[0], R) @ jnp.asarray(self.down)
        pull = self.gravity * down
        forces = jax.vmap(lambda R, a: R.inverse() @ (a - pull))(
            half, jnp.diff(v, axis=0) / seconds
        )
        rates = jnp.concatenate([turns / seconds, forces], axis=1)

        normal, root = partial(jax.random.normal, dtype=rates.dtype), jnp.sqrt(seconds)
        start, told = self._true_start(unit, v[0], down, start_key)
        start = replace(start, mount=off)
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
        still = replace(self.still(rates.dtype), seconds=self.readings * seconds)

        def without_errors(rates):
            turned, sped, moved = _integrated(at, rates[:, :3], rates[:, 3:])
            return replace(still, turned=turned, sped=sped, moved=moved)

        exact = jax.vmap(without_errors)(of_steps(rates))
        return self._through(exact, path, start), controls, told

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
        drawn = retract(mean, root @ jax.random.normal(key, root.shape[:1], root.dtype))
        truth = replace(
            told, gyroscope_bias=drawn.gyroscope_bias, accelerometer_bias=drawn.accelerometer_bias
        )
        direction = told.down + drawn.down - mean.down
        velocity = told.velocity + mean.velocity - drawn.velocity
        told = replace(told, velocity=velocity, down=direction / jnp.linalg.norm(direction))
        root = replace(self, down=told.down).start()[1]
        return truth, self.begun(told, root)

    def _through(self, controls: Increments, path: Pose, start: InertialState) -> Pose:
        """The camera's pose in every frame, of readings without errors."""
        first = jax.tree.map(lambda x: x[0], path)
        none = jnp.zeros(3, start.down.dtype)
        start = replace(start, gyroscope_bias=none, accelerometer_bias=none)
        noise = jnp.zeros(18, none.dtype)

        def move(carry, control):
            pose, variables = carry
            pose = (pose @ self.displacement(variables, noise, control)).normalize()
            return (pose, self.next(variables, noise, control)), pose

        _, poses = jax.lax.scan(move, (first, start), controls)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, poses)
