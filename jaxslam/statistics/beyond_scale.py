"""The part of the poses' errors that is not one of scale, which images alone do not determine.

The truth of another scale, `T(s) = (R, s t)`, explains them as well as the true one, s = 1, but
only with one s for all poses of a map: the gauge (Zhang, Gallego, Scaramuzza, RA-L 2018). The ratio
of the scales of two poses is given by the pixels, and where it changes, the scale drifts.
`beyond_scale` is of one pose alone; `one_scale` makes of all poses of a run the NEES at one scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray
from jaxslam.geometry import Pose, Scalar, retract, scaled, zero_tangent
from jaxslam.linalg import cholesky

STEPS = 3
"""Steps of Gauss–Newton in s: an error that is affine in s, as those of the package, needs one."""
SCALES = (1e-3, 1e3)
"""The least and the greatest s that are tried: no s > 0 explains a reversed path best."""
SCALE = ("beyond_scale", "unit_log_scale", "unit_log_scale_sigma", "unit_fixed")
"""The records of a run from which `one_scale` is computed."""
NOTICEABLE = 0.01
"""The least displacement that can be called reversed, m."""


PoseError = Callable[[Pose], tuple[Float[Array, " t"], Float[Array, "t t"]]]
"""The error against a true T_BC, and its covariance: an `AbstractFilter.pose_error` of a state."""


class BeyondScale(NamedTuple):
    """The scale of one pose, of t degrees of freedom, at which `e(s)ᵀ P⁻¹ e(s)` is the smallest."""

    nees: Float[AnyArray, "*batch"]
    """That smallest value: χ² with t − 1 degrees of freedom for a consistent filter."""
    log_scale: Float[AnyArray, "*batch"]
    """The log ŝ: the estimate's scale relative to the truth's."""
    sigma: Float[AnyArray, "*batch"]
    """The σ that the filter claims of log ŝ, `(gᵀ P⁻¹ g)^(−1/2)` with g = de/d log s; infinite
    where nothing depends on s."""


def beyond_scale(
    pose_error: PoseError, truth: Pose, truth_sigma: Float[AnyArray, " t"] | None = None
) -> BeyondScale:
    """The smallest NEES over the scale of a true T_BC, of an error and covariance against any.

    P is that against the truth itself (of a Gaussian sum it depends on the pose, a little). Of a
    truth that is itself known with σ only, in the camera's axes, it is `P + J(s) diag(σ²) J(s)ᵀ`,
    J(s) of e(s) by the true pose.
    """
    P = pose_error(truth)[1]
    fixed = cholesky(P).whitening

    def error(s: Scalar, truth: Pose) -> Float[Array, " t"]:
        return pose_error(scaled(truth, s))[0]

    def whitening(s: Scalar) -> Float[Array, "t t"]:
        if truth_sigma is None:
            return fixed
        J = jax.jacfwd(lambda delta: error(s, retract(truth, delta)))(zero_tangent(truth))
        root = J * jnp.asarray(truth_sigma)
        return cholesky(P + root @ root.T).whitening

    def whitened(s: Scalar) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
        """The error against T(s) and its derivative by s, both whitened."""
        W = whitening(s)
        return jax.jvp(lambda s: W @ error(s, truth), (s,), (one,))

    s = one = jnp.ones((), truth.translation().dtype)
    for _ in range(STEPS):
        e, slope = whitened(s)
        curvature = slope @ slope
        step = (slope @ e) / jnp.where(curvature > 0, curvature, 1.0)
        s = jnp.clip(s - step, *SCALES).astype(one.dtype)
    e, slope = whitened(s)
    return BeyondScale(e @ e, jnp.log(s), 1 / (s * jnp.sqrt(slope @ slope)))


class OneScale(NamedTuple):
    """The NEES of runs at one scale each: K poses of a run have K t − 1 degrees of freedom."""

    nees: Float[np.ndarray, "*runs steps"]
    """`e(ŝ)ᵀ P⁻¹ e(ŝ)`: t degrees of freedom a pose, less at most one where the errors of scale are
    common to the run, as the fit then takes out more than the one degree of freedom of its own."""
    log_scale: Float[np.ndarray, "*runs"]
    """The log ŝ of the run: NaN where no pose determines it."""
    drift: Float[np.ndarray, "*runs steps"]
    """`log ŝ_k − log ŝ`: the distance of a pose's scale from that of its run; NaN before the unit
    is fixed."""
    normalised: Float[np.ndarray, "*runs steps"]
    """The square of the drift in its claimed σ, the last term of `nees`: at most one degree of
    freedom."""


def one_scale(
    nees: Float[AnyArray, "*runs steps"],
    log_scale: Float[AnyArray, "*runs steps"],
    sigma: Float[AnyArray, "*runs steps"],
    fixed: Bool[AnyArray, "*runs steps"] | None = None,
) -> OneScale:
    """NEES at the one scale of a run that explains all of its poses best, of a `BeyondScale` each.

    An error that is affine in s has `NEES_k(s) = NEES_k(ŝ_k) + w_k (s − ŝ_k)²`, with
    `w = gᵀ P⁻¹ g` and g = de/ds, so that `ŝ = Σ w_k ŝ_k / Σ w_k` minimises the sum. A pose whose
    unit is not `fixed` yet, while a start is still being found out, is of a unit of its own: it
    keeps its own scale, and has no part in the run's.
    """
    own, s = np.asarray(nees, np.float64), np.exp(np.asarray(log_scale, np.float64))
    there = np.isfinite(own) & np.isfinite(s) & (True if fixed is None else np.asarray(fixed))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        w = np.where(there, 1 / (s * np.asarray(sigma, np.float64)) ** 2, 0.0)
        best = np.sum(w * np.where(there, s, 0.0), axis=-1) / np.sum(w, axis=-1)
        away = w * (s - best[..., None]) ** 2
        drift = np.where(there, np.log(s) - np.log(best)[..., None], np.nan)
        told = w > 0
    drift, normalised = (np.where(there & told, x, np.nan) for x in (drift, away))
    return OneScale(own + np.where(told, away, 0.0), np.log(best), drift, normalised)


def one_scale_of(records: Mapping[str, np.ndarray]) -> OneScale:
    """`one_scale` of the records (runs, steps) of a study, see `consistency.filter_run`."""
    *own, fixed = (records[name] for name in SCALE)
    return one_scale(*own, fixed > 0)


def reversal(estimate: Pose, truth: Pose) -> Scalar:
    """Return 1 if the estimated displacement from the origin points away from the true one, else 0.

    NaN unless the true one is `NOTICEABLE`.
    """
    true = truth.translation()
    against = (estimate.translation() @ true < 0).astype(true.dtype)
    return jnp.where(true @ true > NOTICEABLE**2, against, jnp.nan)
