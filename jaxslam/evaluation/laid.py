"""Runs of poses laid on their truths: by the first pose, or to all positions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.evaluation.alignment import (
    Similarity,
    at_first_pose,
    projected,
    similarity,
    straight_line,
    turned_about,
)
from jaxslam.evaluation.arrays import exactly_known
from jaxslam.evaluation.convention import Convention, converted
from jaxslam.evaluation.pose_arrays import Poses

BY_FIRST = "aligned by the first pose, which the covariances take for known"
TO_ALL = "aligned to all positions, and the joint covariance projected to that gauge"
INDEPENDENT = (
    "aligned to all positions; the covariances are projected to that gauge as if the errors of "
    "different poses were independent, as there is no joint covariance"
)
STRAIGHT = (
    "positions are on a straight line, as far as their σ tells: the rotation about it is aligned "
    "by the orientations"
)


class Laid(NamedTuple):
    """The poses in the world of the truth."""

    poses: Poses
    given: bool
    """Whether their scale is still free, so that NEES is given the scale."""
    notes: tuple[str, ...] = ()


def laid(
    poses: Poses,
    convention: Convention,
    align: str,
    axes: Int[np.ndarray, " m"] | Bool[np.ndarray, " t"],
) -> Laid:
    """The estimates aligned by `none`, `se3` or `sim3`; the first pose is known where it has no
    variance on these `axes` of the covariances. Raises ValueError for what does not go together."""
    given = convention.scale == "given"
    if align == "none":
        return Laid(poses, given)
    first = poses.covariances[range(len(poses.logged)), np.argmax(poses.logged, axis=1)]
    if exactly_known(first[:, axes][:, :, axes]).all():
        return Laid(_each_run(poses, convention, _by_first), given or align == "sim3", (BY_FIRST,))
    if given and align == "se3":
        raise ValueError(
            "covariances given the scale are aligned by sim3, or by se3 where the first is zero"
        )

    def to_all(run: Poses, convention: Convention) -> Poses:
        return _to_all(run, convention, scaled=align == "sim3")

    notes = (TO_ALL if poses.joint is not None else INDEPENDENT,)
    if any(_line(run, convention) is not None for run in _runs(poses)):
        notes += (STRAIGHT,)
    return Laid(_each_run(poses, convention, to_all)._replace(joint=None), False, notes)


def _runs(poses: Poses) -> Iterator[Poses]:
    """Every run by itself, of the poses that were logged."""
    for run, logged in enumerate(poses.logged):
        joint = None
        if poses.joint is not None:
            rows = np.flatnonzero(np.repeat(logged, poses.covariances.shape[-1]))
            joint = poses.joint[run][np.ix_(rows, rows)]
        yield Poses(*(x[run, logged] for x in poses[:4]), joint)


def _each_run(
    poses: Poses, convention: Convention, lay: Callable[[Poses, Convention], Poses]
) -> Poses:
    result = [x.copy() for x in poses[:3]]
    joint = None if poses.joint is None else poses.joint.copy()
    for number, run in enumerate(_runs(poses)):
        moved, logged = lay(run, convention), poses.logged[number]
        for x, there in zip(result, moved[:3], strict=True):
            x[number, logged] = there
        if joint is not None and moved.joint is not None:
            rows = np.flatnonzero(np.repeat(logged, poses.covariances.shape[-1]))
            joint[number][np.ix_(rows, rows)] = moved.joint
    return Poses(*result, poses.logged, joint)


def _by_first(run: Poses, convention: Convention) -> Poses:
    """The first pose on its truth, and that position the origin, about which scales are."""
    moved = _moved(run, convention, at_first_pose(run.estimates[0], run.truths[0]))
    return about(moved, convention, run.truths[0, :-1, -1])


def about(run: Poses, convention: Convention, centre: Float[np.ndarray, " n"]) -> Poses:
    """Estimates and truths of a run in the world whose origin is that point."""
    away = Similarity(np.eye(len(centre)), -centre, 1.0)
    return _moved(run, convention, away)._replace(truths=away.moved(run.truths))


def _to_all(run: Poses, convention: Convention, *, scaled: bool) -> Poses:
    n = run.truths.shape[-1] - 1
    fit = similarity(run.estimates[:, :n, n], run.truths[:, :n, n], scaled=scaled)
    line = _line(run, convention)
    if line is not None:
        fit = turned_about(fit, line, run.estimates, run.truths)
    P = run.covariances if run.joint is None else run.joint
    P = projected(run.estimates, P, convention, scaled=scaled, line=line)
    return _moved(run._replace(covariances=P, joint=None), convention, fit)


def _line(run: Poses, convention: Convention) -> Float[np.ndarray, " n"] | None:
    """The direction of an estimate on a straight line, by the largest σ of every position."""
    n = run.estimates.shape[-1] - 1
    split = converted(run.covariances, run.estimates, convention, Convention("split", "world"))
    variance = np.linalg.eigvalsh(split[:, :n, :n])[:, -1]
    return straight_line(run.estimates[:, :n, n], np.sqrt(np.maximum(variance, 0.0)))


def _moved(run: Poses, convention: Convention, motion: Similarity) -> Poses:
    """Estimates and covariances in another world."""
    J = motion.derivative(run.estimates, convention)
    P, joint = J @ run.covariances @ np.swapaxes(J, 1, 2), run.joint
    if joint is not None:
        count, t = J.shape[:2]
        blocks = np.einsum("kab,kblc->kalc", J, joint.reshape(count, t, count, t), optimize=True)
        joint = np.einsum("kalc,ldc->kald", blocks, J, optimize=True).reshape(joint.shape)
    return run._replace(estimates=motion.moved(run.estimates), covariances=P, joint=joint)
