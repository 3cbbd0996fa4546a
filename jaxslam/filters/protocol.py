"""The interface of a filter to its users: Monte Carlo studies, trackers, a loop of one's own.

A filter is a module (a pytree that holds its numbers) with four functions, pure and on a state
that is any pytree of arrays: `init`, `step`, `marginal`, `landmark_marginal`. One that can also
stop within a frame, `AbstractStaged`, can track: features are sought where it predicts them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam._numerics.arrays import AnyArray
from jaxslam.geometry import Pose, difference
from jaxslam.models.observations import Capacity, Features, Innovation


class CameraView(eqx.Module):
    """The quantities that can be asked of the camera."""

    pose: Pose
    """T_BC, in metres."""
    core: Any = None
    """The filter's own variables; None of one that has none to show."""
    log_scale: Float[Array, " u"] | None = None
    """Numbers whose sum is the log of the filter's unit of length in metres; None of one that is in
    metres."""


class LandmarkView(eqx.Module):
    """The quantities that can be asked of one landmark."""

    pose: Pose
    """T_BC, in metres."""
    point: Float[Array, " n"]
    """X of the landmark as a homogeneous point (X, ω) in the camera."""
    omega: Float[Array, ""]
    """ω, so that the point is X/ω metres."""
    log_scale: Float[Array, " u"] | None = None
    """As `CameraView` has it."""


class Expected(NamedTuple):
    """The features that a filter expects in a frame that it has predicted, landmark by landmark."""

    measured: Float[Array, "m p"]
    covariance: Float[Array, "m p p"]
    """The covariances of the innovations: the search ellipses."""
    possible: Bool[Array, " m"]
    """Whether each is in the map and in front of the camera."""
    pose: Pose
    """T_BC."""
    points: Float[Array, "m n"]
    """X of the homogeneous points (X, ω) in the predicted camera."""
    omegas: Float[Array, " m"]


class AbstractFilter(eqx.Module):
    """A recursive estimator of a camera's pose and of a map."""

    @abstractmethod
    def init(self, capacity: int | Capacity, first: Features | None = None) -> Any:
        """The state before the first motion: at the origin of B. With the features of frame 0, in
        which everything is new, the state after it."""

    @abstractmethod
    def step(
        self, state: Any, control: Any, seen: Features, new: Features
    ) -> tuple[Any, Innovation]:
        """One frame: `seen` are features of landmarks in the map, `new` those to insert."""

    @abstractmethod
    def marginal(
        self, state: Any, function: Callable[[CameraView], Any]
    ) -> tuple[Any, Float[Array, "k k"]]:
        """Mean and covariance of `function(view)` of the camera: of a vector, or of a pytree of
        poses and vectors, whose covariance is of its tangent."""

    @abstractmethod
    def landmark_marginal(
        self,
        state: Any,
        function: Callable[[LandmarkView], Float[Array, " k"]],
        slots: Int[Array, " m"],
    ) -> tuple[Float[Array, "m k"], Float[Array, "m k k"]]:
        """Mean and covariance of `function(view)` of the landmark in each of these slots."""

    @property
    def unwrapped(self) -> AbstractFilter:
        """The filter that this one is built around, at the end of all that stands around it; the
        filter itself, unless it says otherwise."""
        return self

    def in_map(self, state: Any) -> Bool[Array, " capacity"]:
        """Whether each slot holds a landmark."""
        return state.active

    def pose_error(self, state: Any, T_BC: Pose) -> tuple[Float[Array, " t"], Float[Array, "t t"]]:
        """The error against a true pose, in the coordinates in which the filter keeps it, and its
        covariance: what NEES is made of."""
        pose, covariance = self.marginal(state, lambda view: view.pose)
        return difference(T_BC, pose), covariance

    def unit_fixed(self, state: Any) -> Bool[Array, ""]:
        """Whether poses from now on are in one unit; false while a start is being found out, and
        every frame has another."""
        del state
        return jnp.ones((), bool)


class AbstractStaged(AbstractFilter):
    """A filter whose frame can be taken in stages: all that a tracker asks for."""

    @property
    def ambiguous_start(self) -> bool:
        """Whether measurements of a start that no linear prediction expects are welcome: the filter
        finds by itself what explains them."""
        return False

    @abstractmethod
    def predict(self, state: Any, control: Any) -> Any:
        """Predict the state before the frame's measurements."""

    @abstractmethod
    def predict_features(self, state: Any, control: Any, slots: Int[Array, " m"]) -> Expected:
        """The features that a predicted state expects to see."""

    @abstractmethod
    def update(self, state: Any, control: Any, seen: Features) -> tuple[Any, Innovation]:
        """Correct a predicted state by the features seen (P16, P17)."""

    @abstractmethod
    def compose(self, state: Any, control: Any) -> Any:
        """Move into the new camera frame (P18–P21)."""

    @abstractmethod
    def close(self, state: Any, new: Features) -> Any:
        """Insert new landmarks, seen from the current camera (P22–P26), and end the frame."""

    @abstractmethod
    def remove(self, state: Any, gone: Bool[AnyArray, " capacity"]) -> Any:
        """Marginalise landmarks and free their slots."""

    def step(
        self, state: Any, control: Any, seen: Features, new: Features
    ) -> tuple[Any, Innovation]:
        """One frame by its stages."""
        state = self.predict(state, control)
        state, innovation = self.update(state, control, seen)
        return self.close(self.compose(state, control), new), innovation

    def moving(self, state: Any) -> Bool[Array, ""]:
        """Whether the newest frame says anything of how the camera moves."""
        del state
        return jnp.ones((), bool)

    def gaussian(self, state: Any, control: Any) -> tuple[AbstractStaged, Any]:
        """A filter and a predicted state of it that is one Gaussian: what hypotheses are tried
        on. The filter itself, unless its state is more than that."""
        del control
        return self, state
