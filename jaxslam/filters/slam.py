"""Monocular SLAM as a model for the filter: frame × landmark parametrization × calibration.

The filter is a model (`SlamModel`), what it does in a frame (`SlamFilter`), and the form in which
the uncertainty is kept: the `Engine` whose functions it calls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.camera import Camera
from jaxslam.filters import ekf
from jaxslam.filters.blocks import Change
from jaxslam.filters.engine import Engine
from jaxslam.filters.filter import step_in_stages
from jaxslam.filters.frames import Frame, KeyframePose, keyframe_due
from jaxslam.filters.initialisation import UNDELAYED, Initialisation
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import (
    Geometry,
    Pose,
    SplitPose,
    difference,
    homogeneous_apply,
    identity,
    scaled,
    tangent_dim,
)
from jaxslam.landmarks.parametrization import Parametrization
from jaxslam.rig import Rig

CALIBRATIONS = ("white", "consider", "estimated", "known")
"""The paper's independent draw of every frame; constant and correlated but not corrected
(Schmidt); constant and estimated; exact."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Core:
    """What the filter estimates beside the landmarks, and the noises that one step appends."""

    pose: Pose | SplitPose | KeyframePose
    """T_CB in a robocentric filter, T_BC in a world-centric one, T_BK and T_KC in one with
    keyframes: what the `Frame` holds."""
    velocity: Float[Array, " v"]
    """Linear and angular velocity in the camera's own frame, m/s and rad/s; v = t, or none."""
    log_scale: Float[Array, " 1"] | None = field(default=None, kw_only=True)
    """λ of a filter with a scale gauge, or None: lengths in the state are in units of `e^λ` m."""
    noise: Float[Array, " t"]
    """What drives this step's motion: the acceleration a (P10), or the odometry's error; zero
    before `predict` and after composition."""
    calibration: Float[Array, " k"]
    """Error of the intrinsics (P15); empty where the calibration is known."""
    anchors: SplitPose | None = None
    """T_AF of the cameras F in which landmarks are written; a batch, or None."""
    depth_error: Float[Array, " 1"] | None = None
    """What the priors on 1/z of all landmarks have in common, in σ of one prior, or None."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Parameters:
    """The numbers of a filter: all are data, so they can be batched and differentiated."""

    camera: Camera
    intrinsics_sigma: Float[Array, " 2p"]
    """σ of (f, c) or (fx, fy, cx, cy), pixels (D of P15)."""
    measurement_sigma: Float[Array, ""] | Float[Array, " p"]
    """σ of what is measured, one for all its numbers or one each: pixels, or metres of a relative
    position."""
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Context:
    """Data of the model's functions: the parameters, and the motion not yet composed."""

    parameters: Parameters
    control: Any
    """The motion model's input for the motion between the map frame and the camera: seconds, or
    the odometry's reading; None once the motion is composed."""
    anchor: Int[Array, ""] | None = None
    """Number of the anchor of new landmarks, the current camera."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class View:
    """What a landmark depends on beside itself."""

    map_from_camera: Pose
    """T_AC(k), the current camera in the map frame."""
    calibration: Float[Array, " k"]
    anchors: SplitPose | None = None
    log_scale: Float[Array, " 1"] | None = None
    depth_error: Float[Array, " 1"] | None = None

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
        return self.frame.moves_landmarks and not self.landmark.anchored

    def displacement(self, core: Core, context: Context) -> Pose:
        """The camera's motion in this step; the identity once it is composed."""
        if context.control is None:
            return identity(self.geometry, core.noise.dtype)
        motion, noise = self.rig.motion, self._noise_in_gauge(core)
        return motion.displacement(self.geometry, core.velocity, noise, context.control)

    def _noise_in_gauge(self, core: Core) -> Float[Array, " t"]:
        """The acceleration in the units of the state.

        λ is frozen at its estimate: the noise's amplitude says nothing about scale, but its
        derivative by λ would pretend so.
        """
        if core.log_scale is None:
            return core.noise
        unit = jnp.exp(-jax.lax.stop_gradient(core.log_scale))
        n = self.geometry.point_dim
        return jnp.concatenate([unit * core.noise[:n], core.noise[n:]])

    def view(self, core: Core, context: Context) -> View:
        """All that a landmark depends on."""
        step = self.displacement(core, context)
        T_AC = self.frame.map_from_camera(core.pose, step)
        return View(T_AC, core.calibration, core.anchors, core.log_scale, core.depth_error)

    def compose_core(self, core: Core, context: Context) -> Core:
        """P18, P19. The noise has been used: it is marginalised."""
        step = self.displacement(core, context)
        return replace(
            core,
            pose=self.frame.compose(core.pose, step),
            anchors=_seen_from(step, core.anchors) if self.frame.moves_landmarks else core.anchors,
            velocity=self.rig.motion.next_velocity(
                core.velocity, self._noise_in_gauge(core), context.control
            ),
            noise=jnp.zeros_like(core.noise),
        )

    def camera_pose(self, core: Core) -> Pose:
        """T_BC, in metres."""
        return self.frame.camera_pose(self._metric_pose(core))

    def estimate(self, core: Core) -> Pose | SplitPose:
        """The one pose whose error is the filter's, in metres."""
        return self.frame.estimate(self._metric_pose(core))

    def _metric_pose(self, core: Core) -> Any:
        """What is held of the pose, its lengths times `e^λ`."""
        if core.log_scale is None:
            return core.pose
        return scaled(core.pose, jnp.exp(core.log_scale[0]))

    def compose_landmark(self, view: View, landmark: Array, context: Context) -> Array:
        """The landmark in the new camera frame, for which the paper numbers no equation."""
        del context
        return self.landmark.transform(view.map_from_camera.inverse(), landmark)

    def reanchoring(self) -> Change | None:
        """The current camera becomes the map frame, its motion composed; None if it never does."""
        reanchor, transform = self.frame.reanchor, self.landmark.transform
        if reanchor is None:
            return None

        def core(core):
            anchors = _seen_from(self._map_from_camera(core), core.anchors)
            return replace(core, pose=reanchor(core.pose), anchors=anchors)

        def landmark(T_AC, landmark):
            return transform(T_AC.inverse(), landmark)

        moved = None if self.landmark.anchored else landmark
        return Change(core=core, view=self._map_from_camera, landmark=moved)

    def reanchoring_due(self, state: State) -> Bool[Array, ""]:
        """Whether the camera is far from the map frame, its motion composed."""
        points, omegas = jax.vmap(self.landmark.homogeneous)(state.landmarks)
        inverse_distances = jnp.abs(omegas) / jnp.linalg.norm(points, axis=1)
        counted = jnp.where(state.active, inverse_distances, 0.0)
        return keyframe_due(self._map_from_camera(state.core), counted)

    def _map_from_camera(self, core: Core) -> Pose:
        """T_AC, once the motion is composed."""
        return self.frame.map_from_camera(core.pose, identity(self.geometry, core.noise.dtype))

    def observe(self, view: View, landmark: Array, context: Context) -> tuple[Array, Array]:
        """`h = proj(K T_AC⁻¹ X)` (P12, P14), and whether it is possible."""
        point, omega = self.camera_point(view, landmark)
        sensor = self.rig.sensor
        return sensor.measure(view.camera(context), point, omega), sensor.possible(point)

    def camera_point(self, view: View, landmark: Array) -> tuple[Array, Array]:
        """The landmark in the current camera as a homogeneous point (X, ω)."""
        point, omega = self.landmark.homogeneous(landmark)
        T_CA = view.map_from_camera.inverse()
        if self.landmark.anchored:
            T_AF = jax.tree.map(lambda x: x[landmark[-1].astype(int)], view.anchors)
            T_CA = T_CA @ T_AF.joined()
        return homogeneous_apply(T_CA, point, omega), omega

    def metric_point(self, view: View, landmark: Array) -> tuple[Array, Array]:
        """`camera_point` in metres: with the gauge's scale, `ω e^−λ`."""
        point, omega = self.camera_point(view, landmark)
        return point, omega if view.log_scale is None else omega * jnp.exp(-view.log_scale[0])

    def chart(self, view: View, landmark: Array) -> Array:
        """The sensor's chart in the current camera: where parametrizations can be compared."""
        return self.rig.sensor.chart(*self.metric_point(view, landmark))

    def convert(self, view: View, landmark: Array, covariance: Array, context: Context) -> Array:
        """The same landmark in the form that its parametrization now prefers."""
        del context
        if self.landmark.convert is None:
            return landmark
        return self.landmark.convert(view.map_from_camera.translation(), landmark, covariance)

    def initialise(self, view: View, measured: Array, hidden: Array, context: Context) -> Array:
        """P22–P26: a landmark in the map frame from its first measurement and the prior."""
        camera = view.camera(context)
        if view.depth_error is not None:
            hidden = hidden + context.parameters.inverse_depth_sigma * view.depth_error
        point, omega = self.rig.sensor.locate(camera, measured, hidden)
        if view.log_scale is not None:
            omega = omega * jnp.exp(view.log_scale[0])
        seen = self.landmark.initialise(point, omega, camera.focal[0])
        if self.landmark.anchored:
            return seen.at[-1].set(context.anchor)
        return self.landmark.transform(view.map_from_camera, seen)

    def anchoring(self, anchor: Int[Array, ""]) -> Change:
        """The current camera, its motion composed, becomes an anchor of landmarks."""

        def core(core):
            camera = SplitPose.of(self._map_from_camera(core))
            anchors = jax.tree.map(lambda all, one: all.at[anchor].set(one), core.anchors, camera)
            return replace(core, anchors=anchors)

        return Change(core=core, view=self._map_from_camera, landmark=None)


@dataclass(frozen=True)
class SlamFilter:
    """An EKF for monocular SLAM: static configuration; its functions are pure.

    One frame is `predict`, `update`, `compose`, `initialise`, in `step`. The motion is composed
    after the update, as the paper has it, or before (`compose_first`). How landmarks enter the
    map is the `initialisation`'s to say; it builds on `correct` and `insert`. The states are
    those of the engine: `State`, or `InformationState`.
    """

    model: SlamModel
    calibration: str = "white"
    compose_first: bool = False
    engine: Engine = ekf
    """The form of the filter: `ekf`, on the covariance, or `information`, on its inverse."""
    initialisation: Initialisation = UNDELAYED
    scale_gauge: bool = False
    """Whether lengths in the state are in a unit of their own, `e^λ` metres, with λ estimated."""
    own_depth: float = 1.0
    """σ of what a landmark's 1/z has of its own, in σ of its prior."""
    common_depth: float = 0.0
    """σ of what the priors on 1/z of all landmarks have in common, in σ of one; it is estimated."""

    def __post_init__(self) -> None:
        if self.calibration not in CALIBRATIONS:
            raise ValueError(
                f"unknown calibration {self.calibration!r}; known: {', '.join(CALIBRATIONS)}"
            )
        if not (self.own_depth > 0 and self.common_depth >= 0):
            raise ValueError(
                "depths have some part of their own, and one in common that is not negative, "
                f"not {self.own_depth} and {self.common_depth}"
            )
        motion, sensor = self.model.rig.motion, self.model.rig.sensor
        if self.scale_gauge and not (motion.has_velocity and sensor.hidden):
            raise ValueError(
                "a scale gauge is for a camera with a velocity: "
                f"motion {motion.name} and sensor {sensor.name} measure metres"
            )
        if self.initialisation is not UNDELAYED:
            self._check_delayed()

    def _check_delayed(self) -> None:
        """Delayed initialisations have depths of their own, in metres, in place of the prior."""
        for wrong, what in (
            (self.common_depth, "depths with a common part"),
            (self.scale_gauge, "a scale gauge"),
        ):
            if wrong:
                raise ValueError(
                    f"{what} cannot go with a delayed initialisation, which replaces the prior "
                    "on depth by depths of its own, in metres"
                )

    @property
    def rig(self) -> Rig:
        return self.model.rig

    @property
    def geometry(self) -> Geometry:
        return self.model.geometry

    @property
    def gaussian_filter(self) -> SlamFilter:
        return self

    def start(
        self,
        parameters: Parameters,
        capacity: int,
        velocity: Float[Array, " v"],
        velocity_sigma: Float[Array, " v"] | Float[Array, "v v"],
        features: tuple[int, int] | None = None,
    ) -> State:
        """An exactly known pose at the origin of B, an uncertain velocity, an empty map.

        Of the velocity's covariance, σ of each number or a root R, `P = R Rᵀ`. The velocity is
        not used by a motion model without one. `features` (how many a frame has at the most, known
        and new) is for filters that remember frames.
        """
        del features
        dtype = parameters.measurement_sigma.dtype
        geometry, landmark = self.geometry, self.model.landmark
        t, p = geometry.tangent_dim, geometry.pixel_dim
        v = t if self.model.rig.motion.has_velocity else 0
        held = self.model.frame.hold(identity(geometry, dtype))
        core = Core(
            pose=held,
            velocity=jnp.asarray(velocity, dtype)[:v],
            log_scale=jnp.zeros(1, dtype) if self.scale_gauge else None,
            noise=jnp.zeros(t, dtype),
            calibration=jnp.zeros(0 if self.calibration == "known" else 2 * p, dtype),
            anchors=self._no_anchors(capacity, dtype),
            depth_error=jnp.zeros(1, dtype) if self.common_depth else None,
        )
        # An empty slot holds a point straight ahead: finite in every formula.
        ahead = jnp.zeros(p + 1, dtype).at[-1].set(1.0)
        focal = parameters.camera.focal[0]
        empty = landmark.initialise(ahead, parameters.inverse_depth, focal)
        slots = self.initialisation.slots(capacity)
        state = self.engine.empty(core, jnp.tile(empty, (slots, 1)))
        state = replace(state, memory=self.initialisation.memory(capacity, dtype))
        state = self.engine.know(state, 0, tangent_dim(held))
        root = velocity_root(jnp.asarray(velocity_sigma, dtype))[:v, :v]
        state = self._with_velocity(state, root)
        if self.common_depth:
            common = jnp.full((1, 1), self.common_depth**2, dtype)
            state = self.engine.augment(state, _part(core, "depth_error").start, common)
        return state if self.calibration == "white" else self._with_calibration(state, parameters)

    def _with_velocity(self, state: State, root: Float[Array, "v v"]) -> State:
        """The prior on the velocity; in a gauge, on the scale and on what it leaves of it."""
        core, covariance = state.core, root @ root.T
        if self.scale_gauge:
            mean, covariance = velocity_in_gauge(core.velocity, root, self.geometry.point_dim)
            core = replace(core, velocity=mean[:-1], log_scale=mean[-1:])
        state = replace(state, core=core)
        return self.engine.augment(state, _part(core, "velocity").start, covariance)

    def predict(self, state: State, parameters: Parameters, control: Array) -> State:
        """Append this step's noise; move already where the motion is composed first."""
        state = self.append_noise(state, parameters)
        return self.composed_first(state, parameters, control)

    def composed_first(self, state: State, parameters: Parameters, control: Array) -> State:
        """Move already, where the motion is composed before the update."""
        if not self.compose_first:
            return state
        return self.engine.compose(self.model, state, Context(parameters, control))

    def predicted_gaussian(self, state: State, parameters: Parameters, control: Array) -> State:
        """A predicted state as one Gaussian of this filter: itself."""
        del parameters, control
        return state

    def append_noise(self, state: State, parameters: Parameters) -> State:
        """Append this step's motion noise and calibration error (P10, P11, P15)."""
        start = _part(state.core, "noise").start
        state = self.engine.augment(state, start, jnp.diag(parameters.motion_sigma**2))
        return state if self.calibration != "white" else self._with_calibration(state, parameters)

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
        noise = self.noise(parameters)
        if share is not None:
            noise = noise / jnp.where(share > 0, share, 1.0)[:, None, None]
        return self.engine.update(
            self.model, state, features, noise, context, self._considered(state)
        )

    def update_mean(
        self, state: State, parameters: Parameters, control: Array, features: Features
    ) -> State:
        """`update` without its covariance: cheap enough to try many hypotheses."""
        context = self._context(parameters, control)
        noise = self.noise(parameters)
        return self.engine.update_mean(
            self.model, state, features, noise, context, self._considered(state)
        )

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
        return self.engine.predict_features(
            self.model, state, slots, self.noise(parameters), context
        )

    def compose(self, state: State, parameters: Parameters, control: Array) -> State:
        """Move into the new camera frame, after the update (P18–P21); convert landmarks; make the
        camera a keyframe where one is due."""
        if not self.compose_first:
            state = self.engine.compose(self.model, state, Context(parameters, control))
        if self.model.frame.reanchor is not None:
            due = self.model.reanchoring_due(state)
            state = jax.lax.cond(due, self.reanchor, lambda state: state, state)
        if self.model.landmark.convert is None:
            return state
        return ekf.convert(self.model, state, _composed(parameters))

    def reanchor(self, state: State) -> State:
        """Make the current camera the keyframe: landmarks move to it, and T_KC is known."""
        change = self.model.reanchoring()
        if change is None:
            return state
        t = self.geometry.tangent_dim
        return self.engine.know(self.engine.change(state, change), t, t)

    def remove(self, state: State, gone: Bool[Array, " capacity"]) -> State:
        """Marginalise landmarks and free their slots."""
        return self.engine.remove(state, gone)

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
        prior = self._prior_in_gauge(state, prior)
        noise, context = self.noise(parameters), _composed(parameters)
        if self.model.landmark.anchored:
            anchor = _free_anchor(state)
            state = self.engine.change(state, self.model.anchoring(anchor))
            context = replace(context, anchor=anchor)
        return self.engine.initialise(self.model, state, features, noise, prior, context)

    def _prior_in_gauge(self, state: State, prior: tuple[Array, Array]) -> tuple[Array, Array]:
        """Mean and σ of 1/z such that `e^λ/z`, linear in λ, has its exact first two moments.

        `E e^λ ρ = ρ0 e^(λ + P/2)` for a ρ ~ N(ρ0, σ²) and λ of variance P; the slope by λ is the
        mean, and the variance that it leaves is `e^2λ ((ρ0² + σ²) e^2P − ρ0² e^P (1 + P))`.
        """
        mean, sigma = prior
        sigma = sigma * self.own_depth
        if not self.scale_gauge:
            return mean, sigma
        P = self.engine.core_covariance(lambda core: core.log_scale, state)[1][0, 0]
        variance = (mean**2 + sigma**2) * jnp.exp(2 * P) - mean**2 * jnp.exp(P) * (1 + P)
        return mean * jnp.exp(P / 2), jnp.sqrt(variance)

    def finish(self, state: State) -> State:
        """Forget the frame's calibration error where the next frame draws another (white)."""
        if self.calibration != "white":
            return state
        part = _calibration(state)
        core = replace(state.core, calibration=jnp.zeros_like(state.core.calibration))
        return replace(
            self.engine.marginalise(state, part.start, part.stop - part.start), core=core
        )

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
        return step_in_stages(self, state, parameters, control, seen, new)

    def pose_error(self, state: State, T_BC: Pose) -> tuple[Float[Array, " t"], Array]:
        """`T_true ⊟ T_est` of the frame's pose, and the covariance of its tangent."""
        frame = self.model.frame
        estimate, covariance = self.engine.core_covariance(self.model.estimate, state)
        return difference(frame.estimate(frame.hold(T_BC)), estimate), covariance

    def camera_pose(self, state: State) -> tuple[Pose, Float[Array, "t t"]]:
        """T_BC and its covariance in the right tangent: position in camera axes, orientation."""
        return self.engine.core_covariance(self.model.camera_pose, state)

    def reported(self, state: State) -> State:
        """The state with one slot a landmark, whatever the initialisation keeps of it."""
        return self.initialisation.reported(state)

    def landmarks_in_camera(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """The sensor's chart of landmarks, (x/z, y/z, 1/z) of a camera, with covariances."""
        return self.engine.landmark_covariance(
            self.composed_view(parameters), self.model.chart, self.reported(state), slots
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
            point, omega = self.model.metric_point(view, landmark)
            x, z = (rotation @ point)[jnp.array([0, -1])]
            return jnp.stack([jnp.atan2(x, z), omega / jnp.hypot(x, z)])

        view = self.composed_view(parameters)
        return self.engine.landmark_covariance(view, above, self.reported(state), slots)

    def landmarks_in_world(
        self, state: State, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """Points in B and their covariances, the camera's uncertainty included.

        Not finite for a landmark at infinity; far from Gaussian for one of unknown depth.
        """
        view, point = self._world_point(parameters)
        return self.engine.landmark_covariance(view, point, self.reported(state), slots)

    def landmark_samples(
        self, state: State, parameters: Parameters, slots: Array, key: Array, count: int = 1000
    ) -> Float[Array, "m count n"]:
        """Draws of points in B from what the state says of them, nothing linearised.

        A draw beyond infinity (ω < 0) comes out on the other side of the camera.
        """
        size = state.core_dim + state.landmarks.shape[1]
        normal = jax.random.normal(key, (slots.size, count, size), state.covariance.dtype)
        view, point = self._world_point(parameters)
        state = self.reported(state)
        return jax.vmap(lambda slot, draws: ekf.landmark_samples(view, point, state, slot, draws))(
            slots, normal
        )

    def _world_point(self, parameters: Parameters):
        """The functions of core and landmark that give its point in B."""
        camera_view = self.composed_view(parameters)

        def view(core):
            return camera_view(core), self.model.camera_pose(core)

        def point(view, landmark):
            (camera_view, T_BC) = view
            seen, omega = self.model.metric_point(camera_view, landmark)
            return T_BC @ (seen / omega)

        return view, point

    def predicted_camera(
        self, state: State, parameters: Parameters, control: Array, slots: Array
    ) -> tuple[Pose, Float[Array, "m n"], Float[Array, " m"]]:
        """T_BC of a predicted state, and the landmarks in that camera as (X, ω)."""
        context = self._context(parameters, control)
        view = self.model.view(state.core, context)
        core = state.core
        if not self.compose_first:
            core = self.model.compose_core(core, context)
        points, omegas = jax.vmap(self.model.metric_point, in_axes=(None, 0))(
            view, state.landmarks[slots]
        )
        return self.model.camera_pose(core), points, omegas

    def composed_view(self, parameters: Parameters) -> Callable[[Core], View]:
        """What landmarks depend on, as a function of the core, the motion being composed."""
        return lambda core: self.model.view(core, _composed(parameters))

    def _no_anchors(self, capacity: int, dtype) -> SplitPose | None:
        if not self.model.landmark.anchored:
            return None
        origin = SplitPose.of(identity(self.geometry, dtype))
        return jax.tree.map(lambda x: jnp.tile(x, (capacity, 1)), origin)

    def _with_calibration(self, state: State, parameters: Parameters) -> State:
        if self.calibration == "known":
            return state
        covariance = jnp.diag(parameters.intrinsics_sigma**2)
        return self.engine.augment(state, _calibration(state).start, covariance)

    def noise(self, parameters: Parameters) -> Float[Array, "p p"]:
        """R of one measurement."""
        size = self.model.rig.sensor.size(self.geometry)
        return jnp.diag(jnp.broadcast_to(parameters.measurement_sigma, size) ** 2)

    def _considered(self, state: State) -> slice:
        """The part of the core that updates leave as it is."""
        return _calibration(state) if self.calibration == "consider" else slice(0, 0)

    def _context(self, parameters: Parameters, control: Array) -> Context:
        return _composed(parameters) if self.compose_first else Context(parameters, control)


def check_one_gaussian(base: SlamFilter, what: str) -> None:
    """Raise ValueError, saying of what, unless all that `base` knows is in one covariance."""
    landmark = base.model.landmark
    for wrong, why in (
        (base.engine is not ekf, "is for filters in covariance form"),
        (base.initialisation is not UNDELAYED, "does not know delayed landmarks"),
        (landmark.convert is not None, f"cannot switch the form of {landmark.name}"),
    ):
        if wrong:
            raise ValueError(f"{what} {why}")


def velocity_in_gauge(
    velocity: Float[Array, " v"], root: Float[Array, "v v"], n: int
) -> tuple[Float[Array, " v+1"], Float[Array, "v+1 v+1"]]:
    """(ṽ, λ) for `(e^λ ṽ[:n], ṽ[n:])` to have the velocity's mean v̄ and covariance `Σ = R Rᵀ`.

    The first n numbers are linear, the only lengths. λ takes the relative speed `sᵀδv`,
    `s = v̄/|v̄|²`, of variance q: `λ ~ N(−P/2, P)` with `e^P = 1 + q`; given λ, nothing is left of
    it in ṽ. The moments are exact but for `O(q²)` of what is correlated with the speed. From
    standstill the scale is known, and 1.
    """
    linear = jnp.arange(velocity.size) < n
    along_mean = jnp.where(linear, velocity, 0.0)
    squared = along_mean @ along_mean
    s = along_mean / jnp.where(squared > 0, squared, 1.0)
    speed = root.T @ s
    with_speed, q = root @ speed, speed @ speed
    P = jnp.log1p(q)
    shrunk = jnp.where(linear, 1 / (1 + q), 1.0)
    by_scale = shrunk * (with_speed - q * along_mean)  # Cov(ṽ, λ)
    rest = root - jnp.outer(with_speed, speed) / jnp.where(q > 0, q, 1.0)
    rest = jnp.sqrt(shrunk)[:, None] * rest
    own = rest @ rest.T + jnp.outer(by_scale, by_scale) / jnp.where(q > 0, P, 1.0)
    mean = velocity - jnp.where(linear, by_scale, 0.0)
    joint = jnp.block([[own, by_scale[:, None]], [by_scale, P]])
    return jnp.append(mean, -P / 2), joint


def velocity_root(
    sigma: Float[Array, " v"] | Float[Array, "v v"],
) -> Float[Array, "v v"]:
    """R with `P = R Rᵀ` of the velocity's prior, given as σ of each number or as R itself."""
    return jnp.diag(sigma) if sigma.ndim == 1 else sigma


def _composed(parameters: Parameters) -> Context:
    return Context(parameters, None)


def _seen_from(T_AN: Pose, anchors: SplitPose | None) -> SplitPose | None:
    """T_NF of all anchors F, from their T_AF and the new map frame N in the old one."""
    if anchors is None:
        return None
    T_NA = T_AN.inverse()
    return jax.vmap(lambda T_AF: SplitPose.of(T_NA @ T_AF.joined()))(anchors)


def _free_anchor(state: State) -> Int[Array, ""]:
    """One that no landmark refers to; there are as many anchors as landmarks."""
    number = jnp.where(state.active, state.landmarks[:, -1].astype(int), state.active.size)
    return jnp.argmin(jnp.zeros(state.active.size, bool).at[number].set(True, mode="drop"))


def _calibration(state: State) -> slice:
    """Where the calibration's error is in the tangent of the core."""
    return _part(state.core, "calibration")


def _part(core: Core, name: str) -> slice:
    """Where a field is in the tangent of the core."""
    start = 0
    for one in fields(core):
        size = tangent_dim(getattr(core, one.name))
        if one.name == name:
            return slice(start, start + size)
        start += size
    raise KeyError(name)
