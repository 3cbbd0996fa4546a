"""Monocular SLAM as a model for the filter: frame × landmark parametrization × calibration.

The map frame A is where landmarks are expressed: in a robocentric filter the camera C itself, in
a world-centric one the base B. Both are the same functions of `T_AC(k)`, the pose of the current
camera in the map frame; they differ in what composition does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.camera import Camera, bearing, project
from jaxslam.filters import ekf
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import Geometry, Pose, log
from jaxslam.landmarks.parametrization import Parametrization
from jaxslam.motion import displacement, next_velocity

CALIBRATIONS = ("white", "consider", "estimated", "known")
"""The paper's independent draw of every frame; constant and correlated but not corrected
(Schmidt); constant and estimated; exact."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Core:
    """What the filter estimates beside the landmarks, and the noises that one step appends."""

    pose: Pose
    """T_CB in a robocentric filter, T_BC in a world-centric one."""
    velocity: Float[Array, " t"]
    """Linear and angular velocity in the camera's own frame, m/s and rad/s."""
    acceleration: Float[Array, " t"]
    """a of this step (P10); zero before `predict` and after composition."""
    calibration: Float[Array, " k"]
    """Error of the intrinsics (P15); empty where the calibration is known."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Parameters:
    """The numbers of a filter: all are data, so they can be batched and differentiated."""

    camera: Camera
    intrinsics_sigma: Float[Array, " 2p"]
    """σ of (f, c) or (fx, fy, cx, cy), pixels (D of P15)."""
    pixel_sigma: Float[Array, ""]
    """σ of a measured pixel."""
    acceleration_sigma: Float[Array, " t"]
    """σ of the white acceleration (Q of P11), m/s² and rad/s²."""
    inverse_depth: Float[Array, ""]
    """Mean of the prior on 1/z, 1/m; the paper's is 1/(2 d_min)."""
    inverse_depth_sigma: Float[Array, ""]
    """σ of the prior on 1/z, 1/m; the paper's is 1/(4 d_min)."""

    @property
    def pixel_covariance(self) -> Float[Array, "p p"]:
        """R of one measured pixel."""
        return self.pixel_sigma**2 * jnp.eye(self.camera.focal.size, dtype=self.pixel_sigma.dtype)


def inverse_depth_prior(nearest: float) -> tuple[float, float]:
    """Mean and σ of 1/z whose 96 % interval is from `nearest` (d_min, metres) to infinity."""
    return 1 / (2 * nearest), 1 / (4 * nearest)


@dataclass(frozen=True)
class Frame:
    """Where landmarks live, as functions of the pose in the state and a displacement."""

    name: str
    moves_landmarks: bool
    pose_from_camera: Callable[[Pose], Pose]
    """The pose that the state holds, from T_BC; its own inverse."""
    map_from_camera: Callable[[Pose, Pose], Pose]
    """T_AC(k), from the pose in the state at k−1 and `T_{k-1,k}`."""
    compose: Callable[[Pose, Pose], Pose]
    """The pose in the state at k, from the one at k−1 and `T_{k-1,k}`."""


ROBOCENTRIC = Frame(
    name="robocentric",
    moves_landmarks=True,
    pose_from_camera=lambda T_BC: T_BC.inverse(),
    map_from_camera=lambda T_CB, step: step,
    compose=lambda T_CB, step: step.inverse() @ T_CB,
)
WORLD = Frame(
    name="world",
    moves_landmarks=False,
    pose_from_camera=lambda T_BC: T_BC,
    map_from_camera=lambda T_BC, step: T_BC @ step,
    compose=lambda T_BC, step: T_BC @ step,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Context:
    """Data of the model's functions: the parameters, and the motion not yet composed."""

    parameters: Parameters
    dt: Float[Array, ""]
    """Seconds of motion between the map frame and the camera; 0 once it is composed."""


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

    geometry: Geometry
    landmark: Parametrization
    frame: Frame

    @property
    def moves_landmarks(self) -> bool:
        return self.frame.moves_landmarks

    def _displacement(self, core: Core, context: Context) -> Pose:
        return displacement(self.geometry, core.velocity, core.acceleration, context.dt)

    def view(self, core: Core, context: Context) -> View:
        """All that a landmark depends on."""
        T_AC = self.frame.map_from_camera(core.pose, self._displacement(core, context))
        return View(T_AC, core.calibration)

    def compose_core(self, core: Core, context: Context) -> Core:
        """P18, P19. The acceleration has been used: it is marginalised."""
        pose = self.frame.compose(core.pose, self._displacement(core, context))
        return replace(
            core,
            pose=pose.normalize(),
            velocity=next_velocity(core.velocity, core.acceleration, context.dt),
            acceleration=jnp.zeros_like(core.acceleration),
        )

    def compose_landmark(self, view: View, landmark: Array, context: Context) -> Array:
        """P20: the landmark in the new camera frame."""
        del context
        return self.landmark.transform(view.map_from_camera.inverse(), landmark)

    def observe(self, view: View, landmark: Array, context: Context) -> tuple[Array, Array]:
        """`h = proj(K T_AC⁻¹ X)` (P12, P14), on the homogeneous numerator."""
        point, _ = self.camera_point(view, landmark)
        return project(view.camera(context), point), point[-1] > 0

    def camera_point(self, view: View, landmark: Array) -> tuple[Array, Array]:
        """The landmark in the current camera as a homogeneous point (X, ω)."""
        point, omega = self.landmark.homogeneous(landmark)
        T_CA = view.map_from_camera.inverse()
        return T_CA.rotation() @ point + omega * T_CA.translation(), omega

    def chart(self, view: View, landmark: Array) -> Array:
        """(x/z, y/z, 1/z) in the current camera: where parametrizations can be compared."""
        point, omega = self.camera_point(view, landmark)
        return jnp.append(point[:-1], omega) / point[-1]

    def initialise(self, view: View, pixel: Array, inverse_depth: Array, context: Context) -> Array:
        """P22–P26: a landmark in the map frame from its first pixel and the prior on depth."""
        camera = view.camera(context)
        seen = self.landmark.initialise(bearing(camera, pixel), inverse_depth, camera.focal[0])
        return self.landmark.transform(view.map_from_camera, seen)


@dataclass(frozen=True)
class SlamFilter:
    """An EKF for monocular SLAM: static configuration; its functions are pure.

    One frame is `predict`, `update`, `compose`, `initialise`, in `step`. The motion is composed
    after the update, as the paper has it, or before (`compose_first`).
    """

    model: SlamModel
    calibration: str = "white"
    compose_first: bool = False

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
        velocity: Float[Array, " t"],
        velocity_sigma: Float[Array, " t"],
    ) -> State:
        """An exactly known pose at the origin of B, an uncertain velocity, an empty map."""
        dtype = parameters.pixel_sigma.dtype
        geometry, landmark = self.geometry, self.model.landmark
        t, p = geometry.tangent_dim, geometry.pixel_dim
        core = Core(
            pose=jax.tree.map(lambda x: x.astype(dtype), geometry.group.identity()),
            velocity=jnp.asarray(velocity, dtype),
            acceleration=jnp.zeros(t, dtype),
            calibration=jnp.zeros(0 if self.calibration == "known" else 2 * p, dtype),
        )
        # An empty slot holds a point straight ahead: finite in every formula.
        empty = landmark.initialise(
            jnp.zeros(p, dtype), parameters.inverse_depth, parameters.camera.focal[0]
        )
        state = State(
            core=core,
            landmarks=jnp.tile(empty, (capacity, 1)),
            active=jnp.zeros(capacity, bool),
            covariance=jnp.zeros((0, 0), dtype),
        )
        n = state.core_dim + capacity * empty.size
        state = replace(state, covariance=jnp.zeros((n, n), dtype))
        state = ekf.augment(state, t, jnp.diag(jnp.asarray(velocity_sigma, dtype) ** 2))
        return state if self.calibration == "white" else self._with_calibration(state, parameters)

    def predict(self, state: State, parameters: Parameters, dt: Float[Array, ""]) -> State:
        """Append this step's acceleration and calibration error (P10, P11, P15)."""
        t = self.geometry.tangent_dim
        state = ekf.augment(state, 2 * t, jnp.diag(parameters.acceleration_sigma**2))
        if self.calibration == "white":
            state = self._with_calibration(state, parameters)
        return (
            ekf.compose(self.model, state, Context(parameters, dt)) if self.compose_first else state
        )

    def update(
        self, state: State, parameters: Parameters, dt: Float[Array, ""], features: Features
    ) -> tuple[State, Innovation]:
        """Correct by the features seen (P16, P17)."""
        context = self._context(parameters, dt)
        noise = parameters.pixel_covariance
        return ekf.update(self.model, state, features, noise, context, self._considered(state))

    def update_mean(
        self, state: State, parameters: Parameters, dt: Float[Array, ""], features: Features
    ) -> State:
        """`update` without its covariance: cheap enough to try many hypotheses."""
        context = self._context(parameters, dt)
        noise = parameters.pixel_covariance
        return ekf.update_mean(self.model, state, features, noise, context, self._considered(state))

    def project(
        self, state: State, parameters: Parameters, dt: Float[Array, ""], slots: Array
    ) -> tuple[Float[Array, "m p"], Bool[Array, " m"]]:
        """Pixels of landmarks in the current camera, and whether they are in front of it."""
        context = self._context(parameters, dt)
        view = self.model.view(state.core, context)
        observe = jax.vmap(self.model.observe, in_axes=(None, 0, None))
        return observe(view, state.landmarks[slots], context)

    def predict_features(
        self, state: State, parameters: Parameters, dt: Float[Array, ""], slots: Array
    ) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]:
        """Search ellipses of a predicted state: pixels, innovation covariances, in front."""
        context = self._context(parameters, dt)
        return ekf.predict_features(self.model, state, slots, parameters.pixel_covariance, context)

    def compose(self, state: State, parameters: Parameters, dt: Float[Array, ""]) -> State:
        """Move into the new camera frame, after the update (P18–P21)."""
        if self.compose_first:
            return state
        return ekf.compose(self.model, state, Context(parameters, dt))

    def initialise(self, state: State, parameters: Parameters, features: Features) -> State:
        """Insert new landmarks seen from the current camera (P22–P26)."""
        prior = (parameters.inverse_depth, parameters.inverse_depth_sigma)
        noise, context = parameters.pixel_covariance, _composed(parameters)
        return ekf.initialise(self.model, state, features, noise, prior, context)

    def finish(self, state: State) -> State:
        """Forget the frame's calibration error where the next frame draws another (white)."""
        if self.calibration != "white":
            return state
        start, size = 3 * self.geometry.tangent_dim, state.core.calibration.size
        core = replace(state.core, calibration=jnp.zeros_like(state.core.calibration))
        return replace(ekf.marginalise(state, start, size), core=core)

    def first(self, state: State, parameters: Parameters, new: Features) -> State:
        """Frame 0: nothing has moved, everything seen is new."""
        if self.calibration == "white":
            state = self._with_calibration(state, parameters)
        return self.finish(self.initialise(state, parameters, new))

    def step(
        self,
        state: State,
        parameters: Parameters,
        dt: Float[Array, ""],
        seen: Features,
        new: Features,
    ) -> tuple[State, Innovation]:
        """One frame: `seen` are features of landmarks in the map, `new` those to insert."""
        state = self.predict(state, parameters, dt)
        state, innovation = self.update(state, parameters, dt, seen)
        state = self.compose(state, parameters, dt)
        return self.finish(self.initialise(state, parameters, new)), innovation

    def pose_error(self, state: State, T_BC: Pose) -> tuple[Float[Array, " t"], Array]:
        """`Log(T_est⁻¹ T_true)` of the pose in the state, and the covariance of its tangent."""
        t = self.geometry.tangent_dim
        truth = self.model.frame.pose_from_camera(T_BC)
        return log(state.core.pose.inverse() @ truth), state.covariance[:t, :t]

    def camera_pose(self, state: State) -> tuple[Pose, Float[Array, "t t"]]:
        """T_BC and its covariance in the right tangent: position in camera axes, orientation."""
        return ekf.core_covariance(lambda core: self.model.frame.pose_from_camera(core.pose), state)

    def landmarks_in_camera(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """(x/z, y/z, 1/z) of landmarks in the current camera, with covariances."""
        return ekf.landmark_covariance(
            self._composed_view(parameters), self.model.chart, state, slots
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

        return ekf.landmark_covariance(self._composed_view(parameters), above, state, slots)

    def landmarks_in_world(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """Points in B and their covariances, the camera's uncertainty included.

        Not finite for a landmark at infinity; far from Gaussian for one of unknown depth.
        """
        camera_view = self._composed_view(parameters)

        def view(core):
            return camera_view(core), self.model.frame.pose_from_camera(core.pose)

        def point(view, landmark):
            (camera_view, T_BC) = view
            seen, omega = self.model.camera_point(camera_view, landmark)
            return T_BC @ (seen / omega)

        return ekf.landmark_covariance(view, point, state, slots)

    def predicted_camera(
        self, state: State, parameters: Parameters, dt: Float[Array, ""], slots: Array
    ) -> tuple[Pose, Float[Array, "m n"], Float[Array, " m"]]:
        """T_BC of a predicted state, and the landmarks in that camera as (X, ω)."""
        context = self._context(parameters, dt)
        view = self.model.view(state.core, context)
        core = self.model.compose_core(state.core, context)
        points, omegas = jax.vmap(self.model.camera_point, in_axes=(None, 0))(
            view, state.landmarks[slots]
        )
        return self.model.frame.pose_from_camera(core.pose), points, omegas

    def _composed_view(self, parameters: Parameters) -> Callable[[Core], View]:
        return lambda core: self.model.view(core, _composed(parameters))

    def _with_calibration(self, state: State, parameters: Parameters) -> State:
        if self.calibration == "known":
            return state
        covariance = jnp.diag(parameters.intrinsics_sigma**2)
        return ekf.augment(state, 3 * self.geometry.tangent_dim, covariance)

    def _considered(self, state: State) -> slice:
        """The part of the core that updates leave as it is."""
        start = 3 * self.geometry.tangent_dim
        size = state.core.calibration.size if self.calibration == "consider" else 0
        return slice(start, start + size)

    def _context(self, parameters: Parameters, dt) -> Context:
        return _composed(parameters) if self.compose_first else Context(parameters, dt)


def _composed(parameters: Parameters) -> Context:
    return Context(parameters, jnp.zeros_like(parameters.pixel_sigma))
