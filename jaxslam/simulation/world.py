"""One simulated run: a true trajectory, true landmarks, and the noisy pixels of every frame."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxslam._numerics.arrays import cast
from jaxslam.geometry import Pose, identity, retract
from jaxslam.models.camera import Camera
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.sensors import AbstractSensor, Pinhole
from jaxslam.simulation.pieces import calibration_sigma_of, motion_of, sensor_of
from jaxslam.simulation.placement import PLACEMENT, thrown
from jaxslam.simulation.run import Run, in_order_of_appearance, in_shared_slots
from jaxslam.simulation.scenario import Scenario, as_scenario
from jaxslam.simulation.trajectories import RecordedMotion, find, sampled
from jaxslam.simulation.visibility import limited, visible


def as_data(scenario: Scenario, dtype: DTypeLike | None = None) -> Scenario:
    """The scenario with its numbers as arrays and without its name: what a program is made for."""
    if any(isinstance(number, jax.Array) for number in jax.tree.leaves(scenario)):
        return scenario
    dtype = dtype or jnp.result_type(float)
    unnamed = replace(scenario, name="", calibration="known")
    return jax.tree.map(lambda number: jnp.asarray(number, dtype), unnamed)


def simulate(
    scenario: Scenario | str,
    key: Array,
    dtype: DTypeLike | None = None,
    *,
    motion: AbstractMotion | RecordedMotion | None = None,
    sensor: AbstractSensor | None = None,
) -> Run:
    """Draw one run: a pure function of the scenario's numbers and of the key (`jax.random.key`).

    The truth is drawn from the prior of the filters of `make_filters`, or moves along the
    scenario's trajectory; or it moves and is measured as models of one's own say, in the world of
    the scenario. Raises ValueError for a sensor that landmarks of this placement cannot have.
    """
    scenario = as_scenario(scenario)
    motion = trajectory_of(scenario, dtype) if motion is None else motion
    s = as_data(scenario, dtype)
    motion_key, world_key, camera_key, pixel_key = jax.random.split(key, 4)
    poses, controls = _path(s, motion, motion_key)
    sensor = sensor_of(s) if sensor is None else sensor
    cameras, sensors = _sensors(s, sensor, camera_key)
    if s.placement == "rays":
        if not isinstance(sensors, Pinhole):
            raise ValueError(f"placement rays is for a Pinhole, not for {type(sensor).__name__}")
        points, new = thrown(s, world_key, poses, sensors)
    else:
        points, new = PLACEMENT[s.placement](s, world_key), None
    one = jnp.ones((), points.dtype)

    def frame(pose: Pose, sensor, points):
        seen_from = jax.vmap(pose.inverse().apply)(points)
        measured = jax.vmap(sensor.measure, in_axes=(0, None))(seen_from, one)
        return measured, visible(s, sensor, seen_from, measured)

    every = jax.vmap(frame, in_axes=(0, 0, None if new is None else 0))
    measured, seen = every(poses, sensors, points)
    seen &= jnp.arange(s.steps + 1)[:, None] >= s.first_frame
    # A key of its own, so that a limit changes nothing else of a run.
    seen = limited(s, jax.random.fold_in(pixel_key, 1), seen)
    noise = jax.random.normal(pixel_key, measured.shape, measured.dtype)
    measured += sensor.sigma * noise + _drift(s, jax.random.fold_in(pixel_key, 2), measured)
    run = Run(poses, points, measured, seen, controls, cameras, new)
    if s.in_view:
        return in_shared_slots(run, s.in_view)
    return in_order_of_appearance(run) if new is None else run


def _drift(s: Scenario, key: Array, measured: Array) -> Array | float:
    """What stays of the errors of a landmark from frame to frame, `b ← ρ b + √(1 − ρ²) σ n`; a
    share of the landmarks has ten times as much."""
    if not s.drift_sigma:
        return 0.0
    first_key, key, share_key = jax.random.split(key, 3)
    stays = jnp.exp(-1 / jnp.asarray(s.drift_frames, measured.dtype))
    noises = jax.random.normal(key, measured.shape, measured.dtype)

    def later(drift, noise):
        return stays * drift + jnp.sqrt(1 - stays**2) * noise, drift

    start = jax.random.normal(first_key, measured.shape[1:], measured.dtype)
    _, drifts = jax.lax.scan(later, start, noises)
    wrong = jax.random.uniform(share_key, measured.shape[1:2]) < s.drift_wrong
    return s.drift_sigma * jnp.where(wrong, 10.0, 1.0)[:, None] * drifts


def trajectory_of(scenario: Scenario, dtype: DTypeLike | None = None) -> RecordedMotion | None:
    """Along what the scenario's camera moves, where that is recorded.

    Raises ValueError where its file is none, or has no piece that is long enough.
    """
    if not scenario.trajectory:
        return None
    moving = scenario.steps - min(scenario.still_frames, scenario.steps)
    path = find(scenario.trajectory)
    return cast(sampled(path, float(scenario.rate), moving), dtype or jnp.result_type(float))


def _path(
    s: Scenario, motion: AbstractMotion | RecordedMotion | None, key: Array
) -> tuple[Pose, Control]:
    """The true poses, and what the filter is given at every step."""
    if isinstance(motion, RecordedMotion):
        return _recorded(s, motion, key)
    if motion is None and s.motion == "odometry":
        return _by_odometry(s, key)
    return _by_noise(s, motion_of(s) if motion is None else motion, key)


def _by_noise(s: Scenario, motion: AbstractMotion, key: Array) -> tuple[Pose, Control]:
    """The start and the noises of a motion model from the filter's prior (P8, P9).

    In frames in which the camera stands still, neither pose nor variables move.
    """
    start_key, noise_key = jax.random.split(key)
    sigma, dtype = jnp.asarray(motion.noise_sigma), jnp.result_type(s.rate)
    mean, root = motion.start()
    start = retract(mean, root @ jax.random.normal(start_key, root.shape[:1], dtype))
    still = min(s.still_frames, s.steps)
    noises = sigma * jax.random.normal(noise_key, (s.steps - still, sigma.size), dtype)
    control = motion.nominal_control(jnp.stack(s.velocity), 1 / s.rate)

    def move(carry, noise):
        pose, variables = carry
        pose = (pose @ motion.displacement(variables, noise, control)).normalize()
        return (pose, motion.next(variables, noise, control)), pose

    origin = identity(motion.geometry, dtype)
    _, poses = jax.lax.scan(move, (origin, start), noises)
    return _with_start(origin, poses, still), _every_step(s, control)


def _recorded(s: Scenario, trajectory: RecordedMotion, key: Array) -> tuple[Pose, Control]:
    """A recorded path from a random start, after the frames in which the camera stands still."""
    still = min(s.still_frames, s.steps)
    if trajectory.steps != s.steps - still:
        raise ValueError(f"a trajectory for {trajectory.steps} steps, not {s.steps - still}")
    poses = jax.tree.map(lambda x: x[1:], trajectory.run(key))
    control = motion_of(s).nominal_control(jnp.stack(s.velocity), 1 / s.rate)
    origin = identity(s.world, jnp.result_type(s.rate))
    return _with_start(origin, poses, still), _every_step(s, control)


def _every_step(s: Scenario, control: Control) -> Control:
    return jax.tree.map(lambda x: jnp.full((s.steps, *x.shape), x), control)


def _by_odometry(s: Scenario, key: Array) -> tuple[Pose, Array]:
    """The nominal motion exactly; each step is read with an error, `u` = truth − w."""
    motion = motion_of(s)
    geometry, sigma = motion.geometry, motion.noise_sigma
    nominal = jnp.stack(s.velocity) / s.rate
    step = motion.displacement((), jnp.zeros_like(nominal), nominal)
    noise = jax.random.normal(key, (s.steps, geometry.tangent_dim), sigma.dtype)

    def move(pose, _):
        pose = (pose @ step).normalize()
        return pose, pose

    start = identity(geometry, sigma.dtype)
    _, poses = jax.lax.scan(move, start, length=s.steps)
    return _with_start(start, poses), nominal - sigma * noise


def _with_start(start: Pose, poses: Pose, still: int = 0) -> Pose:
    """The start, the same again for so many frames, and the poses."""
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (1 + still, *x.shape)), start)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), starts, poses)


def _sensors(s: Scenario, sensor: AbstractSensor, key: Array) -> tuple[Camera, AbstractSensor]:
    """The true camera and the true sensor of every frame."""
    frames, sigma = s.steps + 1, calibration_sigma_of(s)
    if s.true_calibration == "nominal":
        deltas = jnp.zeros((frames, sigma.size), sigma.dtype)
    elif s.true_calibration == "constant":
        deltas = jnp.tile(jax.random.normal(key, (sigma.size,), sigma.dtype), (frames, 1))
    else:
        deltas = jax.random.normal(key, (frames, sigma.size), sigma.dtype)
    cameras = jax.vmap(Camera(s.focal, s.centre).perturbed)(deltas * sigma)
    if isinstance(sensor, Pinhole):
        return cameras, jax.vmap(lambda camera: replace(sensor, camera=camera))(cameras)
    return cameras, jax.tree.map(lambda x: jnp.broadcast_to(x, (frames, *x.shape)), sensor)
