"""First-estimate Jacobians (Huang, Mourikis, Roumeliotis, ISER 2008; IJRR 2010, §5.1).

H is evaluated at the predicted pose and at every landmark's *first* estimate, Φ between predicted
poses. The landmarks' part of N then never changes; that of pose and velocity follows the
prediction, which is `transport` on their rows alone: for odometry
`Φ* = N_pose(x_{k+1|k}) N_pose(x_{k|k-1})⁻¹`, the published one. The first estimate of a landmark
of unknown depth is bad, and remains the linearisation point for good.
"""

from __future__ import annotations

from dataclasses import replace

import jax
from jaxtyping import Array, Float

from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.forms.correction import AbstractCorrection, kalman_update
from jaxslam.filters.forms.observability_constrained import follow
from jaxslam.filters.forms.state import State
from jaxslam.filters.forms.transport import check_metric, check_undelayed
from jaxslam.filters.model import Context, SlamModel
from jaxslam.models.coordinates import WORLD
from jaxslam.models.observations import Features


class FirstEstimates(AbstractCorrection):
    """Residuals of the estimate, H of the first estimates, and `transport` of the core."""

    @property
    def divisible(self) -> bool:
        return False

    def check(self, slam: EkfSlam) -> None:
        """Raise ValueError for filters whose landmarks have no first estimate to keep."""
        check_metric(slam, "fej")
        check_undelayed(slam, "fej")
        if slam.coordinates is not WORLD:
            raise ValueError(
                f"fej is for world filters: a {slam.coordinates.name} one moves its landmarks, "
                "so that no first estimate stays"
            )
        if slam.landmark.anchored or slam.landmark.convert is not None:
            raise ValueError(
                f"fej needs landmarks that are written in one form, in themselves, not "
                f"{slam.landmark.name}"
            )

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        start, moved, predicted = _at_first(model, state, features, context)
        after, innovation = kalman_update(model, start, None, moved, noise, context, considered)
        correction = after.landmarks - start.landmarks
        after = follow(model, start, replace(after, landmarks=start.landmarks))
        after = replace(after, landmarks=state.landmarks + correction)
        return after, replace(innovation, predicted=predicted)

    def remember(self, state, slots):
        first = state.landmarks if state.first is None else state.first
        new = state.landmarks[slots]
        return replace(state, first=first.at[slots].set(new, mode="drop"))


def _at_first(
    model: SlamModel, state: State, features: Features, context: Context
) -> tuple[State, Features, Float[Array, "m p"]]:
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
