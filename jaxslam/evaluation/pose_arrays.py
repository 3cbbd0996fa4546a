"""Poses, their covariances and the truth as somebody else's program logged them: checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST
from jaxslam.evaluation.arrays import all_nan, at, check_every_run, check_finite, filled, numbers
from jaxslam.evaluation.convention import geometry_of
from jaxslam.io.tum import not_rigid

_RIGID = 1e-4
"""How far from orthonormal a rotation may be: what rounding to six digits leaves is less."""


class Poses(NamedTuple):
    """Runs of estimated poses T_wc, their covariances, and the truth."""

    estimates: Float[np.ndarray, "runs steps d d"]
    covariances: Float[np.ndarray, "runs steps t t"]
    truths: Float[np.ndarray, "runs steps d d"]
    logged: Bool[np.ndarray, "runs steps"]
    """Which steps of which run there are; the others are identities, of unit covariance."""
    joint: Float[np.ndarray, "runs steps*t steps*t"] | None = None
    """The covariance of all poses of a run, where it is known."""


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
