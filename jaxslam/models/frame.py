"""The frame in which landmarks are held: the camera, the base frame, a keyframe, or a submap.

A frame says what the state *holds* of the pose. The map frame A, in which landmarks are expressed,
is the camera C itself (robocentric), the base B (world-centric), or the camera K of the current
keyframe (Eade, Drummond, CVPR 2006 and ICCV 2007). All are the same filter on `T_AC(k)`, the pose
of the current camera in the map frame; they differ in what composition does.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.geometry import Pose, Scalar, SplitPose, log, scaled

Held = PyTree
"""What a state holds of the pose."""


class AbstractFrame(eqx.Module):
    """The frame in which landmarks are held, as functions of the pose and a displacement."""

    name: ClassVar[str]
    """The frame as messages call it."""
    moves_landmarks: ClassVar[bool]
    """Whether composition moves landmarks: the map frame is the camera."""
    reanchors: ClassVar[bool] = False
    """Whether the current camera becomes the map frame now and then."""

    begins_submaps: ClassVar[bool] = False
    """Whether the state keeps what a submap began with: the motion's variables there."""

    @property
    def handed_over(self) -> Submaps | None:
        """This frame, where what leaves the map is kept as a submap; None where it is not."""
        return None

    @abstractmethod
    def from_base_pose(self, T_BC: Pose) -> Held:
        """What the state holds of T_BC at the start: its error is this pytree's tangent."""

    @abstractmethod
    def camera_pose(self, held: Held) -> Pose:
        """T_BC, the inverse of `from_base_pose`."""

    @abstractmethod
    def estimate(self, held: Held) -> Pose | SplitPose:
        """The one pose whose error is the filter's: what is held, where that is one pose."""

    @abstractmethod
    def map_from_camera(self, held: Held, step: Pose) -> Pose:
        """T_AC(k), from what was held at k−1 and the displacement."""

    @abstractmethod
    def compose(self, held: Held, step: Pose) -> Held:
        """What is held at k, from that at k−1 and the displacement."""

    def acted(self, held: Held, rigid: Pose, factor: Scalar) -> Held:
        """What is held once everything is enlarged by a factor, then moved in B."""
        return self.from_base_pose(rigid @ scaled(self.camera_pose(held), factor))

    def left(self, held: Held, inverse_distances: Float[Array, " capacity"]) -> Bool[Array, ""]:
        """Whether the camera has left an earlier one from which its pose is held; there is none.
        Distances (of landmarks from that) that are not to count are infinite."""
        del held, inverse_distances
        return jnp.zeros((), bool)


class Robocentric(AbstractFrame):
    """The paper's: A = C, and the state holds T_CB."""

    name: ClassVar[str] = "robocentric"
    moves_landmarks: ClassVar[bool] = True

    def from_base_pose(self, T_BC: Pose) -> Pose:
        return T_BC.inverse()

    def camera_pose(self, held: Pose) -> Pose:
        return held.inverse()

    def estimate(self, held: Pose) -> Pose:
        return held

    def map_from_camera(self, held: Pose, step: Pose) -> Pose:
        return step

    def compose(self, held: Pose, step: Pose) -> Pose:
        return (step.inverse() @ held).normalize()


class WorldCentric(AbstractFrame):
    """The classical one: A = B, and the state holds T_BC, position and orientation apart."""

    name: ClassVar[str] = "world"
    moves_landmarks: ClassVar[bool] = False

    def from_base_pose(self, T_BC: Pose) -> SplitPose:
        return SplitPose.of(T_BC)

    def camera_pose(self, held: SplitPose) -> Pose:
        return held.joined()

    def estimate(self, held: SplitPose) -> SplitPose:
        return held

    def map_from_camera(self, held: SplitPose, step: Pose) -> Pose:
        return held.joined() @ step

    def compose(self, held: SplitPose, step: Pose) -> SplitPose:
        return SplitPose.of((held.joined() @ step).normalize())


class KeyframePose(eqx.Module):
    """The camera by way of a keyframe K: `T_BC = T_BK T_KC`."""

    base_from_keyframe: Pose
    keyframe_from_camera: Pose

    @staticmethod
    def at(T_BC: Pose) -> KeyframePose:
        """The camera at T_BC is the keyframe: T_KC is the identity, exactly."""
        here = jax.tree.map(lambda one, x: one.astype(x.dtype), type(T_BC).identity(), T_BC)
        return KeyframePose(T_BC, here)

    def camera_pose(self) -> Pose:
        """T_BC."""
        return self.base_from_keyframe @ self.keyframe_from_camera

    def moved(self, step: Pose) -> KeyframePose:
        """The pose after a displacement of the camera."""
        T_KC = (self.keyframe_from_camera @ step).normalize()
        return KeyframePose(self.base_from_keyframe, T_KC)

    def reanchored(self) -> KeyframePose:
        """The same camera, as the keyframe."""
        return KeyframePose.at(self.camera_pose().normalize())


class AbstractKeyframed(AbstractFrame):
    """A frame whose state holds T_BK and T_KC, K an earlier camera that the camera leaves."""

    if TYPE_CHECKING:  # fields of each frame, after those of its own

        @property
        def turn(self) -> float:
            """The turn from K at which the camera has left it, rad."""

        @property
        def parallax(self) -> float:
            """The same of its distance from K, as a share of the landmarks' harmonic mean distance:
            about the angle by which a landmark at that distance is seen from another side, rad."""

    def from_base_pose(self, T_BC: Pose) -> KeyframePose:
        return KeyframePose.at(T_BC)

    def camera_pose(self, held: KeyframePose) -> Pose:
        return held.camera_pose()

    def estimate(self, held: KeyframePose) -> Pose:
        return held.camera_pose()

    def compose(self, held: KeyframePose, step: Pose) -> KeyframePose:
        return held.moved(step)

    def acted(self, held: KeyframePose, rigid: Pose, factor: Scalar) -> KeyframePose:
        enlarged = scaled(held, factor)
        return KeyframePose(rigid @ enlarged.base_from_keyframe, enlarged.keyframe_from_camera)

    def left(
        self, held: KeyframePose, inverse_distances: Float[Array, " capacity"]
    ) -> Bool[Array, ""]:
        T_KC = held.keyframe_from_camera
        count = jnp.maximum(jnp.sum(inverse_distances != 0), 1)
        parallax = jnp.linalg.norm(T_KC.translation()) * jnp.sum(inverse_distances) / count
        turn = jnp.linalg.norm(log(T_KC.rotation()))
        return (turn > self.turn) | (parallax > self.parallax)


class Keyframe(AbstractKeyframed):
    """A = K, the camera of the current keyframe.

    A robocentric filter is one whose every frame is a keyframe; here landmarks are moved, and
    linearised in a new frame, only when the camera has left the old one. The limits `turn` and
    `parallax` are small because a landmark's depth is nearly linear only near the keyframe.
    """

    name: ClassVar[str] = "keyframe"
    moves_landmarks: ClassVar[bool] = False
    reanchors: ClassVar[bool] = True

    turn: float = eqx.field(static=True, default=0.05)
    parallax: float = eqx.field(static=True, default=0.05)

    def map_from_camera(self, held: KeyframePose, step: Pose) -> Pose:
        return held.keyframe_from_camera @ step


class Submaps(AbstractKeyframed):
    """A = C, as in a robocentric filter, and K is the camera in which the current submap began.

    When the state is full, or the camera has left the scene in which its submap began (by `turn` or
    `parallax`), what is out of view is frozen and leaves the state (`jaxslam.filters.submaps`).
    Raises ValueError for numbers out of range.
    """

    name: ClassVar[str] = "submap"
    moves_landmarks: ClassVar[bool] = True
    begins_submaps: ClassVar[bool] = True

    spare: int | None = eqx.field(static=True, default=24)
    """Slots beyond those of the landmarks in view, for those out of view until the submap ends.
    None: the submap never ends."""
    history: int = eqx.field(static=True, default=1)
    """Submaps that the state keeps. A tracker takes each as it ends; a batch of runs keeps all."""
    turn: float = eqx.field(static=True, default=0.5)
    parallax: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        if (self.spare or 0) < 0 or self.history < 1:
            raise ValueError(
                f"submaps have 0 spare slots and a history of 1 at least, not {self.spare} and "
                f"{self.history}"
            )

    @property
    def handed_over(self) -> Submaps | None:
        return None if self.spare is None else self

    def map_from_camera(self, held: KeyframePose, step: Pose) -> Pose:
        return step
