"""What a form of the filter offers to `SlamFilter`: the functions of a module, on its own state.

`ekf` has them on a covariance and `information` on its inverse. A state of either has `core`,
`landmarks`, `active`, `core_dim` and `covariance`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.blocks import Change, Landmark, Model
from jaxslam.filters.state import Features, Innovation


class Engine(Protocol):
    """The steps of a filter; see `ekf` for what each does."""

    def empty(self, core: Any, landmarks: Float[Array, "capacity d"]) -> Any: ...

    def augment(self, state: Any, start: int, covariance: Float[Array, "k k"]) -> Any: ...

    def know(self, state: Any, start: int, size: int) -> Any: ...

    def marginalise(self, state: Any, start: int, size: int) -> Any: ...

    def update(
        self,
        model: Model,
        state: Any,
        features: Features,
        noise: Float[Array, "p p"],
        context: Any,
        considered: slice = ...,
    ) -> tuple[Any, Innovation]: ...

    def update_mean(
        self,
        model: Model,
        state: Any,
        features: Features,
        noise: Float[Array, "p p"],
        context: Any,
        considered: slice = ...,
    ) -> Any: ...

    def predict_features(
        self,
        model: Model,
        state: Any,
        slots: Int[Array, " m"],
        noise: Float[Array, "p p"],
        context: Any,
    ) -> tuple[Float[Array, "m p"], Float[Array, "m p p"], Bool[Array, " m"]]: ...

    def compose(self, model: Model, state: Any, context: Any) -> Any: ...

    def change(self, state: Any, variables: Change) -> Any: ...

    def initialise(
        self,
        model: Model,
        state: Any,
        features: Features,
        noise: Float[Array, "p p"],
        prior: tuple[Float[Array, " q"], Float[Array, " q"]],
        context: Any,
    ) -> Any: ...

    def remove(self, state: Any, gone: Bool[Array, " capacity"]) -> Any: ...

    def landmark_covariance(
        self,
        view: Callable[[Any], Any],
        function: Landmark,
        state: Any,
        slots: Int[Array, " m"],
    ) -> tuple[Float[Array, "m k"], Float[Array, "m k k"]]: ...

    def core_covariance(
        self, function: Callable[[Any], Any], state: Any
    ) -> tuple[Any, Float[Array, "k k"]]: ...
