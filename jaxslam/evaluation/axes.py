"""Axes of a pose that a filter does not estimate: height, roll and pitch of a robot in a plane.

Somebody whose files are of six axes writes zero there, or a small or a large number, and the errors
are zero. They have no degree of freedom; what a covariance says of the other axes is right without
them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxslam._runtime.lookup import lookup
from jaxslam.evaluation.arrays import ROUNDING
from jaxslam.evaluation.convention import Convention, geometry_of, pose_errors
from jaxslam.evaluation.laid import laid
from jaxslam.evaluation.pose_arrays import Poses

_NOTHING = 1e-3
"""Errors that are less of σ at every pose are no errors."""
_UNCORRELATED = 1e-6


def named(
    axes: str | Sequence[str], poses: Float[np.ndarray, "runs steps d d"], convention: Convention
) -> tuple[str, ...]:
    """The axes that are used, in the order of a covariance; none where nobody said.

    Raises ValueError.
    """
    told = axes.replace(",", " ").split() if isinstance(axes, str) else [str(x) for x in axes]
    names = convention.names(geometry_of(poses))
    used = lookup("axes used", told, dict.fromkeys(names)) if told else {}
    return tuple(name for name in names if name in used)


def estimated(
    poses: Poses, convention: Convention, align: str
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the axes that are estimated, and a word on those that are not.

    An axis is left out where all its errors are zero, as far as nine decimals tell; or are less
    than a thousandth of σ, and have no correlation with those of other axes.
    """
    names = convention.names(geometry_of(poses.estimates))
    world = laid(poses, convention, align, ~_constant(poses)).poses
    e = pose_errors(convention, world.estimates, world.truths)[poses.logged]
    P = world.covariances[poses.logged]
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    alone = _alone(P, sigma)
    none = (np.abs(e) <= ROUNDING).all(axis=0)
    none |= alone & (np.abs(e) <= _NOTHING * sigma).all(axis=0)
    if none.all() or not none.any():
        return names, ()
    left, used = (
        tuple(name for name, out in zip(names, none, strict=True) if out == which)
        for which in (True, False)
    )
    return used, (
        f"{', '.join(left)}: errors are zero throughout, so that nothing was estimated; left out, "
        f"as with --axes-used {','.join(used)}",
    )


def _alone(P: np.ndarray, sigma: np.ndarray) -> Bool[np.ndarray, " t"]:
    """Which axes have no correlation with any other."""
    scale = np.where(sigma > 0, sigma, 1.0)
    correlation = np.abs(P) / scale[:, :, None] / scale[:, None] * (1 - np.eye(P.shape[-1]))
    return (correlation <= _UNCORRELATED).all(axis=(0, 1))


def _constant(poses: Poses) -> Bool[np.ndarray, " t"]:
    """Which axes have the same variance at every pose: none of them, where all have."""
    variance = np.diagonal(poses.covariances[poses.logged], axis1=1, axis2=2)
    same = np.ptp(variance, axis=0) <= 1e-9 * np.abs(variance).max(axis=0)
    return same & ~same.all()
