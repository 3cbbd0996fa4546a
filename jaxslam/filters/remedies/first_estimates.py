"""First-estimate Jacobians (Huang, Mourikis, Roumeliotis, ISER 2008; IJRR 2010, §5.1).

H is evaluated at the predicted pose and at every landmark's *first* estimate, Φ between predicted
poses. The landmarks' part of N then never changes; that of pose and velocity follows the
prediction, which is `transport` on their rows alone: for odometry
`Φ* = N_pose(x_{k+1|k}) N_pose(x_{k|k-1})⁻¹`, the published one. The first estimate of a landmark
of unknown depth is bad, and remains the linearisation point for good.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import jax
from jaxtyping import Array, Float

from jaxslam.filters.linear.blocks import Noise
from jaxslam.filters.linear.kalman import AbstractCorrection, kalman_update
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import Context, Core, SlamModel
from jaxslam.filters.remedies.observability_constrained import follow
from jaxslam.models.observations import Features


class AbstractFirstEstimates(AbstractCorrection):
    """Residuals of the estimate, H of the first estimates, and `transport` of the core."""

    divisible: ClassVar[bool] = False
    world_centric: ClassVar[bool] = True
    metric: ClassVar[bool] = True
    one_form: ClassVar[bool] = True

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        start, moved, predicted = _at_first(model, state, features, context)
        noise = self.noise(model, state, moved, noise, context)
        after, innovation = kalman_update(model, start, None, moved, noise, context, considered)
        correction = after.landmarks - start.landmarks
        core = self.corrected(model, start, after)
        after = follow(model, start, replace(after, core=core, landmarks=start.landmarks))
        after = replace(after, landmarks=state.landmarks + correction)
        return after, replace(innovation, predicted=predicted)

    def noise(self, model: SlamModel, state: State, seen: Features, R: Noise, at: Context) -> Noise:
        """R, with what the Jacobians of the first estimates leave out."""
        del model, state, seen, at
        return R

    def corrected(self, model: SlamModel, before: State, after: State) -> Core:
        """The core `before` the update with its correction, which `after` has added."""
        del model, before
        return after.core

    def remember(self, state, slots):
        first = state.landmarks if state.first is None else state.first
        new = state.landmarks[slots]
        return replace(state, first=first.at[slots].set(new, mode="drop"))


class FirstEstimates(AbstractFirstEstimates):
    """The published one."""

    name: ClassVar[str] = "fej"


def _at_first(
    model: SlamModel, state: State, features: Features, context: Context
) -> tuple[State, Features, Float[Array, "m p"]]:
    """The state whose landmarks are the first estimates, measurements moved so that its residuals
    are those of the estimate, and the predictions of the estimate."""
    view = model.view(state.core, context)

    def observe(landmarks):
        return jax.vmap(lambda x: model.observe(view, x, context))(landmarks[features.slots])

    (predicted, in_front), (at_first, _) = observe(state.landmarks), observe(state.first)
    moved = replace(
        features, measured=features.measured - predicted + at_first, valid=features.valid & in_front
    )
    return replace(state, landmarks=state.first), moved, predicted
