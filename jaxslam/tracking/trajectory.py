"""The error of a trajectory against a reference, and that whose covariances are written."""

from typing import NamedTuple, TypedDict

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE, Similarity, associated, similarity
from jaxslam.evaluation.convention import Convention
from jaxslam.tracking.pose_with_covariance import Positions, Transforms

TRACKED = Convention("split", "body")
"""The error whose covariances are written: position in the camera's axes, rotation vector."""


class TrajectoryError(TypedDict):
    """The result of `absolute_trajectory_error`; lengths in the reference's unit."""

    alignment: str
    rmse: float
    path_length: float
    extent: float
    matched: int
    sign: float
    orientation_rmse: float
    straight_line: float


class RelativeError(TypedDict):
    """The result of `relative_pose_error`."""

    seconds: float
    translation: float
    rotation: float
    way: float


def absolute_trajectory_error(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
    *,
    scaled: bool = True,
) -> TrajectoryError:
    """The absolute trajectory error of the positions after a Sim(3) alignment, or one by SE(3) of
    an estimate in metres that is not `scaled`.

    Times (n,) and (m,) in seconds, poses (n, 4, 4) and (m, 4, 4). Poses are paired by their
    times (`associated`), and the estimate is aligned by Umeyama's method.
    `path_length` is the reference's over the paired poses, `extent` the diagonal of the box
    around them, `matched` their number.

    Three numbers say what the error does not. `sign` is the correlation, −1 to 1, of the true
    positions with the estimated ones, turned by the one rotation that fits the *orientations*
    best: −1 is a world behind the camera, which the alignment turns round. `orientation_rmse`
    is the angle, in degrees, that this rotation leaves. `straight_line` is the error that the
    best straight line at constant speed would have, which looks at no picture.

    Raises `ValueError` where fewer than three poses pair up or all positions of one trajectory
    coincide.
    """
    pairs = _paired(estimate_times, estimate, reference_times, reference)
    positions, aligned = pairs.reference[:, :3, 3], pairs.aligned(scaled=scaled)
    turn, angle = _by_orientation(pairs.estimate, pairs.reference)
    return {
        "alignment": "sim3" if scaled else "se3",
        "rmse": _rms(aligned[:, :3, 3] - positions),
        "path_length": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "extent": float(np.linalg.norm(np.ptp(positions, axis=0))),
        "matched": len(pairs.times),
        "sign": _sign(turn, pairs.estimate[:, :3, 3], positions),
        "orientation_rmse": angle,
        "straight_line": _straight_line(pairs.times, positions),
    }


def orientation_error(*trajectories: ArrayLike) -> float:
    """The `orientation_rmse` of `absolute_trajectory_error`, of the same arguments, also of cameras
    that only turn. Raises ValueError where fewer than three poses pair up."""
    pairs = _paired(*trajectories)
    return _by_orientation(pairs.estimate, pairs.reference)[1]


def relative_pose_error(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
    seconds: float = 1.0,
) -> RelativeError:
    """The relative pose error over `seconds`: how far a motion of that long is off.

    RMS over all pairs of poses so far apart: of the `translation`, in the reference's unit, and of
    the `rotation`, in degrees; `way` is the reference's own displacement, RMS. Of the alignment
    only its scale matters. Arguments are those of `absolute_trajectory_error`. Raises `ValueError`
    as it does, and for a trajectory that is shorter.
    """
    pairs = _paired(estimate_times, estimate, reference_times, reference)
    apart = max(1, round(seconds / float(np.median(np.diff(pairs.times)))))
    if apart >= len(pairs.times):
        raise ValueError(f"no two poses of the trajectory are {seconds:g} s apart")
    both = (pairs.aligned(), pairs.reference)
    moved, true = (np.linalg.inv(T[:-apart]) @ T[apart:] for T in both)
    error = np.linalg.inv(true) @ moved
    return {
        "seconds": seconds,
        "translation": _rms(error[:, :3, 3]),
        "rotation": _rms(np.degrees(Rotation.from_matrix(error[:, :3, :3]).magnitude())[:, None]),
        "way": _rms(true[:, :3, 3]),
    }


def alignment(*trajectories: ArrayLike) -> Similarity:
    """Return the similarity from the estimate's world to the reference's: that of
    `absolute_trajectory_error`, of the same arguments; it raises the same."""
    return _paired(*trajectories).alignment()


class _Pairs(NamedTuple):
    """Poses of the same time."""

    times: Float[np.ndarray, " k"]
    """Of the reference, s."""
    estimate: Float[np.ndarray, "k 4 4"]
    reference: Float[np.ndarray, "k 4 4"]

    def alignment(self, *, scaled: bool = True) -> Similarity:
        """The Sim(3), or SE(3), that takes the estimate to where it fits best."""
        return similarity(*(T[:, :3, 3] for T in (self.estimate, self.reference)), scaled=scaled)

    def aligned(self, *, scaled: bool = True) -> Float[np.ndarray, "k 4 4"]:
        """The estimate in the reference's world."""
        return self.alignment(scaled=scaled).moved(self.estimate)


def _paired(*trajectories: ArrayLike) -> _Pairs:
    """Poses of the same time. Raises ValueError for fewer than three."""
    times, T, true_times, true = (np.asarray(x, float) for x in trajectories)
    theirs, ours = associated(true_times, times)
    if len(ours) < 3:
        raise ValueError(
            f"{len(ours)} poses of the trajectory are within {MAX_TIME_DIFFERENCE} s of a "
            "reference pose; at least three are needed"
        )
    return _Pairs(true_times[theirs], T[ours], true[theirs])


def _rms(errors: Float[np.ndarray, "k n"]) -> float:
    """Root of the mean of their squared lengths."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _by_orientation(estimate: Transforms, reference: Transforms) -> tuple[Rotation, float]:
    """Return the mean rotation from estimated to true orientations, and `orientation_rmse`."""
    true, estimated = (Rotation.from_matrix(T[:, :3, :3]) for T in (reference, estimate))
    turn = (true * estimated.inv()).mean()
    angles = (true.inv() * turn * estimated).magnitude()
    return turn, float(np.degrees(np.sqrt(np.mean(angles**2))))


def _sign(turn: Rotation, estimate: Positions, reference: Positions) -> float:
    """Return the correlation of the positions after that rotation."""
    turned = turn.apply(estimate)
    a, b = reference - reference.mean(0), turned - turned.mean(0)
    return float(np.sum(a * b) / np.sqrt(np.sum(a**2) * np.sum(b**2)))


def _straight_line(times: Float[np.ndarray, " n"], positions: Positions) -> float:
    """RMS distance to the least squares line `a + b t`: any line can be aligned to any other."""
    centred, t = positions - positions.mean(0), times - times.mean()
    return _rms(centred - np.outer(t, t @ centred / (t @ t)))
