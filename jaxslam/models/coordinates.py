"""The frame in which landmarks are held: the camera, the base frame, or the camera of a keyframe.

`Coordinates` are a few functions of what the state *holds* of the pose. The map frame A, in which
landmarks are expressed, is the camera C itself (robocentric), the base B (world), or the camera K
of the current keyframe (Eade, Drummond, CVPR 2006 and ICCV 2007). All are the same filter on
`T_AC(k)`, the pose of the current camera in the map frame; they differ in what composition does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxslam.geometry import Pose, SplitPose, log

Held = PyTree
"""What a state holds of the pose."""

KEYFRAME_TURN = 0.05
"""A camera that has turned more than this from its keyframe becomes the next one, rad."""
KEYFRAME_PARALLAX = 0.05
"""And so does one that has moved by more than this share of the landmarks' harmonic mean distance:
about the angle by which a landmark at that distance is seen from another side, rad. Both are small
because a landmark's depth is nearly linear only in a camera near the keyframe."""


@dataclass(frozen=True)
class Coordinates:
    """The frame in which landmarks are held, as functions of the pose and a displacement."""

    name: str
    moves_landmarks: bool
    """Whether composition moves landmarks."""
    from_base_pose: Callable[[Pose], Held]
    """What the state holds of T_BC at the start: its error is this pytree's tangent."""
    camera_pose: Callable[[Held], Pose]
    """T_BC, the inverse of `from_base_pose`."""
    estimate: Callable[[Held], Pose | SplitPose]
    """The one pose whose error is the filter's: what is held, where that is one pose."""
    map_from_camera: Callable[[Held, Pose], Pose]
    """T_AC(k), from what was held at k−1 and the displacement."""
    compose: Callable[[Held, Pose], Held]
    """What is held at k, from that at k−1 and the displacement."""
    reanchor: Callable[[Held], Held] | None = None
    """What is held once the current camera is the map frame; None where that never changes."""


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


def keyframe_due(
    T_KC: Pose,
    inverse_distances: Float[Array, " capacity"],
    least_turn: float = KEYFRAME_TURN,
    least_parallax: float = KEYFRAME_PARALLAX,
) -> Bool[Array, ""]:
    """Whether the camera has left its keyframe; distances (of landmarks in K) that are not to
    count are infinite."""
    count = jnp.maximum(jnp.sum(inverse_distances != 0), 1)
    parallax = jnp.linalg.norm(T_KC.translation()) * jnp.sum(inverse_distances) / count
    turn = jnp.linalg.norm(log(T_KC.rotation()))
    return (turn > least_turn) | (parallax > least_parallax)


ROBOCENTRIC = Coordinates(
    name="robocentric",
    moves_landmarks=True,
    from_base_pose=lambda T_BC: T_BC.inverse(),
    camera_pose=lambda T_CB: T_CB.inverse(),
    estimate=lambda T_CB: T_CB,
    map_from_camera=lambda T_CB, step: step,
    compose=lambda T_CB, step: (step.inverse() @ T_CB).normalize(),
)
"""A = C: the state holds T_CB."""

WORLD = Coordinates(
    name="world",
    moves_landmarks=False,
    from_base_pose=SplitPose.of,
    camera_pose=SplitPose.joined,
    estimate=lambda split: split,
    map_from_camera=lambda split, step: split.joined() @ step,
    compose=lambda split, step: SplitPose.of((split.joined() @ step).normalize()),
)
"""A = B: the state holds T_BC, position and orientation separately."""

SUBMAP = Coordinates(
    name="submap",
    moves_landmarks=True,
    from_base_pose=KeyframePose.at,
    camera_pose=KeyframePose.camera_pose,
    estimate=KeyframePose.camera_pose,
    map_from_camera=lambda held, step: step,
    compose=KeyframePose.moved,
)
"""A = C, as in a robocentric filter: the state holds T_BK and T_KC, K the camera in which the
current submap began (`jaxslam.filters.submaps`)."""

KEYFRAME = Coordinates(
    name="keyframe",
    moves_landmarks=False,
    from_base_pose=KeyframePose.at,
    camera_pose=KeyframePose.camera_pose,
    estimate=KeyframePose.camera_pose,
    map_from_camera=lambda held, step: held.keyframe_from_camera @ step,
    compose=KeyframePose.moved,
    reanchor=KeyframePose.reanchored,
)
"""A = K: the state holds T_BK and T_KC. A robocentric filter is one whose every frame is a
keyframe; here landmarks are moved, and linearised in a new frame, only when the camera has left
the old one."""
