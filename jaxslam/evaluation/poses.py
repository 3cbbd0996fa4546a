"""The evaluation of poses against the truth: aligned, with their errors in a convention."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST
from jaxslam._runtime.lookup import lookup
from jaxslam.evaluation.alignment import ALIGNMENTS
from jaxslam.evaluation.causes import causes, explained, suspect
from jaxslam.evaluation.comparison import compared, stated_errors
from jaxslam.evaluation.convention import Convention, alternatives, geometry_of, turning
from jaxslam.evaluation.convention_search import Identification, Tried, identify
from jaxslam.evaluation.inputs import Poses, checked_poses, filled, squared, step_times, whitened
from jaxslam.evaluation.result import Evaluation, described, of_steps
from jaxslam.evaluation.sanity_checks import Mistake
from jaxslam.io.text import vector_of


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
    told = axes_used.replace(",", " ").split() if isinstance(axes_used, str) else axes_used
    used = lookup("axes used", map(str, told), dict.fromkeys(poses.names)) if len(told) else ()
    names = tuple(name for name in poses.names if name in used)
    found = compared(poses._replace(align=align, used=names, truth_sigma=sigma))
    poses = poses._replace(align=align, used=found.names, truth_sigma=sigma)
    why = tuple(causes(poses, found, names))
    open_still = not any(x.certain for x in why)
    identified = _identified(poses, wrong=suspect(found) and open_still)
    if identified.doubtful and found.most is not None and not suspect(found):
        identified = None  # correlations of errors may be what makes it doubtful
    if identified and open_still:
        sure, of = bool(identified.doubtful and not identified.stands), identified.nees
        if (best := identified.consistent[0] if sure else identified.possible) is not None:
            what = f"the convention of the covariances {'is' if sure else 'may be'} another"
            told = f"with {best} NEES is {of[best]:.4g} instead of {of.get(stated, np.inf):.4g}"
            cause = Mistake(what, identified.sentence if sure else told, of[best], sure)
            why = (cause,) if sure else (*why, cause)
    at = at[len(at) - found.steps :]
    return described(found, causes=why, times=at, timed=times is not None, identified=identified)


def _identified(poses: Poses, *, wrong: bool) -> Identification:
    """Identify the convention among those of the same scale; else among those given the scale. Of
    errors that are `wrong` as stated, whether they are right is asked of each."""
    geometry, poses, stated = geometry_of(poses.estimates), poses.some(), poses.convention

    def tried(conventions: Iterable[Convention]) -> dict[Convention, Tried]:
        result = {}
        for convention in conventions:
            with suppress(ValueError):  # a wrong one may make no covariance of its numbers
                result[convention] = _tried(poses._replace(convention=convention), wrong=wrong)
        return result

    # With one axis of rotation mixed and rpy are world, as in the plane.
    flat = sum(name.startswith("r") for name in poses.used) < 2
    turned = stated.axes if stated.axes != "body" else "world"
    same = [c for c in alternatives(stated, geometry) if not flat or c.axes in ("body", turned)]
    free = stated.scale != "given" and poses.align == "none"
    given = [replace(convention, scale="given") for convention in same if free]
    return identify(stated, tried(same), lambda: tried(given))


def _tried(poses: Poses, *, wrong: bool) -> Tried:
    """The NEES of a convention: of all axes, of the position and of the rotation alone."""
    e, P, logged, words = stated_errors(poses)
    found = of_steps(e, P, logged, **words)
    turns, parts = np.array([name.startswith("r") for name in found.names]), {}
    for what, block in (("position", ~turns), ("rotation", turns)):
        if block.any():
            z = whitened(e[..., block], P[..., block, :][..., block])
            parts[what] = filled(squared(z), logged, np.nan), int(block.sum())
    volume = float(np.linalg.slogdet(P[logged])[1].mean())
    if poses.convention.axes == "rpy":  # angles that follow one another are not orthogonal
        N = turning(poses.convention, poses.estimates[poses.logged])
        volume -= 2 * float(np.linalg.slogdet(N)[1].mean())
    right = wrong and explained(found)
    return Tried(found.nees, found.dof, found.fitted, volume, parts, right)


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
