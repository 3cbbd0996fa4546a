"""Poses compared with the truth as is stated: aligned, along the axes used, at one scale."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxslam.evaluation.alignment import BY_FIRSTS, aligned
from jaxslam.evaluation.convention import Squares, geometry_of, truth_derivatives
from jaxslam.evaluation.inputs import ROUNDING, Poses, step_times, whitened, without_known
from jaxslam.evaluation.result import Evaluation, of_steps
from jaxslam.evaluation.scale import at_one_scale, of_aligned
from jaxslam.statistics.bands import Mask, PerAxis

BEYOND = (
    "NEES is computed at the scale of each run that explains all of its poses best; positions are "
    "in the estimate's unit"
)


def compared(poses: Poses) -> Evaluation:
    """The verdict in the convention that is stated, without a look at others or at causes."""
    e, P, logged, words = stated_errors(poses)
    return of_steps(e, P, logged, **words)


def stated_errors(poses: Poses) -> tuple[PerAxis, Squares, Mask, dict[str, Any]]:
    """Errors, their covariances, the steps that were logged, and words for an `Evaluation`.

    Without the steps that are known by definition, and the axes without errors if none are named.
    """
    poses, left_out = (poses, ()) if poses.used else with_axes(poses)
    world = aligned(poses)
    first, e = np.argmax(world.poses.logged, axis=1), world.poses.errors()
    start, logged, known = without_known(e, world.poses.along_axes(), world.poses.logged)
    poses, e, scale = world.poses.later(start, logged), e[:, start:], None
    notes = (*left_out, *known, *world.notes)
    if world.given or poses.align == "sim3":
        whitened(e, poses.along_axes())  # refuses what is not positive definite, by run and step
    if poses.truth_sigma is not None:
        metres, degrees = poses.truth_sigma
        unit = at_one_scale(poses)[2].log_scale if world.given else np.zeros(len(logged))
        by_first = {*BY_FIRSTS} & {*world.notes}
        firsts = world.poses.truths[range(len(first)), first] if by_first else None
        poses = with_truth(poses, np.exp(np.nan_to_num(unit)), firsts)
        notes += (f"every stated σ includes that of the truth, {metres:g} m and {degrees:g}°",)
    P = poses.along_axes()
    if world.given:
        e, P, scale = at_one_scale(poses)
        notes += (BEYOND,)
    elif poses.align == "sim3":
        scale = of_aligned(poses, world.log_scale)
    most = None if world.most is None else world.most[:, start:]
    by = 1.0 if most is None else float(np.sqrt(np.mean(most[poses.logged])))
    if by > 1.05:
        told = "if errors of different poses correlate, σ of a right filter may seem too large, or"
        notes += (f"{told} too small by up to {by:.2f}",)
    words = {
        "quantity": "NEES",
        "times": step_times(None, len(logged[0]))[start:],
        "timed": False,
        "names": tuple(poses.names[i] for i in poses.axes),
        "convention": poses.convention,
        "alignment": poses.align,
        "notes": notes,
        "scale": scale,
        "truth_sigma": poses.truth_sigma,
        "most": most if by > 1 else None,
    }
    return e, P, poses.logged, words


def with_axes(poses: Poses) -> tuple[Poses, tuple[str, ...]]:
    """The poses with the names of the axes that are estimated, and a word on those that are not.

    An axis is left out where all its errors are zero, to nine decimals; or are less
    than a thousandth of σ, and have no correlation with those of other axes; or where its variance
    is zero at every pose.
    """
    names, few = poses.names, poses.some()
    if few is not poses and not with_axes(few)[1]:
        return poses._replace(used=names), ()
    variance = np.diagonal(poses.covariances[poses.logged], axis1=1, axis2=2)
    constant = np.ptp(variance, axis=0) <= 1e-9 * np.abs(variance).max(axis=0)
    varying = [name for name, same in zip(names, constant, strict=True) if not same]
    world = aligned(poses._replace(used=tuple(varying))).poses
    e, P = world._replace(used=()).errors()[poses.logged], world.covariances[poses.logged]
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    correlation = np.abs(P) / scale[:, :, None] / scale[:, None] * (1 - np.eye(P.shape[-1]))
    alone = (correlation <= 1e-6).all(axis=(0, 1))
    none = (np.abs(e) <= ROUNDING).all(axis=0) | ~variance.any(axis=0)
    # Errors that are less of σ at every pose are no errors.
    none |= alone & (np.abs(e) <= 1e-3 * sigma).all(axis=0)
    if none.all() or not none.any():
        return poses._replace(used=names), ()
    told = list(zip(names, none, strict=True))
    left, used = (tuple(name for name, out in told if out == which) for which in (True, False))
    return poses._replace(used=used), (
        f"{', '.join(left)}: not estimated, as errors are zero, or below a thousandth of σ, or σ "
        f"is zero; left out, as with --axes-used {','.join(used)}",
    )


def with_truth(
    poses: Poses, scale: Float[np.ndarray, " runs"], firsts: Float[np.ndarray, "runs d d"] | None
) -> Poses:
    """The covariances of errors against a truth with its σ, along the axes of the true body.

    `P + J S Jᵀ` with S the diagonal of σ² and J the derivative of the error by a small motion of
    the true pose; positions of a truth are `scale` times as large in the estimate's unit. Where
    the estimate was aligned to the `firsts` of the true poses, their errors move all of a run:
    `P + J S Jᵀ + M S Mᵀ`, M the derivative by a motion of that one.
    """
    n, t = poses.truths.shape[-1] - 1, geometry_of(poses.truths).tangent_dim
    metres, degrees = poses.truth_sigma or (0.0, 0.0)
    truths = poses.truths.copy()
    truths[..., :n, n] *= scale[:, None, None]
    at = truths if firsts is None else np.broadcast_to(firsts[:, None], truths.shape)
    J, M = truth_derivatives(poses.convention, poses.estimates, truths, at)
    S = np.ones((len(truths), 1, t)) * np.radians(degrees)
    S[..., :n] = metres * scale[:, None, None]
    J, M = J * S[..., None, :], M * S[..., None, :] * (firsts is not None)
    own = J @ np.swapaxes(J, -1, -2)
    P, joint = poses.covariances + own + M @ np.swapaxes(M, -1, -2), poses.joint
    if joint is not None:
        M = M.reshape(len(M), -1, t)
        joint = joint + M @ np.swapaxes(M, -1, -2)
        steps = np.arange(truths.shape[1])
        blocks = joint.reshape(len(joint), len(steps), t, len(steps), t)
        blocks[:, steps, :, steps] += np.swapaxes(own, 0, 1)
    return poses._replace(covariances=P, joint=joint)
