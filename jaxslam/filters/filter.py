"""What a filter is to those who run it: Monte Carlo studies, benchmarks, a user's own loop.

`SlamFilter` and `FixedLag` are filters. One of your own needs these functions, pure and on a state
that is any pytree of arrays; give it to `jaxslam.monte_carlo(scenario, {"mine": my_filter})`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from jaxtyping import Array, Bool, Float

from jaxslam.filters.state import Features, Innovation, State
from jaxslam.geometry import Pose
from jaxslam.rig import Rig

if TYPE_CHECKING:
    from jaxslam.filters.slam import Parameters, SlamFilter


class Filter(Protocol):
    """A recursive estimator of a camera's pose and of a map; hashable, since `jit` keys on it."""

    @property
    def rig(self) -> Rig:
        """What it is for: geometry, motion model, sensor."""
        ...

    @property
    def calibration(self) -> str:
        """How it treats the camera's calibration, one of `CALIBRATIONS`."""
        ...

    def start(
        self,
        parameters: Parameters,
        capacity: int,
        velocity: Float[Array, " v"],
        velocity_sigma: Float[Array, " v"] | Float[Array, "v v"],
        features: tuple[int, int] | None = None,
    ) -> Any:
        """The state before frame 0: at the origin of B, with a prior on the velocity (σ, or a root
        of its covariance) and slots for `capacity` landmarks. `features`: the most that a frame
        has, known and new."""
        ...

    def first(self, state: Any, parameters: Parameters, new: Features) -> Any:
        """Frame 0, in which everything is new."""
        ...

    def step(
        self, state: Any, parameters: Parameters, control: Array, seen: Features, new: Features
    ) -> tuple[Any, Innovation]:
        """One frame: `seen` are features of landmarks in the map, `new` those to insert."""
        ...

    def pose_error(self, state: Any, T_BC: Pose) -> tuple[Float[Array, " t"], Float[Array, "t t"]]:
        """The error against a true pose and the covariance that the filter gives it: its NEES."""
        ...

    def camera_pose(self, state: Any) -> tuple[Pose, Float[Array, "t t"]]:
        """T_BC and its covariance, position in the camera's axes and then orientation."""
        ...

    def landmarks_in_camera(
        self, state: Any, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """Landmarks in the sensor's chart, (x/z, y/z, 1/z) of a camera, with covariances."""
        ...

    def landmarks_from_above(
        self, state: Any, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m 2"], Float[Array, "m 2 2"]]:
        """Azimuth and inverse horizontal distance from the camera, axes of B, with covariances."""
        ...

    def reported(self, state: Any) -> State:
        """A state with one slot a landmark, of which `active` says what is in the map."""
        ...


class StagedFilter(Filter, Protocol):
    """A filter whose frame can be taken in stages: a tracker searches where `predict` says.

    Its `step` is `step_in_stages`. `SlamFilter` and `SplitAndMerge` are such filters.
    """

    @property
    def gaussian_filter(self) -> SlamFilter:
        """The filter whose states are single Gaussians: itself, or that of every member."""
        ...

    def predict(self, state: Any, parameters: Parameters, control: Array) -> Any:
        """What is known before the frame's measurements."""
        ...

    def predicted_gaussian(self, state: Any, parameters: Parameters, control: Array) -> State:
        """A predicted state as one Gaussian, for the functions of `gaussian_filter`."""
        ...

    def update(
        self, state: Any, parameters: Parameters, control: Array, features: Features
    ) -> tuple[Any, Innovation]:
        """Correct a predicted state by the features seen."""
        ...

    def compose(self, state: Any, parameters: Parameters, control: Array) -> Any:
        """Move into the new camera frame."""
        ...

    def initialise(self, state: Any, parameters: Parameters, features: Features) -> Any:
        """Begin new landmarks seen from the current camera."""
        ...

    def finish(self, state: Any) -> Any:
        """End the frame."""
        ...

    def remove(self, state: Any, gone: Bool[Array, " capacity"]) -> Any:
        """Marginalise landmarks and free their slots."""
        ...

    def landmarks_in_world(
        self, state: Any, parameters: Parameters, slots: Array
    ) -> tuple[Float[Array, "m n"], Float[Array, "m n n"]]:
        """Points in B and their covariances, the camera's uncertainty included."""
        ...


def step_in_stages(
    slam_filter: StagedFilter,
    state: Any,
    parameters: Parameters,
    control: Array,
    seen: Features,
    new: Features,
) -> tuple[Any, Innovation]:
    """One frame of a filter by its stages: predict, update, compose, initialise and finish."""
    state = slam_filter.predict(state, parameters, control)
    state, innovation = slam_filter.update(state, parameters, control, seen)
    state = slam_filter.compose(state, parameters, control)
    return slam_filter.finish(slam_filter.initialise(state, parameters, new)), innovation
