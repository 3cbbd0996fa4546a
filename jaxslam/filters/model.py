"""Monocular SLAM as a model for a form: frame × landmark × calibration × motion × sensor.

Everything is written once, as pure functions of the core, or of a view of it and one landmark.
What the core holds is what the pieces declare.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.linear.blocks import Change
from jaxslam.filters.linear.state import State
from jaxslam.geometry import (
    Geometry,
    Pose,
    Scalar,
    SplitPose,
    homogeneous_apply,
    identity,
    scaled,
    tangent_dim,
)
from jaxslam.landmarks import AbstractLandmark
from jaxslam.models.calibration import AbstractCalibration
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import AbstractFrame, KeyframePose
from jaxslam.models.motion import AbstractMotion, Control, Variables
from jaxslam.models.scale import AbstractScale
from jaxslam.models.sensors import AbstractSensor


class Core(eqx.Module):
    """The estimate of everything but the landmarks, and the noises that one step appends."""

    pose: Pose | SplitPose | KeyframePose
    """T_CB in a robocentric filter, T_BC in a world-centric one, T_BK and T_KC in one with
    keyframes: what the `AbstractFrame` hold."""
    motion: Variables
    """What the motion model keeps: a velocity in the camera's own frame, a bias, nothing."""
    log_scale: Float[Array, " u"] | None
    """λ of a filter with a scale gauge, or None: lengths in the state are in units of `e^λ` of what
    was given as metres. Behind it, where that is not known, the log of these metres in metres."""
    noise: Float[Array, " q"]
    """What drives this step's motion: the acceleration a (P10), or the odometry's error, and what
    the calibration drifts by; zero before `predict` and after composition."""
    calibration: Float[Array, " k"]
    """δ, by which the calibration is off (P15); empty where it is known."""
    anchors: SplitPose | None = None
    """T_AF of the cameras F in which landmarks are written; a batch, or None."""
    depth_error: Float[Array, " 1"] | None = None
    """What the priors on 1/z of all landmarks have in common, in σ of one prior, or None."""
    base_motion: Variables | None = None
    """What the motion model kept in the camera in which the submap began; None without submaps."""

    def part(self, name: str) -> slice:
        """The slice of a field in the tangent of the core."""
        start = 0
        for field in fields(self):
            size = tangent_dim(getattr(self, field.name))
            if field.name == name:
                return slice(start, start + size)
            start += size
        raise KeyError(name)


class Context(NamedTuple):
    """Data of the model's functions beside core and landmark."""

    control: Control
    """The motion model's input for the motion between the map frame and the camera: seconds, or
    the odometry's reading; None once the motion is composed."""
    anchor: Int[Array, ""] | None = None
    """Number of the anchor of new landmarks, the current camera."""
    log_scale: Scalar | None = None
    """λ of the gauge, where a Jacobian is to take it as given."""


COMPOSED = Context(None)
"""The motion is composed."""


class CameraInMap(eqx.Module):
    """The quantities beside itself on which a landmark depends."""

    map_from_camera: Pose
    """T_AC(k), the current camera in the map frame."""
    calibration: Float[Array, " k"]
    """δ, and behind it the camera's velocity, where the sensor's rows depend on that."""
    anchors: SplitPose | None = None
    log_scale: Float[Array, " u"] | None = None
    depth_error: Float[Array, " 1"] | None = None


class SlamModel(eqx.Module):
    """The one-landmark functions that a form of the filter asks for."""

    motion: AbstractMotion
    sensor: AbstractSensor
    landmark: AbstractLandmark
    frame: AbstractFrame
    calibration: AbstractCalibration
    depth: InverseDepth
    scale: AbstractScale

    @property
    def geometry(self) -> Geometry:
        return self.motion.geometry

    def given(self, core: Core, context: Context) -> Context:
        """λ is data of a Jacobian: the amplitude of the noise says nothing about the scale, but its
        derivative by λ would pretend so."""
        return context if core.log_scale is None else context._replace(log_scale=core.log_scale[0])

    @property
    def moves_landmarks(self) -> bool:
        return self.frame.moves_landmarks and not self.landmark.anchored

    @property
    def noise_sigma(self) -> Float[Array, " q"]:
        """σ of what one step appends: the motion's noise, the calibration's drift, and the walk of
        what depths have in common."""
        drift, walk = self.calibration.drift_sigma, self.depth.walk
        own = jnp.asarray(self.motion.noise_sigma)
        own = jnp.concatenate([own, drift]) if drift.size else own
        return own if walk is None else jnp.append(own, walk)

    def displacement(self, core: Core, context: Context) -> Pose:
        """The camera's motion in this step; the identity once it is composed."""
        return self._step(core, context)[0]

    def _step(self, core: Core, context: Context) -> tuple[Pose, Variables]:
        """The displacement, and the motion's variables after it; once composed, as they are."""
        if context.control is None:
            return identity(self.geometry, core.noise.dtype), core.motion
        noise = self._noises(core, context)[0]
        return self.moved(core.motion, noise, context.control, core.log_scale)

    def _noises(
        self, core: Core, context: Context
    ) -> tuple[Float[Array, " q"], Float[Array, " w"]]:
        """The motion's noise in the units of the state, and the calibration's."""
        own = self.motion.noise_sigma.shape[-1]
        noise, drift = core.noise[:own], core.noise[own : own + self.calibration.drift_sigma.size]
        if core.log_scale is not None:
            log_scale = core.log_scale[0] if context.log_scale is None else context.log_scale
            noise = self.motion.enlarged(core.motion, noise, jnp.exp(-log_scale))[1]
        return noise, drift

    def view(self, core: Core, context: Context) -> CameraInMap:
        """All that a landmark depends on."""
        step, variables = self._step(core, context)
        T_AC = self.frame.map_from_camera(core.pose, step)
        delta = self.in_motion(core.calibration, variables)
        return CameraInMap(T_AC, delta, core.anchors, core.log_scale, core.depth_error)

    def compose_core(self, core: Core, context: Context) -> Core:
        """P18, P19. The noise has been used: it is marginalised."""
        noise, drift = self._noises(core, context)
        step, variables = self.moved(core.motion, noise, context.control, core.log_scale)
        delta = self.calibration.next(core.calibration, drift)
        moved, common = self.frame.moves_landmarks, core.depth_error
        if common is not None and self.depth.walk is not None:
            common += core.noise[-1:]
        return replace(
            core,
            pose=self.frame.compose(core.pose, step),
            anchors=_seen_from(step, core.anchors) if moved else core.anchors,
            depth_error=common,
            motion=variables,
            calibration=delta,
            noise=jnp.zeros_like(core.noise),
        )

    def moved(
        self,
        variables: Variables,
        noise: Float[Array, " q"],
        control: Control,
        log_scale: Float[Array, " u"] | None = None,
    ) -> tuple[Pose, Variables]:
        """The displacement of a step and the motion's variables after it, in the unit of the state,
        in which `_noises` are; where the control is in metres, by way of these."""
        motion = self.motion
        if log_scale is None or motion.has_velocity:
            displacement = motion.displacement(variables, noise, control)
            return displacement, motion.next(variables, noise, control)
        metres = jnp.exp(log_scale[0])
        variables, noise = motion.enlarged(variables, noise, metres)
        displacement = scaled(motion.displacement(variables, noise, control), 1 / metres)
        variables = motion.next(variables, noise, control)
        return displacement, motion.enlarged(variables, noise, 1 / metres)[0]

    def camera_pose(self, core: Core) -> Pose:
        """T_BC, in metres."""
        return self.frame.camera_pose(self._metric_pose(core))

    def estimate(self, core: Core) -> Pose | SplitPose:
        """The one pose whose error is the filter's, in metres."""
        return self.frame.estimate(self._metric_pose(core))

    def _metric_pose(self, core: Core) -> Pose | SplitPose | KeyframePose:
        """The pose as the core holds it, in metres."""
        if core.log_scale is None:
            return core.pose
        return scaled(core.pose, jnp.exp(jnp.sum(core.log_scale)))

    def compose_landmark(self, view: CameraInMap, landmark: Array, context: Context) -> Array:
        """The landmark in the new camera frame, for which the paper numbers no equation."""
        del context
        return self.landmark.transform(view.map_from_camera.inverse(), landmark)

    def reanchoring(self) -> Change:
        """The current camera becomes the map frame, its motion composed."""

        def core(core):
            anchors = _seen_from(self._map_from_camera(core), core.anchors)
            return replace(core, pose=core.pose.reanchored(), anchors=anchors)

        def landmark(T_AC, landmark):
            return self.landmark.transform(T_AC.inverse(), landmark)

        moved = None if self.landmark.anchored else landmark
        return Change(core=core, view=self._map_from_camera, landmark=moved)

    def keyframe_left(self, state: State) -> Bool[Array, ""]:
        """Whether the camera has left its keyframe, or the one in which its submap began; its
        motion is composed."""
        return self.frame.left(state.core.pose, self.inverse_distances(state))

    def inverse_distances(self, state: State) -> Float[Array, " capacity"]:
        """Each landmark's 1/distance from the origin of the map frame; zero in empty slots."""
        points, omegas = jax.vmap(self.landmark.homogeneous)(state.landmarks)
        inverse_distances = jnp.abs(omegas) / jnp.linalg.norm(points, axis=1)
        return jnp.where(state.active, inverse_distances, 0.0)

    def _map_from_camera(self, core: Core) -> Pose:
        """T_AC, once the motion is composed."""
        return self.frame.map_from_camera(core.pose, identity(self.geometry, core.noise.dtype))

    def observe(self, view: CameraInMap, landmark: Array, context: Context) -> tuple[Array, Array]:
        """`h = proj(K T_AC⁻¹ X)` (P12, P14), and whether it is possible."""
        del context
        point, omega = self.camera_point(view, landmark)
        sensor = self.sensor_at(view.calibration)
        return sensor.measure(point, omega), sensor.possible(point)

    def in_motion(
        self, delta: Float[Array, " k"], variables: Variables | None
    ) -> Float[Array, " kt"]:
        """δ, and behind it the motion's variables, where the sensor depends on its velocity; None
        of a core without any, of which no measurement is asked."""
        if variables is None or not self.sensor.rolling:
            return delta
        return jnp.concatenate([delta, variables])

    def sensor_at(self, delta: Float[Array, " kt"], unit: Scalar | None = None) -> AbstractSensor:
        """The sensor whose calibration is off by δ, at the velocity behind that, of which the unit
        of length has so many metres; with one, metres are what it measures."""
        own = jnp.size(self.calibration.sigma)
        sensor = self.calibration.sensor(self.sensor, delta[:own])
        if not sensor.rolling:
            return sensor
        velocity = delta[own:]
        if unit is not None:
            velocity, _ = self.motion.enlarged(velocity, velocity, unit)
        return sensor.moving(velocity)

    def residual(self, measured: Array, predicted: Array) -> Array:
        """The difference of a measurement from its prediction."""
        return self.sensor.residual(measured, predicted)

    def camera_point(self, view: CameraInMap, landmark: Array) -> tuple[Array, Array]:
        """The landmark in the current camera as a homogeneous point (X, ω)."""
        point, omega = self.landmark.homogeneous(landmark)
        T_CA = view.map_from_camera.inverse()
        if self.landmark.anchored:
            T_AF = jax.tree.map(lambda x: x[landmark[-1].astype(int)], view.anchors)
            T_CA = T_CA @ T_AF.joined()
        return homogeneous_apply(T_CA, point, omega), omega

    def metric_point(self, view: CameraInMap, landmark: Array) -> tuple[Array, Array]:
        """`camera_point` in metres: with the gauge's scale, `ω e^−λ`."""
        point, omega = self.camera_point(view, landmark)
        return point, omega if view.log_scale is None else omega * jnp.exp(-jnp.sum(view.log_scale))

    def convert(
        self, view: CameraInMap, landmark: Array, covariance: Array, context: Context
    ) -> Array:
        """The same landmark in the form that its parametrization now prefers."""
        del context
        return self.landmark.convert(view.map_from_camera.translation(), landmark, covariance)

    def initialise(
        self, view: CameraInMap, measured: Array, hidden: Array, context: Context
    ) -> Array:
        """P22–P26: a landmark in the map frame from its first measurement and the prior."""
        unit = None if view.log_scale is None else jnp.exp(view.log_scale[0])
        sensor = self.sensor_at(view.calibration, unit)
        if view.depth_error is not None:
            hidden = self.depth.with_common(hidden, view.depth_error)
        point, omega = sensor.locate(measured, hidden)
        if unit is not None:
            omega = omega * unit
        seen = self.landmark.initialise(point, omega, jnp.asarray(sensor.focal))
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


def _seen_from(T_AN: Pose, anchors: SplitPose | None) -> SplitPose | None:
    """T_NF of all anchors F, from their T_AF and the new map frame N in the old one."""
    if anchors is None:
        return None
    T_NA = T_AN.inverse()
    return jax.vmap(lambda T_AF: SplitPose.of(T_NA @ T_AF.joined()))(anchors)
