"""Trajectories and their covariances as text, and their error against a reference, by `evo`."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxslam.evaluation import covariance_text
from jaxslam.evaluation.alignment import MAX_TIME_DIFFERENCE, Similarity, similarity
from jaxslam.evaluation.arrays import ROUNDING, exactly_known, normalised
from jaxslam.evaluation.convention import Convention, errors_beyond_scale, pose_errors
from jaxslam.io.tum import write_tum
from jaxslam.statistics.beyond_scale import one_scale

TRACKED = Convention("split", "body")
"""The error whose covariances are written: position in the camera's axes, rotation vector."""

_UNITS = "one unit of length a map, another in every map of frames.csv"
_GIVEN_SCALE = (
    "of poses in that unit, of which sigma_log_scale of frames.csv is in doubt; "
    "where unit_fixed is 0 there, it is nearly the same unit"
)


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


class RelativeError(TypedDict):
    """What `relative_pose_error` returns."""

    seconds: float
    translation: float
    rotation: float
    way: float


def write_trajectory(path: str | Path, times: ArrayLike, T_wc: ArrayLike) -> None:
    """Write times (n,) in seconds and poses (n, 4, 4) in TUM format, whole or not at all.

    All poses of a map are in one unit of length (docs/gauge.md), and the header says so.
    """
    write_tum(path, times, T_wc, _UNITS)


def write_covariances(
    path: str | Path,
    times: ArrayLike,
    covariances: ArrayLike,
    *,
    given_scale: bool = False,
    caveat: str = "",
) -> None:
    """Write times (n,) and covariances (n, 6, 6) of the `TRACKED` error, whole or not at all.

    They are of poses in the one unit of their map; that maps which follow one another have others
    is not in them. The header says whether these are covariances `given_scale`, of a filter with a
    unit of its own, of whose size in metres it is in doubt, or of poses in a unit that the filter
    takes for exactly known; and the caveat, if there is one.
    """
    convention = replace(TRACKED, scale="given" if given_scale else "marginal")
    scale = _GIVEN_SCALE if given_scale else "the filter has no doubt of its scale"
    remark = "; ".join(filter(None, [f"{_UNITS}, taken as one", scale, caveat]))
    covariance_text.write_covariances(
        path, times, covariances, convention, length="map", remark=remark
    )


def pose_nees(
    T_wc: ArrayLike, covariances: ArrayLike, reference: ArrayLike
) -> Float[np.ndarray, " n"]:
    """`eᵀ P⁻¹ e` of poses (n, 4, 4), e the `TRACKED` error; ideally 6.

    The reference has the world frame and the unit of the map, as a simulation's has. Of a pose
    that is `exactly_known` it is 0 where the pose is right, to the rounding of the files, and
    infinite where it is not. Raises `ValueError` for any other covariance that is not positive.
    """
    errors = pose_errors(TRACKED, *(np.asarray(T, float) for T in (T_wc, reference)))
    covariances = np.asarray(covariances, float)
    known = exactly_known(covariances)
    nees = np.where(np.linalg.norm(errors, axis=1) <= ROUNDING, 0.0, np.inf)
    nees[~known] = normalised(errors[None, ~known], covariances[None, ~known])[0]
    return nees


class BeyondScale(NamedTuple):
    """Of n poses of a map against a reference of another scale."""

    nees: Float[np.ndarray, " n"]
    """NEES at the map's scale: 6 degrees of freedom each, less one for the map."""
    scale: Float[np.ndarray, " n"]
    """The scale of the reference's position that explains this pose alone best."""
    sigma: Float[np.ndarray, " n"]
    """What is claimed of the log of that."""
    drift: Float[np.ndarray, " n"]
    """Log of that by the map's; NaN where it has no part in it."""


def nees_beyond_scale(
    T_wc: ArrayLike, covariances: ArrayLike, reference: ArrayLike, fixed: ArrayLike | None = None
) -> BeyondScale:
    """NEES of poses (n, 4, 4) of one map at the one scale of the reference that explains them best:
    `consistency.one_scale` of the `TRACKED` error.

    Poses whose unit is not `fixed` (n,) are at their own best scale, with a degree of freedom less,
    and have no part in the map's.
    """
    arrays = (np.asarray(x, float) for x in (T_wc, reference, covariances))
    best = errors_beyond_scale(TRACKED, *arrays)
    one = one_scale(
        np.asarray(best.nees),
        np.asarray(best.log_scale),
        np.asarray(best.sigma),
        None if fixed is None else np.asarray(fixed, bool),
    )
    return BeyondScale(
        one.nees, np.exp(np.asarray(best.log_scale)), np.asarray(best.sigma), one.drift
    )


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


def relative_pose_error(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
    seconds: float = 1.0,
) -> RelativeError:
    """The relative pose error over `seconds`, by `evo`: how far a motion of that long is off.

    RMS over all pairs of poses so far apart: of the `translation`, in the reference's unit, and of
    the `rotation`, in degrees; `way` is the reference's own displacement, RMS. Of the alignment
    only its scale matters. Arguments are those of
    `absolute_trajectory_error`, and so is what is raised; also for a trajectory that is shorter.
    """
    from evo.core import metrics

    paired, paired_reference = _paired(estimate_times, estimate, reference_times, reference)
    _align(paired, paired_reference)
    apart = max(1, round(seconds / float(np.median(np.diff(paired_reference.timestamps)))))
    if apart >= paired.num_poses:
        raise ValueError(f"no two poses of the trajectory are {seconds:g} s apart")

    def rms(relation: Any) -> float:
        error = metrics.RPE(relation, apart, metrics.Unit.frames, all_pairs=True)
        error.process_data((paired_reference, paired))
        return float(error.get_statistic(metrics.StatisticsType.rmse))

    translation = rms(metrics.PoseRelation.translation_part)
    rotation = rms(metrics.PoseRelation.rotation_angle_deg)
    ways = paired_reference.positions_xyz[apart:] - paired_reference.positions_xyz[:-apart]
    way = float(np.sqrt(np.mean(np.sum(ways**2, axis=1))))
    return {"seconds": seconds, "translation": translation, "rotation": rotation, "way": way}


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
        found = similarity(paired.positions_xyz, paired_reference.positions_xyz, scaled=True)
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


def _too_few(count: int) -> str:
    return (
        f"{count} poses of the trajectory are within {MAX_TIME_DIFFERENCE} s of one of the "
        "reference's; at least three are needed"
    )
