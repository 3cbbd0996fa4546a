"""One simulated run: a true trajectory, true landmarks, and the noisy measurements of a frame."""

from __future__ import annotations

from dataclasses import replace
from numbers import Integral
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import cast
from jaxslam.geometry import Pose, exp, identity, retract, step_tangents
from jaxslam.linalg import semidefinite_root
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import PriorMap
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation.run import Run, in_order_of_appearance, in_shared_slots
from jaxslam.simulation.scenario import as_scenario
from jaxslam.simulation.trajectories import RecordedMotion, find, from_first, sampled
from jaxslam.simulation.visibility import limited
from jaxslam.simulation.world import NominalCalibration, World

SWAY = np.array([0.31, 0.23, 0.27, 0.37, 0.41, 0.19])
"""Hz, at which each number of a velocity sways."""


def as_data(world: World, dtype: DTypeLike | None = None) -> World:
    """The world with its numbers as arrays, its trajectory read and without its name: what a
    program is made for. Raises ValueError as `trajectory_of`."""
    if isinstance(world.rate, jax.Array):
        return world
    dtype = dtype or jnp.result_type(float)
    unnamed = replace(world, name="", treatment="known", trajectory=trajectory_of(world))

    def number(leaf: Any) -> Any:
        return jnp.asarray(leaf, dtype) if isinstance(leaf, float | int) else leaf

    return cast(jax.tree.map(number, unnamed), dtype)


def with_own(
    scenario: World | str,
    motion: AbstractMotion | RecordedMotion | None = None,
    sensor: AbstractSensor | None = None,
) -> World:
    """The scenario's world, or that in which the truth moves, or is measured, as these say."""
    world = as_scenario(scenario)
    if isinstance(motion, RecordedMotion):
        world = replace(world, trajectory=motion)
    elif motion is not None:
        world = replace(world, motion=motion, trajectory=None)
    if sensor is not None:
        truth = world.calibration
        try:
            eqx.filter_eval_shape(sensor.perturbed, jnp.asarray(truth.sigma))
        except (TypeError, ValueError):  # of another sensor
            truth = NominalCalibration()
        world = replace(world, sensor=sensor, calibration=truth, treatment="known")
    return world


def simulate(
    scenario: World | str,
    key: Array | int,
    dtype: DTypeLike | None = None,
    *,
    motion: AbstractMotion | RecordedMotion | None = None,
    sensor: AbstractSensor | None = None,
) -> Run:
    """Draw one run: a pure function of a world's numbers and of a key, or of a seed.

    Run i of a study is of the key `jax.random.fold_in(jax.random.key(seed), i)`. The truth is drawn
    from the prior of the filters of `make_filters`, or moves along the world's trajectory. A
    `motion` and a `sensor` take the place of the world's. Raises ValueError for what is no key.
    """
    world = as_data(with_own(scenario, motion, sensor), dtype)
    motion_key, world_key, camera_key, pixel_key = jax.random.split(_as_key(key), 4)
    poses, controls, told = (_read_path if world.inertial else _path)(world, motion_key)
    sensors = world.calibration.sensors(world.sensor, camera_key, world.steps + 1)
    if world.sensor.rolling:
        sensors = jax.vmap(lambda sensor, v: sensor.moving(v))(sensors, _velocities(world, poses))
    points, new = world.placement.along(world, world_key, poses, sensors)
    every = jax.vmap(world.measured, in_axes=(0, 0, None if new is None else 0))
    measured, seen = every(poses, sensors, points)
    seen &= jnp.arange(world.steps + 1)[:, None] >= world.limits.first_frame
    # A key of its own, so that a limit changes nothing else of a run.
    seen = limited(world.limits, jax.random.fold_in(pixel_key, 1), seen)
    noise = jax.random.normal(pixel_key, measured.shape, measured.dtype)
    errors = _errors(world.sensor, measured, noise)
    drift_key, beacon_key = (jax.random.fold_in(pixel_key, i) for i in (2, 3))
    if world.drift is not None:
        errors += world.drift.errors(drift_key, measured)
    run = Run(poses, points, measured + errors, seen, controls, sensors, new, motion=told)
    if world.limits.in_view:
        return in_shared_slots(run, world.limits.in_view)
    if new is not None:
        return run
    if world.beacons:
        run = replace(run, known=_surveyed(world, points, beacon_key))
    return in_order_of_appearance(run)


def _as_key(key: Any) -> Array:
    """A key, or that of a seed. Raises ValueError for anything else."""
    if isinstance(key, Integral) and not isinstance(key, bool) and 0 <= key < 2**63:
        return jax.random.key(int(key))
    is_key = isinstance(key, jax.Array) and key.ndim <= 1
    if is_key and (jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or key.dtype == jnp.uint32):
        return key
    raise ValueError(f"a key is jax.random.key(seed), or a seed of 0 to 2⁶³ − 1, not {key!r}")


def _errors(
    sensor: AbstractSensor, measured: Float[Array, "f l p"], normal: Float[Array, "f l p"]
) -> Float[Array, "f l p"]:
    """The errors of measurements, of standard normal numbers."""
    kind = type(sensor)
    if (kind.noise, kind.noise_at) == (AbstractSensor.noise, AbstractSensor.noise_at):
        return sensor.sigma * normal  # the root of a constant R that is diagonal

    def error(measured, normal):
        return semidefinite_root(sensor.noise_at(measured)).root @ normal

    return jax.vmap(jax.vmap(error))(measured, normal)


def _surveyed(world: World, points: Float[Array, "l n"], key: Array) -> PriorMap:
    """What a survey says of the beacons, which are spread evenly over the landmarks."""
    slots = jnp.arange(world.beacons) * world.landmarks // world.beacons
    truth, sigma = points[slots], world.beacon_sigma
    errors = sigma * jax.random.normal(key, truth.shape, truth.dtype)
    return PriorMap(slots, truth + errors, sigma**2 * jnp.eye(truth.size, dtype=truth.dtype))


def trajectory_of(world: World) -> RecordedMotion | None:
    """Along what the world's camera moves, where that is recorded.

    Raises ValueError where its file is none, or has no piece that is long enough.
    """
    if not isinstance(world.trajectory, str):
        return world.trajectory
    moving = world.steps - min(world.still_frames, world.steps)
    of_step = world.motion.readings if world.inertial else 1
    return sampled(find(world.trajectory), float(world.rate) * of_step, moving * of_step)


def _read_path(world: World, key: Array) -> tuple[Pose, Control, AbstractMotion]:
    """The true poses, what the filter is given at every step, and its motion with this run's start:
    of a motion that is read many times a step."""
    motion = world.motion
    path_key, key = jax.random.split(key)
    seconds = jnp.asarray(1 / (world.rate * motion.readings))
    if isinstance(world.trajectory, RecordedMotion):
        path, down = world.trajectory.piece(path_key), -jnp.eye(3, dtype=seconds.dtype)[2]
    else:
        path, down = _swaying(world, path_key, seconds), None
    poses, controls, told = motion.along(path, seconds, down, key)
    return from_first(poses), controls, told


def _swaying(world: World, key: Array, seconds: Array) -> Pose:
    """A path at the nominal velocity and what it sways by, after frames that stand still."""
    count = world.steps * world.motion.readings
    time = (jnp.arange(count, dtype=seconds.dtype) + 0.5)[:, None] * seconds
    phase = jax.random.uniform(key, (6,), time.dtype, maxval=2 * jnp.pi)
    velocity = world.velocity + world.sway * jnp.sin(2 * jnp.pi * SWAY * time + phase)
    started = jnp.clip(time - world.still_frames / world.rate, 0.0, 1.0)
    started = started**2 * (3 - 2 * started) if world.still_frames else jnp.ones_like(time)
    group, origin = world.geometry.group, identity(world.geometry, time.dtype)

    def move(pose, velocity):
        pose = (pose @ exp(group, velocity * seconds)).normalize()
        return pose, pose

    return _with_start(origin, jax.lax.scan(move, origin, started * velocity)[1])


def _path(world: World, key: Array) -> tuple[Pose, Control, None]:
    """The true poses, and what the filter is given at every step.

    In frames in which the camera stands still, neither pose nor variables move.
    """
    motion, dtype = world.motion, jnp.result_type(world.rate)
    control = motion.nominal_control(jnp.asarray(world.velocity), 1 / world.rate)
    still = min(world.still_frames, world.steps)
    moving, origin = world.steps - still, identity(motion.geometry, dtype)
    every = jax.tree.map(lambda x: jnp.full((world.steps, *jnp.shape(x)), x), control)
    if isinstance(world.trajectory, RecordedMotion):
        if world.trajectory.steps != moving:
            raise ValueError(f"a trajectory for {world.trajectory.steps} steps, not {moving}")
        poses = jax.tree.map(lambda x: x[1:], world.trajectory.run(key))
        return _with_start(origin, poses, still), every, None
    # Of a reading all of the noise, as of a motion the start too, from the filter's prior (P8, P9).
    start_key, noise_key = (
        (jax.random.fold_in(key, 1), key) if world.reads else jax.random.split(key)
    )
    mean, root = motion.start()
    start = mean
    if root.size:
        start = retract(start, root @ jax.random.normal(start_key, root.shape[:1], dtype))
    sigma = jnp.asarray(motion.noise_sigma)
    noises = sigma * jax.random.normal(noise_key, (moving, sigma.size), dtype)

    def move(carry, noise):
        pose, variables = carry
        pose = (pose @ motion.displacement(variables, noise, control)).normalize()
        return (pose, motion.next(variables, noise, control)), pose

    moved = jnp.zeros_like(noises) if world.reads else noises
    _, poses = jax.lax.scan(move, (origin, start), moved)
    if world.reads:
        every = jax.vmap(motion.reading, in_axes=(None, 0))(control, noises)
    return _with_start(origin, poses, still), every, None


def _velocities(world: World, poses: Pose) -> Float[Array, "frames t"]:
    """The mean velocity of the step before every frame; in frame 0 that of the step after it."""
    velocities = step_tangents(poses) * world.rate
    return jnp.concatenate([velocities[:1], velocities])


def _with_start(start: Pose, poses: Pose, still: int = 0) -> Pose:
    """The start, the same again for so many frames, and the poses."""
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (1 + still, *x.shape)), start)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), starts, poses)
