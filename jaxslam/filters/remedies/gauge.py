"""The gauge of SLAM: transformations of the whole state that no measurement observes.

Where the base frame is, is a convention; so is the unit of length where only bearings are measured
and no motion is metric. The group's action on the state gives the unobservable directions,
`N = ∂ action(s, x)/∂s` at s = 0, n × g: the Jacobians of a consistent filter have `H N = 0`, and
take N of one step to N of the next (Huang, Mourikis, Roumeliotis, IJRR 2010; Hesch et al., IJRR
2014).
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.filters.linear.state import State
from jaxslam.filters.model import Core, SlamModel
from jaxslam.geometry import Pose, Scalar, SplitPose, identity, jacobian, nudge, scaled


def scale_is_free(model: SlamModel) -> bool:
    """Whether nothing that is measured holds a metre; what drives the motion is only noise."""
    return model.motion.has_velocity and model.sensor.hidden > 0


def act(
    model: SlamModel, rigid: Pose, factor: Scalar, core: Core, landmarks: Float[Array, "capacity d"]
) -> tuple[Core, Float[Array, "capacity d"]]:
    """The same camera among the same points: all enlarged by a factor, then moved in B. Lengths,
    those of the rigid motion too, are in the unit of the state.

    What drives the motion is enlarged with it: its variance is prior knowledge, no measurement.
    """
    in_base = not model.frame.moves_landmarks
    driven = core.noise[: model.motion.noise_sigma.shape[-1]]
    variables, noise = model.motion.enlarged(core.motion, driven, factor)

    def anchor(T_AF: SplitPose) -> SplitPose:
        enlarged = scaled(T_AF, factor)
        return SplitPose.of(rigid @ enlarged.joined()) if in_base else enlarged

    def landmark(parameters):
        parameters = model.landmark.scale(factor, parameters)
        moved = in_base and not model.landmark.anchored
        return model.landmark.transform(rigid, parameters) if moved else parameters

    kept = core.base_motion
    core = replace(
        core,
        pose=model.frame.acted(core.pose, rigid, factor),
        motion=variables,
        base_motion=None if kept is None else model.motion.enlarged(kept, driven, factor)[0],
        noise=core.noise.at[: driven.size].set(noise),
        anchors=None if core.anchors is None else jax.vmap(anchor)(core.anchors),
    )
    return core, jax.vmap(landmark)(landmarks)


def unobservable_directions(model: SlamModel, state: State) -> Float[Array, "n g"]:
    """N: translation and rotation of everything in B, then its size; zero in empty slots."""
    dtype, t = state.landmarks.dtype, model.geometry.tangent_dim
    origin = identity(model.geometry, dtype)

    def moved(s):
        factor = 1 + jnp.sum(s[t:])
        return act(model, nudge(origin, s[:t]), factor, state.core, state.landmarks)

    # The base frame, and the scale where it is free.
    N = jacobian(moved, jnp.zeros(model.geometry.tangent_dim + scale_is_free(model), dtype))
    return jnp.where(state.numbers(state.active)[:, None], N, 0.0)
