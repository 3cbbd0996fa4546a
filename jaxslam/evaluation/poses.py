"""Poses against the truth: aligned, their errors and covariances in a convention, evaluated."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam._runtime.lookup import lookup
from jaxslam.evaluation.alignment import ALIGNMENTS
from jaxslam.evaluation.arrays import filled, normalised, step_times, without_known
from jaxslam.evaluation.axes import estimated, named
from jaxslam.evaluation.convention import Convention, alternatives, geometry_of, pose_errors
from jaxslam.evaluation.evaluate import Evaluation
from jaxslam.evaluation.identify import Identification, Tried, identify
from jaxslam.evaluation.laid import BY_FIRST, Laid, laid
from jaxslam.evaluation.pose_arrays import Poses, checked_poses
from jaxslam.evaluation.scale import Scale, at_one_scale, of_aligned
from jaxslam.evaluation.truth import checked_sigma, note, with_truth
from jaxslam.geometry import Geometry

BEYOND = (
    "NEES is given the scale, at the one of each run that explains all of its poses best; "
    "positions are in the estimate's unit"
)


class _Options(NamedTuple):
    """How poses are compared, beside their convention."""

    align: str
    used: tuple[str, ...]
    """Names of axes."""
    truth_sigma: tuple[float, float] | None


class _Compared(NamedTuple):
    """What is evaluated: all of the steps whose poses are not known by definition."""

    errors: Float[np.ndarray, "runs steps m"]
    covariances: Float[np.ndarray, "runs steps m m"]
    nees: Float[np.ndarray, "runs steps"]
    start: int
    logged: Bool[np.ndarray, "runs steps"]
    fitted: float
    axis_fitted: Float[np.ndarray, " m"]
    scale: Scale | None
    notes: tuple[str, ...]


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

    `estimates` and `truths` are (runs, steps, 4, 4), or (runs, steps, 3, 3) in the plane, `times`
    (steps,) in seconds. A pose that is all NaN together with its covariance was not logged, and one
    whose truth is all NaN is not compared. `covariances` are of every pose, (runs, steps, 6, 6), or
    of all poses of a run together, (runs, 6 steps, 6 steps), of the errors that the `convention`
    names. Where the estimate is of another world, `align` it by `se3` or `sim3`: by the first pose,
    if that is exactly known, else to all positions. The covariance is transported with it. Given
    the scale of the world, or with `sim3`, NEES is at one scale a run, and the drift of scale is
    judged beside it. Of a robot that moves in a plane `axes_used` are those that it estimates, as
    ("x", "y", "rz"); by default all whose errors are not zero throughout. A truth that is measured
    has a `truth_sigma`, of position (m) and orientation (degrees), along the axes of the body,
    which is added to the covariances. Whether another convention would make the data consistent is
    tried too. Raises ValueError, naming run and step.
    """
    stated = convention or Convention()
    if not isinstance(stated, Convention):
        raise ValueError(
            f"a convention is a jaxslam.Convention, as Convention('right'), not {stated}"
        )
    lookup("align", [align], dict.fromkeys(ALIGNMENTS))
    poses = checked_poses(estimates, covariances, truths)
    at, sigma = step_times(times, poses.estimates.shape[1]), checked_sigma(truth_sigma)
    found = as_stated(poses, stated, align, named(axes_used, poses.estimates, stated), sigma)
    start = len(at) - found.steps
    return replace(
        found,
        times=at[start:],
        timed=times is not None,
        identified=_identified(poses, stated, _Options(align, found.names, sigma)),
    )


def as_stated(
    poses: Poses,
    stated: Convention,
    align: str = "none",
    used: tuple[str, ...] = (),
    truth_sigma: tuple[float, float] | None = None,
) -> Evaluation:
    """The verdict in the convention that is stated, without a look at others."""
    told: tuple[str, ...] = ()
    if not used:
        used, told = estimated(poses, stated, align)
    found = _compared(poses, stated, _Options(align, used, truth_sigma))
    return Evaluation(
        quantity="NEES",
        dof=len(used),
        nees=filled(found.nees, found.logged, np.nan),
        errors=filled(found.errors, found.logged, np.nan),
        sigmas=filled(_sigmas(found.covariances), found.logged, np.nan),
        times=step_times(None, poses.estimates.shape[1])[found.start :],
        timed=False,
        names=used,
        convention=stated,
        alignment=align,
        notes=(*told, *found.notes),
        fitted=found.fitted,
        axis_fitted=tuple(float(x) for x in found.axis_fitted),
        scale=found.scale,
        truth_sigma=truth_sigma,
    )


def _sigmas(covariances: Float[np.ndarray, "*batch m m"]) -> Float[np.ndarray, "*batch m"]:
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def _compared(poses: Poses, convention: Convention, options: _Options) -> _Compared:
    """Errors and covariances along the axes used, aligned, at one scale where it is free."""
    align, used, truth_sigma = options
    names = convention.names(geometry_of(poses.estimates))
    axes = np.array([i for i, name in enumerate(names) if name in used])
    world = laid(poses, convention, align, axes)
    errors = pose_errors(convention, world.poses.estimates, world.poses.truths)[..., axes]
    P = world.poses.covariances[..., axes[:, None], axes]
    start, logged, known = without_known(errors, P, world.poses.logged)
    later = _later(world.poses, start, logged)
    errors, P = errors[:, start:], later.covariances[..., axes[:, None], axes]
    fitted, axis_fitted, scale, notes = 0.0, np.zeros(len(axes)), None, (*known, *world.notes)
    if world.given:
        normalised(errors, P)  # refuses what is not positive definite, by run and step
    if truth_sigma is not None:
        later = _with_truth(world, later, convention, axes, truth_sigma)
        P, notes = later.covariances[..., axes[:, None], axes], (*notes, note(truth_sigma))
    if world.given:
        errors, P, fitted, axis_fitted, scale = at_one_scale(later, convention, axes)
        notes += (BEYOND,)
    elif align == "sim3":
        scale = of_aligned(later, convention, axes, _log_scales(poses, world.poses))
    nees = normalised(errors, P)
    return _Compared(errors, P, nees, start, later.logged, fitted, axis_fitted, scale, notes)


def _later(poses: Poses, start: int, logged: Bool[np.ndarray, "runs steps"]) -> Poses:
    """From a step on, those that have a part in the verdict."""
    t, there = poses.covariances.shape[-1], logged[:, start:]
    P = filled(poses.covariances[:, start:], there, np.eye(t))
    joint = None if poses.joint is None else poses.joint[:, start * t :, start * t :]
    return Poses(poses.estimates[:, start:], P, poses.truths[:, start:], there, joint)


def _with_truth(
    world: Laid,
    later: Poses,
    convention: Convention,
    axes: Int[np.ndarray, " m"],
    truth_sigma: tuple[float, float],
) -> Poses:
    """With the σ of the truth, in the unit of the estimate where their ratio is free."""
    first, log_scale = np.argmax(world.poses.logged, axis=1), np.zeros(len(later.logged))
    firsts = world.poses.truths[range(len(first)), first] if BY_FIRST in world.notes else None
    if world.given:
        log_scale = np.nan_to_num(at_one_scale(later, convention, axes).scale.log_scale)
    return with_truth(later, convention, truth_sigma, np.exp(log_scale), firsts)


def _log_scales(before: Poses, after: Poses) -> Float[np.ndarray, " runs"]:
    """log of the estimate's unit relative to the truth's, of what a Sim(n) did to each run."""
    spreads = (
        [np.linalg.norm(p[own] - p[own].mean(0)) for p, own in zip(x, before.logged, strict=True)]
        for x in (before.estimates[..., :-1, -1], after.estimates[..., :-1, -1])
    )
    old, new = (np.log(spread) for spread in spreads)
    return old - new


def _identified(poses: Poses, stated: Convention, options: _Options) -> Identification:
    """Among the conventions of the same scale; given the scale, where none of them does."""
    geometry, used = geometry_of(poses.estimates), options.used

    def tried(conventions: Iterable[Convention]) -> dict[Convention, Tried]:
        result = {}
        for convention in conventions:
            with suppress(ValueError):  # a wrong one may make no covariance of its numbers
                found = _compared(poses, convention, options)
                result[convention] = _tried(convention, geometry, found, used)
        return result

    same = _alternatives(stated, geometry, used)
    if stated.scale == "given" or options.align != "none":
        return identify(stated, tried(same))
    given = [replace(convention, scale="given") for convention in same]
    return identify(stated, tried(same), lambda: tried(given))


def _alternatives(
    stated: Convention, geometry: Geometry, used: tuple[str, ...]
) -> list[Convention]:
    """Those that differ: of one axis of rotation mixed is world, as in the plane."""
    flat = sum(name.startswith("r") for name in used) < 2
    other = "world" if stated.axes == "mixed" else "mixed"
    return [c for c in alternatives(stated, geometry) if not flat or c.axes != other]


def _tried(
    convention: Convention, geometry: Geometry, found: _Compared, used: tuple[str, ...]
) -> Tried:
    """NEES of a convention: of all, of the position and of the rotation alone."""
    names = [name for name in convention.names(geometry) if name in used]
    turns = np.array([name.startswith("r") for name in names])

    def of(block: np.ndarray) -> np.ndarray:
        e, P = found.errors[..., block], found.covariances[..., block, :][..., block]
        return filled(normalised(e, P), found.logged, np.nan)

    determinant = np.linalg.slogdet(found.covariances[found.logged])[1].mean()
    return Tried(
        filled(found.nees, found.logged, np.nan),
        len(names),
        found.fitted,
        float(determinant),
        of(~turns) if (~turns).any() else None,
        of(turns) if turns.any() else None,
        int(turns.sum()),
    )
