"""Worlds and filters of published studies that have no scenario: pieces of their own."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxslam.filters.gaussian import append_noise, noise_of
from jaxslam.filters.linear.covariance import composed
from jaxslam.filters.model import COMPOSED, Context
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.slam import Slam
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import PLANAR, SPATIAL, SplitPose, exp, joined, tangent_dim
from jaxslam.landmarks import LANDMARKS, Cartesian
from jaxslam.models.frame import AbstractFrame, Keyframe, Robocentric, WorldCentric
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.sensors import AbstractSensor, FieldOfView, Position
from jaxslam.simulation import GivenPoints, World
from jaxslam.simulation.world import AbstractPlacement, count


class AbstractTold(AbstractMotion):
    """A motion u that odometry reads as `Exp(−w) u`. The control is −w in its σ, and the variable
    the number of the step, which is known."""

    @abstractmethod
    def nominal(self, step):
        """u of a step, and σ of w."""

    @property
    def noise_sigma(self):
        return np.ones(self.geometry.tangent_dim)

    def start(self):
        return jnp.zeros(1), jnp.zeros((1, 1))

    def displacement(self, variables, noise, control):
        u, sigma = self.nominal(variables[0])
        return exp(self.geometry.group, sigma * (control + noise)) @ u

    def next(self, variables, noise, control):
        return variables + 1

    def still(self, dtype=None):
        return jnp.zeros(self.geometry.tangent_dim, dtype)

    def nominal_control(self, velocity, seconds):
        return jnp.zeros_like(velocity)

    def reading(self, control, noise):
        return control - noise


HALF = np.array([50.0, 40.0, 20.0])
"""Half of the box in which the path of `zhang` is, m."""
RATE = np.array([0.1, 0.2 / 3, 0.2 / 3])
"""By how much that path turns about the middle of the box, rad a step: 8 rounds in 500 steps."""
TURN = 0.6 * np.array([0.5, -0.3, 0.4])
"""By how much the robot turns about x, y and z, rad a step."""
BORDER = 12.0
"""Landmarks are in the box and so far around it, m."""
REACH, ANGLE = 20.0, 2 * np.pi / 3
"""A point is seen that is nearer, m, and at less than this angle from straight ahead."""


def path(step):
    """T_WC of a step: a curve of Lissajous, as in the code of the authors."""
    a, b, c = RATE * step
    position = HALF * jnp.stack([jnp.cos(a), jnp.sin(b), jnp.sin(c + 1)])
    rotation = jaxlie.SO3.from_rpy_radians(*(TURN * step + jnp.array([2.0, 0.0, 0.0])))
    return jaxlie.SE3.from_rotation_and_translation(rotation, position)


class AlongPath(AbstractTold):
    """The steps of `path`, of which odometry knows all numbers with σ in proportion to them."""

    share: float
    """σ in |u|."""
    geometry = SPATIAL

    def nominal(self, step):
        u = path(step).inverse() @ path(step + 1)
        turn = u.rotation().log()
        return u, self.share * jnp.abs(jnp.concatenate([u.translation(), turn]))


class WithSigma(AbstractSensor):
    """A point in the sensor's frame, and σ of each coordinate, a share of its true size:
    `(X, σ |X|)`. The second half is told, and tells nothing of the point."""

    sigma: float
    """The share."""
    size = 6
    point_dim = 3

    def measure(self, point, omega):
        return jnp.concatenate([point, jax.lax.stop_gradient(self.sigma * jnp.abs(point))])

    def locate(self, measured, hidden):
        return measured[:3], jnp.ones((), measured.dtype)

    def residual(self, measured, predicted):
        return jnp.concatenate([measured[:3] - predicted[:3], jnp.zeros(3)])

    def noise_at(self, measured):
        return jnp.diag(jnp.concatenate([measured[3:], jnp.full(3, 1e-9)]) ** 2)

    def visible(self, point, measured, view):
        ahead = point[2] > jnp.cos(ANGLE) * jnp.linalg.norm(point)
        return super().visible(point, measured, view) & ahead


class Around(AbstractPlacement):
    """Landmarks drawn anew for every run, in the box of the path and around it."""

    landmarks: int = count(300)

    def points(self, world, key):
        half = HALF + BORDER
        points = jax.random.uniform(key, (self.landmarks, 3), minval=-half, maxval=half)
        return jax.vmap(path(0.0).inverse().apply)(points)


def zhang(share: float) -> World:
    """Zhang, Wu, Song, Huang, Dissanayake, RA-L 2017, §VI: 500 steps among 300 landmarks."""
    return World(
        motion=AlongPath(share),
        sensor=WithSigma(share),
        placement=Around(),
        steps=500,
        view=FieldOfView(range=(0.0, REACH)),
        name="zhang",
    )


class OnCircle(AbstractTold):
    """A circle of 5 m in 40 s at 100 Hz, once the heading has got an error of 45°."""

    geometry = PLANAR

    def nominal(self, step):
        begun = step > 0
        u = jnp.where(begun, jnp.array([0.0, 2 * math.pi * 5 / 4000, 2 * math.pi / 4000]), 0.0)
        turn = exp(jaxlie.SO2, u[2:])
        odometry = jnp.array([0.01, 0.01, math.radians(1)]) / 100
        start = jnp.array([0.0, 0.0, math.radians(45)])
        return joined(turn, u[:2]), jnp.where(begun, odometry, start)


class Range(AbstractSensor):
    """The distance of a point, m."""

    sigma: float = 1.0
    size = 1
    point_dim = 2

    def measure(self, point, omega):
        return jnp.linalg.norm(point / omega, keepdims=True)

    def locate(self, measured, hidden):
        return jnp.append(jnp.zeros(1), measured), jnp.ones((), measured.dtype)


def localisation() -> World:
    """ukfm's 2-D localisation, whose GPS is the distance of two beacons 1000 km away, along x and
    along z: what it measures is linear in the position, and nothing of the heading."""
    return World(
        motion=OnCircle(),
        sensor=Range(),
        placement=GivenPoints([[1e6, 0.0], [0.0, 1e6]]),
        steps=4000,
        beacons=2,
        beacon_sigma=1e-6,
        name="localisation",
    )


GRAVITY = np.array([0.0, 0.0, -9.82])
PERIOD = 0.01
"""Of the unit, s."""


def _accelerations():
    """Of a circle of 5 m in 30 s, m/s², by differences of its places; at first it is at rest."""
    angle = np.linspace(0, 2 * np.pi, 3000)
    place = 5 * np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    velocity = np.diff(place, axis=0, prepend=place[:1]) / PERIOD
    return np.diff(velocity, axis=0, prepend=velocity[:1]) / PERIOD


ACCELERATIONS = _accelerations()


class Unit(AbstractTold):
    """An inertial unit without biases, which does not turn, on that circle; its start is the first
    step. Gravity is known, so that the variables have the orientation R too, as a copy of the
    pose's, and with it the velocity v: (R, v) is one pose, whose error is that of the filter's.
    """

    held: AbstractFrame = WorldCentric()
    """How (R, v) is held, as one pose: with the error of SO(3) × R⁶, or of SE₂(3) on a side."""
    geometry = SPATIAL

    def nominal(self, step):
        """What is read of a step, m/s² and rad/s, and σ; of the start its place, m."""
        begun = step > 0
        force = jnp.asarray(ACCELERATIONS)[step.astype(int) - 1] - GRAVITY
        of_start = jnp.array([1.0] * 3 + [math.radians(15)] * 3) / math.sqrt(3)
        read = jnp.where(begun, force, jnp.array([0.0, 5.0, 0.0]))
        return jnp.append(read, jnp.zeros(3)), jnp.where(begun, 0.01, of_start)

    def start(self):
        rest = self.held.from_base_pose(jaxlie.SE3.identity())
        size = 1 + tangent_dim(rest)
        return (jnp.zeros(1), rest), jnp.zeros((size, size))

    def _read(self, variables, noise, control):
        """How a step turns, the force that is read, and its seconds; of the start its place, 0."""
        step, _ = variables
        read, sigma = self.nominal(step[0])
        force, rate = jnp.split(read + sigma * (control + noise), 2)
        seconds = jnp.where(step[0] > 0, PERIOD, 0.0)
        return exp(jaxlie.SO3, jnp.where(seconds > 0, rate * seconds, rate)), force, seconds

    def displacement(self, variables, noise, control):
        turn, force, seconds = self._read(variables, noise, control)
        attitude = self.held.camera_pose(variables[1])
        fallen = attitude.translation() * seconds + jnp.asarray(GRAVITY) * seconds**2 / 2
        moved = attitude.rotation().inverse() @ fallen + force * seconds**2 / 2
        return joined(turn, jnp.where(seconds > 0, moved, force))

    def next(self, variables, noise, control):
        turn, force, seconds = self._read(variables, noise, control)
        step, held = variables
        pull = joined(jaxlie.SO3.identity(), jnp.asarray(GRAVITY) * seconds)
        after = pull @ self.held.camera_pose(held) @ joined(turn, force * seconds)
        return step + 1, self.held.from_base_pose(after.normalize())


def inertial() -> World:
    """ukfm's inertial navigation: a unit at 100 Hz, and three known points that are measured."""
    return World(
        motion=Unit(),
        sensor=Position(0.1, 3),
        placement=GivenPoints([[0.0, 2.0, 2.0], [-2.0, -2.0, -2.0], [2.0, -2.0, -2.0]]),
        steps=3000,
        beacons=3,
        beacon_sigma=1e-6,
        name="inertial",
    )


class ComposedFirst(Slam):
    """A robocentric filter whose motion is composed before the update: landmarks move into the new
    camera by the prediction."""

    def predict(self, state, control):
        return composed(self.model, append_noise(self, state), Context(control))

    def update(self, state, control, seen):
        noise = noise_of(self, seen)
        return self.correction.update(self.model, state, seen, noise, COMPOSED)

    def compose(self, state, control):
        return state


def left_invariant(**pieces) -> Slam:
    """The pose with the error `T Exp(ξ)`: that of a first keyframe that is never left."""
    return Slam(**pieces, frame=Keyframe(turn=math.inf, parallax=math.inf))


class AboutWorldAxes(WorldCentric):
    """World-centric, with the error of the orientation about the axes of the base: `R ← Exp(θ) R`,
    where the classical one here is about those of the camera. The inverse of R is held."""

    def from_base_pose(self, T_BC):
        return SplitPose(T_BC.translation(), T_BC.rotation().inverse())

    def camera_pose(self, held):
        return joined(held.rotation.inverse(), held.translation)

    def map_from_camera(self, held, step):
        return self.camera_pose(held) @ step

    def compose(self, held, step):
        return self.from_base_pose((self.camera_pose(held) @ step).normalize())


OWN = {
    "robocentric, composed first": ComposedFirst,
    "left-invariant": left_invariant,
    "world, about its axes": partial(Slam, frame=AboutWorldAxes()),
}
HELD = {
    "invariant": Robocentric(),
    "left-invariant": Keyframe(),
    "world, about its axes": AboutWorldAxes(),
}
"""How a `Unit` holds (R, v) so that its error is the filter's; as in `world` for others."""


class Surveyed(Cartesian):
    """A known point: the base frame is that of the survey, so that nothing moves it there."""

    def transform(self, T_ab, landmark):
        return landmark


def make(name: str, world: World) -> AbstractFilter:
    """A filter by its name in the tables, `filter/landmarks`."""
    frame, _, landmark = name.partition("/")
    pieces: dict[str, Any] = scenario_pieces(world) | {"landmark": LANDMARKS[landmark]}
    if isinstance(world.motion, Unit):
        held = Unit(HELD.get(frame, WorldCentric()))
        pieces |= {"motion": held, "landmark": Surveyed()}
    return OWN.get(frame, partial(make_filter, frame))(**pieces)
