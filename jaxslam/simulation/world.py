"""One simulated run: a true trajectory, true landmarks, and the noisy pixels of every frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.camera import Camera, bearing, project
from jaxslam.filters import Features, Parameters, inverse_depth_prior
from jaxslam.geometry import Pose
from jaxslam.motion import displacement, next_velocity
from jaxslam.simulation.scenario import Scenario


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Run:
    """Truth and measurements; frame 0 is the start, `frames` = steps + 1."""

    poses: Pose
    """T_BC of every frame; the first is the identity."""
    points: Float[Array, "landmarks n"]
    """In B, in the order in which they are first seen."""
    pixels: Float[Array, "frames landmarks p"]
    """Measured, with noise."""
    visible: Bool[Array, "frames landmarks"]


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
    mean, sigma = inverse_depth_prior(scenario.nearest_depth)
    p = scenario.world.pixel_dim

    def array(values):
        return jnp.asarray(values, dtype or jnp.result_type(float))

    return Parameters(
        camera=Camera(array(scenario.focal), array(scenario.centre)),
        intrinsics_sigma=array([scenario.focal_sigma] * p + [scenario.centre_sigma] * p),
        pixel_sigma=array(scenario.pixel_sigma),
        acceleration_sigma=array(scenario.acceleration_sigma),
        inverse_depth=array(mean),
        inverse_depth_sigma=array(sigma),
    )


def simulate(scenario: Scenario, key: Array, dtype=None) -> Run:
    """Draw one run: a pure function of the key, to be batched by `vmap`."""
    motion_key, world_key, camera_key, pixel_key = jax.random.split(key, 4)
    dtype = dtype or jnp.result_type(float)
    truth = parameters(scenario, dtype)
    poses = _trajectory(scenario, truth, motion_key)
    points = _PLACEMENT[scenario.placement](scenario, truth, world_key)
    cameras = _cameras(scenario, truth, camera_key)

    def frame(pose: Pose, camera: Camera):
        seen_from = jax.vmap(pose.inverse().apply)(points)
        pixels = jax.vmap(project, in_axes=(None, 0))(camera, seen_from)
        size = jnp.asarray(scenario.image, dtype)
        inside = jnp.all((pixels >= 0) & (pixels < size), axis=-1)
        return pixels, inside & (seen_from[:, -1] > scenario.visible_depth)

    pixels, visible = jax.vmap(frame)(poses, cameras)
    pixels += truth.pixel_sigma * jax.random.normal(pixel_key, pixels.shape, dtype)
    return _in_order_of_appearance(Run(poses, points, pixels, visible))


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
    first = _picked(new[0], run.pixels[0], int(capacity.first))
    pick = jax.vmap(_picked, in_axes=(0, 0, None))
    return (
        first,
        pick(known[1:], run.pixels[1:], int(capacity.known)),
        pick(new[1:], run.pixels[1:], int(capacity.new)),
    )


def _known_and_new(run: Run):
    before = jnp.cumsum(run.visible, axis=0) - run.visible > 0
    return run.visible & before, run.visible & ~before


def _picked(mask, pixels, count: int) -> Features:
    """The first `count` landmarks of the mask, padded with features that are not valid."""
    slots = jnp.argsort(~mask, stable=True)[:count]
    return Features(slots, pixels[slots], mask[slots])


def _trajectory(scenario: Scenario, truth: Parameters, key: Array) -> Pose:
    """White accelerations and an initial velocity from the filter's prior (P8, P9)."""
    start_key, acceleration_key = jax.random.split(key)
    geometry, dtype = scenario.world, truth.pixel_sigma.dtype
    t, dt = geometry.tangent_dim, jnp.asarray(1 / scenario.rate, dtype)
    velocity = jnp.asarray(scenario.velocity, dtype) + jnp.asarray(
        scenario.velocity_sigma, dtype
    ) * jax.random.normal(start_key, (t,), dtype)
    accelerations = truth.acceleration_sigma * jax.random.normal(
        acceleration_key, (scenario.steps, t), dtype
    )

    def move(carry, acceleration):
        pose, velocity = carry
        pose = (pose @ displacement(geometry, velocity, acceleration, dt)).normalize()
        return (pose, next_velocity(velocity, acceleration, dt)), pose

    start = jax.tree.map(lambda x: x.astype(dtype), geometry.group.identity())
    _, poses = jax.lax.scan(move, (start, velocity), accelerations)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, poses)


def _from_prior(scenario: Scenario, truth: Parameters, key: Array) -> Float[Array, "l n"]:
    """Uniform pixels of frame 0, inverse depths from the prior, truncated."""
    pixel_key, depth_key = jax.random.split(key)
    dtype, count = truth.pixel_sigma.dtype, scenario.landmarks
    low, high = jnp.asarray(scenario.first_pixels, dtype).T
    pixels = jax.random.uniform(pixel_key, (count, low.size), dtype, minval=low, maxval=high)
    lower = (scenario.least_inverse_depth - truth.inverse_depth) / truth.inverse_depth_sigma
    draws = jax.random.truncated_normal(depth_key, lower, jnp.inf, (count,), dtype)
    inverse_depths = truth.inverse_depth + truth.inverse_depth_sigma * draws
    bearings = jax.vmap(bearing, in_axes=(None, 0))(truth.camera, pixels)
    return jnp.column_stack([bearings, jnp.ones(count, dtype)]) / inverse_depths[:, None]


def _on_ring(scenario: Scenario, truth: Parameters, key: Array) -> Float[Array, "l n"]:
    """Evenly on a circle about the centre of the nominal path, at the camera's height."""
    del key
    dtype = truth.pixel_sigma.dtype
    *linear, rotation = scenario.velocity
    # x' = v + ω J x has its fixed point, the centre, at J v / ω: left of a camera that turns
    # from x towards z.
    centre = jnp.asarray([-linear[-1] / rotation, linear[0] / rotation], dtype)
    angles = 2 * jnp.pi * jnp.arange(scenario.landmarks, dtype=dtype) / scenario.landmarks
    ring = centre + scenario.ring_radius * jnp.column_stack([jnp.cos(angles), jnp.sin(angles)])
    return ring.astype(dtype)


_PLACEMENT = {"prior": _from_prior, "ring": _on_ring}


def _cameras(scenario: Scenario, truth: Parameters, key: Array) -> Camera:
    """The true camera of every frame."""
    frames, size = scenario.steps + 1, truth.intrinsics_sigma.size
    dtype = truth.pixel_sigma.dtype
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
        pixels=run.pixels[:, order],
        visible=run.visible[:, order],
    )
