"""Monocular SLAM as a model for the filter: frame × landmark parametrization × calibration.

The map frame A is where landmarks are expressed: in a robocentric filter the camera C itself, in
a world-centric one the base B. Both are the same functions of `T_AC(k)`, the pose of the current
camera in the map frame; they differ in what composition does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.camera import Camera
from jaxslam.filters import ekf
from jaxslam.filters.initialisation import UNDELAYED, Initialisation
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import Geometry, Pose, SplitPose, difference, identity
from jaxslam.landmarks.parametrization import Parametrization
from jaxslam.rig import Rig

CALIBRATIONS = ("white", "consider", "estimated", "known")
"""The paper's independent draw of every frame; constant and correlated but not corrected
(Schmidt); constant and estimated; exact."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Core:
    """What the filter estimates beside the landmarks, and the noises that one step appends."""

    pose: Pose | SplitPose
    """T_CB in a robocentric filter, T_BC in a world-centric one, as the `Frame` holds it."""
    velocity: Float[Array, " v"]
    """Linear and angular velocity in the camera's own frame, m/s and rad/s; v = t, or none."""
    noise: Float[Array, " t"]
    """What drives this step's motion: the acceleration a (P10), or the odometry's error; zero
    before `predict` and after composition."""
    calibration: Float[Array, " k"]
    """Error of the intrinsics (P15); empty where the calibration is known."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Parameters:
    """The numbers of a filter: all are data, so they can be batched and differentiated."""

    camera: Camera
    intrinsics_sigma: Float[Array, " 2p"]
    """σ of (f, c) or (fx, fy, cx, cy), pixels (D of P15)."""
    measurement_sigma: Float[Array, ""]
    """σ of each number measured: a pixel's, or a relative position's in metres."""
    motion_sigma: Float[Array, " t"]
    """σ of the noise that drives the motion (Q of P11): acceleration, m/s² and rad/s², or
    odometry, m and rad."""
    inverse_depth: Float[Array, ""]
    """Mean of the prior on 1/z, 1/m; the paper's is 1/(2 d_min)."""
    inverse_depth_sigma: Float[Array, ""]
    """σ of the prior on 1/z, 1/m; the paper's is 1/(4 d_min)."""


def inverse_depth_prior(nearest: float) -> tuple[float, float]:
    """Mean and σ of 1/z whose 96 % interval is from `nearest` (d_min, metres) to infinity."""
    return 1 / (2 * nearest), 1 / (4 * nearest)


@dataclass(frozen=True)
class Frame:
    """Where landmarks live, as functions of a pose and a displacement `T_{k-1,k}`."""

    name: str
    moves_landmarks: bool
    hold: Callable[[Pose], Any]
    """What the state holds of a pose: its error is this pytree's tangent."""
    pose: Callable[[Any], Pose]
    """The inverse of `hold`."""
    pose_from_camera: Callable[[Pose], Pose]
    """The pose that the state holds, from T_BC; its own inverse."""
    map_from_camera: Callable[[Pose, Pose], Pose]
    """T_AC(k), from the pose at k−1 and the displacement."""
    compose: Callable[[Pose, Pose], Pose]
    """The pose at k, from the one at k−1 and the displacement."""


ROBOCENTRIC = Frame(
    name="robocentric",
    moves_landmarks=True,
    hold=lambda T_CB: T_CB,
    pose=lambda T_CB: T_CB,
    pose_from_camera=lambda T_BC: T_BC.inverse(),
    map_from_camera=lambda T_CB, step: step,
    compose=lambda T_CB, step: step.inverse() @ T_CB,
)
WORLD = Frame(
    name="world",
    moves_landmarks=False,
    hold=SplitPose.of,
    pose=SplitPose.joined,
    pose_from_camera=lambda T_BC: T_BC,
    map_from_camera=lambda T_BC, step: T_BC @ step,
    compose=lambda T_BC, step: T_BC @ step,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Context:
    """Data of the model's functions: the parameters, and the motion not yet composed."""

    parameters: Parameters
    control: Any
    """The motion model's input for the motion between the map frame and the camera: seconds, or
    the odometry's reading; None once the motion is composed."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class View:
    """What a landmark depends on beside itself."""

    map_from_camera: Pose
    """T_AC(k), the current camera in the map frame."""
    calibration: Float[Array, " k"]

    def camera(self, context: Context) -> Camera:
        """The camera with the calibration error of this step."""
        return context.parameters.camera.perturbed(self.calibration)


@dataclass(frozen=True)
class SlamModel:
    """The one-landmark functions that `jaxslam.filters.ekf` asks for."""

    rig: Rig
    landmark: Parametrization
    frame: Frame

    @property
    def geometry(self) -> Geometry:
        return self.rig.geometry

    @property
    def moves_landmarks(self) -> bool:
        return self.frame.moves_landmarks

    def _displacement(self, core: Core, context: Context) -> Pose:
        if context.control is None:
            return identity(self.geometry, core.noise.dtype)
        motion = self.rig.motion
        return motion.displacement(self.geometry, core.velocity, core.noise, context.control)

    def view(self, core: Core, context: Context) -> View:
        """All that a landmark depends on."""
        step = self._displacement(core, context)
        T_AC = self.frame.map_from_camera(self.frame.pose(core.pose), step)
        return View(T_AC, core.calibration)

    def compose_core(self, core: Core, context: Context) -> Core:
        """P18, P19. The noise has been used: it is marginalised."""
        step = self._displacement(core, context)
        pose = self.frame.compose(self.frame.pose(core.pose), step).normalize()
        return replace(
            core,
            pose=self.frame.hold(pose),
            velocity=self.rig.motion.next_velocity(core.velocity, core.noise, context.control),
            noise=jnp.zeros_like(core.noise),
        )

    def camera_pose(self, core: Core) -> Pose:
        """T_BC."""
        return self.frame.pose_from_camera(self.frame.pose(core.pose))

    def compose_landmark(self, view: View, landmark: Array, context: Context) -> Array:
        """P20: the landmark in the new camera frame."""
        del context
        return self.landmark.transform(view.map_from_camera.inverse(), landmark)

    def observe(self, view: View, landmark: Array, context: Context) -> tuple[Array, Array]:
        """`h = proj(K T_AC⁻¹ X)` (P12, P14), and whether it is possible."""
        point, omega = self.camera_point(view, landmark)
        sensor = self.rig.sensor
        return sensor.measure(view.camera(context), point, omega), sensor.possible(point)

    def camera_point(self, view: View, landmark: Array) -> tuple[Array, Array]:
        """The landmark in the current camera as a homogeneous point (X, ω)."""
        point, omega = self.landmark.homogeneous(landmark)
        T_CA = view.map_from_camera.inverse()
        return T_CA.rotation() @ point + omega * T_CA.translation(), omega

    def chart(self, view: View, landmark: Array) -> Array:
        """The sensor's chart in the current camera: where parametrizations can be compared."""
        return self.rig.sensor.chart(*self.camera_point(view, landmark))

    def convert(self, view: View, landmark: Array, covariance: Array, context: Context) -> Array:
        """The same landmark in the form that its parametrization now prefers."""
        del context
        if self.landmark.convert is None:
            return landmark
        return self.landmark.convert(view.map_from_camera.translation(), landmark, covariance)

    def initialise(self, view: View, measured: Array, hidden: Array, context: Context) -> Array:
        """P22–P26: a landmark in the map frame from its first measurement and the prior."""
        camera = view.camera(context)
        point, omega = self.rig.sensor.locate(camera, measured, hidden)
        seen = self.landmark.initialise(point, omega, camera.focal[0])
        return self.landmark.transform(view.map_from_camera, seen)


@dataclass(frozen=True)
class SlamFilter:
    """An EKF for monocular SLAM: static configuration; its functions are pure.

    One frame is `predict`, `update`, `compose`, `initialise`, in `step`. The motion is composed
    after the update, as the paper has it, or before (`compose_first`). How landmarks enter the
    map is the `initialisation`'s to say; it builds on `correct` and `insert`.
    """

    model: SlamModel
    calibration: str = "white"
    compose_first: bool = False
    initialisation: Initialisation = UNDELAYED

    def __post_init__(self) -> None:
        if self.calibration not in CALIBRATIONS:
            raise ValueError(
                f"unknown calibration {self.calibration!r}; known: {', '.join(CALIBRATIONS)}"
            )

    @property
    def geometry(self) -> Geometry:
        return self.model.geometry

    def start(
        self,
        parameters: Parameters,
        capacity: int,
        velocity: Float[Array, " v"],
        velocity_sigma: Float[Array, " v"],
    ) -> State:
        """An exactly known pose at the origin of B, an uncertain velocity, an empty map.

        The velocity is not used by a motion model without one.
        """
        dtype = parameters.measurement_sigma.dtype
        geometry, landmark = self.geometry, self.model.landmark
        t, p = geometry.tangent_dim, geometry.pixel_dim
        v = t if self.model.rig.motion.has_velocity else 0
        core = Core(
            pose=self.model.frame.hold(identity(geometry, dtype)),
            velocity=jnp.asarray(velocity, dtype)[:v],
            noise=jnp.zeros(t, dtype),
            calibration=jnp.zeros(0 if self.calibration == "known" else 2 * p, dtype),
        )
        # An empty slot holds a point straight ahead: finite in every formula.
        ahead = jnp.zeros(p + 1, dtype).at[-1].set(1.0)
        focal = parameters.camera.focal[0]
        empty = landmark.initialise(ahead, parameters.inverse_depth, focal)
        slots = self.initialisation.slots(capacity)
        state = State(
            core=core,
            landmarks=jnp.tile(empty, (slots, 1)),
            active=jnp.zeros(slots, bool),
            covariance=jnp.zeros((0, 0), dtype),
            memory=self.initialisation.memory(capacity, dtype),
        )
        n = state.core_dim + state.landmarks.size
        state = replace(state, covariance=jnp.zeros((n, n), dtype))
        state = ekf.augment(state, t, jnp.diag(jnp.asarray(velocity_sigma, dtype)[:v] ** 2))
        return state if self.calibration == "white" else self._with_calibration(state, parameters)

    def predict(self, state: State, parameters: Parameters, control: Array) -> State:
        """Append this step's motion noise and calibration error (P10, P11, P15)."""
        start = self.geometry.tangent_dim + state.core.velocity.size
        state = ekf.augment(state, start, jnp.diag(parameters.motion_sigma**2))
        if self.calibration == "white":
            state = self._with_calibration(state, parameters)
        if not self.compose_first:
            return state
        return ekf.compose(self.model, state, Context(parameters, control))

    def update(
        self, state: State, parameters: Parameters, control: Array, features: Features
    ) -> tuple[State, Innovation]:
        """Correct by the features seen (P16, P17)."""
        return self.initialisation.update(self, state, parameters, control, features)

    def correct(
        self,
        state: State,
        parameters: Parameters,
        control: Array,
        features: Features,
        share: Float[Array, " m"] | None = None,
    ) -> tuple[State, Innovation]:
        """The Kalman update by features of slots; with a share ρ of each, by R/ρ."""
        context = self._context(parameters, control)
        noise = self._noise(parameters)
        if share is not None:
            noise = noise / jnp.where(share > 0, share, 1.0)[:, None, None]
        return ekf.update(self.model, state, features, noise, context, self._considered(state))

    def update_mean(
        self, state: State, parameters: Parameters, control: Array, features: Features
    ) -> State:
        """`update` without its covariance: cheap enough to try many hypotheses."""
        context = self._context(parameters, control)
        noise = self._noise(parameters)
        return ekf.update_mean(self.model, state, features, noise, context, self._considered(state))

    def project(
        self, state: State, parameters: Parameters, control: Array, slots: Array
    ) -> tuple[Float[Array, "m p"], Bool[Array, " m"]]:
        """Pixels of landmarks in the current camera, and whether they are in front of it."""
        context = self._context(parameters, control)
        view = self.model.view(state.core, context)
        observe = jax.vmap(self.model.observe, in_axes=(None, 0, None))
        return observe(view, state.landmarks[slots], context)

    def predict_features(
        self, state: State, parameters: Parameters, control: Array, slots: Array
    ) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]:
        """Search ellipses of a predicted state: pixels, innovation covariances, in front."""
        context = self._context(parameters, control)
        return ekf.predict_features(self.model, state, slots, self._noise(parameters), context)

    def compose(self, state: State, parameters: Parameters, control: Array) -> State:
        """Move into the new camera frame, after the update (P18–P21); convert landmarks."""
        if not self.compose_first:
            state = ekf.compose(self.model, state, Context(parameters, control))
        if self.model.landmark.convert is None:
            return state
        return ekf.convert(self.model, state, _composed(parameters))

    def initialise(self, state: State, parameters: Parameters, features: Features) -> State:
        """Begin new landmarks seen from the current camera (P22–P26)."""
        return self.initialisation.initialise(self, state, parameters, features)

    def insert(
        self,
        state: State,
        parameters: Parameters,
        features: Features,
        prior: tuple[Float[Array, "m q"], Float[Array, "m q"]] | None = None,
    ) -> State:
        """Insert Gaussians into slots; 1/z has the parameters' prior, or one for each slot."""
        if prior is None:
            hidden = self.model.rig.sensor.hidden
            mean, sigma = parameters.inverse_depth, parameters.inverse_depth_sigma
            prior = (jnp.tile(mean, hidden), jnp.tile(sigma, hidden))
        noise, context = self._noise(parameters), _composed(parameters)
        return ekf.initialise(self.model, state, features, noise, prior, context)

    def finish(self, state: State) -> State:
        """Forget the frame's calibration error where the next frame draws another (white)."""
        if self.calibration != "white":
            return state
        part = _calibration(state)
        core = replace(state.core, calibration=jnp.zeros_like(state.core.calibration))
        return replace(ekf.marginalise(state, part.start, part.stop - part.start), core=core)

    def first(self, state: State, parameters: Parameters, new: Features) -> State:
        """Frame 0: nothing has moved, everything seen is new."""
        if self.calibration == "white":
            state = self._with_calibration(state, parameters)
        return self.finish(self.initialise(state, parameters, new))

    def step(
        self,
        state: State,
        parameters: Parameters,
        control: Array,
        seen: Features,
        new: Features,
    ) -> tuple[State, Innovation]:
        """One frame: `seen` are features of landmarks in the map, `new` those to insert."""
        state = self.predict(state, parameters, control)
        state, innovation = self.update(state, parameters, control, seen)
        state = self.compose(state, parameters, control)
        return self.finish(self.initialise(state, parameters, new)), innovation

    def pose_error(self, state: State, T_BC: Pose) -> tuple[Float[Array, " t"], Array]:
        """`T_true ⊟ T_est` of the pose in the state, and the covariance of its tangent."""
        t, frame = self.geometry.tangent_dim, self.model.frame
        truth = frame.hold(frame.pose_from_camera(T_BC))
        return difference(truth, state.core.pose), state.covariance[:t, :t]

    def camera_pose(self, state: State) -> tuple[Pose, Float[Array, "t t"]]:
        """T_BC and its covariance in the right tangent: position in camera axes, orientation."""
        return ekf.core_covariance(self.model.camera_pose, state)

    def reported(self, state: State) -> State:
        """The state with one slot a landmark, whatever the initialisation keeps of it."""
        return self.initialisation.reported(state)

    def landmarks_in_camera(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """The sensor's chart of landmarks, (x/z, y/z, 1/z) of a camera, with covariances."""
        return ekf.landmark_covariance(
            self._composed_view(parameters), self.model.chart, self.reported(state), slots
        )

    def landmarks_from_above(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m 2"], Float[Array, "m 2 2"]]:
        """Azimuth (from z towards x, axes of B) and inverse horizontal distance from the camera.

        A map seen from above: the point is `(sin θ, cos θ)/ρ` from the camera, and a Gaussian in
        (θ, ρ) is drawn as the bent region that it is. The camera's pose is taken as known.
        """
        rotation = self.camera_pose(state)[0].rotation()

        def above(view, landmark):
            point, omega = self.model.camera_point(view, landmark)
            x, z = (rotation @ point)[jnp.array([0, -1])]
            return jnp.stack([jnp.atan2(x, z), omega / jnp.hypot(x, z)])

        view = self._composed_view(parameters)
        return ekf.landmark_covariance(view, above, self.reported(state), slots)

    def landmarks_in_world(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """Points in B and their covariances, the camera's uncertainty included.

        Not finite for a landmark at infinity; far from Gaussian for one of unknown depth.
        """
        camera_view = self._composed_view(parameters)

        def view(core):
            return camera_view(core), self.model.camera_pose(core)

        def point(view, landmark):
            (camera_view, T_BC) = view
            seen, omega = self.model.camera_point(camera_view, landmark)
            return T_BC @ (seen / omega)

        return ekf.landmark_covariance(view, point, self.reported(state), slots)

    def predicted_camera(
        self, state: State, parameters: Parameters, control: Array, slots: Array
    ) -> tuple[Pose, Float[Array, "m n"], Float[Array, " m"]]:
        """T_BC of a predicted state, and the landmarks in that camera as (X, ω)."""
        context = self._context(parameters, control)
        view = self.model.view(state.core, context)
        core = state.core
        if not self.compose_first:
            core = self.model.compose_core(core, context)
        points, omegas = jax.vmap(self.model.camera_point, in_axes=(None, 0))(
            view, state.landmarks[slots]
        )
        return self.model.camera_pose(core), points, omegas

    def _composed_view(self, parameters: Parameters) -> Callable[[Core], View]:
        return lambda core: self.model.view(core, _composed(parameters))

    def _with_calibration(self, state: State, parameters: Parameters) -> State:
        if self.calibration == "known":
            return state
        covariance = jnp.diag(parameters.intrinsics_sigma**2)
        return ekf.augment(state, _calibration(state).start, covariance)

    def _noise(self, parameters: Parameters) -> Float[Array, "p p"]:
        """R of one measurement."""
        sigma = parameters.measurement_sigma
        return sigma**2 * jnp.eye(self.model.rig.sensor.size(self.geometry), dtype=sigma.dtype)

    def _considered(self, state: State) -> slice:
        """The part of the core that updates leave as it is."""
        return _calibration(state) if self.calibration == "consider" else slice(0, 0)

    def _context(self, parameters: Parameters, control: Array) -> Context:
        return _composed(parameters) if self.compose_first else Context(parameters, control)


def _composed(parameters: Parameters) -> Context:
    return Context(parameters, None)


def _calibration(state: State) -> slice:
    """Where the calibration's error is in the tangent of the core: at its end."""
    return slice(state.core_dim - state.core.calibration.size, state.core_dim)
