"""One simulated run: a true trajectory, true landmarks, and the noisy pixels of every frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.camera import Camera, bearing
from jaxslam.filters import Features, Parameters, inverse_depth_prior
from jaxslam.geometry import Pose, identity
from jaxslam.simulation.scenario import Scenario


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Run:
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sightings:
    """How many landmarks a run sees, at the most: the capacities that a filter needs."""

    landmarks: Int[Array, ""]
    """Ever."""
    first: Int[Array, ""]
    """In frame 0."""
    known: Int[Array, ""]
    """In one frame, seen before."""
    new: Int[Array, ""]
    """In one frame after 0, for the first time."""


def parameters(scenario: Scenario, dtype=None) -> Parameters:
    """The filter's numbers that fit the scenario: the true noise and the nominal camera."""
    mean, sigma = scenario.inverse_depth or inverse_depth_prior(scenario.nearest_depth)
    p = scenario.rig.geometry.pixel_dim
    camera = scenario.sensor == "camera"
    velocity = scenario.motion == "velocity"

    def array(values):
        return jnp.asarray(values, dtype or jnp.result_type(float))

    return Parameters(
        camera=Camera(array(scenario.focal), array(scenario.centre)),
        intrinsics_sigma=array([scenario.focal_sigma] * p + [scenario.centre_sigma] * p),
        measurement_sigma=array(scenario.pixel_sigma if camera else scenario.position_sigma),
        motion_sigma=array(scenario.acceleration_sigma if velocity else scenario.odometry_sigma),
        inverse_depth=array(mean),
        inverse_depth_sigma=array(sigma),
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Prior:
    """All that a filter is told of a scenario, as data: other numbers need no other program."""

    parameters: Parameters
    velocity: Float[Array, " t"]
    velocity_sigma: Float[Array, " t"]

    @staticmethod
    def of(scenario: Scenario, dtype=None) -> Prior:
        """The scenario's own numbers: the truth is drawn from this prior."""
        dtype = dtype or jnp.result_type(float)
        return Prior(
            parameters(scenario, dtype),
            jnp.asarray(scenario.velocity, dtype),
            jnp.asarray(scenario.velocity_sigma, dtype),
        )


def structure(scenario: Scenario) -> Scenario:
    """The scenario with every number that is drawn from its `Prior` replaced by one.

    `simulate(structure(s), key, dtype, Prior.of(s))` draws the runs of `s`, and its program is
    compiled once for all scenarios that differ in such numbers only.
    """
    t, p = scenario.rig.geometry.tangent_dim, scenario.rig.geometry.pixel_dim
    return replace(
        scenario,
        name="",
        # With odometry the nominal motion is the true one: it is not drawn.
        velocity=scenario.velocity if scenario.motion == "odometry" else (1.0,) * t,
        velocity_sigma=(1.0,) * t,
        acceleration_sigma=(1.0,) * t,
        odometry_sigma=(1.0,) * t,
        nearest_depth=1.0,
        inverse_depth=(),
        focal=(1.0,) * p,
        centre=(1.0,) * p,
        focal_sigma=1.0,
        centre_sigma=1.0,
        pixel_sigma=1.0,
        position_sigma=1.0,
    )


def simulate(scenario: Scenario, key: Array, dtype=None, prior: Prior | None = None) -> Run:
    """Draw one run: a pure function of the key, to be batched by `vmap`.

    The truth is drawn from the prior: the scenario's own, or one given as data.
    """
    motion_key, world_key, camera_key, pixel_key = jax.random.split(key, 4)
    dtype = dtype or jnp.result_type(float)
    prior = Prior.of(scenario, dtype) if prior is None else prior
    truth = prior.parameters
    poses, controls = _MOTION[scenario.motion](scenario, prior, motion_key)
    points = _PLACEMENT[scenario.placement](scenario, prior, world_key)
    cameras = _cameras(scenario, truth, camera_key)
    measure, one = scenario.rig.sensor.measure, jnp.ones((), dtype)

    def frame(pose: Pose, camera: Camera):
        seen_from = jax.vmap(pose.inverse().apply)(points)
        measured = jax.vmap(measure, in_axes=(None, 0, None))(camera, seen_from, one)
        return measured, _VISIBLE[scenario.sensor](scenario, seen_from, measured)

    measured, visible = jax.vmap(frame)(poses, cameras)
    visible &= jnp.arange(scenario.steps + 1)[:, None] >= scenario.first_frame
    # A key of its own, so that a limit changes nothing else of a run.
    visible = _limited(scenario, jax.random.fold_in(pixel_key, 1), visible)
    noise = jax.random.normal(pixel_key, measured.shape, dtype)
    measured += truth.measurement_sigma * noise
    return _in_order_of_appearance(Run(poses, points, measured, visible, controls, cameras))


def sightings(run: Run) -> Sightings:
    """Capacities that hold this run exactly."""
    known, new = _known_and_new(run)
    return Sightings(
        landmarks=jnp.sum(jnp.any(run.visible, axis=0)),
        first=jnp.sum(run.visible[0]),
        known=jnp.max(jnp.sum(known, axis=1), initial=0),
        new=jnp.max(jnp.sum(new[1:], axis=1), initial=0),
    )


def features(run: Run, capacity: Sightings) -> tuple[Features, Features, Features]:
    """A run's measurements for the filter: new in frame 0; known and new of every later frame.

    Slot i of the filter is point i of the run. `capacity` holds Python integers.
    """
    known, new = _known_and_new(run)
    first = _picked(new[0], run.measured[0], int(capacity.first))
    pick = jax.vmap(_picked, in_axes=(0, 0, None))
    return (
        first,
        pick(known[1:], run.measured[1:], int(capacity.known)),
        pick(new[1:], run.measured[1:], int(capacity.new)),
    )


def _known_and_new(run: Run):
    before = jnp.cumsum(run.visible, axis=0) - run.visible > 0
    return run.visible & before, run.visible & ~before


def _picked(mask, measured, count: int) -> Features:
    """The first `count` landmarks of the mask, padded with features that are not valid."""
    slots = jnp.argsort(~mask, stable=True)[:count]
    return Features(slots, measured[slots], mask[slots])


def _by_acceleration(scenario: Scenario, prior: Prior, key: Array) -> tuple[Pose, Array]:
    """White accelerations and an initial velocity from the filter's prior (P8, P9)."""
    start_key, acceleration_key = jax.random.split(key)
    rig, sigma = scenario.rig, prior.parameters.motion_sigma
    geometry, motion, dtype = rig.geometry, rig.motion, sigma.dtype
    t, dt = geometry.tangent_dim, jnp.asarray(1 / scenario.rate, dtype)
    velocity = prior.velocity + prior.velocity_sigma * jax.random.normal(start_key, (t,), dtype)
    accelerations = sigma * jax.random.normal(acceleration_key, (scenario.steps, t), dtype)

    def move(carry, acceleration):
        pose, velocity = carry
        pose = (pose @ motion.displacement(geometry, velocity, acceleration, dt)).normalize()
        return (pose, motion.next_velocity(velocity, acceleration, dt)), pose

    start = identity(geometry, dtype)
    _, poses = jax.lax.scan(move, (start, velocity), accelerations)
    return _with_start(start, poses), jnp.full(scenario.steps, dt)


def _by_odometry(scenario: Scenario, prior: Prior, key: Array) -> tuple[Pose, Array]:
    """The nominal motion exactly; each step is read with an error, `u` = truth − w."""
    geometry, sigma = scenario.rig.geometry, prior.parameters.motion_sigma
    nominal = jnp.asarray(scenario.velocity, sigma.dtype) / scenario.rate
    still = jnp.zeros_like(nominal)
    step = scenario.rig.motion.displacement(geometry, still, still, nominal)
    noise = jax.random.normal(key, (scenario.steps, geometry.tangent_dim), sigma.dtype)

    def move(pose, _):
        pose = (pose @ step).normalize()
        return pose, pose

    start = identity(geometry, sigma.dtype)
    _, poses = jax.lax.scan(move, start, length=scenario.steps)
    return _with_start(start, poses), nominal - sigma * noise


_MOTION = {"velocity": _by_acceleration, "odometry": _by_odometry}


def _with_start(start: Pose, poses: Pose) -> Pose:
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, poses)


def _in_image(scenario: Scenario, points, pixels) -> Bool[Array, " l"]:
    """In front of the camera and inside the picture."""
    inside = jnp.all((pixels >= 0) & (pixels < jnp.asarray(scenario.image, pixels.dtype)), axis=-1)
    return inside & (points[:, -1] > scenario.visible_depth)


def _in_range(scenario: Scenario, points, measured) -> Bool[Array, " l"]:
    """Neither too near nor too far, in any direction."""
    del measured
    least, greatest = scenario.range
    distance = jnp.linalg.norm(points, axis=-1)
    return (distance >= least) & (distance <= greatest)


_VISIBLE = {"camera": _in_image, "position": _in_range}


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


def _from_prior(scenario: Scenario, prior: Prior, key: Array) -> Float[Array, "l n"]:
    """Uniform pixels of frame 0, inverse depths from the prior, truncated."""
    pixel_key, depth_key = jax.random.split(key)
    truth = prior.parameters
    dtype, count = truth.motion_sigma.dtype, scenario.landmarks
    low, high = jnp.asarray(scenario.first_pixels, dtype).T
    pixels = jax.random.uniform(pixel_key, (count, low.size), dtype, minval=low, maxval=high)
    lower = (scenario.least_inverse_depth - truth.inverse_depth) / truth.inverse_depth_sigma
    draws = jax.random.truncated_normal(depth_key, lower, jnp.inf, (count,), dtype)
    inverse_depths = truth.inverse_depth + truth.inverse_depth_sigma * draws
    bearings = jax.vmap(bearing, in_axes=(None, 0))(truth.camera, pixels)
    return jnp.column_stack([bearings, jnp.ones(count, dtype)]) / inverse_depths[:, None]


def _on_ring(scenario: Scenario, prior: Prior, key: Array) -> Float[Array, "l n"]:
    """Evenly on a circle about the centre of the nominal path, at the camera's height."""
    del key
    dtype = prior.velocity.dtype
    *linear, rotation = prior.velocity
    # x' = v + ω J x has its fixed point, the centre, at J v / ω: left of a camera that turns
    # from x towards z.
    centre = jnp.stack([-linear[-1] / rotation, linear[0] / rotation])
    angles = 2 * jnp.pi * jnp.arange(scenario.landmarks, dtype=dtype) / scenario.landmarks
    ring = centre + scenario.ring_radius * jnp.column_stack([jnp.cos(angles), jnp.sin(angles)])
    return ring.astype(dtype)


def _in_room(scenario: Scenario, prior: Prior, key: Array) -> Float[Array, "72 3"]:
    """The cloister of slamtb: nine points along each wall of a 12 m room, in two rows, 1 m apart
    in height; the camera starts 0.6 m above the lower ones, 5 m from the centre, looking along
    the wall."""
    del scenario, key
    along = jnp.concatenate([jnp.arange(-4, 5, 2), jnp.arange(-4, 3, 2)])
    out = jnp.array([6] * 5 + [4] * 4)
    wall = jnp.column_stack([along, out])  # (east, north) of the northern wall
    walls = jnp.concatenate([wall, wall[:, ::-1] * jnp.array([-1, 1])])
    plane = jnp.concatenate([walls, -walls])
    east, north, up = jnp.concatenate(
        [jnp.column_stack([plane, jnp.full(len(plane), height)]) for height in (0, 1)]
    ).T
    return jnp.column_stack([-(north + 5), 0.6 - up, east]).astype(prior.velocity.dtype)


_PLACEMENT = {"prior": _from_prior, "ring": _on_ring, "room": _in_room}


def _cameras(scenario: Scenario, truth: Parameters, key: Array) -> Camera:
    """The true camera of every frame."""
    frames, size = scenario.steps + 1, truth.intrinsics_sigma.size
    dtype = truth.motion_sigma.dtype
    if scenario.true_calibration == "nominal":
        deltas = jnp.zeros((frames, size), dtype)
    elif scenario.true_calibration == "constant":
        deltas = jnp.tile(jax.random.normal(key, (size,), dtype), (frames, 1))
    else:
        deltas = jax.random.normal(key, (frames, size), dtype)
    return jax.vmap(truth.camera.perturbed)(deltas * truth.intrinsics_sigma)


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
