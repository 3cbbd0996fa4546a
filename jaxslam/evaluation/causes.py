"""The causes of a wrong NEES that lie between the logs, not in the filter.

Quaternions with w first, a constant rotation and lever arm between the bodies, two worlds, an
alignment of what the filter observes, half angles, runs that are the same. Each is named only
on strong evidence, with a number and the NEES without it; then there is no verdict.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Float

from jaxslam.evaluation.alignment import aligned, gauge_directions, nearest_rotation, similarity
from jaxslam.evaluation.convention import Convention, Matrices, geometry_of
from jaxslam.evaluation.inputs import Poses
from jaxslam.evaluation.result import Evaluation
from jaxslam.evaluation.sanity_checks import Mistake
from jaxslam.io.tum import poses as poses_of
from jaxslam.io.tum import quaternions
from jaxslam.statistics.verdict import not_disproved

Compared = Callable[[Poses, str, Sequence[str]], Evaluation]
"""The evaluation of poses with an alignment, along some axes, or as stated with none."""
ROUNDS = 8
"""Alignments, and fits of the mounting, in turn."""
UNDETERMINED = 0.05
"""The share of the largest singular value below which motion does not determine a direction."""
LESS = 3.0
"""The factor by which a constant that is fitted lessens the errors that it explains."""
TURNED = np.radians(60)
"""A rotation between worlds that is no error of a filter's first heading."""
MANY = 10
"""Poses that are equal by chance are fewer."""
WORSE = ("over-confident", "lost")
FEWEST, ALPHA = 4, 1e-3
"""The fewest runs that a constant can be common to, and the chance that one is found of none."""


def causes(
    poses: Poses, convention: Convention, align: str, found: Evaluation, compared: Compared
) -> Iterator[Mistake]:
    """The causes of an evaluation that found a filter over-confident; none of others."""
    yield from _repeated(poses)
    if not suspect(found) or convention.scale == "given":
        return
    few = poses.some()
    if few is not poses:
        poses, found = few, compared(few, align, ())
    spatial = poses.estimates.shape[-1] == 4
    turns = spatial and any(name.startswith("r") for name in found.names)
    for look in ((_w_first,) if turns else ()) + (_worlds, _tilt, _mounting):
        mistake = look(poses, convention, align, found, compared)
        if mistake is not None:
            yield mistake
            return
    if turns and (mistake := _half_angles(poses, convention, align, found, compared)):
        yield mistake


def suspect(found: Evaluation) -> bool:
    """Whether errors are larger than σ says, or are taken for ones in degrees for that."""
    return bool(found.mistakes) or found.verdict["word"] in WORSE


def _right(found: Evaluation) -> bool:
    return not found.mistakes and not_disproved(found.verdict)


def _nees(found: Evaluation) -> float:
    return float(np.mean(found.nees[found.logged]))


def _instead(found: Evaluation, fixed: Evaluation) -> str:
    return f"NEES is {_nees(fixed):.4g} instead of {_nees(found):.4g}"


def _angles(R: Float[np.ndarray, "*k n n"]) -> Float[np.ndarray, "*k"]:
    n = R.shape[-1]
    chord = np.linalg.norm(R - np.eye(n), axis=(-2, -1)) / np.sqrt(2)
    return np.asarray(2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)))


def _mean_rotation(R: Float[np.ndarray, "k n n"]) -> Float[np.ndarray, "n n"]:
    """The rotation nearest to their mean."""
    return nearest_rotation(R.mean(axis=0))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _repeated(poses: Poses) -> Iterator[Mistake]:
    """Runs, said to be independent, with the same rows: their poses are equal to the last digit."""
    if len(poses.logged) < 2:
        return
    rows = [
        {pose.tobytes() for pose in run[logged]}
        for run, logged in zip(poses.estimates, poses.logged, strict=True)
    ]
    # Poses that every run shares, such as a first one, are no copies.
    rows = [own - set.intersection(*rows) for own in rows] if len(rows) > 2 else rows
    for second in range(1, len(rows)):
        for first in range(second):
            fewest = min(len(rows[first]), len(rows[second]))
            same = len(rows[first] & rows[second])
            if same >= MANY and same > 0.5 * fewest:
                yield Mistake(
                    "the same run twice",
                    f"run {first} and run {second} share {same} of {fewest} estimates to the last "
                    "digit: they are one run, not two independent ones; leave one out",
                )
                return


def _w_first(
    poses: Poses, convention: Convention, align: str, found: Evaluation, compared: Compared
) -> Mistake | None:
    there = poses.logged

    def off(T: Matrices, true: Matrices) -> float:
        turn = np.swapaxes(T[there][:, :3, :3], 1, 2) @ true[there][:, :3, :3]
        # Up to a constant, as of another world or body.
        constant = _mean_rotation(turn)
        return float(np.median(_angles(turn @ constant.T)))

    before = off(poses.estimates, poses.truths)
    if before < np.radians(20):
        return None
    for name, which in (("estimate", "estimates"), ("truth", "truths")):
        changed = poses._replace(**{which: _reread(getattr(poses, which), there)})
        if off(changed.estimates, changed.truths) < before / 4:
            fixed = compared(changed, align, ())
            return Mistake(
                f"quaternions of the {name} have w first",
                f"rotations differ by {np.degrees(before):.3g}° (median); with the quaternions of "
                f"the {name} read as qw qx qy qz {_instead(found, fixed)}; write qx qy qz qw, or "
                "name the columns",
                _nees(fixed),
            )
    return None


def _reread(T: Matrices, there: np.ndarray) -> Matrices:
    """Poses whose quaternions, read as x, y, z, w, are w, x, y, z."""
    result = T.copy()
    q = quaternions(T[there][:, :3, :3])
    result[there] = poses_of(T[there][:, :3, 3], q[:, [1, 2, 3, 0]])
    return result


def _worlds(
    poses: Poses, convention: Convention, align: str, found: Evaluation, compared: Compared
) -> Mistake | None:
    """Positions that agree after an alignment, by a large rotation or of first poses apart."""
    if align != "none":
        return None
    n = poses.estimates.shape[-1] - 1
    before, after, scaled, first, angles, tilts = [], [], [], [], [], []
    for run, there in enumerate(poses.logged):
        p, true = poses.estimates[run, there, :n, n], poses.truths[run, there, :n, n]
        try:
            fit, scale = (similarity(p, true, scaled=x) for x in (False, True))
        except ValueError:
            return None
        before.append(_rms(p - true))
        after.append(_rms(p @ fit.rotation.T + fit.translation - true))
        scaled.append(_rms(scale.scale * p @ scale.rotation.T + scale.translation - true))
        first.append(np.linalg.norm(p[0] - true[0]))
        angles.append(float(_angles(fit.rotation)))
        tilts.append(float(np.arccos(np.clip(fit.rotation[-1, -1], -1, 1))) if n == 3 else 0.0)
    rms, left = float(np.median(before)), float(np.median(after))
    sigma = float(np.nanmedian(np.where(np.isfinite(found.sigmas), found.sigmas, np.nan)))
    apart = np.median(first) > max(0.2 * rms, 5 * sigma) or np.median(angles) > TURNED
    if not (rms > 5 * max(left, 1e-12) and apart):
        return None
    by = "yaw" if n == 3 and np.median(tilts) < np.radians(2) else "se3"
    if np.median(scaled) < left / LESS:
        by = "sim3"
    fixed = compared(poses, by, ())
    return Mistake(
        "estimate and truth are not in one world",
        f"positions differ by {rms:.3g} m (RMS) and by {left:.3g} m once aligned, by "
        f"{np.degrees(np.median(angles)):.3g}°: with --align {by} {_instead(found, fixed)}",
        _nees(fixed),
    )


def _tilt(
    poses: Poses, convention: Convention, align: str, found: Evaluation, compared: Compared
) -> Mistake | None:
    """An alignment of roll and pitch, which the filter observes; or of yaw alone, in two worlds."""
    if poses.estimates.shape[-1] != 4 or align not in ("se3", "yaw"):
        return None
    other = "yaw" if align == "se3" else "se3"
    fixed = compared(poses, other, ())
    if not _right(fixed) or _nees(fixed) > _nees(found) / 1.2:
        return None
    why = (
        "the filter knows roll and pitch, which se3 aligns too"
        if other == "yaw"
        else "the verticals of both worlds differ"
    )
    told = f"{why}: with --align {other} {_instead(found, fixed)}"
    return Mistake(f"an alignment by {align}", told, _nees(fixed))


def _mounting(
    poses: Poses, convention: Convention, align: str, found: Evaluation, compared: Compared
) -> Mistake | None:
    """A constant X between the bodies, `T = W T̂ X`: its rotation, and its lever arm."""
    best, X = found, np.eye(poses.estimates.shape[-1])
    for lever, gain in ((False, 1.5), (True, 1.2)):
        other = _fitted(poses, convention, align, X, lever=lever)
        fixed = compared(_unmounted(poses, other), align, ())
        if _nees(fixed) < _nees(best) / gain:
            best, X = fixed, other
    n = len(X) - 1
    angle, metres = float(_angles(X[:n, :n])), float(np.linalg.norm(X[:n, n]))
    moved = _unmounted(poses, X)
    if best is found:
        return None
    if not _of_body(poses, found, best, angle) and not (
        _right(best)
        and _in_all_runs(X, aligned(moved, convention, align, np.arange(len(found.names))).poses)
    ):
        return None
    parts = [f"a constant rotation of {np.degrees(angle):.4g}°"] if angle > 0 else []
    parts += [f"a lever arm of {metres:.3g} m"] if metres > 0 else []
    return Mistake(
        "estimate and truth are of two bodies",
        f"{' and '.join(parts)} between them, the same at every pose: without it "
        f"{_instead(found, best)}{_by_part(compared, moved, align, found)}; give the truth of the "
        "body that is estimated",
        _nees(best),
    )


def _fitted(
    poses: Poses, convention: Convention, align: str, X: Float[np.ndarray, "d d"], *, lever: bool
) -> Float[np.ndarray, "d d"]:
    """X by least squares, of alignments and fits in turn; its rotation from that of increments."""
    n, there = len(X) - 1, poses.logged
    axes = np.arange(geometry_of(poses.estimates).tangent_dim)
    X = X.copy()
    if not lever and n == 3:
        X[:n, :n] = _by_increments(poses)
    for _ in range(ROUNDS):
        world = aligned(_unmounted(poses, X), convention, align, axes).poses
        between = np.linalg.inv(world.estimates[there]) @ world.truths[there]
        step = np.eye(n + 1)
        step[:n, :n] = _mean_rotation(between[:, :n, :n])
        if lever:
            step[:n, n] = _lever_arm(world, align)
        X = step @ X
    return X


def _lever_arm(world: Poses, align: str) -> Float[np.ndarray, " n"]:
    """The arm l of `p = p̂ + R̂ l` by least squares of positions, whose alignment goes with it.

    Zero along directions that the rotations do not determine.
    """
    n = world.estimates.shape[-1] - 1
    rows = []
    for estimates, truths, there in zip(world.estimates, world.truths, world.logged, strict=True):
        T, off = estimates[there], (truths - estimates)[there, :n, n]
        own = np.column_stack([T[:, :n, :n].reshape(-1, n), off.ravel()])
        if align != "none":
            T[:, :n, n] -= T[:, :n, n].mean(axis=0)
            U = gauge_directions(T, align)[:, :n].reshape(len(own), -1)
            own -= U @ np.linalg.lstsq(U, own)[0]
        rows.append(own)
    both = np.concatenate(rows)
    return np.linalg.lstsq(both[:, :n], both[:, n], rcond=UNDETERMINED)[0]


def _by_increments(poses: Poses) -> Float[np.ndarray, "3 3"]:
    """C of `φ̂ = C φ`, rotation vectors from pose to pose; 1 where they do not determine it."""
    from scipy.spatial.transform import Rotation  # slow to import

    both = poses.logged[:, 1:] & poses.logged[:, :-1]
    own, true = (
        Rotation.from_matrix(
            (np.swapaxes(T[:, :-1, :3, :3], 2, 3) @ T[:, 1:, :3, :3])[both]
        ).as_rotvec()
        for T in (poses.estimates, poses.truths)
    )
    singular = np.linalg.svd(own.T @ true, compute_uv=False)
    if singular[1] < UNDETERMINED * singular[0]:
        return np.eye(3)
    return nearest_rotation(own.T @ true)


def _by_part(compared: Compared, poses: Poses, align: str, found: Evaluation) -> str:
    """The NEES of position and of rotation by themselves."""
    turns = [name for name in found.names if name.startswith("r")]
    parts = {"position": [x for x in found.names if x not in turns], "rotation": turns}
    told = [
        f"{what} {_nees(compared(poses, align, axes)):.3g} of {len(axes)}"
        for what, axes in parts.items()
        if axes
    ]
    return f" ({', '.join(told)})" if len(told) > 1 else ""


def _of_body(poses: Poses, found: Evaluation, fixed: Evaluation, angle: float) -> bool:
    """Whether the constant is one of a body beyond doubt.

    A constant error of a filter is one in its world, where a turn moves positions as well: it is
    one of the body if positions are no worse for it, or the body turns against its world.
    """
    turns = np.array([name.startswith("r") for name in found.names])
    ratio, left = (
        np.sqrt(np.mean((x.errors[x.logged] / x.sigmas[x.logged]) ** 2, axis=0))
        for x in (found, fixed)
    )
    n = poses.estimates.shape[-1] - 1
    R = poses.estimates[:, :, :n, :n][poses.logged]
    axis = poses.truths[:, :, :n, :n][poses.logged] @ np.swapaxes(R, 1, 2)
    constant = _angles(axis @ _mean_rotation(axis).T)
    in_world = turns.any() and _rms(constant) < 0.5 * angle
    few = ratio[turns].max(initial=0.0) < LESS * ratio[~turns].max(initial=0.0)
    return bool((ratio > LESS).any() and (ratio > LESS * left).any() and not (in_world and few))


def _in_all_runs(X: Float[np.ndarray, "d d"], moved: Poses) -> bool:
    """Whether X is more than the scatter of what every run alone would add to it, by a t-test."""
    n = len(X) - 1

    def parts(T: Matrices) -> np.ndarray:
        S = T[:, :n, :n] - np.swapaxes(T[:, :n, :n], 1, 2)
        return np.column_stack([T[:, :n, n], S[:, *np.triu_indices(n, 1)]])

    runs = zip(moved.estimates, moved.truths, moved.logged, strict=True)
    each = np.array(
        [parts(np.linalg.inv(T[own]) @ true[own]).mean(axis=0) for T, true, own in runs]
    )
    if len(each) < FEWEST:
        return False
    t = np.abs(parts(X[None])[0]) / (each.std(axis=0, ddof=1) / np.sqrt(len(each)))
    return bool(2 * scipy.special.stdtr(len(each) - 1, -t).min() * len(t) < ALPHA)


def _unmounted(poses: Poses, X: Float[np.ndarray, "d d"]) -> Poses:
    """With truths of the body that is estimated, `T X⁻¹`."""
    moved = poses.truths @ np.linalg.inv(X)
    return poses._replace(truths=np.where(poses.logged[..., None, None], moved, poses.truths))


def _half_angles(
    poses: Poses, convention: Convention, align: str, found: Evaluation, compared: Compared
) -> Mistake | None:
    """Covariances of the vector part of a quaternion: σ of all rotations is half, and no other."""
    factors = {name: found.axis_verdict(i) for i, name in enumerate(found.names)}
    for name, verdict in factors.items():
        low, high = verdict["interval99"]
        factor = 2.0 if name.startswith("r") else 1.0
        if not (low and high and low <= 1.05 * factor and high >= 0.95 * factor):
            return None
        if factor == 2.0 and not (1.8 < verdict["sigma_factor"] < 2.2):
            return None
    names: Sequence[str] = convention.names(geometry_of(poses.estimates))
    scale = np.array([2.0 if name.startswith("r") else 1.0 for name in names])
    fixed = compared(
        poses._replace(covariances=scale[:, None] * poses.covariances * scale), align, ()
    )
    if not _right(fixed):
        return None
    return Mistake(
        "half angles",
        "σ of all rotations is half of the right one, and that of positions right, as if the "
        f"covariances were of the vector part of a quaternion (g2o): with angle=half in their "
        f"header {_instead(found, fixed)}. If they are of angles, the filter is over-confident",
        _nees(fixed),
    )
