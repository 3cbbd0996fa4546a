"""First-estimate Jacobians (Huang, Mourikis, Roumeliotis, ISER 2008; IJRR 2010, §5.1).

H is evaluated at the predicted pose and at every landmark's *first* estimate, Φ between predicted
poses. The landmarks' part of N then never changes; that of pose and velocity follows the
prediction, which is `transport` on their rows alone: for odometry
`Φ* = N_pose(x_{k+1|k}) N_pose(x_{k|k-1})⁻¹`, the published one. The first estimate of a landmark
of unknown depth is bad, and remains the linearisation point for good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.filters import ekf
from jaxslam.filters.frames import WORLD
from jaxslam.filters.observability_constrained import follow
from jaxslam.filters.slam import SlamFilter, SlamModel
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.filters.transport import CovarianceForm, check_plain


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FirstEstimateState(State):
    """A state that remembers how every landmark was first estimated."""

    first: Any = None
    """Landmarks as they were inserted, capacity × d."""


def empty(core: Any, landmarks: Float[Array, "capacity d"]) -> FirstEstimateState:
    """That of `ekf`, with room for first estimates."""
    state = ekf.empty(core, landmarks)
    return FirstEstimateState(
        state.core, landmarks, state.active, state.covariance, first=landmarks
    )


def update(
    model: SlamModel,
    state: FirstEstimateState,
    features: Features,
    noise: Float[Array, "*m p p"],
    context: Any,
    considered: slice = slice(0, 0),
) -> tuple[FirstEstimateState, Innovation]:
    """Residuals of the estimate, H of the first estimates, and `transport` of the core."""
    start, moved, predicted = _at_first(model, state, features, context)
    after: Any
    after, innovation = ekf.update(model, start, moved, noise, context, considered)
    correction = after.landmarks - start.landmarks
    after = follow(model, start, replace(after, landmarks=start.landmarks))
    after = replace(after, landmarks=state.landmarks + correction)
    return after, replace(innovation, predicted=predicted)


def update_mean(
    model: SlamModel,
    state: FirstEstimateState,
    features: Features,
    noise: Float[Array, "p p"],
    context: Any,
    considered: slice = slice(0, 0),
) -> FirstEstimateState:
    """The mean that `update` would give."""
    start, moved, _ = _at_first(model, state, features, context)
    after: Any = ekf.update_mean(model, start, moved, noise, context, considered)
    correction = after.landmarks - start.landmarks
    return replace(after, landmarks=state.landmarks + correction)


def initialise(
    model: SlamModel,
    state: FirstEstimateState,
    features: Features,
    noise: Float[Array, "p p"],
    prior: tuple[Float[Array, "*m q"], Float[Array, "*m q"]],
    context: Any,
) -> FirstEstimateState:
    """That of `ekf`, which is remembered."""
    after: Any = ekf.initialise(model, state, features, noise, prior, context)
    slots = jnp.where(features.valid, features.slots, state.active.size)
    new = after.landmarks[features.slots]
    return replace(after, first=state.first.at[slots].set(new, mode="drop"))


def _at_first(
    model: SlamModel, state: FirstEstimateState, features: Features, context: Any
) -> tuple[FirstEstimateState, Features, Float[Array, "m p"]]:
    """The state whose landmarks are the first estimates, measurements moved so that its residuals
    are those of the estimate, and the predictions of the estimate."""
    view = model.view(state.core, context)

    def observe(landmarks):
        return jax.vmap(lambda x: model.observe(view, x, context))(landmarks[features.slots])

    (predicted, in_front), (at_first, _) = observe(state.landmarks), observe(state.first)
    moved = Features(
        features.slots, features.measured - predicted + at_first, features.valid & in_front
    )
    return replace(state, landmarks=state.first), moved, predicted


FIRST_ESTIMATES = CovarianceForm(
    empty=empty, update=update, update_mean=update_mean, initialise=initialise
)


def with_first_estimates(slam_filter: SlamFilter, number: int | None = None) -> SlamFilter:
    """`+fej`. Raises ValueError for filters whose landmarks have no first estimate to keep."""
    if number is not None:
        raise ValueError(f"modifier fej takes no number, not {number}")
    check_plain(slam_filter, "fej")
    model = slam_filter.model
    if model.frame is not WORLD:
        raise ValueError(
            f"fej is for world filters: a {model.frame.name} one moves its landmarks, so that no "
            "first estimate stays"
        )
    if model.landmark.anchored or model.landmark.convert is not None:
        raise ValueError(
            f"fej needs landmarks that are written in one form, in themselves, not "
            f"{model.landmark.name}"
        )
    return replace(slam_filter, engine=FIRST_ESTIMATES)
