"""A truth that is measured has a σ of its own, which is a part of every error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import LARGEST
from jaxslam.evaluation.convention import Convention, geometry_of, truth_derivatives
from jaxslam.evaluation.pose_arrays import Poses


def checked_sigma(sigma: Sequence[float] | None) -> tuple[float, float] | None:
    """σ of a truth's position (m) and of its orientation (degrees). Raises ValueError."""
    if sigma is None:
        return None
    try:
        told = np.asarray(sigma, np.float64)
    except (ValueError, TypeError):
        told = np.empty(0)
    if told.shape != (2,) or not ((told >= 0) & (told <= LARGEST)).all():
        raise ValueError(
            f"truth_sigma must be two numbers, metres and degrees, not negative, not {sigma}"
        )
    return float(told[0]), float(told[1])


def note(sigma: tuple[float, float]) -> str:
    """What is said of it beside the verdict."""
    return f"σ of the truth, {sigma[0]:g} m and {sigma[1]:g}°, is a part of every σ claimed"


def with_truth(
    poses: Poses,
    convention: Convention,
    sigma: tuple[float, float],
    scale: Float[np.ndarray, " runs"],
    firsts: Float[np.ndarray, "runs d d"] | None,
) -> Poses:
    """Covariances of errors against a truth with that σ, along the axes of the true body.

    `P + J S Jᵀ` with S the diagonal of σ² and J the derivative of the error by a small motion of
    the true pose; positions of a truth are `scale` times as large in the estimate's unit. Where
    the estimate was laid on the `firsts` of the true poses, their errors move all of a run:
    `P + J S Jᵀ + M S Mᵀ`, M the derivative by a motion of that one.
    """
    n, t = poses.truths.shape[-1] - 1, geometry_of(poses.truths).tangent_dim
    truths = poses.truths.copy()
    truths[..., :n, n] *= scale[:, None, None]
    at = truths if firsts is None else np.broadcast_to(firsts[:, None], truths.shape)
    J, M = truth_derivatives(convention, poses.estimates, truths, at)
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
