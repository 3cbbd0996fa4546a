"""Placement of the landmarks of a simulated world: all at once, or thrown as the camera moves."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.geometry import Pose
from jaxslam.models.camera import Camera, bearing
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation.pieces import depth_of
from jaxslam.simulation.scenario import Scenario
from jaxslam.simulation.visibility import in_image


def _from_prior(s: Scenario, key: Array) -> Float[Array, "l n"]:
    """Uniform pixels of frame 0, inverse depths from the prior, truncated."""
    pixel_key, depth_key = jax.random.split(key)
    depth, count = depth_of(s), s.landmarks
    pixels = _random_pixels(s, pixel_key)
    lower = (s.least_inverse_depth - depth.mean) / depth.sigma
    draws = jax.random.truncated_normal(depth_key, lower, jnp.inf, (count,), pixels.dtype)
    return _on_rays(Camera(s.focal, s.centre), pixels, depth.mean + depth.sigma * draws)


def _random_pixels(s: Scenario, key: Array) -> Float[Array, "l p"]:
    low, high = (jnp.stack(ends) for ends in zip(*s.first_pixels, strict=True))
    size = (s.landmarks, low.size)
    return jax.random.uniform(key, size, low.dtype, minval=low, maxval=high)


def _on_rays(camera: Camera, pixels, inverse_depths) -> Float[Array, "l n"]:
    """The points of these pixels and 1/z, in the camera."""
    bearings = jax.vmap(bearing, in_axes=(None, 0))(camera, pixels)
    return jnp.column_stack([bearings, jnp.ones_like(inverse_depths)]) / inverse_depths[:, None]


def _on_ring(s: Scenario, key: Array) -> Float[Array, "l n"]:
    """Evenly on a circle about the centre of the nominal path, at the camera's height; in space in
    turn below, at and above it."""
    del key
    # In the plane from x towards z; about y, which points down, the other way round.
    turn = s.velocity[-1] if s.geometry == "planar" else -s.velocity[4]
    n = s.world.point_dim
    # x' = v + ω J x has its fixed point, the centre, at J v / ω: left of a camera that turns
    # from x towards z.
    centre = jnp.stack([-s.velocity[n - 1] / turn, s.velocity[0] / turn])
    angles = 2 * jnp.pi * jnp.arange(s.landmarks, dtype=centre.dtype) / s.landmarks
    ring = centre + s.ring_radius * jnp.column_stack([jnp.cos(angles), jnp.sin(angles)])
    if s.geometry == "spatial":
        level = jnp.arange(s.landmarks, dtype=centre.dtype) % 3 - 1
        ring = jnp.column_stack([ring[:, 0], level, ring[:, 1]])
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


PLACEMENT = {"prior": _from_prior, "ring": _on_ring, "room": _in_room}
"""Where landmarks are for a whole run, of a scenario and a key."""


def thrown(
    s: Scenario, key: Array, poses: Pose, sensors: Pinhole
) -> tuple[Float[Array, "frames l n"], Bool[Array, "frames l"]]:
    """Landmarks that come as others go: of every frame and slot the point, and whether it is new.

    Whenever one leaves the picture, another is thrown along a random ray of the camera there, at
    a depth that is uniform in an interval, as OpenVINS' simulator does (Geneva et al., ICRA 2020).
    """

    def frame(points, data):
        key, pose, sensor, is_first = data
        seen_from = jax.vmap(pose.inverse().apply)(points)
        measured = jax.vmap(sensor.measure, in_axes=(0, None))(seen_from, one)
        new = is_first | ~in_image(s, seen_from, measured)
        fresh = jax.vmap(pose.apply)(_thrown(s, key, sensor.camera))
        points = jnp.where(new[:, None], fresh, points)
        return points, (points, new)

    frames = s.steps + 1
    keys, is_first = jax.random.split(key, frames), jnp.arange(frames) == 0
    one = jnp.ones((), jnp.result_type(s.rate))
    nowhere = jnp.ones((s.landmarks, s.world.point_dim), one.dtype)
    return jax.lax.scan(frame, nowhere, (keys, poses, sensors, is_first))[1]


def _thrown(s: Scenario, key: Array, camera: Camera) -> Float[Array, "l n"]:
    """Points along random rays of a camera, in that."""
    pixel_key, depth_key = jax.random.split(key)
    pixels, (least, greatest) = _random_pixels(s, pixel_key), s.depth_range
    share = jax.random.uniform(depth_key, (s.landmarks,), pixels.dtype)
    depths = least + (greatest - least) * share
    return _on_rays(camera, pixels, 1 / depths)
