"""The wrapper of a filter: everything is handed on, and a wrapper says only what it changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.protocol import (
    AbstractFilter,
    AbstractStaged,
    CameraView,
    Expected,
    LandmarkView,
)
from jaxslam.geometry import Pose
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.observations import Capacity, Features, Innovation


class AbstractWrapper(AbstractStaged):
    """A filter around `base`, of which it does all that a subclass does not override.

    A state is that of the base, unless `init`, `base_state` and `with_base_state` say otherwise.
    Raises ValueError for a base that takes a frame as a whole.
    """

    base: eqx.AbstractVar[AbstractStaged]

    def __check_init__(self) -> None:
        check_staged(self, self.base)

    def base_state(self, state: Any) -> Any:
        """The base's state in the wrapper's."""
        return state

    def with_base_state(self, state: Any, inner: Any) -> Any:
        """The wrapper's state with another one of the base in it."""
        del state
        return inner

    @property
    def unwrapped(self) -> AbstractFilter:
        return self.base.unwrapped

    @property
    def ambiguous_start(self) -> bool:
        return self.base.ambiguous_start

    def init(self, capacity: int | Capacity, first: Features | None = None) -> Any:
        return self.base.init(capacity, first)

    def predict(self, state: Any, control: Any) -> Any:
        return self.with_base_state(state, self.base.predict(self.base_state(state), control))

    def predict_features(self, state: Any, control: Any, slots: Int[Array, " m"]) -> Expected:
        return self.base.predict_features(self.base_state(state), control, slots)

    def gaussian(self, state: Any, control: Any) -> tuple[AbstractStaged, Any]:
        return self.base.gaussian(self.base_state(state), control)

    def update(self, state: Any, control: Any, seen: Features) -> tuple[Any, Innovation]:
        inner, innovation = self.base.update(self.base_state(state), control, seen)
        return self.with_base_state(state, inner), innovation

    def compose(self, state: Any, control: Any) -> Any:
        return self.with_base_state(state, self.base.compose(self.base_state(state), control))

    def close(self, state: Any, new: Features) -> Any:
        return self.with_base_state(state, self.base.close(self.base_state(state), new))

    def remove(self, state: Any, gone: Bool[AnyArray, " capacity"]) -> Any:
        return self.with_base_state(state, self.base.remove(self.base_state(state), gone))

    def moving(self, state: Any) -> Bool[Array, ""]:
        return self.base.moving(self.base_state(state))

    def marginal(
        self, state: Any, function: Callable[[CameraView], Any]
    ) -> tuple[Any, Float[Array, "k k"]]:
        return self.base.marginal(self.base_state(state), function)

    def landmark_marginal(
        self,
        state: Any,
        function: Callable[[LandmarkView], Float[Array, " k"]],
        slots: Int[Array, " m"],
    ) -> tuple[Float[Array, "m k"], Float[Array, "m k k"]]:
        return self.base.landmark_marginal(self.base_state(state), function, slots)

    def in_map(self, state: Any) -> Bool[Array, " capacity"]:
        return self.base.in_map(self.base_state(state))

    def pose_error(self, state: Any, T_BC: Pose) -> tuple[Float[Array, " t"], Float[Array, "t t"]]:
        return self.base.pose_error(self.base_state(state), T_BC)

    def unit_fixed(self, state: Any) -> Bool[Array, ""]:
        return self.base.unit_fixed(self.base_state(state))


def check_staged(around: AbstractStaged, base: AbstractFilter) -> None:
    """Raise ValueError unless what a filter is around takes a frame in stages too."""
    if not isinstance(base, AbstractStaged):
        raise ValueError(
            f"{type(around).__name__} takes a frame in stages, which {type(base).__name__} does not"
        )


def with_motion(slam: Any, motion: AbstractMotion) -> Any:
    """The filter with another motion model inside."""
    return eqx.tree_at(lambda slam: slam.unwrapped.motion, slam, motion)
