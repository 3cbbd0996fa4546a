"""The base of delayed initialisations: filters around one Gaussian that weigh a landmark's depths.

They are rivals of undelayed landmarks, and show what a filter of another kind is: four functions.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray, precision
from jaxslam.filters.gaussian import check_features, with_frames_calibration
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import SlamModel
from jaxslam.filters.protocol import (
    AbstractFilter,
    Corrected,
    EachMoments,
    Moments,
    OfCamera,
    OfLandmark,
    PoseError,
)
from jaxslam.geometry import Pose
from jaxslam.landmarks import Cartesian
from jaxslam.models.motion import Control
from jaxslam.models.observations import Capacity, Features, PriorMap, Slots


class Delayed(eqx.Module):
    """The state: a Gaussian, in which what is not finished has several slots or no depth, and the
    weights of the alternative depths of every landmark."""

    gaussian: State
    weights: Float[Array, "landmarks k"]


class AbstractDelayed(AbstractFilter):
    """A filter around `slam`, one Gaussian, whose landmarks become points when their depth is
    known. Raises ValueError for a filter of another kind, and depths that are not in order."""

    slam: eqx.AbstractVar[AbstractSlam]
    nearest: eqx.AbstractVar[float]
    farthest: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        check_delayed(self.slam)
        if not 0 < self.nearest < self.farthest:
            raise ValueError(
                f"depths need 0 < nearest < farthest, not nearest {self.nearest} and farthest "
                f"{self.farthest}"
            )

    @property
    def slots_each(self) -> int:
        """The number of slots of the Gaussian that a landmark owns."""
        return 1

    @abstractmethod
    def even(self, landmarks: int, dtype: DTypeLike) -> Float[Array, "landmarks k"]:
        """The weights of landmarks of which nothing is known."""

    @abstractmethod
    def update(self, state: Delayed, control: Control, features: Features) -> Corrected:
        """Correct a predicted state by the features of landmarks, finished or not."""

    @abstractmethod
    def begin(self, state: Delayed, features: Features) -> Delayed:
        """Begin new landmarks, seen from the current camera, and end the frame."""

    @abstractmethod
    def collapsed(self, state: Delayed) -> State:
        """The Gaussian with one slot a landmark."""

    @property
    def model(self) -> SlamModel | None:
        return self.slam.model

    def init(
        self, capacity: int | Capacity, first: Features | None = None, known: PriorMap | None = None
    ) -> Delayed:
        """Raises ValueError for a prior map, whose landmarks are no rays."""
        if known is not None:
            raise ValueError("a delayed initialisation takes no prior map; leave out known")
        room = Capacity.of(capacity)
        gaussian = self.slam.init(room._replace(landmarks=room.landmarks * self.slots_each))
        state = Delayed(gaussian, self.even(room.landmarks, precision(self.slam)))
        if first is None:
            return state
        check_features(self.slam, first, room.landmarks)
        return self.begin(
            replace(state, gaussian=with_frames_calibration(self.slam, gaussian)), first
        )

    def step(self, state: Delayed, control: Control, seen: Features, new: Features) -> Corrected:
        state = replace(state, gaussian=self.slam.predict(state.gaussian, control))
        state, innovation = self.update(state, control, seen)
        composed = replace(state, gaussian=self.slam.compose(state.gaussian, control))
        return self.begin(composed, new), innovation

    def remove(self, state: Delayed, gone: Bool[AnyArray, " landmarks"]) -> Delayed:
        """Marginalise landmarks and free their slots."""
        gaussian = self.slam.remove(state.gaussian, jnp.repeat(gone, self.slots_each))
        return replace(state, gaussian=gaussian)

    def marginal(self, state: Delayed, function: OfCamera) -> Moments:
        return self.slam.marginal(state.gaussian, function)

    def landmark_marginal(self, state: Delayed, function: OfLandmark, slots: Slots) -> EachMoments:
        return self.slam.landmark_marginal(self.collapsed(state), function, slots)

    def in_map(self, state: Delayed) -> Bool[Array, " landmarks"]:
        return self.collapsed(state).active

    def pose_error(self, state: Delayed, T_BC: Pose) -> PoseError:
        return self.slam.pose_error(state.gaussian, T_BC)


def check_delayed(slam: AbstractSlam) -> None:
    """Raise ValueError for a filter whose landmarks cannot be delayed."""
    what = "a delayed initialisation"
    for wrong, why in (
        (slam.sensor.hidden != 1, f"finds a depth, which {type(slam.sensor).__name__} measures"),
        (slam.layered, "is around one Gaussian, without mixture, start, submaps or gate"),
        (slam.depth.common is not None, "replaces the prior on depth, so that none is common"),
        (slam.scale.free, "has depths in metres, and goes with no scale gauge"),
        (slam.correction != Kalman(), "goes with the Kalman update alone, of one step"),
    ):
        if wrong:
            raise ValueError(f"{what} {why}")


def around(slam: AbstractFilter) -> AbstractSlam:
    """The filter, which is to end in Cartesian landmarks. Raises ValueError for others."""
    if not isinstance(slam, AbstractSlam):
        raise ValueError(f"a delayed initialisation is around a Slam, not {type(slam).__name__}")
    if slam.landmark != Cartesian():
        raise ValueError(
            f"a delayed initialisation ends in cartesian landmarks, not {slam.landmark.name}"
        )
    return slam


def reweighted(
    weights: Float[Array, "m k"], log_likelihood: Float[Array, "m k"]
) -> Float[Array, "m k"]:
    """Bayes' rule on k alternatives; weights stay as they are where none has a likelihood."""
    best = jnp.max(jnp.where(weights > 0, log_likelihood, -jnp.inf), axis=1, keepdims=True)
    possible = jnp.isfinite(best)
    product = weights * jnp.exp(log_likelihood - jnp.where(possible, best, 0.0))
    total = jnp.sum(product, axis=1, keepdims=True)
    possible &= total > 0
    return jnp.where(possible, product / jnp.where(possible, total, 1.0), weights)
