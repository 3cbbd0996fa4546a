"""What a filter's state says, of any filter: free functions of its `marginal`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxslam.geometry import Pose, Scalar, retract, tangent_dim
from jaxslam.linalg import cholesky, semidefinite_root
from jaxslam.models.sensors import AbstractSensor
from jaxslam.slam.filter import EkfSlam, scene_of_landmark
from jaxslam.slam.protocol import AbstractFilter, Scene


def camera_pose(slam: AbstractFilter, state: Any) -> tuple[Pose, Float[Array, "t t"]]:
    """T_BC and its covariance in the right tangent: position in camera axes, orientation."""
    return slam.marginal(state, lambda scene: scene.pose)


def camera_pose_in_unit(
    slam: AbstractFilter, state: Any
) -> tuple[Pose, Float[Array, "t t"], Scalar]:
    """T_BC in metres, its covariance *given the scale*, and the variance of the log of the scale.

    The camera's path is known much better than its size: with J of the pose by λ, the covariance of
    `camera_pose` is `P + J var(λ) Jᵀ`, and P is what is returned. Of a filter in metres it is all.
    """

    def both(scene: Scene):
        return scene.pose, _log_scale(scene)

    (pose, _), P = slam.marginal(state, both)
    t = tangent_dim(pose)
    return pose, _given_rest(P, t), jnp.sum(P[t:, t:])


def landmarks_in_unit(
    slam: AbstractFilter, state: Any, slots: Int[Array, " m"]
) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
    """`landmarks_in_world`, with covariances given the scale."""

    def both(scene: Scene):
        return jnp.concatenate([_point_in_world(scene), _log_scale(scene)])

    values, P = slam.marginal(state, both, slots)
    n = values.shape[1] - jax.eval_shape(lambda: slam.marginal(state, _log_scale)[0]).size
    return values[:, :n], jax.vmap(lambda P: _given_rest(P, n))(P)


def landmarks_in_camera(
    slam: AbstractFilter, state: Any, slots: Int[Array, " m"], sensor: AbstractSensor
) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
    """The sensor's chart of landmarks, (x/z, y/z, 1/z) of a camera, with covariances."""
    return slam.marginal(state, lambda scene: sensor.chart(scene.point, scene.omega), slots)


def landmarks_from_above(
    slam: AbstractFilter, state: Any, slots: Int[Array, " m"]
) -> tuple[Float[Array, "m 2"], Float[Array, "m 2 2"]]:
    """Azimuth (from z towards x, axes of B) and inverse horizontal distance from the camera.

    A map seen from above: the point is `(sin θ, cos θ)/ρ` from the camera, and a Gaussian in
    (θ, ρ) is drawn as the bent region that it is. The camera's pose is taken as known.
    """
    rotation = camera_pose(slam, state)[0].rotation()

    def above(scene: Scene):
        x, z = (rotation @ scene.point)[jnp.array([0, -1])]
        return jnp.stack([jnp.atan2(x, z), scene.omega / jnp.hypot(x, z)])

    return slam.marginal(state, above, slots)


def landmarks_in_world(
    slam: AbstractFilter, state: Any, slots: Int[Array, " m"]
) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
    """Points in B and their covariances, the camera's uncertainty included.

    Not finite for a landmark at infinity; far from Gaussian for one of unknown depth.
    """
    return slam.marginal(state, _point_in_world, slots)


def landmark_samples(
    slam: EkfSlam,
    state: Any,
    slots: Int[Array, " m"],
    key: Array,
    count: int = 1000,
    function: Callable[[Scene], Float[Array, " k"]] | None = None,
) -> Float[Array, "m count k"]:
    """Draws of points in B, or of another function, from the Gaussian of a filter's state.

    Nothing is linearised: this is the distribution that mean and covariance stand for. A draw
    beyond infinity (ω < 0) comes out on the other side of the camera.
    """
    state = slam.entry.reported(state)
    view, landmark = scene_of_landmark(slam, function or _point_in_world, state.core)
    c, size = state.core_dim, state.core_dim + state.landmarks.shape[1]
    normal = jax.random.normal(key, (slots.size, count, size), state.landmarks.dtype)

    def of_slot(slot, draws):
        root = semidefinite_root(slam.gaussian_form.joint_covariance(state, slot)).root

        def one(draw):
            delta = root @ draw
            return landmark(view(retract(state.core, delta[:c])), state.landmarks[slot] + delta[c:])

        return jax.vmap(one)(draws)

    return jax.vmap(of_slot)(slots, normal)


def _log_scale(scene: Scene) -> Float[Array, " u"]:
    return jnp.zeros(0) if scene.log_scale is None else scene.log_scale


def _given_rest(P: Float[Array, "k k"], n: int) -> Float[Array, "n n"]:
    """Covariance of the first n numbers, given the others."""
    if n == len(P):
        return P
    # Where those are known there is nothing to subtract.
    tiny = jnp.finfo(P.dtype).tiny * jnp.eye(len(P) - n, dtype=P.dtype)
    half = cholesky(P[n:, n:] + tiny).whitening @ P[n:, :n]
    return P[:n, :n] - half.T @ half


def _point_in_world(scene: Scene) -> Float[Array, " n"]:
    return scene.pose @ (scene.point / scene.omega)
