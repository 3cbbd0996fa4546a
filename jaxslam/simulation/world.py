"""One simulated run: a true trajectory, true landmarks, and the noisy pixels of every frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.forms.state import Features
from jaxslam.geometry import Pose, identity, retract
from jaxslam.models.camera import Camera, bearing
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.sensors import AbstractSensor, Pinhole
from jaxslam.simulation.pieces import calibration_sigma_of, depth_of, motion_of, sensor_of
from jaxslam.simulation.scenario import Scenario
from jaxslam.slam.protocol import Capacity


class Run(eqx.Module):
    """Truth and measurements; frame 0 is the start, `frames` = steps + 1."""

    poses: Pose
    """T_BC of every frame; the first is the identity."""
    points: Float[Array, "landmarks n"]
    """In B, in the order in which they are first seen."""
    measured: Float[Array, "frames landmarks p"]
    """With noise."""
    visible: Bool[Array, "frames landmarks"]
    """Which points are measured."""
    controls: Any
    """The motion model's input of every step: seconds, or a reading."""
    cameras: Camera
    """The true camera of every frame."""


class Sightings(eqx.Module):
    """How many landmarks a run sees, at the most: the capacities that a filter needs."""

    landmarks: Int[Array, ""]
    """Ever."""
    first: Int[Array, ""]
    """In frame 0."""
    known: Int[Array, ""]
    """In one frame, seen before."""
    new: Int[Array, ""]
    """In one frame after 0, for the first time."""


def as_data(scenario: Scenario, dtype: Any = None) -> Scenario:
    """The scenario with its numbers as arrays and without its name: what a program is made for."""
    if any(isinstance(number, jax.Array) for number in jax.tree.leaves(scenario)):
        return scenario
    dtype = dtype or jnp.result_type(float)
    unnamed = replace(scenario, name="", calibration="known")
    return jax.tree.map(lambda number: jnp.asarray(number, dtype), unnamed)


def simulate(
    scenario: Scenario,
    key: Array,
    dtype: Any = None,
    *,
    motion: AbstractMotion | None = None,
    sensor: AbstractSensor | None = None,
) -> Run:
    """Draw one run: a pure function of the scenario's numbers and of the key.

    The truth is drawn from the prior of the filters of `make_filters`; or it moves and is measured
    as models of one's own say, in the world of the scenario.
    """
    s = as_data(scenario, dtype)
    motion_key, world_key, camera_key, pixel_key = jax.random.split(key, 4)
    if motion is None and s.motion == "odometry":
        poses, controls = _by_odometry(s, motion_key)
    else:
        poses, controls = _by_noise(s, motion_of(s) if motion is None else motion, motion_key)
    points = _PLACEMENT[s.placement](s, world_key)
    sensor = sensor_of(s) if sensor is None else sensor
    cameras, sensors = _sensors(s, sensor, camera_key)
    one = jnp.ones((), points.dtype)

    def frame(pose: Pose, sensor):
        seen_from = jax.vmap(pose.inverse().apply)(points)
        measured = jax.vmap(sensor.measure, in_axes=(0, None))(seen_from, one)
        return measured, _visible(s, sensor, seen_from, measured)

    measured, visible = jax.vmap(frame)(poses, sensors)
    visible &= jnp.arange(s.steps + 1)[:, None] >= s.first_frame
    # A key of its own, so that a limit changes nothing else of a run.
    visible = _limited(s, jax.random.fold_in(pixel_key, 1), visible)
    noise = jax.random.normal(pixel_key, measured.shape, measured.dtype)
    measured += sensor.sigma * noise
    return _in_order_of_appearance(Run(poses, points, measured, visible, controls, cameras))


class Room(NamedTuple):
    """Capacities that hold every run of a study."""

    landmarks: int
    first: int
    known: int
    new: int

    @property
    def capacity(self) -> Capacity:
        """Of a filter."""
        return Capacity(self.landmarks, self.known, self.new)


def sightings(run: Run) -> Sightings:
    """Capacities that hold this run exactly."""
    known, new = _known_and_new(run)
    return Sightings(
        landmarks=jnp.sum(jnp.any(run.visible, axis=0)),
        first=jnp.sum(run.visible[0]),
        known=jnp.max(jnp.sum(known, axis=1), initial=0),
        new=jnp.max(jnp.sum(new[1:], axis=1), initial=0),
    )


def features(run: Run, capacity: Room) -> tuple[Features, Features, Features]:
    """A run's measurements for the filter: new in frame 0; known and new of every later frame.

    Slot i of the filter is point i of the run.
    """
    known, new = _known_and_new(run)
    first = _picked(new[0], run.measured[0], capacity.first)
    pick = jax.vmap(_picked, in_axes=(0, 0, None))
    return (
        first,
        pick(known[1:], run.measured[1:], capacity.known),
        pick(new[1:], run.measured[1:], capacity.new),
    )


def _known_and_new(run: Run):
    before = jnp.cumsum(run.visible, axis=0) - run.visible > 0
    return run.visible & before, run.visible & ~before


def _picked(mask, measured, count: int) -> Features:
    """The first `count` landmarks of the mask, padded with features that are not valid."""
    slots = jnp.argsort(~mask, stable=True)[:count]
    return Features(slots, measured[slots], mask[slots])


def _by_noise(s: Scenario, motion: AbstractMotion, key: Array) -> tuple[Pose, Any]:
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
    controls = jax.tree.map(lambda x: jnp.full((s.steps, *x.shape), x), control)
    return _with_start(origin, poses, still), controls


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


def _in_image(scenario: Scenario, points, pixels) -> Bool[Array, " l"]:
    """In front of the camera and inside the picture."""
    inside = jnp.all((pixels >= 0) & (pixels < jnp.stack(scenario.image)), axis=-1)
    return inside & (points[:, -1] > scenario.visible_depth)


def _in_range(scenario: Scenario, points, measured) -> Bool[Array, " l"]:
    """Neither too near nor too far, in any direction."""
    del measured
    least, greatest = scenario.range
    distance = jnp.linalg.norm(points, axis=-1)
    return (distance >= least) & (distance <= greatest)


def _visible(s: Scenario, sensor: AbstractSensor, points, measured) -> Bool[Array, " l"]:
    """A camera sees what is in its picture; another sensor what is in its range."""
    if isinstance(sensor, Pinhole):
        return _in_image(s, points, measured)
    return _in_range(s, points, measured) & jax.vmap(sensor.possible)(points)


def _limited(scenario: Scenario, key: Array, visible: Bool[Array, "frames l"]):
    """No more landmarks in a frame than the scenario allows, drawn at random."""
    frames, count = visible.shape
    first, new = scenario.first_landmarks or count, scenario.new_landmarks or count
    known = scenario.known_landmarks or count
    if min(first, new, known) >= count:
        return visible

    def frame(before, data):
        visible, order, most_new = data
        again = _at_most(visible & before, order, known)
        fresh = _at_most(visible & ~before, order, most_new)
        return before | fresh, again | fresh

    orders = jax.random.uniform(key, (frames, count))
    most_new = jnp.full(frames, new).at[0].set(first)
    return jax.lax.scan(frame, jnp.zeros(count, bool), (visible, orders, most_new))[1]


def _at_most(mask, order, count) -> Bool[Array, " l"]:
    """The `count` of the mask that come first in the order."""
    rank = jnp.argsort(jnp.argsort(jnp.where(mask, order, jnp.inf)))
    return mask & (rank < count)


def _from_prior(s: Scenario, key: Array) -> Float[Array, "l n"]:
    """Uniform pixels of frame 0, inverse depths from the prior, truncated."""
    pixel_key, depth_key = jax.random.split(key)
    depth, count = depth_of(s), s.landmarks
    low, high = (jnp.stack(ends) for ends in zip(*s.first_pixels, strict=True))
    pixels = jax.random.uniform(pixel_key, (count, low.size), low.dtype, minval=low, maxval=high)
    lower = (s.least_inverse_depth - depth.mean) / depth.sigma
    draws = jax.random.truncated_normal(depth_key, lower, jnp.inf, (count,), low.dtype)
    inverse_depths = depth.mean + depth.sigma * draws
    camera = Camera(s.focal, s.centre)
    bearings = jax.vmap(bearing, in_axes=(None, 0))(camera, pixels)
    return jnp.column_stack([bearings, jnp.ones(count, low.dtype)]) / inverse_depths[:, None]


def _on_ring(s: Scenario, key: Array) -> Float[Array, "l n"]:
    """Evenly on a circle about the centre of the nominal path, at the camera's height."""
    del key
    *linear, rotation = s.velocity
    # x' = v + ω J x has its fixed point, the centre, at J v / ω: left of a camera that turns
    # from x towards z.
    centre = jnp.stack([-linear[-1] / rotation, linear[0] / rotation])
    angles = 2 * jnp.pi * jnp.arange(s.landmarks, dtype=centre.dtype) / s.landmarks
    ring = centre + s.ring_radius * jnp.column_stack([jnp.cos(angles), jnp.sin(angles)])
    return ring.astype(centre.dtype)


def _in_room(s: Scenario, key: Array) -> Float[Array, "72 3"]:
    """The cloister of slamtb: nine points along each wall of a 12 m room, in two rows, 1 m apart
    in height; the camera starts 0.6 m above the lower ones, 5 m from the centre, looking along
    the wall."""
    del key
    along = jnp.concatenate([jnp.arange(-4, 5, 2), jnp.arange(-4, 3, 2)])
    out = jnp.array([6] * 5 + [4] * 4)
    wall = jnp.column_stack([along, out])  # (east, north) of the northern wall
    walls = jnp.concatenate([wall, wall[:, ::-1] * jnp.array([-1, 1])])
    plane = jnp.concatenate([walls, -walls])
    east, north, up = jnp.concatenate(
        [jnp.column_stack([plane, jnp.full(len(plane), height)]) for height in (0, 1)]
    ).T
    return jnp.column_stack([-(north + 5), 0.6 - up, east]).astype(jnp.result_type(s.rate))


_PLACEMENT = {"prior": _from_prior, "ring": _on_ring, "room": _in_room}


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


def _in_order_of_appearance(run: Run) -> Run:
    """Landmarks that are never seen come last, so that a filter needs no slots for them."""
    never = run.visible.shape[0]
    seen = jnp.any(run.visible, axis=0)
    order = jnp.argsort(jnp.where(seen, jnp.argmax(run.visible, axis=0), never), stable=True)
    return replace(
        run,
        points=run.points[order],
        measured=run.measured[:, order],
        visible=run.visible[:, order],
    )
