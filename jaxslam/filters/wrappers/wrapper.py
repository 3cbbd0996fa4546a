"""The wrapper of a filter: everything is handed on, and a wrapper says only what it changes."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.protocol import (
    AbstractFilter,
    AbstractStaged,
    Belief,
    Corrected,
    EachMoments,
    Expected,
    Moments,
    OfCamera,
    OfLandmark,
    PoseError,
)
from jaxslam.geometry import Pose
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Capacity, Features, Slots


class AbstractWrapper(AbstractStaged):
    """A filter around `base`, of which it does all that a subclass does not override.

    A state is that of the base, unless `init`, `base_state` and `with_base_state` say otherwise.
    Raises ValueError for a base that takes a frame as a whole.
    """

    base: eqx.AbstractVar[AbstractStaged]

    def __check_init__(self) -> None:
        if not isinstance(self.base, AbstractStaged):
            raise ValueError(
                f"{type(self).__name__} takes a frame in stages, which {type(self.base).__name__} "
                "does not"
            )

    def base_state(self, state: Belief) -> Belief:
        """The base's state in the wrapper's."""
        return state

    def with_base_state(self, state: Belief, inner: Belief) -> Belief:
        """The wrapper's state with another one of the base in it."""
        del state
        return inner

    @property
    def unwrapped(self) -> AbstractFilter:
        return self.base.unwrapped

    @property
    def ambiguous_start(self) -> bool:
        return self.base.ambiguous_start

    def init(self, capacity: int | Capacity, first: Features | None = None) -> Belief:
        return self.base.init(capacity, first)

    def predict(self, state: Belief, control: Control) -> Belief:
        return self.with_base_state(state, self.base.predict(self.base_state(state), control))

    def predict_features(self, state: Belief, control: Control, slots: Slots) -> Expected:
        return self.base.predict_features(self.base_state(state), control, slots)

    def gaussian(self, state: Belief, control: Control) -> tuple[AbstractStaged, Belief]:
        return self.base.gaussian(self.base_state(state), control)

    def update(self, state: Belief, control: Control, seen: Features) -> Corrected:
        inner, innovation = self.base.update(self.base_state(state), control, seen)
        return self.with_base_state(state, inner), innovation

    def compose(self, state: Belief, control: Control) -> Belief:
        return self.with_base_state(state, self.base.compose(self.base_state(state), control))

    def close(self, state: Belief, new: Features) -> Belief:
        return self.with_base_state(state, self.base.close(self.base_state(state), new))

    def remove(self, state: Belief, gone: Bool[AnyArray, " capacity"]) -> Belief:
        return self.with_base_state(state, self.base.remove(self.base_state(state), gone))

    def marginal(self, state: Belief, function: OfCamera) -> Moments:
        return self.base.marginal(self.base_state(state), function)

    def landmark_marginal(self, state: Belief, function: OfLandmark, slots: Slots) -> EachMoments:
        return self.base.landmark_marginal(self.base_state(state), function, slots)

    def in_map(self, state: Belief) -> Bool[Array, " capacity"]:
        return self.base.in_map(self.base_state(state))

    def pose_error(self, state: Belief, T_BC: Pose) -> PoseError:
        return self.base.pose_error(self.base_state(state), T_BC)

    def unit_fixed(self, state: Belief) -> Bool[Array, ""]:
        return self.base.unit_fixed(self.base_state(state))


def with_motion(slam: AbstractStaged, motion: AbstractMotion) -> AbstractStaged:
    """The filter with another motion model inside."""
    return eqx.tree_at(lambda slam: slam.unwrapped.motion, slam, motion)
