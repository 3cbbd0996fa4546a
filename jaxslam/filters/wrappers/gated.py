"""A filter that believes only what agrees: for measurements of which some are wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import AnyArray
from jaxslam._runtime.lookup import lookup
from jaxslam.filters.association import ASSOCIATIONS, TOLERANCE, candidates
from jaxslam.filters.ekf import innermost
from jaxslam.filters.protocol import AbstractStaged, Expected
from jaxslam.geometry import Pose
from jaxslam.models.observations import Capacity, Features, Innovation


class Gated(AbstractStaged):
    """`base`, whose updates are by the features that an `Association` believes; its state."""

    base: AbstractStaged
    association: str = eqx.field(static=True, default="sequential")
    """A name of ASSOCIATIONS."""
    tolerance: float = eqx.field(static=True, default=TOLERANCE)
    """σ by which a match may be off beyond its noise, in that."""

    def __check_init__(self) -> None:
        lookup("association", [self.association], ASSOCIATIONS)
        if not isinstance(self.base, AbstractStaged) or innermost(self.base) is None:
            raise ValueError(
                "features are checked before the update of a frame that has one, which "
                f"{type(self.base).__name__} lacks"
            )

    def init(self, capacity: int | Capacity, first: Features | None = None) -> Any:
        return self.base.init(capacity, first)

    def predict(self, state: Any, control: Any) -> Any:
        return self.base.predict(state, control)

    def predict_features(self, state: Any, control: Any, slots: Int[Array, " m"]) -> Expected:
        return self.base.predict_features(state, control, slots)

    def gaussian(self, state: Any, control: Any) -> tuple[AbstractStaged, Any]:
        return self.base.gaussian(state, control)

    def update(self, state: Any, control: Any, seen: Features) -> tuple[Any, Innovation]:
        """Of the base, by what agrees; the others count as not seen."""
        one, gaussian = self.base.gaussian(state, control)
        tolerance = self.tolerance * jnp.sqrt(self._noise[0, 0])
        found = candidates(one, gaussian, control, seen, tolerance)
        agreed = ASSOCIATIONS[self.association](found)
        return self.base.update(state, control, replace(seen, valid=agreed))

    def compose(self, state: Any, control: Any) -> Any:
        return self.base.compose(state, control)

    def close(self, state: Any, new: Features) -> Any:
        return self.base.close(state, new)

    def moving(self, state: Any) -> Bool[Array, ""]:
        return self.base.moving(state)

    def remove(self, state: Any, gone: Bool[AnyArray, " capacity"]) -> Any:
        return self.base.remove(state, gone)

    def marginal(self, state: Any, function, slots: Int[Array, " m"] | None = None):
        return self.base.marginal(state, function, slots)

    def in_map(self, state: Any) -> Bool[Array, " capacity"]:
        return self.base.in_map(state)

    def pose_error(self, state: Any, T_BC: Pose) -> tuple[Float[Array, " t"], Array]:
        return self.base.pose_error(state, T_BC)

    def unit_fixed(self, state: Any) -> Bool[Array, ""]:
        return self.base.unit_fixed(state)

    @property
    def _noise(self) -> Any:
        inner: Any = innermost(self.base)
        return inner.sensor.noise
