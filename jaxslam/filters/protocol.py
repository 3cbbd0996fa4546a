"""The interface of a filter to its users: Monte Carlo studies, trackers, a loop of your own.

A filter is a module (a pytree that holds its numbers) with four functions, pure and on a state
that is any pytree of arrays: `init`, `step`, `marginal`, `landmark_marginal`. One that can also
stop within a frame, `AbstractStaged`, can track: features are sought where it predicts them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.model import SlamModel
from jaxslam.geometry import Pose, Scalar, difference
from jaxslam.models.motion import Control
from jaxslam.models.observations import Capacity, Features, Innovation, PriorMap, Slots

Belief = PyTree
"""The state of a filter: a pytree of arrays that only the filter knows."""
Moments = tuple[PyTree, Float[Array, "k k"]]
"""Mean and covariance of a vector, or of a pytree of poses and vectors, whose covariance is of its
tangent."""
EachMoments = tuple[Float[Array, "m k"], Float[Array, "m k k"]]
"""Means and covariances of some landmarks."""
Corrected = tuple[Belief, Innovation]
"""A belief after an update, and what the update made of it."""
PoseError = tuple[Float[Array, " t"], Float[Array, "t t"]]
"""The error of a pose, and its covariance."""


class CameraView(eqx.Module):
    """The quantities that can be asked of the camera."""

    pose: Pose
    """T_BC, in metres."""
    core: PyTree = None
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
    omega: Scalar
    """ω, so that the point is X/ω metres."""
    log_scale: Float[Array, " u"] | None = None
    """As `CameraView` has it."""


OfCamera = Callable[[CameraView], PyTree]
"""A function of the camera: a vector, or a pytree of poses and vectors."""
OfLandmark = Callable[[LandmarkView], Float[Array, " k"]]
"""A function of one landmark."""


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
    def init(
        self, capacity: int | Capacity, first: Features | None = None, known: PriorMap | None = None
    ) -> Belief:
        """The state before the first motion: at the origin of B. With the features of frame 0, in
        which everything is new, the state after it; with a prior map, landmarks are known."""

    @abstractmethod
    def step(self, state: Belief, control: Control, seen: Features, new: Features) -> Corrected:
        """One frame: `seen` are features of landmarks in the map, `new` those to insert."""

    @abstractmethod
    def marginal(self, state: Belief, function: OfCamera) -> Moments:
        """Mean and covariance of `function(view)` of the camera."""

    @abstractmethod
    def landmark_marginal(self, state: Belief, function: OfLandmark, slots: Slots) -> EachMoments:
        """Mean and covariance of `function(view)` of the landmark in each of these slots."""

    @property
    def model(self) -> SlamModel | None:
        """The models of motion, sensor and landmark that the filter is made of; None of a filter
        that is made otherwise."""
        return None

    def in_map(self, state: Belief) -> Bool[Array, " capacity"]:
        """Whether each slot holds a landmark."""
        return state.active

    def pose_error(self, state: Belief, T_BC: Pose) -> PoseError:
        """The error against a true pose, in the coordinates in which the filter keeps it, and its
        covariance: what NEES is made of."""
        pose, covariance = self.marginal(state, lambda view: view.pose)
        return difference(T_BC, pose), covariance

    def unit_fixed(self, state: Belief) -> Bool[Array, ""]:
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
    def predict(self, state: Belief, control: Control) -> Belief:
        """Predict the state before the frame's measurements."""

    @abstractmethod
    def predict_features(self, state: Belief, control: Control, slots: Slots) -> Expected:
        """The features that a predicted state expects to see."""

    @abstractmethod
    def update(self, state: Belief, control: Control, seen: Features) -> Corrected:
        """Correct a predicted state by the features seen (P16, P17)."""

    @abstractmethod
    def compose(self, state: Belief, control: Control) -> Belief:
        """Move into the new camera frame (P18–P21)."""

    @abstractmethod
    def close(self, state: Belief, new: Features) -> Belief:
        """Insert new landmarks, seen from the current camera (P22–P26), and end the frame."""

    @abstractmethod
    def remove(self, state: Belief, gone: Bool[AnyArray, " capacity"]) -> Belief:
        """Marginalise landmarks and free their slots."""

    def step(self, state: Belief, control: Control, seen: Features, new: Features) -> Corrected:
        """One frame by its stages."""
        state = self.predict(state, control)
        state, innovation = self.update(state, control, seen)
        return self.close(self.compose(state, control), new), innovation

    def gaussian(self, state: Belief, control: Control) -> tuple[AbstractStaged, Belief]:
        """A filter and a predicted state of it that is one Gaussian: what hypotheses are tried
        on. The filter itself, unless its state is more than that."""
        del control
        return self, state
