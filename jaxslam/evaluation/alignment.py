"""The alignment of trajectories of different worlds, and of their covariances.

A trajectory that nothing ties to the world is known up to a rigid motion, and from images alone up
to a similarity: a gauge. A covariance is of errors in one gauge, and aligning the trajectory to
the truth is a change of gauge (Zhang, Gallego, Scaramuzza, RA-L 2018). To first order the errors e
of all poses become `e − U (Vᵀ U)⁻¹ Vᵀ e`, the oblique projection along the gauge's directions U
onto the errors that the alignment leaves as they are, `Vᵀ e = 0`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxslam.evaluation.convention import (
    Axes,
    Convention,
    Joints,
    Matrices,
    Squares,
    blocks,
    change,
    converted,
    geometry_of,
    lever,
)
from jaxslam.evaluation.inputs import MOST, Poses, exactly_known
from jaxslam.statistics.bands import PerStep

Positions = Float[np.ndarray, "k n"]
ALIGNMENTS = ("none", "first", "yaw", "se3", "sim3")
MAX_TIME_DIFFERENCE = 0.01
"""The largest time difference of poses that are compared, s; evo's default."""
_SPLIT = Convention("split", "world")
"""The error in which gauge directions are written."""


class Similarity(NamedTuple):
    """A similarity `x → s R x + t` of world frames: an element of Sim(n)."""

    rotation: Float[np.ndarray, "n n"]
    translation: Float[np.ndarray, " n"]
    scale: float

    def inverse(self) -> Similarity:
        """Return `x → R' (x − t)/s`."""
        back = self.rotation.T
        return Similarity(back, -back @ self.translation / self.scale, 1 / self.scale)

    def moved(self, T_wc: Matrices) -> Matrices:
        """Return the poses in the other world."""
        n, result = T_wc.shape[-1] - 1, T_wc.copy()
        result[..., :n, :n] = self.rotation @ T_wc[..., :n, :n]
        result[..., :n, n] = self.scale * T_wc[..., :n, n] @ self.rotation.T + self.translation
        return result

    @property
    def block(self) -> Float[np.ndarray, "t t"]:
        """The derivative of an error of a pose, split along the axes of the world."""
        n = len(self.translation)
        B = np.eye(6 if n == 3 else 3)
        B[:n, :n] = self.scale * self.rotation
        if n == 3:
            B[n:, n:] = self.rotation
        return B


def associated(
    first: Float[np.ndarray, " n"], second: Float[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """The indices of the times that belong together, as evo pairs them.

    Each of the shorter has the nearest of the longer, within `MAX_TIME_DIFFERENCE`.
    """
    if len(first) < len(second):
        return associated(second, first)[::-1]
    order = np.argsort(first, kind="stable")
    after = np.clip(np.searchsorted(first[order], second), 1, max(len(first) - 1, 1))
    beside = order[np.stack([after - 1, np.minimum(after, len(first) - 1)])]
    away = np.abs(first[beside] - second)
    close = np.flatnonzero(away.min(axis=0) <= MAX_TIME_DIFFERENCE)
    return np.where(away[1] < away[0], beside[1], beside[0])[close], close


def yaw_alone(M: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The rotation about the vertical that is nearest to M: it makes `tr Rᵀ M` the greatest."""
    angle = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    R = np.eye(len(M))
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return R


def nearest_rotation(M: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The rotation that makes `tr Rᵀ M` the greatest (Kabsch 1976)."""
    left, _, right = np.linalg.svd(M)
    signs = np.ones(len(M))
    signs[-1] = np.sign(np.linalg.det(left @ right))
    return left * signs @ right


def angles(R: Matrices, others: np.ndarray) -> np.ndarray:
    """The angles between rotations."""
    chord = np.linalg.norm(R - others, axis=(-2, -1)) / np.sqrt(2)
    return np.asarray(2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)))


def apart(R: Matrices, others: np.ndarray) -> float:
    """The median angle between rotations, up to a constant, as of another world or body."""
    turn = np.swapaxes(R, 1, 2) @ others
    return float(np.median(angles(turn, nearest_rotation(turn.mean(axis=0)))))


TURNED = np.radians(20)
"""Rotations that are apart by more are misread, if they are by a quarter of it when read anew."""


def similarity(
    estimate: Positions, reference: Positions, *, scaled: bool, yaw: bool = False
) -> Similarity:
    """Umeyama's least squares of positions (TPAMI 1991), without the test that the rank is two; or
    by a rotation about the vertical alone, `yaw`.

    On a straight line the rotation about it is arbitrary, but no position depends on it where
    the reference is the line, so the error is nevertheless the smallest one. Raises ValueError
    where all positions of one coincide.
    """
    mean_estimate, mean_reference = estimate.mean(0), reference.mean(0)
    centred, target = estimate - mean_estimate, reference - mean_reference
    M = target.T @ centred
    if not yaw and (np.linalg.norm(M) <= 1e-12 * np.sum(target**2) or not np.any(target)):
        name = "Sim(3)" if scaled else "SE(3)"
        raise ValueError(
            f"all positions of a trajectory coincide; an alignment by {name} needs motion"
        )
    rotation = yaw_alone(M) if yaw else nearest_rotation(M)
    scale = float(np.sum(rotation * M) / np.sum(centred**2)) if scaled else 1.0
    return Similarity(rotation, mean_reference - scale * rotation @ mean_estimate, scale)


def turned_about(fit: Similarity, line: Float[np.ndarray, " 3"], run: Poses) -> Similarity:
    """A fit whose rotation about a line is that of all orientations, not of the positions.

    Exp(φ line) makes `Σ tr R_refᵀ R_fit Exp(φ line) R_est` the greatest. To first order
    `Σ lineᵀ δθ = 0`, of rotations along the axes of the estimate's world.
    """
    T, true = run.estimates, run.truths
    M = np.einsum("kij,klj->il", T[:, :3, :3], true[:, :3, :3]) @ fit.rotation
    K = -lever(line)
    angle = np.arctan2(np.trace(K @ M), np.trace(M) - line @ M @ line)
    turn = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    rotation = fit.rotation @ turn
    centre, target = T[:, :3, 3].mean(0), true[:, :3, 3].mean(0)
    return Similarity(rotation, target - fit.scale * rotation @ centre, fit.scale)


def projected(
    run: Poses, line: Float[np.ndarray, " 3"] | None = None
) -> tuple[Squares, Float[np.ndarray, " k"]]:
    """The covariances of an aligned run in the gauge of `similarity`, `Σ U_posᵀ e_pos = 0`.

    About a `line` it is that of `turned_about`. Errors, which are split along the axes of the
    world, are taken as independent of each other's where there is no joint covariance. With
    W = (VᵀU)⁻¹ the k-th block of `Q P Qᵀ` is
    `P_kk − U_k W (VᵀP)_k − (…)ᵀ + U_k W VᵀPV Wᵀ U_kᵀ`. Also returns how large NEES may be if they
    are dependent, by `most_nees`: of N errors, whatever they are, `VᵀPV` is at most N times that.
    """
    P, n, result = run.covariances, run.truths.shape[-1] - 1, np.empty_like(run.covariances)
    most = np.ones(len(P))

    def directions(part: slice) -> tuple[np.ndarray, np.ndarray]:
        U = gauge_directions(run.estimates[part], run.align)
        V = U.copy()  # of the errors that the fit leaves as they are, Σ Vᵀ e = 0
        V[:, n:] = 0
        if line is not None:
            about = np.outer(line, line)
            V[:, :3, 3:6] = V[:, :3, 3:6] @ (np.eye(3) - about)
            V[:, 3:, 3:6] = about
        return U, V

    of_joint = None
    if run.joint is not None:
        joint = run.joint.reshape(*P.shape[:2], *P.shape[:2])
        of_joint = np.einsum("kta,ktju->jau", directions(slice(None))[1], joint)

    def of(part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        U, V = directions(part)
        return U, V, np.swapaxes(V, 1, 2) @ P[part] if of_joint is None else of_joint[part]

    parts = [*blocks(len(P))]
    sums = [(np.einsum("kta,ktb->ab", V, U), np.sum(VP @ V, axis=0)) for U, V, VP in map(of, parts)]
    VU, VPV = map(sum, zip(*sums, strict=True))
    W = np.linalg.pinv(VU)
    for part in parts:
        U, _, VP = of(part)
        UW = U @ W
        lost, fitted = UW @ VP, UW @ VPV @ np.swapaxes(UW, 1, 2)
        result[part] = P[part] - lost - np.swapaxes(lost, 1, 2) + fitted
        if of_joint is None:
            most[part] = most_nees(P[part], len(P) * fitted, result[part], run.axes)
    return result, most


def most_nees(
    own: Squares, moved: Squares, assumed: Squares, axes: Axes
) -> Float[np.ndarray, " k"]:
    """The most mean NEES/n of errors that are those of `own` and of `moved` covariances together,
    however both correlate: `(√tr A⁻¹P + √tr A⁻¹M)²/n`, with the `assumed` covariance A."""
    A, *both = (x[:, axes[:, None], axes] for x in (assumed, own, moved))
    scale = np.sqrt(np.maximum(np.diagonal(A, axis1=1, axis2=2), np.finfo(float).tiny))
    with np.errstate(over="ignore"):
        A, *both = (
            np.clip(x / scale[:, :, None] / scale[:, None], -1e150, 1e150) for x in (A, *both)
        )
    A += 1e-9 * np.eye(len(axes))  # a fit of few poses leaves no variance in some directions
    share = (np.trace(np.linalg.solve(A, x), axis1=1, axis2=2) / len(axes) for x in both)
    return sum(np.sqrt(np.maximum(x, 0.0)) for x in share) ** 2


def gauge_directions(T_wc: Float[np.ndarray, "k d d"], align: str) -> Float[np.ndarray, "k t g"]:
    """The errors (split, world) of the poses by a change of gauge, which no measurement determines.

    They are a translation, a rotation about the origin (`yaw`: about the vertical) and, of `sim3`,
    the log of a scale.
    """
    scaled = align == "sim3"
    n, t = T_wc.shape[-1] - 1, geometry_of(T_wc).tangent_dim
    positions = T_wc[:, :n, n]
    U = np.zeros((len(T_wc), t, t + scaled))
    U[:, :, :t] = np.eye(t)
    U[:, :n, n:t] = lever(positions)
    if scaled:
        U[:, :n, t] = positions
    return U[:, :, [0, 1, 2, 5]] if align == "yaw" and n == 3 else U


BY_FIRST = "aligned at the first pose, which the covariances treat as known"
BY_ANY = "aligned at the first pose, whose covariance is added to the others'"
BY_SMALL = "aligned at the first pose, whose σ is small beside the others'"
BY_FIRSTS = (BY_FIRST, BY_ANY, BY_SMALL)
TO_ALL = "aligned with all positions; the joint covariance is projected to that gauge"
INDEPENDENT = (
    "aligned with all positions; the covariances are projected to that gauge as if the errors of "
    "different poses were independent, because there is no joint covariance"
)
STRAIGHT = (
    "within their σ, the positions lie on a straight line: the rotation about it is aligned by the "
    "orientations"
)


class Aligned(NamedTuple):
    """The poses in the world of the truth."""

    poses: Poses
    given: bool
    """Whether their scale is still free, so that NEES is given the scale."""
    notes: tuple[str, ...] = ()
    """How they were aligned."""
    log_scale: Float[np.ndarray, " runs"] = np.zeros(0)
    """The log of the estimate's unit relative to the truth's, of what was done to every run."""
    most: PerStep | None = None
    """The most that NEES/n of a right filter is on average, where errors of different poses, whose
    correlations are unknown, are taken as independent."""


def aligned(poses: Poses) -> Aligned:
    """The estimates aligned by `none`, `first`, `yaw` (and position), `se3` or `sim3`.

    Where the first pose is known, with no variance on the axes that are compared, or a small one,
    it is by the first pose, and with `first` in any case; else to all positions. The first position
    then is the origin, also of scaling. Raises ValueError for what does not go together.
    """
    align, given = poses.align, poses.convention.scale == "given"
    if align == "none":
        return Aligned(poses, given)
    firsts = range(len(poses.logged)), np.argmax(poses.logged, axis=1)
    here = in_convention(poses, _SPLIT)
    if exactly_known(poses.at(firsts).along_axes()).all():
        notes = (BY_FIRST,)
    elif align == "first":
        notes = (BY_ANY,)
    elif not given and align != "sim3" and _small_at_first(here):
        notes = (BY_SMALL,)
    elif given and align != "sim3":
        raise ValueError(
            "covariances given the scale need --align sim3, or se3 if the first covariance is zero"
        )
    else:
        notes = (TO_ALL if poses.joint is not None else INDEPENDENT,)
        if align != "yaw" and any(_line(run) is not None for run in _runs(here)):
            notes += (STRAIGHT,)
    if by_first := notes[0] in BY_FIRSTS:
        truths = here.truths.copy()
        truths[..., :-1, -1] -= here.truths[firsts][:, None, :-1, -1]
        here, given = here._replace(truths=truths), given or align == "sim3"
    T, P, motions, most = here.estimates.copy(), here.covariances, [], np.ones(poses.logged.shape)
    for run, own, logged in zip(_runs(here), P, poses.logged, strict=True):
        motion, of_run, of_most = _by_first(run, notes[0]) if by_first else _to_all(run)
        T[len(motions), logged] = motion.moved(run.estimates)
        most[len(motions), logged] = of_most
        for part in blocks(len(of_run)):
            of_run[part] = motion.block @ of_run[part] @ motion.block.T
        own[logged] = of_run
        motions.append(motion)
    joint = None
    if by_first and here.joint is not None and notes[0] != BY_ANY:
        B = np.array([motion.block for motion in motions])[:, None]
        joint = _joint(here.joint, np.broadcast_to(B, P.shape))
    log_scale = -np.log([motion.scale for motion in motions])
    moved = in_convention(here._replace(estimates=T, joint=joint), poses.convention)
    return Aligned(moved, given, notes, log_scale, most)


def in_convention(poses: Poses, new: Convention) -> Poses:
    """The same poses, with covariances of errors of another convention."""
    T, old, joint = poses.estimates, poses.convention, poses.joint
    P = converted(poses.covariances, T, old, new)
    if joint is not None:
        joint = _joint(joint, change(T, old, new))
    return poses._replace(covariances=P, convention=new, joint=joint)


def _joint(P: Joints, J: Float[np.ndarray, "runs steps t t"]) -> Joints:
    """`J P Jᵀ` of joint covariances."""
    of_blocks = P.reshape(*J.shape[:3], *J.shape[1:3])
    return np.einsum("rkab,rkblc,rldc->rkald", J, of_blocks, J, optimize=True).reshape(P.shape)


def _runs(poses: Poses) -> Iterator[Poses]:
    """Yield every run by itself, of the poses that were logged."""
    for run, logged in enumerate(poses.logged):
        own, joint = (slice(None) if logged.all() else logged), None
        if poses.joint is not None:
            rows = np.flatnonzero(np.repeat(logged, poses.covariances.shape[-1]))
            joint = poses.joint[run][np.ix_(rows, rows)]
        yield poses.at((run, own), joint)


def _small_at_first(poses: Poses) -> bool:
    """Whether what the error of a run's first pose moves the others by is small beside their σ.

    The farther a pose is, the more it is moved by the rotation of the first.
    """
    poses = poses.some()
    n = poses.estimates.shape[-1] - 1
    upright = poses.align == "yaw" and n == 3
    for run in _runs(poses):
        moved = _moved_by_first(run)
        for part in (slice(0, n), slice(5, 6) if upright else slice(n, None)):
            variance, own = (
                np.diagonal(x, axis1=1, axis2=2)[:, part].max(axis=1)
                for x in (moved, run.covariances)
            )
            if np.median(variance) > 0.5**2 * np.median(own):  # half of σ
                return False
    return True


def _moved_by_first(run: Poses) -> Squares:
    """The covariances of what the error of the first pose moves every pose by, `U_k U₀⁻¹ e₀`, along
    the directions that are aligned."""
    U, n = gauge_directions(run.estimates, run.align), run.truths.shape[-1] - 1
    fixed = np.array([0, 1, 2, 5]) if run.align == "yaw" and n == 3 else np.arange(U.shape[1])
    J = U @ np.linalg.inv(U[0, fixed])
    return J @ run.covariances[0][np.ix_(fixed, fixed)] @ np.swapaxes(J, 1, 2)


def _by_first(run: Poses, how: str) -> tuple[Similarity, Squares, Float[np.ndarray, " k"]]:
    """The rigid motion that takes the first pose to the true one, or its position and yaw.

    The error of that pose moves all others; where its σ is not small, its covariance is added to
    theirs as if both were independent.
    """
    P, n, most = run.covariances, run.truths.shape[-1] - 1, np.ones(len(run.estimates))
    if how == BY_ANY or (how != BY_FIRST and run.joint is None):
        P, moved = P.copy(), _moved_by_first(run)
        P[1:] += (how == BY_ANY) * moved[1:]
        most = most_nees(run.covariances, moved, P, run.axes)
    R = (run.truths[0] @ np.linalg.inv(run.estimates[0]))[:n, :n]
    R = yaw_alone(R) if run.align == "yaw" else R
    return Similarity(R, run.truths[0, :n, n] - R @ run.estimates[0, :n, n], 1.0), P, most


def _to_all(run: Poses) -> tuple[Similarity, Squares, Float[np.ndarray, " k"]]:
    """The similarity that takes all positions nearest to the true ones."""
    n, yaw, line = run.truths.shape[-1] - 1, run.align == "yaw", None
    positions = run.estimates[:, :n, n], run.truths[:, :n, n]
    fit = similarity(*positions, scaled=run.align == "sim3", yaw=yaw)
    if not yaw and (line := _line(run)) is not None:
        fit = turned_about(fit, line, run)
    return fit, *projected(run, line)


def _line(run: Poses) -> Float[np.ndarray, " n"] | None:
    """The direction of a line that fits the estimate, by the largest σ of every position; None
    where none does.

    A fit of positions then does not determine the rotation about it, and would fit that to noise.
    """
    n, every = run.estimates.shape[-1] - 1, -(-len(run.estimates) // MOST)
    positions = run.estimates[::every, :n, n]
    _, singular, right = np.linalg.svd(positions - positions.mean(0), full_matrices=False)
    variance = np.linalg.eigvalsh(run.covariances[::every, :n, :n])[:, -1]
    sigma = np.linalg.norm(np.sqrt(np.maximum(variance, 0.0)))
    # A rotation about a line is fixed by positions so many σ off it, root of the mean squares: of
    # four it has 6 % more σ than to first order, of ten 1 %.
    return None if len(right) <= 2 or singular[1] > 10 * sigma else right[0]
