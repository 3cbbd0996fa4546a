"""Poses against the truth: aligned, their errors and covariances in a convention, evaluated."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam.evaluation.alignment import (
    ALIGNMENTS,
    Similarity,
    at_first_pose,
    projected,
    similarity,
)
from jaxslam.evaluation.arrays import (
    all_nan,
    at,
    check_every_run,
    check_finite,
    exactly_known,
    filled,
    normalised,
    numbers,
    step_times,
    without_known,
)
from jaxslam.evaluation.convention import (
    Convention,
    alternatives,
    errors_beyond_scale,
    geometry_of,
    pose_errors,
)
from jaxslam.evaluation.evaluate import Evaluation
from jaxslam.evaluation.identify import Identification, identify
from jaxslam.files import LARGEST
from jaxslam.lookup import chosen
from jaxslam.tum import not_rigid

_RIGID = 1e-4
"""How far from orthonormal a rotation may be: what rounding to six digits leaves is less."""
_SINGULAR = 1e-12
"""Of a variance, what is left of it where all of it is scale's."""
_ENOUGH = 100
"""Runs, by which conventions are told from each other."""
BY_FIRST = "aligned by the first pose, which the covariances take for known"
TO_ALL = "aligned to all positions, and the joint covariance projected to that gauge"
INDEPENDENT = (
    "aligned to all positions; the covariances are projected to that gauge as if the errors of "
    "different poses were independent, as there is no joint covariance"
)
BEYOND = (
    "NEES is given the scale, at that of the truth which explains each pose best; positions are "
    "in the estimate's unit"
)


class Poses(NamedTuple):
    """Runs of estimated poses T_wc, their covariances, and the truth."""

    estimates: Float[np.ndarray, "runs steps d d"]
    covariances: Float[np.ndarray, "runs steps t t"]
    truths: Float[np.ndarray, "runs steps d d"]
    logged: Bool[np.ndarray, "runs steps"]
    """Which steps of which run there are; the others are identities, of unit covariance."""
    joint: Float[np.ndarray, "runs steps*t steps*t"] | None = None
    """The covariance of all poses of a run, where it is known."""


class _Compared(NamedTuple):
    """What is evaluated: all of the steps whose poses are not known by definition."""

    errors: np.ndarray
    sigmas: np.ndarray
    nees: np.ndarray
    dof: int
    start: int
    notes: tuple[str, ...]


def evaluate_poses(
    estimates: ArrayLike,
    covariances: ArrayLike,
    truths: ArrayLike,
    convention: Convention | None = None,
    *,
    align: str = "none",
    times: ArrayLike | None = None,
) -> Evaluation:
    """The verdict on a filter from its poses T_wc, m, and the true ones.

    `estimates` and `truths` are (runs, steps, 4, 4), or (runs, steps, 3, 3) in the plane, `times`
    (steps,) in seconds. A pose that is all NaN together with its covariance was not logged, and one
    whose truth is all NaN is not compared. `covariances` are of every pose, (runs, steps, 6, 6), or
    of all poses of a run together, (runs, 6 steps, 6 steps), of the errors that the `convention`
    names. Where the estimate is of another world, `align` it by `se3` or `sim3`: by the first pose,
    if that is exactly known, else to all positions. The covariance is transported with it. Whether
    another convention would make the data consistent is tried too. Raises ValueError, naming run
    and step.
    """
    stated = convention or Convention()
    if not isinstance(stated, Convention):
        raise ValueError(
            f"a convention is a jaxslam.Convention, as Convention('right'), not {stated}"
        )
    chosen("align", [align], dict.fromkeys(ALIGNMENTS))
    poses = checked_poses(estimates, covariances, truths)
    found = _compared(poses, stated, align)
    return Evaluation(
        quantity="NEES",
        dof=found.dof,
        nees=found.nees,
        errors=found.errors,
        sigmas=found.sigmas,
        times=step_times(times, poses.estimates.shape[1])[found.start :],
        timed=times is not None,
        names=stated.names(geometry_of(poses.estimates)),
        convention=stated,
        alignment=align,
        identified=_identified(poses, stated, align, found),
        notes=found.notes,
    )


def checked_poses(estimates: ArrayLike, covariances: ArrayLike, truths: ArrayLike) -> Poses:
    """Arrays that belong together. Raises ValueError, naming run and step."""
    matrices = "(runs, steps, 4, 4), or (runs, steps, 3, 3) in the plane"
    T, truth = (
        _matrices(what, numbers(what, x, 4, matrices), matrices)
        for what, x in (("estimates", estimates), ("truths", truths))
    )
    if T.shape != truth.shape:
        raise ValueError(f"estimates are {T.shape}, so truths must be too, not {truth.shape}")
    runs, steps, t = *T.shape[:2], geometry_of(T).tangent_dim
    each, joint = (runs, steps, t, t), (runs, steps * t, steps * t)
    P = numbers("covariances", covariances, 3 if np.ndim(covariances) == 3 else 4, str(each))
    if P.shape not in (each, joint):
        raise ValueError(
            f"covariances of {runs} runs of {steps} poses must be {each}, or the joint ones "
            f"{joint}, not {P.shape}"
        )
    joints = P if P.shape == joint else None
    if joints is not None:
        blocks = joints.reshape(runs, steps, t, steps, t)
        P = np.moveaxis(blocks[:, range(steps), :, range(steps)], 0, 1)
    logged = ~(all_nan(T[..., :-1, :]) & all_nan(P) | all_nan(truth[..., :-1, :]))
    check_every_run(logged)
    if joints is not None:
        joints = _joint(joints, np.repeat(logged, t, axis=1))
    for what, x in (("estimates", T), ("truths", truth), ("covariances", P)):
        check_finite(what, x, logged)
        if (largest := np.abs(x[logged]).max()) > LARGEST:
            raise ValueError(f"{what} hold {largest:.2g}; up to {LARGEST:.0e} is accepted")
    T, truth = (filled(x, logged, np.eye(x.shape[-1])) for x in (T, truth))
    _check_rigid("estimates", T)
    _check_rigid("truths", truth)
    return Poses(T, filled(P, logged, np.eye(t)), truth, logged, joints)


def _joint(
    P: Float[np.ndarray, "runs k k"], logged: Bool[np.ndarray, "runs k"]
) -> Float[np.ndarray, "runs k k"]:
    """Zero where one of two numbers was not logged. Raises ValueError for any that cannot be."""
    P = np.where(logged[:, :, None] & logged[:, None], P, 0.0)
    if not (np.abs(P) <= LARGEST).all():
        run = int(np.argwhere(~(np.abs(P) <= LARGEST))[0, 0])
        raise ValueError(
            f"covariances of run {run} hold numbers that are not finite, or beyond {LARGEST:.0e}"
        )
    return P


def _matrices(what: str, T: np.ndarray, accepted: str) -> np.ndarray:
    if T.shape[-2:] not in ((3, 3), (4, 4)):
        raise ValueError(f"{what} must be matrices {accepted}, not {T.shape}")
    return T


def _check_rigid(what: str, T: np.ndarray) -> None:
    wrong = not_rigid(T, _RIGID)
    if wrong.any():
        place = at(np.argwhere(wrong)[0])
        raise ValueError(f"{what} of {place} is no rigid motion [R t; 0 1] with R a rotation")


def _compared(poses: Poses, convention: Convention, align: str) -> _Compared:
    laid, given, notes = _laid(poses, convention, align)
    errors = pose_errors(convention, laid.estimates, laid.truths)
    start, logged, known = without_known(errors, laid.covariances, laid.logged)
    later = Poses(*(x[:, start:] for x in laid[:3]), logged[:, start:])
    t = errors.shape[-1]
    later = later._replace(covariances=filled(later.covariances, later.logged, np.eye(t)))
    errors, P = errors[:, start:], later.covariances
    nees, dof = normalised(errors, P), t
    sigmas = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    if given:
        errors, sigmas, nees = _beyond_scale(later, convention)
        dof, notes = t - 1, (*notes, BEYOND)
    there = (filled(x, later.logged, np.nan) for x in (errors, sigmas, nees))
    return _Compared(*there, dof, start, (*known, *notes))


def _beyond_scale(
    poses: Poses, convention: Convention
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors, σ and NEES at the scale of the truth that explains each pose best.

    The covariance of what is left is P without its part along scale, `P − g gᵀ/(gᵀ P⁻¹ g)`.
    """
    best = errors_beyond_scale(convention, poses.estimates, poses.truths, poses.covariances)
    n, scale = poses.truths.shape[-1] - 1, np.exp(np.asarray(best.log_scale))

    def error(s):
        truths = poses.truths.copy()
        truths[..., :n, n] *= s[..., None]
        return pose_errors(convention, poses.estimates, truths)

    errors, sigma = error(scale), np.asarray(best.sigma)
    slope = error(2 * scale) - errors  # times s: the error is affine in s
    lost = np.where(np.isfinite(sigma), sigma, 0.0)[..., None] * slope
    variance = np.diagonal(poses.covariances, axis1=-2, axis2=-1)
    left = np.maximum(variance - lost**2, _SINGULAR * variance)
    return errors, np.sqrt(left), np.asarray(best.nees)


def _laid(poses: Poses, convention: Convention, align: str) -> tuple[Poses, bool, tuple[str, ...]]:
    """The estimates laid on the truth, whether what is left is given the scale, and a word."""
    given = convention.scale == "given"
    if align == "none":
        return poses, given, ()
    first = poses.covariances[range(len(poses.logged)), np.argmax(poses.logged, axis=1)]
    if exactly_known(first).all():
        return _each_run(poses, convention, _by_first), given or align == "sim3", (BY_FIRST,)
    if given and align == "se3":
        raise ValueError(
            "covariances given the scale are aligned by sim3, or by se3 where the first is zero"
        )

    def to_all(run: Poses, convention: Convention) -> Poses:
        return _to_all(run, convention, scaled=align == "sim3")

    notes = (TO_ALL if poses.joint is not None else INDEPENDENT,)
    return _each_run(poses, convention, to_all), False, notes


def _each_run(poses: Poses, convention: Convention, lay) -> Poses:
    """Every run by itself, of the poses that were logged."""
    laid = [x.copy() for x in poses[:3]]
    for run, logged in enumerate(poses.logged):
        joint = None
        if poses.joint is not None:
            rows = np.flatnonzero(np.repeat(logged, poses.covariances.shape[-1]))
            joint = poses.joint[run][np.ix_(rows, rows)]
        there = Poses(*(x[run, logged] for x in poses[:4]), joint)
        for x, moved in zip(laid, lay(there, convention)[:3], strict=True):
            x[run, logged] = moved
    return Poses(*laid, poses.logged)


def _by_first(run: Poses, convention: Convention) -> Poses:
    """The first pose on its truth, and that position the origin, about which scales are."""
    moved = _moved(run, convention, at_first_pose(run.estimates[0], run.truths[0]))
    n = run.truths.shape[-1] - 1
    away = Similarity(np.eye(n), -run.truths[0, :n, n], 1.0)
    return _moved(moved, convention, away)._replace(truths=away.moved(run.truths))


def _to_all(run: Poses, convention: Convention, *, scaled: bool) -> Poses:
    n = run.truths.shape[-1] - 1
    fit = similarity(run.estimates[:, :n, n], run.truths[:, :n, n], scaled=scaled)
    P = run.covariances if run.joint is None else run.joint
    run = run._replace(covariances=projected(run.estimates, P, convention, scaled=scaled))
    return _moved(run, convention, fit)


def _moved(run: Poses, convention: Convention, motion: Similarity) -> Poses:
    """Estimates and covariances in another world."""
    P = motion.moved_covariances(run.covariances, run.estimates, convention)
    return run._replace(estimates=motion.moved(run.estimates), covariances=P)


def _identified(poses: Poses, stated: Convention, align: str, found: _Compared) -> Identification:
    """Among the conventions of the same scale; where none of them does, given the scale."""
    few = Poses(*(x[:_ENOUGH] for x in poses[:4]))
    if poses.joint is not None:
        few = few._replace(joint=poses.joint[:_ENOUGH])
    geometry = geometry_of(poses.estimates)
    nees = {
        c: found.nees[:_ENOUGH] if c == stated else _compared(few, c, align).nees
        for c in alternatives(stated, geometry)
    }
    same = identify(stated, nees, found.dof)
    if same.consistent or found.dof < found.errors.shape[-1] or align != "none":
        return same
    others = alternatives(replace(stated, scale="given"), geometry)
    given = identify(stated, {c: _compared(few, c, align).nees for c in others}, found.dof - 1)
    return replace(given, nees=same.nees | given.nees)
