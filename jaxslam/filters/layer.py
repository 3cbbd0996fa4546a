"""The record of a filter's pieces, and what a piece around its Gaussians does with a frame.

A mixture, a start, submaps and a gate are *layers*: each hands every stage on to the record without
it, `slam.inner`, and says only what it changes. Which stands around which is fixed (`Slam`), so
that the fields of a record have no order.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import fields

import equinox as eqx
from jaxtyping import Array, Bool

from jaxslam._numerics.arrays import AnyArray
from jaxslam.filters.linear.kalman import AbstractCorrection
from jaxslam.filters.model import SlamModel
from jaxslam.filters.protocol import (
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
from jaxslam.landmarks import AbstractLandmark
from jaxslam.models.calibration import AbstractCalibration
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import AbstractFrame
from jaxslam.models.motion import AbstractMotion, Control
from jaxslam.models.observations import Capacity, Features, PriorMap, Slots
from jaxslam.models.scale import AbstractScale
from jaxslam.models.sensors import AbstractSensor


class AbstractSlam(AbstractStaged):
    """The pieces of a filter, which `Slam` documents."""

    motion: eqx.AbstractVar[AbstractMotion]
    sensor: eqx.AbstractVar[AbstractSensor]
    landmark: eqx.AbstractVar[AbstractLandmark]
    frame: eqx.AbstractVar[AbstractFrame]
    calibration: eqx.AbstractVar[AbstractCalibration]
    depth: eqx.AbstractVar[InverseDepth]
    scale: eqx.AbstractVar[AbstractScale]
    correction: eqx.AbstractVar[AbstractCorrection]

    @property
    def model(self) -> SlamModel:
        """The pure functions of core and landmark."""
        return SlamModel(**{piece.name: getattr(self, piece.name) for piece in fields(SlamModel)})

    @property
    @abstractmethod
    def layer(self) -> AbstractLayer:
        """The outermost layer."""

    @property
    @abstractmethod
    def layered(self) -> bool:
        """Whether anything stands around the Gaussian."""

    @property
    @abstractmethod
    def inner(self) -> AbstractSlam:
        """The same filter without its outermost layer."""

    @property
    @abstractmethod
    def one(self) -> AbstractSlam:
        """The same filter without any layer, whose state is one Gaussian."""


class AbstractLayer(eqx.Module):
    """The stages of a frame, each handed on to `slam.inner` unless a subclass overrides it.

    A state is that of the inner filter, unless `init`, `inside` and `around` say otherwise.
    """

    def inside(self, state: Belief) -> Belief:
        """The inner filter's state in the layer's."""
        return state

    def around(self, state: Belief, inner: Belief) -> Belief:
        """The layer's state with another one of the inner filter in it."""
        del state
        return inner

    def ambiguous_start(self, slam: AbstractSlam) -> bool:
        """As `AbstractStaged` has it."""
        return slam.inner.ambiguous_start

    def init(
        self,
        slam: AbstractSlam,
        capacity: int | Capacity,
        first: Features | None,
        known: PriorMap | None,
    ) -> Belief:
        return slam.inner.init(capacity, first, known)

    def step(
        self, slam: AbstractSlam, state: Belief, control: Control, seen: Features, new: Features
    ) -> Corrected:
        """One frame by its stages."""
        return AbstractStaged.step(slam, state, control, seen, new)

    def predict(self, slam: AbstractSlam, state: Belief, control: Control) -> Belief:
        return self.around(state, slam.inner.predict(self.inside(state), control))

    def predict_features(
        self, slam: AbstractSlam, state: Belief, control: Control, slots: Slots
    ) -> Expected:
        return slam.inner.predict_features(self.inside(state), control, slots)

    def gaussian(
        self, slam: AbstractSlam, state: Belief, control: Control
    ) -> tuple[AbstractStaged, Belief]:
        return slam.inner.gaussian(self.inside(state), control)

    def update(
        self, slam: AbstractSlam, state: Belief, control: Control, seen: Features
    ) -> Corrected:
        """As `AbstractStaged` has it."""
        inner, innovation = slam.inner.update(self.inside(state), control, seen)
        return self.around(state, inner), innovation

    def compose(self, slam: AbstractSlam, state: Belief, control: Control) -> Belief:
        return self.around(state, slam.inner.compose(self.inside(state), control))

    def close(self, slam: AbstractSlam, state: Belief, new: Features) -> Belief:
        """As `AbstractStaged` has it."""
        return self.around(state, slam.inner.close(self.inside(state), new))

    def remove(
        self, slam: AbstractSlam, state: Belief, gone: Bool[AnyArray, " capacity"]
    ) -> Belief:
        """As `AbstractStaged` has it."""
        return self.around(state, slam.inner.remove(self.inside(state), gone))

    def marginal(self, slam: AbstractSlam, state: Belief, function: OfCamera) -> Moments:
        return slam.inner.marginal(self.inside(state), function)

    def landmark_marginal(
        self, slam: AbstractSlam, state: Belief, function: OfLandmark, slots: Slots
    ) -> EachMoments:
        return slam.inner.landmark_marginal(self.inside(state), function, slots)

    def in_map(self, slam: AbstractSlam, state: Belief) -> Bool[Array, " capacity"]:
        return slam.inner.in_map(self.inside(state))

    def pose_error(self, slam: AbstractSlam, state: Belief, T_BC: Pose) -> PoseError:
        return slam.inner.pose_error(self.inside(state), T_BC)

    def unit_fixed(self, slam: AbstractSlam, state: Belief) -> Bool[Array, ""]:
        """As `AbstractStaged` has it."""
        return slam.inner.unit_fixed(self.inside(state))
