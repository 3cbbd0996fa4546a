"""The readouts of a filter's state, of any filter: free functions of its marginals."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxslam.filters.gaussian import composed, of_landmark
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.covariance import joint_covariance
from jaxslam.filters.protocol import (
    AbstractFilter,
    Belief,
    CameraView,
    EachMoments,
    LandmarkView,
    OfLandmark,
)
from jaxslam.geometry import Pose, Scalar, retract, scaled
from jaxslam.linalg import cholesky, semidefinite_root
from jaxslam.models.observations import Innovation, Slots
from jaxslam.models.sensors import AbstractSensor


def camera_pose(slam: AbstractFilter, state: Belief) -> tuple[Pose, Float[Array, "t t"]]:
    """T_BC and its covariance in the right tangent: position in camera axes, orientation."""
    return slam.marginal(state, lambda view: view.pose)


def whitened_innovation(innovation: Innovation) -> Float[Array, "m p"] | None:
    """The residuals whitened by their joint covariance, `L⁻¹ r` with `L Lᵀ = S`: independent and of
    unit variance if the filter is right. None where it keeps no S."""
    if innovation.covariance is None:
        return None
    whitening = cholesky(innovation.covariance).whitening
    return (whitening @ innovation.residual.ravel()).reshape(innovation.residual.shape)


class InUnit(NamedTuple):
    """The camera's pose in the filter's own unit of length, and that unit in metres."""

    pose: Pose
    """T_BC, with its lengths in that unit."""
    covariance: Float[Array, "t t"]
    """In the right tangent of the pose: what is not known of the metre is no part of it."""
    log_scale: Scalar
    """Mean of the log of the unit in metres, Σλ; zero of a filter in metres."""
    log_scale_variance: Scalar


def camera_pose_in_unit(slam: AbstractFilter, state: Belief) -> InUnit:
    """T_BC in the filter's own unit, `(R, t e^−Σλ)`, and beside it Σλ, the log of that in metres.

    The camera's path is known much better than its size: λ wanders while nothing observes it, and a
    path in metres is blown up and shrunk with it, but none in the unit of the state. Mean and
    covariance of a Gaussian sum are those of the pose in the unit.
    """

    def both(view: CameraView):
        log_scale = _log_scale(view)
        return scaled(view.pose, jnp.exp(-log_scale)), log_scale[None]

    (pose, log_scale), P = slam.marginal(state, both)
    return InUnit(pose, P[:-1, :-1], log_scale[0], P[-1, -1])


def landmarks_in_unit(slam: AbstractFilter, state: Belief, slots: Slots) -> EachMoments:
    """`landmarks_in_world` in the filter's own unit of length, with covariances of these."""

    def point(view: LandmarkView):
        return jnp.exp(-_log_scale(view)) * _point_in_world(view)

    return slam.landmark_marginal(state, point, slots)


def log_unit(slam: AbstractFilter, state: Belief) -> Scalar:
    """Mean of the log of the filter's unit of length in metres, Σλ."""
    return slam.marginal(state, lambda view: _log_scale(view)[None])[0][0]


def landmarks_in_camera(
    slam: AbstractFilter, state: Belief, slots: Slots, sensor: AbstractSensor
) -> EachMoments:
    """The sensor's chart of landmarks, (x/z, y/z, 1/z) of a camera, with covariances."""
    return slam.landmark_marginal(state, lambda view: sensor.chart(view.point, view.omega), slots)


def landmarks_from_above(slam: AbstractFilter, state: Belief, slots: Slots) -> EachMoments:
    """Azimuth (from z towards x, axes of B) and inverse horizontal distance from the camera.

    A map seen from above: the point is `(sin θ, cos θ)/ρ` from the camera, and a Gaussian in
    (θ, ρ) is drawn as the bent region that it is. The camera's pose is taken as known.
    """
    rotation = camera_pose(slam, state)[0].rotation()

    def above(view: LandmarkView):
        x, z = (rotation @ view.point)[jnp.array([0, -1])]
        return jnp.stack([jnp.atan2(x, z), view.omega / jnp.hypot(x, z)])

    return slam.landmark_marginal(state, above, slots)


def landmarks_on_sides(
    slam: AbstractFilter, state: Belief, slots: Slots
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The numbers of landmarks surely, by 2σ, in front of infinity, 1/z > 0 (of a fisheye, one over
    the distance), and surely behind.

    Pixels do not distinguish the two: a world that is mostly behind is a reversed one.
    """

    def last(view: LandmarkView):
        if slam.model is None:
            return (view.omega / view.point[-1])[None]
        return slam.model.sensor.chart(view.point, view.omega)[-1:]

    inverse_depth, P = slam.landmark_marginal(state, last, slots)
    sure = slam.in_map(state)[slots] & (inverse_depth[:, 0] ** 2 > 4 * P[:, 0, 0])
    ahead = inverse_depth[:, 0] > 0
    return jnp.sum(sure & ahead), jnp.sum(sure & ~ahead)


def landmarks_in_world(slam: AbstractFilter, state: Belief, slots: Slots) -> EachMoments:
    """Points in B and their covariances, the camera's uncertainty included.

    Not finite for a landmark at infinity; far from Gaussian for one of unknown depth.
    """
    return slam.landmark_marginal(state, _point_in_world, slots)


def landmark_samples(
    slam: AbstractSlam,
    state: Belief,
    slots: Slots,
    key: Array,
    count: int = 1000,
    function: OfLandmark | None = None,
) -> Float[Array, "m count k"]:
    """Draws of points in B, or of another function, from the Gaussian of a filter's state.

    Nothing is linearised: this is the distribution that mean and covariance stand for. A draw
    beyond infinity (ω < 0) comes out on the other side of the camera.
    """
    value = of_landmark(slam, function or _point_in_world)
    c, size = state.core_dim, state.core_dim + state.landmarks.shape[1]
    normal = jax.random.normal(key, (slots.size, count, size), state.landmarks.dtype)

    def of_slot(slot, draws):
        root = semidefinite_root(joint_covariance(state, slot)).root

        def one(draw):
            delta = root @ draw
            core = composed(retract(state.core, delta[:c]))
            return value(core, state.landmarks[slot] + delta[c:])

        return jax.vmap(one)(draws)

    return jax.vmap(of_slot)(slots, normal)


def _log_scale(view: CameraView | LandmarkView) -> Scalar:
    """Σλ; zero of a filter in metres."""
    if view.log_scale is None:
        return jnp.zeros((), view.pose.translation().dtype)
    return jnp.sum(view.log_scale)


def _point_in_world(view: LandmarkView) -> Float[Array, " n"]:
    return view.pose @ (view.point / view.omega)
