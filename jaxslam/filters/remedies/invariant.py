"""Right-invariant EKF-SLAM (Barrau, Bonnabel, arXiv:1510.06263, 2015; Zhang, Wu, Song, Huang,
Dissanayake, RA-L 2017): a world-centric filter with another error.

Its error ξ is that of a group in which every landmark shares the pose's part, `x ⊞ ξ`:

    pose ← Exp(ξ_pose) pose,
    landmark ← Exp(ξ_pose/2) · (Exp(ξ_pose/2) · landmark + ξ_l),

where a rigid motion acts on a parametrization by its `transform`. For Cartesian landmarks this is
the published SE_{1+N}, `p ← R p + V (ξ_l + ξ_position)`, but for a factor sin(θ/2)/(θ/2) of ξ_l in
a plane. Adding ξ_l after the whole motion, or before it, is right to first order only, and moves
every landmark by ∓θ²/2 of its distance with every correction.

In these coordinates N is constant, the identity on ξ_pose, and H N = 0 at any estimate. The
covariance is kept in the coordinates of every other filter here, δ = B(x) ξ: an update is then
followed by `B(x⁺) B(x)⁻¹ = I + (N(x⁺) − N(x)) L`, with the gauge L read from the pose alone. The
gauge is the base frame's: nothing is done for the scale. An update in another base frame is the
same update, exactly where `transform` is affine in the landmark, else to first order.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.filters.linear.blocks import minus, plus
from jaxslam.filters.linear.kalman import AbstractCorrection, kalman_update
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import SlamModel
from jaxslam.filters.remedies.gauge import act, unobservable_directions
from jaxslam.filters.remedies.transport import carried, read_from
from jaxslam.geometry import exp, tangent_dim


class Invariant(AbstractCorrection):
    """The EKF whose correction is read as a ξ."""

    name: ClassVar[str] = "invariant"
    world_centric: ClassVar[bool] = True
    metric: ClassVar[bool] = True

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        added, innovation = kalman_update(model, state, None, features, noise, context, considered)
        N, L = rigid_directions(model, state)
        after = _retracted(model, state, added, N, L)
        N_after, _ = rigid_directions(model, after)
        return replace(after, covariance=carried(added.covariance, N_after - N, L)), innovation


def rigid_directions(
    model: SlamModel, state: State
) -> tuple[Float[Array, "n t"], Float[Array, "t n"]]:
    """N of the base frame, and how it is read from the pose."""
    N = unobservable_directions(model, state)[:, : model.geometry.tangent_dim]
    return N, read_from(N, tangent_dim(state.core.pose))


def _retracted(
    model: SlamModel, before: State, added: State, N: Float[Array, "n t"], L: Float[Array, "t n"]
) -> State:
    """`x ⊞ ξ` with `ξ = B(x)⁻¹ δ`, from the state `added` = x + δ."""
    delta = minus(added, before)
    rigid = L @ delta
    half, one = exp(model.geometry.group, rigid / 2), jnp.ones((), delta.dtype)

    def turned(state):
        core, landmarks = act(model, half, one, state.core, state.landmarks)
        return replace(state, core=core, landmarks=landmarks)

    after = turned(plus(turned(before), delta - N @ rigid))
    landmarks = jnp.where(before.active[:, None], after.landmarks, before.landmarks)
    return replace(added, core=after.core, landmarks=landmarks)
