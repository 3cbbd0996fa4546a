"""What a filter's state says, of any filter: free functions of its `marginal`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxslam.geometry import Pose, retract
from jaxslam.linalg import semidefinite_root
from jaxslam.models.sensors import AbstractSensor
from jaxslam.slam.filter import EkfSlam, scene_of_landmark
from jaxslam.slam.protocol import AbstractFilter, Scene


def camera_pose(slam: AbstractFilter, state: Any) -> tuple[Pose, Float[Array, "t t"]]:
    """T_BC and its covariance in the right tangent: position in camera axes, orientation."""
    return slam.marginal(state, lambda scene: scene.pose)


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


def _point_in_world(scene: Scene) -> Float[Array, " n"]:
    return scene.pose @ (scene.point / scene.omega)
