"""The evaluation of poses against the truth: aligned, with their errors in a convention."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST
from jaxslam._runtime.lookup import lookup
from jaxslam.evaluation.alignment import (
    ALIGNMENTS,
    BY_ANY,
    BY_FIRST,
    BY_SMALL,
    Aligned,
    aligned,
)
from jaxslam.evaluation.causes import causes
from jaxslam.evaluation.convention import (
    Axes,
    Convention,
    Squares,
    Values,
    alternatives,
    geometry_of,
    pose_errors,
    truth_derivatives,
    turning,
)
from jaxslam.evaluation.convention_search import Identification, Tried, identify
from jaxslam.evaluation.inputs import (
    ROUNDING,
    Poses,
    checked_poses,
    filled,
    squared,
    step_times,
    whitened,
    without_known,
)
from jaxslam.evaluation.result import Evaluation, described, of_steps
from jaxslam.evaluation.sanity_checks import Mistake
from jaxslam.evaluation.scale import at_one_scale, of_aligned
from jaxslam.io.text import vector_of
from jaxslam.statistics.bands import Mask, PerAxis

BEYOND = (
    "NEES is computed at the scale of each run that explains all of its poses best; positions are "
    "in the estimate's unit"
)


class PoseComparison(NamedTuple):
    """How poses are compared with the truth."""

    align: str = "none"
    used: tuple[str, ...] = ()
    """The names of the axes; none where they are to be found."""
    truth_sigma: tuple[float, float] | None = None
    """The σ of the true poses, m and degrees; None of exact ones."""


def evaluate_poses(
    estimates: ArrayLike,
    covariances: ArrayLike,
    truths: ArrayLike,
    convention: Convention | None = None,
    *,
    align: str = "none",
    axes_used: str | Sequence[str] = (),
    times: ArrayLike | None = None,
    truth_sigma: Sequence[float] | None = None,
) -> Evaluation:
    """The verdict on a filter from its poses T_wc, m, and the true ones.

    `estimates` and `truths` are (runs, steps, 4, 4), or (runs, steps, 6) of x, y, z and a rotation
    vector; in the plane (runs, steps, 3, 3). `times` (steps,) are seconds. A pose that is all NaN
    together with its covariance was not logged, and one whose truth is all NaN is not compared.
    `covariances` are of every pose, (runs, steps, 6, 6), or of all poses of a run together, (runs,
    6 steps, 6 steps), of the errors that the `convention` names. Where the estimate is of another
    world, `align` it by `yaw` (and position), `se3` or `sim3`: at the first pose, if its σ is
    small, else to all positions; by `first` at the first pose in any case. The covariance is
    transported with it. Given the scale of the world, or with `sim3`, NEES is at one scale a run,
    and the drift of scale is tested beside it. Of a robot that moves in a plane `axes_used` are
    those that it estimates, as ("x", "y", "rz"); by default all whose errors are not zero
    throughout. A truth that is measured has a `truth_sigma`, of position (m) and orientation
    (degrees), along the axes of the body, which is added to the covariances. Whether another
    convention would make the data consistent is tried too. Raises ValueError, naming run and step.
    """
    stated = convention or Convention()
    if not isinstance(stated, Convention):
        raise ValueError(
            f"convention must be a jaxslam.Convention, such as Convention('right'), not {stated}"
        )
    lookup("align", [align], dict.fromkeys(ALIGNMENTS))
    poses = checked_poses(estimates, covariances, truths, stated)
    at, sigma = step_times(times, poses.estimates.shape[1]), checked_sigma(truth_sigma)
    found = as_stated(poses, PoseComparison(align, axes_named(axes_used, poses), sigma))
    identified = _identified(poses, PoseComparison(align, found.names, sigma))
    at = at[len(at) - found.steps :]

    def compared(poses: Poses, align: str, axes: Sequence[str]) -> Evaluation:
        return as_stated(poses, PoseComparison(align, tuple(axes) or found.names, sigma))

    told = tuple(causes(poses, align, found, compared))
    if not told and identified.doubtful and not identified.stands:
        best = identified.nees[identified.consistent[0]]
        what = "the convention of the covariances is another"
        told = (Mistake(what, identified.sentence, best),)
    timed = times is not None
    return described(found, causes=told, times=at, timed=timed, identified=identified)


def as_stated(poses: Poses, asked: PoseComparison) -> Evaluation:
    """The verdict in the convention that is stated, without a look at others."""
    used, told = (asked.used, ()) if asked.used else estimated(poses, asked.align)
    found, _, _ = _compared(poses, asked._replace(used=used))
    return described(found, notes=(*told, *found.notes))


def _compared(poses: Poses, asked: PoseComparison) -> tuple[Evaluation, PerAxis, Squares]:
    """The evaluation, errors and covariances of all steps that are not known by definition: along
    the axes used, aligned, at one scale where it is free."""
    (align, used, truth_sigma), convention = asked, poses.convention
    names = convention.names(geometry_of(poses.estimates))
    axes = np.array([i for i, name in enumerate(names) if name in used])
    world = aligned(poses, align, axes)
    errors = pose_errors(convention, world.poses.estimates, world.poses.truths)[..., axes]
    P = _along(world.poses.covariances, axes)
    start, logged, known = without_known(errors, P, world.poses.logged)
    later = _later(world.poses, start, logged)
    errors, P = errors[:, start:], _along(later.covariances, axes)
    fitted, axis_fitted, scale, notes = 0.0, np.zeros(len(axes)), None, (*known, *world.notes)
    if world.given or align == "sim3":
        whitened(errors, P)  # refuses what is not positive definite, by run and step
    if truth_sigma is not None:
        later = _with_truth(world, later, axes, truth_sigma)
        P, (metres, degrees) = _along(later.covariances, axes), truth_sigma
        notes += (f"every stated σ includes that of the truth, {metres:g} m and {degrees:g}°",)
    if world.given:
        errors, P, fitted, axis_fitted, scale = at_one_scale(later, axes)
        notes += (BEYOND,)
    elif align == "sim3":
        scale = of_aligned(later, axes, world.log_scale)
    found = of_steps(
        errors,
        P,
        later.logged,
        quantity="NEES",
        times=step_times(None, poses.estimates.shape[1])[start:],
        timed=False,
        names=tuple(names[i] for i in axes),
        convention=convention,
        alignment=align,
        notes=notes,
        fitted=fitted,
        axis_fitted=tuple(float(x) for x in axis_fitted),
        scale=scale,
        truth_sigma=truth_sigma,
    )
    return found, errors, P


def _along(P: Values, axes: Axes) -> Values:
    return P if len(axes) == P.shape[-1] else P[..., axes[:, None], axes]


def _later(poses: Poses, start: int, logged: Mask) -> Poses:
    """The poses from a step on that have a part in the verdict."""
    t, there = poses.covariances.shape[-1], logged[:, start:]
    P = filled(poses.covariances[:, start:], there, np.eye(t))
    joint = None if poses.joint is None else poses.joint[:, start * t :, start * t :]
    T, truths = poses.estimates[:, start:], poses.truths[:, start:]
    return Poses(T, P, truths, there, poses.convention, joint)


def _with_truth(
    world: Aligned, later: Poses, axes: Axes, truth_sigma: tuple[float, float]
) -> Poses:
    """Add the σ of the truth, in the unit of the estimate where their ratio is free."""
    first, log_scale = np.argmax(world.poses.logged, axis=1), np.zeros(len(later.logged))
    by_first = {BY_ANY, BY_FIRST, BY_SMALL} & {*world.notes}
    firsts = world.poses.truths[range(len(first)), first] if by_first else None
    if world.given:
        log_scale = np.nan_to_num(at_one_scale(later, axes).scale.log_scale)
    return with_truth(later, truth_sigma, np.exp(log_scale), firsts)


def _identified(poses: Poses, asked: PoseComparison) -> Identification:
    """Identify the convention among those of the same scale; else among those given the scale."""
    geometry, poses, stated = geometry_of(poses.estimates), poses.some(), poses.convention

    def tried(conventions: Iterable[Convention]) -> dict[Convention, Tried]:
        result = {}
        for convention in conventions:
            with suppress(ValueError):  # a wrong one may make no covariance of its numbers
                other = poses._replace(convention=convention)
                one = _tried(*_compared(other, asked))
                volume = one.log_determinant - _log_volume(other)
                result[convention] = one._replace(log_determinant=volume)
        return result

    # With one axis of rotation mixed and rpy are world, as in the plane.
    flat = sum(name.startswith("r") for name in asked.used) < 2
    turned = stated.axes if stated.axes != "body" else "world"
    same = [c for c in alternatives(stated, geometry) if not flat or c.axes in ("body", turned)]
    if stated.scale == "given" or asked.align != "none":
        return identify(stated, tried(same))
    given = [replace(convention, scale="given") for convention in same]
    return identify(stated, tried(same), lambda: tried(given))


def _log_volume(poses: Poses) -> float:
    """The log determinant of a covariance along the convention's axes over that of orthogonal ones:
    angles that follow one another are not."""
    if poses.convention.axes != "rpy":
        return 0.0
    volume = np.linalg.slogdet(turning(poses.convention, poses.estimates[poses.logged]))[1]
    return 2 * float(volume.mean())


def _tried(found: Evaluation, errors: PerAxis, P: Squares) -> Tried:
    """The NEES of a convention: of all axes, of the position and of the rotation alone."""
    turns = np.array([name.startswith("r") for name in found.names])

    def of(block: np.ndarray) -> np.ndarray:
        z = whitened(errors[..., block], P[..., block, :][..., block])
        return filled(squared(z), found.logged, np.nan)

    log_determinant = float(np.linalg.slogdet(P[found.logged])[1].mean())
    parts = (of(block) if block.any() else None for block in (~turns, turns))
    return Tried(found.nees, found.dof, found.fitted, log_determinant, *parts, int(turns.sum()))


def axes_named(axes: str | Sequence[str], poses: Poses) -> tuple[str, ...]:
    """The axes that are used, in the order of a covariance; none where they are not given.

    Raises ValueError.
    """
    told = axes.replace(",", " ").split() if isinstance(axes, str) else [str(x) for x in axes]
    names = poses.convention.names(geometry_of(poses.estimates))
    used = lookup("axes used", told, dict.fromkeys(names)) if told else {}
    return tuple(name for name in names if name in used)


def estimated(poses: Poses, align: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the axes that are estimated, and a word on those that are not.

    An axis is left out where all its errors are zero, to nine decimals; or are less
    than a thousandth of σ, and have no correlation with those of other axes.
    """
    names = poses.convention.names(geometry_of(poses.estimates))
    few = poses.some()
    if few is not poses and not estimated(few, align)[1]:
        return names, ()
    world = aligned(poses, align, ~_constant(poses)).poses
    e = pose_errors(poses.convention, world.estimates, world.truths)[poses.logged]
    P = world.covariances[poses.logged]
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    alone = _alone(P, sigma)
    none = (np.abs(e) <= ROUNDING).all(axis=0)
    # Errors that are less of σ at every pose are no errors.
    none |= alone & (np.abs(e) <= 1e-3 * sigma).all(axis=0)
    if none.all() or not none.any():
        return names, ()
    told = list(zip(names, none, strict=True))
    left, used = (tuple(name for name, out in told if out == which) for which in (True, False))
    return used, (
        f"{', '.join(left)}: errors are always zero, so these axes were not estimated; left out, "
        f"as with --axes-used {','.join(used)}",
    )


def _alone(P: np.ndarray, sigma: np.ndarray) -> Bool[np.ndarray, " t"]:
    """A mask of the axes that have no correlation with any other."""
    scale = np.where(sigma > 0, sigma, 1.0)
    correlation = np.abs(P) / scale[:, :, None] / scale[:, None] * (1 - np.eye(P.shape[-1]))
    return (correlation <= 1e-6).all(axis=(0, 1))


def _constant(poses: Poses) -> Bool[np.ndarray, " t"]:
    """A mask of the axes with the same variance at every pose: none of them, where all have."""
    variance = np.diagonal(poses.covariances[poses.logged], axis1=1, axis2=2)
    same = np.ptp(variance, axis=0) <= 1e-9 * np.abs(variance).max(axis=0)
    return same & ~same.all()


def checked_sigma(sigma: Sequence[float] | None) -> tuple[float, float] | None:
    """The σ of a truth's position (m) and of its orientation (degrees). Raises ValueError."""
    if sigma is None:
        return None
    told = vector_of(sigma, 2)
    if told is None or not ((told >= 0) & (told <= LARGEST)).all():
        raise ValueError(
            f"truth_sigma must be two numbers, metres and degrees, not negative, not {sigma}"
        )
    return float(told[0]), float(told[1])


def with_truth(
    poses: Poses,
    sigma: tuple[float, float],
    scale: Float[np.ndarray, " runs"],
    firsts: Float[np.ndarray, "runs d d"] | None,
) -> Poses:
    """The covariances of errors against a truth with that σ, along the axes of the true body.

    `P + J S Jᵀ` with S the diagonal of σ² and J the derivative of the error by a small motion of
    the true pose; positions of a truth are `scale` times as large in the estimate's unit. Where
    the estimate was aligned to the `firsts` of the true poses, their errors move all of a run:
    `P + J S Jᵀ + M S Mᵀ`, M the derivative by a motion of that one.
    """
    n, t = poses.truths.shape[-1] - 1, geometry_of(poses.truths).tangent_dim
    truths = poses.truths.copy()
    truths[..., :n, n] *= scale[:, None, None]
    at = truths if firsts is None else np.broadcast_to(firsts[:, None], truths.shape)
    J, M = truth_derivatives(poses.convention, poses.estimates, truths, at)
    S = np.ones((len(truths), 1, t)) * np.radians(sigma[1])
    S[..., :n] = sigma[0] * scale[:, None, None]
    J, M = J * S[..., None, :], M * S[..., None, :]
    P, joint = poses.covariances + J @ np.swapaxes(J, -1, -2), poses.joint
    if firsts is not None:
        P = P + M @ np.swapaxes(M, -1, -2)
    if joint is not None:
        joint = joint.copy()
        steps = np.arange(truths.shape[1])
        blocks = joint.reshape(len(joint), len(steps), t, len(steps), t)
        blocks[:, steps, :, steps] += np.swapaxes(J @ np.swapaxes(J, -1, -2), 0, 1)
        if firsts is not None:
            M = M.reshape(len(M), -1, t)
            joint += M @ np.swapaxes(M, -1, -2)
    return poses._replace(covariances=P, joint=joint)
