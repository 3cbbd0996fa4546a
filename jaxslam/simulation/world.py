"""A simulated world: its pieces, which are the truth of what filters have models of.

Angles, axes and controls are those of `jaxslam.geometry` and `jaxslam.models.motion`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from importlib import import_module
from operator import attrgetter, index
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import (
    AnyArray,
    Number,
    check_kinds,
    check_leaves,
    check_shape,
    number_field,
    numbers,
    optional_numbers,
)
from jaxslam._runtime import plotted
from jaxslam._runtime.lookup import suggestion
from jaxslam.geometry import SPATIAL, Geometry, Pose
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.depth import InverseDepth
from jaxslam.models.imu import Imu
from jaxslam.models.motion import AbstractMotion, ConstantVelocity, Odometry
from jaxslam.models.sensors import AbstractSensor, FieldOfView, Pinhole, Position, RangeBearing
from jaxslam.simulation.fields import FIELDS, PLACES, Value, check_signs
from jaxslam.simulation.run import Run
from jaxslam.simulation.trajectories import RecordedMotion

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOTIONS = {"velocity": ConstantVelocity, "odometry": Odometry, "imu": Imu}
SENSORS = {"camera": Pinhole, "position": Position, "range_bearing": RangeBearing}


class AbstractPlacement(eqx.Module):
    """Where landmarks are. One of your own is a class with `landmarks` and `points`."""

    word: ClassVar[str] = ""
    """Its name in scenarios."""

    if TYPE_CHECKING:  # a field or a property of each placement

        @property
        def landmarks(self) -> int:
            """How many there are."""

    def check(self, world: World) -> None:
        """Raise ValueError for a world in which landmarks cannot be placed so."""

    def points(self, world: World, key: Array) -> Float[Array, "l n"]:
        """Where they are for a whole run, in the camera of frame 0, m."""
        raise NotImplementedError(f"{type(self).__name__} does not say where its points are")

    def along(
        self, world: World, key: Array, poses: Pose, sensors: AbstractSensor
    ) -> tuple[Float[Array, "*frames l n"], Bool[Array, "frames l"] | None]:
        """The points, and None; or, where others come along a path, the points in each slot in
        every frame, and which are new."""
        del poses, sensors
        return self.points(world, key), None


class AbstractTrueCalibration(eqx.Module):
    """How far the true calibration is off the nominal one: δ, of which filters know σ."""

    word: ClassVar[str] = ""
    sigma: eqx.AbstractVar[Float[AnyArray, " k"]]
    """σ of δ, pixels."""

    def deltas(self, key: Array, frames: int) -> Float[Array, "frames k"]:
        """δ of every frame, in σ."""
        raise NotImplementedError(f"{type(self).__name__} does not say how it is drawn")

    def sensors(self, nominal: AbstractSensor, key: Array, frames: int) -> AbstractSensor:
        """The true sensor of every frame. Raises ValueError for one without a calibration."""
        return jax.vmap(nominal.perturbed)(self.deltas(key, frames) * jnp.asarray(self.sigma))


class NominalCalibration(AbstractTrueCalibration):
    """The true calibration is the nominal one."""

    word: ClassVar[str] = "nominal"
    sigma: Float[AnyArray, " k"] = number_field(default=())
    """The σ that filters are given, of (f, c), (fx, fy, cx, cy) or (f, cx, cy), pixels."""

    def sensors(self, nominal: AbstractSensor, key: Array, frames: int) -> AbstractSensor:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (frames, *jnp.shape(x))), nominal)


class WhiteCalibration(AbstractTrueCalibration):
    """Drawn anew in every frame (P15)."""

    word: ClassVar[str] = "white"
    sigma: Float[AnyArray, " k"] = number_field()
    """The σ of (f, c), (fx, fy, cx, cy) or (f, cx, cy), pixels."""

    def deltas(self, key: Array, frames: int) -> Float[Array, "frames k"]:
        sigma = jnp.asarray(self.sigma)
        return jax.random.normal(key, (frames, sigma.size), sigma.dtype)


class ConstantCalibration(AbstractTrueCalibration):
    """Drawn once per run."""

    word: ClassVar[str] = "constant"
    sigma: Float[AnyArray, " k"] = number_field()
    """The σ of (f, c), (fx, fy, cx, cy) or (f, cx, cy), pixels."""

    def deltas(self, key: Array, frames: int) -> Float[Array, "frames k"]:
        sigma = jnp.asarray(self.sigma)
        return jnp.tile(jax.random.normal(key, (sigma.size,), sigma.dtype), (frames, 1))


CALIBRATIONS = {
    kind.word: kind for kind in (NominalCalibration, WhiteCalibration, ConstantCalibration)
}


def count(default: int) -> Any:
    """Return a field of a whole number, which is no data: another one makes another program."""
    return eqx.field(
        static=True, default=default, converter=lambda x: index(x) if hasattr(x, "__index__") else x
    )


class Limits(eqx.Module):
    """How many of the visible landmarks are measured; 0 is no limit. Raises ValueError for limits
    of single frames beside `in_view`."""

    first_frame: int = count(0)
    """Before it nothing is measured."""
    first_landmarks: int = count(0)
    """The most that are new in frame 0."""
    new_landmarks: int = count(0)
    """The most that are new in a later frame."""
    known_landmarks: int = count(0)
    """The most that are measured again in a frame, drawn at random."""
    in_view: int = count(0)
    """The most that are measured at once, where one that leaves the view is a new one when it is
    seen again: a filter needs slots for no more."""

    def __check_init__(self) -> None:
        check_signs(self, "limits")
        if self.in_view and self.of_a_frame:
            raise ValueError(f"in_view: not with {', '.join(self.of_a_frame)}")

    @property
    def of_a_frame(self) -> list[str]:
        """The fields that limit single frames."""
        fields = ("first_landmarks", "new_landmarks", "known_landmarks")
        return [field for field in fields if getattr(self, field)]


class Drift(eqx.Module):
    """Errors of a landmark's measurements that stay from frame to frame, and that no filter
    knows: `b ← ρ b + √(1 − ρ²) σ n` with ρ = exp(−1/frames)."""

    sigma: Number
    """In the unit of the measurement: pixels, m, rad."""
    frames: Number = 20.0
    """After which 1/e is left."""
    wrong: Number = 0.0
    """Share of the landmarks of which σ is ten times as large."""

    def __check_init__(self) -> None:
        check_signs(self, "drift")

    def errors(self, key: Array, measured: Float[Array, "f l p"]) -> Float[Array, "f l p"]:
        """The errors of every measurement."""
        first_key, key, share_key = jax.random.split(key, 3)
        stays = jnp.exp(-1 / jnp.asarray(self.frames, measured.dtype))
        noises = jax.random.normal(key, measured.shape, measured.dtype)

        def later(drift, noise):
            return stays * drift + jnp.sqrt(1 - stays**2) * noise, drift

        start = jax.random.normal(first_key, measured.shape[1:], measured.dtype)
        _, drifts = jax.lax.scan(later, start, noises)
        wrong = jax.random.uniform(share_key, measured.shape[1:2]) < self.wrong
        return self.sigma * jnp.where(wrong, 10.0, 1.0)[:, None] * drifts


KINDS = {
    "motion": AbstractMotion, "sensor": AbstractSensor, "placement": AbstractPlacement,
    "calibration": AbstractTrueCalibration, "depth": InverseDepth, "limits": Limits,
    "view": FieldOfView | None, "drift": Drift | None,
}  # fmt: skip
"""The pieces of a world."""


class World(eqx.Module):
    """What is true: the pieces of a filter, which draw here what a filter has to estimate.

    Lengths are metres, angles radians, times seconds. Camera axes are x right,
    y down, z ahead; the plane has x and z, and its angle θ turns from x towards z. A point is
    (x, z) or (x, y, z), a velocity or the reading of an odometry (x, z, θ) or
    (x, y, z, about x, about y, about z). The base frame B is the camera of frame 0.

    - `motion`: how the camera moves and what a filter knows of it (`AbstractMotion`);
    - `sensor`: what is measured, of nominal calibration, with its noise (`AbstractSensor`);
    - `placement`: where landmarks are (`FromPrior`, `Ring`, `Cloister`, `Rays`, `GivenPoints`);
    - `calibration`: how far the true one is off, pixels (`NominalCalibration`,
      `WhiteCalibration`, `ConstantCalibration`);
    - `depth`: the prior on 1/z, 1/m;
    - `steps`: steps of a run after frame 0; `rate`: frames per second;
    - `velocity`: the nominal one in the camera's axes, m/s and rad/s; by default the motion's mean
      or, for a motion without one, 1.2 m/s ahead in a circle of 4 m;
    - `sway`: what each number of that velocity sways by about it, of a motion that is read along a
      path (`Imu`);
    - `trajectory`: a recorded path, or the name of its file, which an `Imu` takes to be in a world
      whose z points up; `still_frames`: steps in which the
      camera is first at rest;
    - `view`: what the sensor sees (least depth and distances, m; picture, pixels); `limits`: how
      much of that is measured;
    - `drift`: errors of landmarks that stay; `beacons`: how many landmarks are surveyed, with
      `beacon_sigma`, m, of each coordinate;
    - `treatment`: how filters treat the calibration by default (`known`, `white`, `consider`,
      `estimated`); `name`: for tables.

    The flat fields of `jaxslam.scenario` are attributes too: `world.pixel_sigma`. Numbers are
    leaves: worlds that differ in nothing else share their compiled programs. Raises ValueError for
    pieces that do not fit one another.
    """

    motion: AbstractMotion
    sensor: AbstractSensor
    placement: AbstractPlacement
    calibration: AbstractTrueCalibration = NominalCalibration()
    depth: InverseDepth = InverseDepth.beyond(3.0)
    steps: int = count(100)
    rate: Number = 10.0
    velocity: Float[AnyArray, " t"] = eqx.field(default=None, converter=optional_numbers)
    sway: Float[AnyArray, " t"] = eqx.field(default=None, converter=optional_numbers)
    trajectory: str | RecordedMotion | None = None
    still_frames: int = count(0)
    view: FieldOfView = eqx.field(default=None)
    limits: Limits = Limits()
    drift: Drift | None = None
    beacons: int = count(0)
    beacon_sigma: Number = 0.1
    treatment: str = eqx.field(static=True, default="known")
    name: str = eqx.field(static=True, default="world")

    def __post_init__(self) -> None:
        check_kinds(self, KINDS)
        if self.view is None:
            self.view = self.sensor.view
        if self.velocity is None:
            ahead = {3: (0.0, 1.2, 0.3), 6: (0.0, 0.0, 1.2, 0.0, -0.3, 0.0)}
            known = self.motion.start()[0] if self.motion.has_velocity else None
            self.velocity = numbers(ahead[self.geometry.tangent_dim] if known is None else known)
        if self.sway is None or not np.size(self.sway):
            self.sway = numbers((0.0,) * self.geometry.tangent_dim)

    def __check_init__(self) -> None:
        check_signs(self, "world")
        check_leaves(self)
        geometry, sensor = self.geometry, type(self.sensor).__name__
        check_shape("the velocity of a world", self.velocity, (geometry.tangent_dim,))
        check_shape("the sway of a world", self.sway, (geometry.tangent_dim,))
        if isinstance(self.sway, np.ndarray) and self.sway.any() and not self.inertial:
            raise ValueError(f"sway: not of a {type(self.motion).__name__}; use 0")
        if self.inertial and self.still_frames and self.trajectory:
            raise ValueError("still_frames: not with an Imu along a trajectory; use 0")
        if self.sensor.point_dim != geometry.point_dim:
            raise ValueError(
                f"the sensor {sensor} is not for a {geometry.name} world, in which "
                f"{type(self.motion).__name__} moves"
            )
        if self.treatment not in TREATMENTS:
            raise ValueError(f"calibration is {self.treatment!r}; known: {', '.join(TREATMENTS)}")
        if self.treatment != "known" and not np.size(self.calibration.sigma):
            raise ValueError(f"calibration: a {sensor} sensor has none; use known")
        if self.reads and (self.still_frames or self.trajectory):
            field = "still_frames" if self.still_frames else "trajectory"
            raise ValueError(f"{field}: odometry has the nominal motion; leave it out")
        if self.trajectory and geometry is not SPATIAL:
            raise ValueError(f"trajectory is for a spatial world, not a {geometry.name} one")
        if self.beacons > self.placement.landmarks or (self.beacons and self.limits.in_view):
            raise ValueError(
                f"beacons: at most the {self.placement.landmarks} landmarks are accepted, and "
                "none with in_view"
            )
        self.placement.check(self)

    @property
    def geometry(self) -> Geometry:
        """Planar or spatial."""
        return self.motion.geometry

    @property
    def landmarks(self) -> int:
        """How many there are, or are at once."""
        return self.placement.landmarks

    @property
    def reads(self) -> bool:
        """Whether the truth is the nominal motion, which filters are given as it is read."""
        return type(self.motion).reading is not AbstractMotion.reading

    @property
    def inertial(self) -> bool:
        """Whether the motion is read many times a step along a path, which is the truth."""
        return type(self.motion).along is not AbstractMotion.along

    @property
    def scale_free(self) -> bool:
        """Whether nothing is measured or given in metres: only priors know the scale."""
        return self.motion.has_velocity and self.sensor.hidden == 1 and not self.beacons

    def measured(
        self, pose: Pose, sensor: AbstractSensor, points: Float[Array, "l n"]
    ) -> tuple[Float[Array, "l p"], Bool[Array, " l"]]:
        """Return what a sensor in a pose measures without noise, and what it sees of that."""
        seen_from = jax.vmap(pose.inverse().apply)(points)
        one = jnp.ones((), points.dtype)
        measured = jax.vmap(sensor.measure, in_axes=(0, None))(seen_from, one)
        visible = jax.vmap(sensor.visible, in_axes=(0, 0, None))(seen_from, measured, self.view)
        return measured, visible

    def plot(self, run: Run | int = 0, path: str | Path | None = None) -> Figure:
        """The world from above: the true path of a run, its landmarks, and which are measured.

        `run` is a run, or i of run i of a study with seed 0. The figure is written to `path` where
        one is given.
        """
        if not isinstance(run, Run):
            simulate = import_module("jaxslam.simulation").simulate
            key = jax.random.fold_in(jax.random.key(0), run)
            run = cast(Run, jax.jit(partial(simulate, self))(key))
        points = np.asarray(run.points_by_frame)
        return plotted("plot_world")(
            f"{self.name} from above, {self.steps} steps at {float(self.rate):g} Hz",
            np.asarray(run.poses.as_matrix()),
            points,
            np.asarray(run.visible),
            points[0, :0] if run.known is None else np.asarray(run.known.points),
            path,
        )

    def to_dict(self) -> dict[str, Value]:
        """The flat fields of a scenario, as files have them: words, numbers and lists.

        A piece of your own is a table of its `type` and its numbers.
        """
        return {field: _plain(value) for field, value in self.fields.items()}

    @property
    def fields(self) -> dict[str, Value]:
        """The flat fields with which `jaxslam.scenario` makes this world; those that it has no use
        for are their defaults."""
        found = {name: field.within(self.geometry) for name, field in FIELDS.items()} | {
            "velocity_sigma": (0.0,) * self.geometry.tangent_dim,
            "geometry": self.geometry.name,
            "true_calibration": self.calibration.word,
            "landmarks": self.landmarks,
            "placement": self.placement.word or self.placement,
            "trajectory": self.trajectory or "",
        }
        pieces = {
            "world": self, "view": self.view, "picture": self.view, "limits": self.limits,
            "drift": self.drift, self.placement.word: self.placement,
        }  # fmt: skip
        for kind, known in (("motion", MOTIONS), ("sensor", SENSORS)):
            piece = getattr(self, kind)
            word = {made: word for word, made in known.items()}.get(type(piece), "")
            word = word if _says_all(PLACES.get(word, {}), piece) else ""
            found[kind] = word or piece
            pieces[word] = piece
        for word, piece in pieces.items():
            found |= _flat(piece, PLACES.get(word, {}))
        if sigma := _numbers_of(self.calibration.sigma):
            found |= {"focal_sigma": sigma[0], "centre_sigma": sigma[-1]}
        return found | _of_depth(self.depth)

    def __hash__(self) -> int:
        """Return the hash of its words and numbers, so that a world may be a key."""
        leaves, kind = jax.tree.flatten(self)
        return hash((kind, *(np.asarray(leaf).tobytes() for leaf in leaves)))

    def __getattr__(self, name: str) -> Value:
        """A flat field by its name. Raises AttributeError for another."""
        if name in FIELDS and not hasattr(type(self), name) and name not in _PIECES:
            return self.fields[name]
        raise AttributeError(f"a {type(self).__name__} has no {name!r}{suggestion(name, FIELDS)}")


_PIECES = {field.name for field in dataclasses.fields(World)}


def _flat(piece: eqx.Module | None, places: Mapping[str, str]) -> dict[str, Value]:
    """The flat fields of a piece, of those that it has."""
    found = {}
    for field, place in places.items():
        with suppress(AttributeError):  # a lens, where there is none
            found[field] = _numbers_of(attrgetter(place)(piece))
    return {field: value for field, value in found.items() if value is not None}


def _says_all(places: Mapping[str, str], piece: eqx.Module) -> bool:
    """Whether what a piece has beside these places is as it is by default."""
    said = {place.partition(".")[0] for place in places.values()}
    others = [field for field in dataclasses.fields(piece) if field.name not in said]
    values = [(_numbers_of(getattr(piece, field.name)), field.default) for field in others]
    return all(value == default for value, default in values if not isinstance(value, Tracer))


def _numbers_of(value: Value) -> Value:
    """Arrays of known numbers as tuples, which compare and print."""
    if isinstance(value, np.ndarray) or (eqx.is_array(value) and not isinstance(value, Tracer)):
        value = np.asarray(value).tolist()
    return tuple(map(_numbers_of, value)) if isinstance(value, list) else value


def _of_depth(depth: InverseDepth) -> dict[str, Value]:
    """The prior on 1/z, of d_min where it is that of one to within rounding."""
    mean, sigma, unit = (_numbers_of(x) for x in (depth.mean, depth.sigma, depth.unit))
    found: dict[str, Value] = {"scale_sigma": unit or 0.0, "inverse_depth": (mean, sigma)}
    if isinstance(mean, float) and np.isclose(mean, 2 * sigma, rtol=1e-15, atol=0):
        found |= {"nearest_depth": float(f"{1 / (2 * mean):.15g}"), "inverse_depth": ()}
    return found


def _plain(value: Value) -> Value:
    """A value as JSON has it."""
    value = _numbers_of(value)
    if isinstance(value, tuple):
        return [_plain(x) for x in value]
    if isinstance(value, eqx.Module):
        kind, fields = type(value), dataclasses.fields(value)
        told = {field.name: _plain(getattr(value, field.name)) for field in fields}
        return {"type": f"{kind.__module__}:{kind.__qualname__}"} | told
    return value
