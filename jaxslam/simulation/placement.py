"""Placement of the landmarks of a simulated world: all at once, or as the camera moves."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray, Number, number_field
from jaxslam.geometry import PLANAR, SPATIAL, Pose
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation.fields import check_signs
from jaxslam.simulation.world import AbstractPlacement, World, count


def _intervals(intervals: Any) -> AnyArray:
    pairs = np.asarray(intervals, np.float64)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not (pairs[:, 0] < pairs[:, 1]).all():
        raise ValueError(f"first_pixels needs [low, high] pairs, not {pairs.tolist()}")
    return pairs


class FromPrior(AbstractPlacement):
    """Measurements of frame 0 that are uniform, and what they hide (1/z of a camera) drawn from the
    world's prior, truncated."""

    word: ClassVar[str] = "prior"
    landmarks: int = count(12)
    """The number of landmarks."""
    first: Float[AnyArray, "p 2"] = eqx.field(converter=_intervals, default=((20.0, 620.0),))
    """Interval of each number of a measurement, pixels of a camera."""
    least_inverse_depth: Number = 0.001
    """The least 1/z of the truth, 1/m."""
    through: AbstractSensor | None = None
    """The sensor of whose measurements they are; by default that of the world."""

    def __check_init__(self) -> None:
        check_signs(self, self.word)

    def check(self, world: World) -> None:
        _check_intervals(self.first, self.through or world.sensor)

    def points(self, world: World, key: Array) -> Float[Array, "l n"]:
        pixel_key, depth_key = jax.random.split(key)
        sensor = world.sensor if self.through is None else self.through
        measured, depth = _uniform(self.first, self.landmarks, pixel_key), world.depth
        lower = (self.least_inverse_depth - depth.mean) / depth.sigma
        size = (self.landmarks, sensor.hidden)
        draws = jax.random.truncated_normal(depth_key, lower, jnp.inf, size, measured.dtype)
        return _located(sensor, measured, depth.mean + depth.sigma * draws)


def _check_intervals(first: Float[AnyArray, "p 2"], sensor: AbstractSensor) -> None:
    if len(first) != sensor.size:
        world = (PLANAR if sensor.point_dim == PLANAR.point_dim else SPATIAL).name
        raise ValueError(
            f"first_pixels needs {sensor.size} values in a {world} world, not {len(first)}"
        )


def _uniform(intervals: Float[AnyArray, "p 2"], count: int, key: Array) -> Float[Array, "l p"]:
    low, high = jnp.asarray(intervals).T
    return jax.random.uniform(key, (count, low.size), low.dtype, minval=low, maxval=high)


def _located(
    sensor: AbstractSensor, measured: Float[Array, "l p"], hidden: Float[Array, "l q"]
) -> Float[Array, "l n"]:
    """The points of these measurements, in the sensor's frame."""
    points, omegas = jax.vmap(sensor.locate)(measured, hidden)
    return points / omegas[:, None]


class Ring(AbstractPlacement):
    """Evenly on a circle about the centre of the nominal path, at the camera's height; in space in
    turn below, at and above it by a metre. Raises ValueError for a path that does not turn."""

    word: ClassVar[str] = "ring"
    landmarks: int = count(12)
    """The number of landmarks."""
    radius: Number = 8.0
    """m."""

    def __check_init__(self) -> None:
        check_signs(self, self.word)

    def check(self, world: World) -> None:
        turn = world.velocity[-1 if world.geometry is PLANAR else 4]
        if isinstance(world.velocity, np.ndarray) and turn == 0:
            raise ValueError(
                "placement ring needs a nominal path that turns: velocity[-1], in space "
                "velocity[4], is 0"
            )

    def points(self, world: World, key: Array) -> Float[Array, "l n"]:
        del key
        velocity, n = jnp.asarray(world.velocity), world.geometry.point_dim
        # In the plane from x towards z; about y, which points down, the other way round.
        turn = velocity[-1] if world.geometry is PLANAR else -velocity[4]
        # x' = v + ω J x has its fixed point, the centre, at J v / ω: left of a camera that turns
        # from x towards z.
        centre = jnp.stack([-velocity[n - 1] / turn, velocity[0] / turn])
        angles = 2 * jnp.pi * jnp.arange(self.landmarks, dtype=centre.dtype) / self.landmarks
        ring = centre + self.radius * jnp.column_stack([jnp.cos(angles), jnp.sin(angles)])
        if world.geometry is SPATIAL:
            level = jnp.arange(self.landmarks, dtype=centre.dtype) % 3 - 1
            ring = jnp.column_stack([ring[:, 0], level, ring[:, 1]])
        return ring.astype(centre.dtype)


class Cloister(AbstractPlacement):
    """The cloister of slamtb: nine points along each wall of a 12 m room, in two rows, 1 m apart
    in height; the camera starts 0.6 m above the lower ones, 5 m from the centre, looking along
    the wall. Raises ValueError for another world than a spatial one of 72 landmarks."""

    word: ClassVar[str] = "room"
    landmarks: int = count(72)
    """The number of landmarks."""

    def check(self, world: World) -> None:
        if world.geometry is not SPATIAL or self.landmarks != 72:
            raise ValueError(
                "placement room is for a spatial geometry and 72 landmarks, "
                f"not {world.geometry.name} and {self.landmarks}"
            )

    def points(self, world: World, key: Array) -> Float[Array, "72 3"]:
        del key
        along = jnp.concatenate([jnp.arange(-4, 5, 2), jnp.arange(-4, 3, 2)])
        out = jnp.array([6] * 5 + [4] * 4)
        wall = jnp.column_stack([along, out])  # (east, north) of the northern wall
        walls = jnp.concatenate([wall, wall[:, ::-1] * jnp.array([-1, 1])])
        plane = jnp.concatenate([walls, -walls])
        east, north, up = jnp.concatenate(
            [jnp.column_stack([plane, jnp.full(len(plane), height)]) for height in (0, 1)]
        ).T
        return jnp.column_stack([-(north + 5), 0.6 - up, east]).astype(jnp.result_type(world.rate))


class GivenPoints(AbstractPlacement):
    """The points that are given. Raises ValueError for points of another world."""

    word: ClassVar[str] = "points"
    positions: Float[AnyArray, "l n"] = number_field()
    """In the camera of frame 0, (x, z) or (x, y, z), m."""

    @property
    def landmarks(self) -> int:
        return len(self.positions)

    def check(self, world: World) -> None:
        shape, n = np.shape(self.positions), world.geometry.point_dim
        if shape[1:] != (n,) or not shape[0]:
            raise ValueError(
                f"points need {n} numbers each in a {world.geometry.name} world, and one point at "
                f"least; their shape is {shape}"
            )

    def points(self, world: World, key: Array) -> Float[Array, "l n"]:
        del world, key
        return jnp.asarray(self.positions)


class Rays(AbstractPlacement):
    """Landmarks that come as others go, which are gone for good: always as many are in view.

    Whenever one leaves the picture, another is thrown along a random ray of the camera there, at
    a depth that is uniform in an interval, as OpenVINS' simulator does (Geneva et al., ICRA 2020).
    Raises ValueError for a sensor that is no camera, and for an interval that is none.
    """

    word: ClassVar[str] = "rays"
    landmarks: int = count(12)
    """The number of landmarks."""
    first: Float[AnyArray, "p 2"] = eqx.field(converter=_intervals, default=((20.0, 620.0),))
    """Interval of each pixel coordinate at first sight."""
    depth_range: Float[AnyArray, " 2*parts"] = number_field(default=(1.0, 6.0))
    """Least and greatest depth z, m; of several pairs each holds in an equal part of the run."""

    def __check_init__(self) -> None:
        check_signs(self, self.word)
        given = self.depth_range
        pairs = np.ndim(given) == 1 and np.size(given) and np.size(given) % 2 == 0
        if not pairs or (isinstance(given, np.ndarray) and not (given[::2] < given[1::2]).all()):
            raise ValueError(
                "depth_range needs a least and a greatest depth, or several such pairs, not "
                f"{self.depth_range}"
            )

    def check(self, world: World) -> None:
        if world.sensor.hidden != 1:
            raise ValueError(
                f"placement rays is for a camera, not for a {type(world.sensor).__name__}"
            )
        _check_intervals(self.first, world.sensor)
        if world.limits.in_view:
            raise ValueError("in_view: not with placement rays")
        for field in ("first_frame", *world.limits.of_a_frame):
            if getattr(world.limits, field):
                raise ValueError(f"{field}: placement rays has no limits; use 0")
        if world.beacons:
            raise ValueError("beacons: not with placement rays, whose landmarks go")

    def along(
        self, world: World, key: Array, poses: Pose, sensors: AbstractSensor
    ) -> tuple[Float[Array, "frames l n"], Bool[Array, "frames l"]]:
        def frame(points, data):
            key, pose, sensor, depths, is_first = data
            new = is_first | ~world.measured(pose, sensor, points)[1]
            fresh = jax.vmap(pose.apply)(self._thrown(key, sensor, depths))
            points = jnp.where(new[:, None], fresh, points)
            return points, (points, new)

        frames = world.steps + 1
        number, pairs = jnp.arange(frames), jnp.reshape(self.depth_range, (-1, 2))
        keys, depths = jax.random.split(key, frames), pairs[number * len(pairs) // frames]
        nowhere = jnp.ones((self.landmarks, world.geometry.point_dim), jnp.result_type(world.rate))
        return jax.lax.scan(frame, nowhere, (keys, poses, sensors, depths, number == 0))[1]

    def _thrown(
        self, key: Array, sensor: AbstractSensor, depths: Float[Array, " 2"]
    ) -> Float[Array, "l n"]:
        """Points along random rays of a camera, in its frame."""
        pixel_key, depth_key = jax.random.split(key)
        pixels = _uniform(self.first, self.landmarks, pixel_key)
        least, greatest = depths
        share = jax.random.uniform(depth_key, (self.landmarks, 1), pixels.dtype)
        return _located(sensor, pixels, 1 / (least + (greatest - least) * share))


PLACEMENTS = {kind.word: kind for kind in (FromPrior, Ring, Cloister, Rays, GivenPoints)}
