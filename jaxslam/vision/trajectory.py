"""Trajectories and their covariances as text, and their error against a reference, by `evo`."""

from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxslam.files import write_atomically

# A pose and a reference pose further apart in time than this (s) are not compared; evo's default.
MAX_TIME_DIFFERENCE = 0.01
# Nine decimals of two files: their poses can differ by 4e-9 (map units and rad), and be the same.
_ROUNDING = 1e-8

_UNITS = "every map of frames.csv has a unit of its own"
_GIVEN_SCALE = "given the scale of its map, of which sigma_log_scale of frames.csv is in doubt"


class TrajectoryError(TypedDict):
    """What `absolute_trajectory_error` returns; lengths in the reference's unit."""

    alignment: str
    rmse: float
    path_length: float
    extent: float
    matched: int
    sign: float
    orientation_rmse: float
    straight_line: float


class Similarity(NamedTuple):
    """`x → s R x + t`, of world frames: a Sim(3)."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    scale: float

    def inverse(self) -> "Similarity":
        """`x → R' (x − t)/s`."""
        back = self.rotation.T
        return Similarity(back, -back @ self.translation / self.scale, 1 / self.scale)

    def moved(self, T_wc: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """The poses in the other world."""
        result = T_wc.copy()
        result[:, :3, :3] = self.rotation @ T_wc[:, :3, :3]
        result[:, :3, 3] = self.scale * T_wc[:, :3, 3] @ self.rotation.T + self.translation
        return result


def write_tum(path: str | Path, times: ArrayLike, T_wc: ArrayLike) -> None:
    """Write times (n,) in seconds and poses (n, 4, 4) in TUM format, whole or not at all.

    Quaternions are normalised, w comes last and is not negative.
    """
    T_wc = np.asarray(T_wc, dtype=float).reshape(-1, 4, 4)
    table = np.empty((len(T_wc), 7))
    table[:, :3] = T_wc[:, :3, 3]
    if len(T_wc):  # Rotation refuses an empty stack
        table[:, 3:] = Rotation.from_matrix(T_wc[:, :3, :3]).as_quat(canonical=True)
    header = f"tx ty tz qx qy qz qw (s; camera in the world frame; {_UNITS})"
    _write_rows(path, header, times, table, "poses", ".9f")


def write_covariances(
    path: str | Path, times: ArrayLike, covariances: ArrayLike, *, given_scale: bool = False
) -> None:
    """Write times (n,) and covariances (n, 6, 6), whole or not at all.

    A line is the time and the upper triangle, row by row: position in the camera's axes, rotation
    vector. The true pose is `T_wc E`, and that is the covariance of E's translation and rotation
    vector. That maps which follow one another have different units of length is not in it. The
    header says whether these are covariances `given_scale`, of a filter with a unit of its own, or
    of poses in a unit that the filter takes for exactly known.
    """
    rows, columns = np.triu_indices(6)
    table = np.asarray(covariances, dtype=float).reshape(-1, 6, 6)[:, rows, columns]
    names = ("x", "y", "z", "rx", "ry", "rz")
    pairs = " ".join(f"{names[i]}{names[j]}" for i, j in zip(rows, columns, strict=True))
    scale = _GIVEN_SCALE if given_scale else "the filter has no doubt of its scale"
    header = f"{pairs} (s; map units and rad, in the camera frame; {_UNITS}, taken as one; {scale})"
    _write_rows(path, header, times, table, "covariances", ".9e")


def _write_rows(
    path: str | Path, header: str, times: ArrayLike, table: np.ndarray, what: str, number: str
) -> None:
    """A line of each time and row, under a comment that names the columns after the time."""
    times = np.asarray(times, dtype=float)
    if times.shape != (len(table),):
        raise ValueError(
            f"{len(times)} times for {len(table)} {what}; as many of each are accepted"
        )
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f"# t {header}\n")
        for time, row in zip(times, table, strict=True):
            file.write(f"{time:.9f} " + " ".join(format(value, number) for value in row) + "\n")


def read_covariances(
    path: str | Path,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 6 6"]]:
    """What `write_covariances` wrote."""
    table = np.loadtxt(path, ndmin=2)
    covariances = np.zeros((len(table), 6, 6))
    rows, columns = np.triu_indices(6)
    covariances[:, rows, columns] = covariances[:, columns, rows] = table[:, 1:]
    return table[:, 0], covariances


def exactly_known(covariances: ArrayLike) -> Bool[np.ndarray, " n"]:
    """Which of the covariances (n, 6, 6) are zero: poses that are known by definition.

    The first camera is the world frame, so every file begins with one. They have no degree of
    freedom, and are to be left out of a mean NEES.
    """
    return ~np.any(np.asarray(covariances, float), axis=(1, 2))


def pose_nees(
    T_wc: ArrayLike, covariances: ArrayLike, reference: ArrayLike
) -> Float[np.ndarray, " n"]:
    """`eᵀ P⁻¹ e` of poses (n, 4, 4), e of `T_wc⁻¹ T_true` as in `write_covariances`; ideally 6.

    The reference has the world frame and the unit of the map, as a simulation's has. Of a pose
    that is `exactly_known` it is 0 where the pose is right, to the rounding of the files, and
    infinite where it is not. Raises `ValueError` for any other singular covariance.
    """
    E = np.linalg.inv(np.asarray(T_wc, float)) @ np.asarray(reference, float)
    errors = np.hstack([E[:, :3, 3], Rotation.from_matrix(E[:, :3, :3]).as_rotvec()])
    covariances = np.asarray(covariances, float)
    known = exactly_known(covariances)
    nees = np.where(np.linalg.norm(errors, axis=1) <= _ROUNDING, 0.0, np.inf)
    try:
        solved = np.linalg.solve(covariances[~known], errors[~known, :, None])[..., 0]
    except np.linalg.LinAlgError:
        raise ValueError(
            "the covariance of a pose is singular; a positive one, or zero, is accepted"
        ) from None
    nees[~known] = np.sum(errors[~known] * solved, axis=1)
    return nees


def nees_beyond_scale(
    T_wc: ArrayLike, covariances: ArrayLike, reference: ArrayLike
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The least NEES of each pose (n, 4, 4) over the scale s > 0 of the reference's position, and
    that scale; χ² with 5 degrees of freedom for covariances that are true given the scale.

    The error as in `pose_nees` is affine in s, `e(s) = a s + b`, so that
    `s = −aᵀ P⁻¹ b / aᵀ P⁻¹ a`. Where the reference has not moved, s is 1.
    """
    T_wc, reference = np.asarray(T_wc, float), np.asarray(reference, float)
    to_camera = np.swapaxes(T_wc[:, :3, :3], 1, 2)
    turn = Rotation.from_matrix(to_camera @ reference[:, :3, :3]).as_rotvec()

    def in_camera(positions: Float[np.ndarray, "n 3"], rest: ArrayLike) -> np.ndarray:
        moved = np.einsum("nij,nj->ni", to_camera, positions)
        return np.hstack([moved, np.broadcast_to(rest, turn.shape)])

    a = in_camera(reference[:, :3, 3], 0.0)
    b = in_camera(-T_wc[:, :3, 3], turn)
    solved = np.linalg.solve(np.asarray(covariances, float), np.stack([a, b], axis=2))
    aa, ab = (np.einsum("ni,ni->n", a, solved[..., k]) for k in (0, 1))
    scale = np.where(aa > 0, np.maximum(-ab / np.where(aa > 0, aa, 1.0), 1e-3), 1.0)
    error = scale[:, None] * a + b
    weighed = np.einsum("ni,nik->nk", error, solved)
    return scale * weighed[:, 0] + weighed[:, 1], scale


def absolute_trajectory_error(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
) -> TrajectoryError:
    """The absolute trajectory error of the positions after a Sim(3) alignment, by `evo`.

    Times (n,) and (m,) in seconds, poses (n, 4, 4) and (m, 4, 4). `evo` pairs poses by their
    times (`MAX_TIME_DIFFERENCE`) and aligns the estimate with scale (Umeyama's method).
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
    from evo.core import metrics

    paired, paired_reference = _paired(estimate_times, estimate, reference_times, reference)
    estimated, true = np.stack(paired.poses_se3), np.stack(paired_reference.poses_se3)
    _align(paired, paired_reference)
    sign, angle = _by_orientation(estimated, true)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((paired_reference, paired))
    return {
        "alignment": "sim3",
        "rmse": float(error.get_statistic(metrics.StatisticsType.rmse)),
        "path_length": float(paired_reference.path_length),
        "extent": float(np.linalg.norm(np.ptp(paired_reference.positions_xyz, axis=0))),
        "matched": int(paired.num_poses),
        "sign": sign,
        "orientation_rmse": angle,
        "straight_line": _straight_line(paired_reference.timestamps, true[:, :3, 3]),
    }


def alignment(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
) -> Similarity:
    """From the estimate's world to the reference's: that of `absolute_trajectory_error`, which is
    of the same arguments and raises the same."""
    return _align(*_paired(estimate_times, estimate, reference_times, reference))


def _paired(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
) -> tuple[Any, Any]:
    """Estimate and reference as `evo` has them, pose by pose of the same time."""
    from evo.core import sync

    try:
        paired_reference, paired = sync.associate_trajectories(
            _evo_trajectory(reference_times, reference),
            _evo_trajectory(estimate_times, estimate),
            max_diff=MAX_TIME_DIFFERENCE,
        )
    except sync.SyncException:
        raise ValueError(_too_few(0)) from None
    if paired.num_poses < 3:
        raise ValueError(_too_few(paired.num_poses))
    return paired, paired_reference


def _evo_trajectory(times: ArrayLike, T_wc: ArrayLike) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    T_wc = np.asarray(T_wc, dtype=float)
    # evo reads the scalar first; poses_se3 alone would make it check float32 too strictly.
    x, y, z, w = Rotation.from_matrix(T_wc[:, :3, :3]).as_quat().T
    return PoseTrajectory3D(T_wc[:, :3, 3], np.stack([w, x, y, z], 1), np.asarray(times, float))


def _align(paired: Any, paired_reference: Any) -> Similarity:
    """Move the estimate to where it fits best, in place; by what."""
    from evo.core import lie_algebra
    from evo.core.geometry import GeometryException

    try:
        return Similarity(*paired.align(paired_reference, correct_scale=True))
    except GeometryException:  # a straight line, about which evo leaves the roll open: see below
        found = _line_alignment(paired.positions_xyz, paired_reference.positions_xyz)
        paired.scale(found.scale)
        paired.transform(lie_algebra.se3(found.rotation, found.translation))
        return found


def _by_orientation(
    estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"]
) -> tuple[float, float]:
    """`sign` and `orientation_rmse`, by the mean rotation from estimated to true orientations."""
    true, estimated = (Rotation.from_matrix(T[:, :3, :3]) for T in (reference, estimate))
    turn = (true * estimated.inv()).mean()
    angles = (true.inv() * turn * estimated).magnitude()
    positions, turned = reference[:, :3, 3], turn.apply(estimate[:, :3, 3])
    a, b = positions - positions.mean(0), turned - turned.mean(0)
    sign = np.sum(a * b) / np.sqrt(np.sum(a**2) * np.sum(b**2))
    return float(sign), float(np.degrees(np.sqrt(np.mean(angles**2))))


def _straight_line(times: Float[np.ndarray, " n"], positions: Float[np.ndarray, "n 3"]) -> float:
    """RMS distance to the least squares line `a + b t`: any line can be aligned to any other."""
    centred, t = positions - positions.mean(0), times - times.mean()
    rest = centred - np.outer(t, t @ centred / (t @ t))
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def _line_alignment(
    estimate: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "n 3"]
) -> Similarity:
    """Umeyama's rotation, translation and scale without the test that the rank is two.

    On a straight line the rotation about it is arbitrary, but no position depends on it where
    the reference is the line, so that the error is the smallest one all the same.
    """
    mean_estimate, mean_reference = estimate.mean(0), reference.mean(0)
    centred, target = estimate - mean_estimate, reference - mean_reference
    left, singular, right = np.linalg.svd(target.T @ centred)
    if singular[0] <= 1e-12 * np.sum(target**2) or not np.any(target):
        raise ValueError("all poses of a trajectory are in one place; a Sim(3) needs a motion")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(singular @ signs / np.sum(centred**2))
    return Similarity(rotation, mean_reference - scale * rotation @ mean_estimate, scale)


def _too_few(count: int) -> str:
    return (
        f"{count} poses of the trajectory are within {MAX_TIME_DIFFERENCE} s of one of the "
        "reference's; at least three are needed"
    )
