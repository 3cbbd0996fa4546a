"""The poses at the one scale of their run, and the drift of their scales from it.

Where nothing determines the scale, the true positions of another, `s p`, explain an estimate as
well, but one s for a whole run. An error is affine in s, `e(s) = e + g (s − 1)` with g = de/ds, so
that `ŝ = 1 − gᵀ Σ⁻¹ e/(gᵀ Σ⁻¹ g)` of all poses of a run, Σ their joint covariance, or where there
is none block by block (`statistics.beyond_scale.one_scale`). Of one pose alone it is ŝ_k, and log
ŝ_k − log ŝ is its drift.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jaxslam._runtime.files import Json, json_numbers
from jaxslam.evaluation.convention import Convention, Joints, Matrices, Squares, Tangents, converted
from jaxslam.evaluation.inputs import Poses, correlations, sigmas
from jaxslam.statistics.bands import Mask, PerAxis, PerStep
from jaxslam.statistics.beyond_scale import SCALES, BeyondScale, one_scale
from jaxslam.statistics.verdict import Verdict, run_verdict

QUANTILES = (0.025, 0.5, 0.975)
"""The quantiles of the runs' drifts, per step."""


@dataclass(frozen=True, eq=False)
class Scale:
    """The scale of every run, and its drift along the run."""

    log_scale: Float[np.ndarray, " runs"]
    """The log scale of the estimate relative to the truth; NaN where no pose determines it."""
    drift: PerStep
    """The log of a pose's own scale relative to its run's; NaN where it determines none."""
    sigma: PerStep
    """The σ that the filter claims of log ŝ_k, or of the drift where all covariances are known."""
    nees: PerStep
    """The NEES of the drift; NaN where a pose determines no scale."""
    fitted: float
    """The most degrees of freedom that the fit of the run's scale took from every drift, and from
    the NEES of every pose."""
    axis_fitted: tuple[float, ...] = ()
    """The same of every axis alone."""

    @property
    def told(self) -> Mask:
        """A mask of the poses that have a drift."""
        return ~np.isnan(self.nees)

    @cached_property
    def verdict(self) -> Verdict | None:
        """The verdict on the drift alone, of one degree of freedom; None if no run has one."""
        runs = self.told.any(axis=1)
        if not runs.any():
            return None
        return run_verdict(self.nees[runs], 1, self.fitted, self.told[runs])

    @property
    def factor(self) -> float:
        """The drift in its claimed σ, root of the mean square."""
        found = self.verdict
        return np.nan if found is None or found["nees"] is None else float(np.sqrt(found["nees"]))

    @property
    def rms(self) -> float:
        """The drift along a run, root of the mean square weighted by each pose's information."""
        told = self.told & (self.sigma > 0)
        if not told.any():
            return np.nan
        weight = self.sigma[told] ** -2
        return float(np.sqrt(np.sum(weight * self.drift[told] ** 2) / np.sum(weight)))

    @property
    def disproved(self) -> bool:
        """Whether the scale certainly drifts more than σ allows."""
        found = self.verdict
        if found is None or (found["nees"] is not None and found["nees"] <= 1):
            return False
        # The confidence of the verdict on drift: with that on NEES, which is one-sided where a fit
        # took a degree of freedom, a right filter is called inconsistent in one of a hundred
        # studies.
        return bool(found["p"] < 1 - 0.999)

    @property
    def sentence(self) -> str:
        """A sentence: `the scale drifts by 12 % (RMS) along a run, 5 times what σ allows …`."""
        if self.verdict is None:
            return "no pose determines a scale"
        size = f"{100 * np.expm1(min(self.rms, 700.0)):.2g}"
        told = f"the scale drifts by {size} % (RMS) along a run, {self.factor:.2g} times "
        if self.disproved:
            return told + "its σ: over-confident"
        return told + "its σ: no more than σ allows"

    @property
    def over_runs(self) -> tuple[Float[np.ndarray, "2 steps"], np.ndarray, np.ndarray]:
        """The drift of every step: the limits of 95 % of the runs, their median, and its σ."""
        there = np.asarray(self.told.any(axis=0))
        low, median, high = (np.full(len(there), np.nan) for _ in QUANTILES)
        sigma = np.full(len(there), np.nan)
        if there.any():
            drift = np.where(self.told, self.drift, np.nan)[:, there]
            low[there], median[there], high[there] = np.nanquantile(drift, QUANTILES, axis=0)
            sigma[there] = np.nanmedian(np.where(self.told, self.sigma, np.nan)[:, there], axis=0)
        return np.stack([low, high]), median, sigma

    def asdict(self) -> dict[str, Json]:
        """Return the content for `evaluation.json`."""
        (low, high), median, sigma = self.over_runs
        rms, in_sigma = json_numbers(np.array([self.rms, self.factor]))
        return {
            "log_scale": json_numbers(self.log_scale),
            "drift": json_numbers(median),
            "drift95": [json_numbers(low), json_numbers(high)],
            "sigma": json_numbers(sigma),
            "drift_rms": rms,
            "drift_in_sigma": in_sigma,
            "fitted": self.fitted,
            "verdict": self.verdict,
            "disproved": self.disproved,
        }


def at_one_scale(poses: Poses) -> tuple[PerAxis, Squares, Scale]:
    """The errors at the true scale that explains all poses of a run best, their covariances, and
    that scale. A fit to a joint covariance takes its part out of them."""
    if poses.joint is not None:
        return _jointly(poses, poses.joint)
    P, (errors, slope) = poses.along_axes(), _affine(poses)
    own = _own_scales(errors, slope, P)
    found = one_scale(*own, poses.logged)
    s = np.exp(np.where(np.isfinite(found.log_scale), found.log_scale, 0.0))
    known = np.where(np.isfinite(own.sigma), np.exp(own.log_scale) * own.sigma, 0.0)
    share = (known[..., None] * slope) ** 2 / np.diagonal(P, axis1=-2, axis2=-1)
    fitted = np.clip(share[poses.logged].mean(axis=0), 0.0, 1.0).tolist()
    scale = Scale(found.log_scale, found.drift, own.sigma, found.normalised, 1.0, tuple(fitted))
    return errors + slope * (s - 1)[:, None, None], P, scale


def errors_beyond_scale(
    convention: Convention, estimates: Matrices, truths: Matrices, covariances: Squares
) -> BeyondScale:
    """The part of every pose's error that is not one of scale, about the origin of the world.

    The covariances are in the convention.
    """
    logged = np.ones(estimates.shape[:-2], bool)
    poses = Poses(estimates, covariances, truths, logged, convention)
    return _own_scales(*_affine(poses), covariances)


def _affine(poses: Poses) -> tuple[Tangents, Tangents]:
    """Return e and g = de/ds of the truth times s: every error is `e + g (s − 1)`."""
    twice = poses.truths.copy()
    twice[..., :-1, -1] *= 2.0
    once = poses.errors()
    return once, poses._replace(truths=twice).errors() - once


def _own_scales(errors: Tangents, slope: Tangents, covariances: Squares) -> BeyondScale:
    """The scale in `SCALES` that explains each pose alone best, `ŝ = 1 − gᵀ P⁻¹ e/(gᵀ P⁻¹ g)`."""
    sigma, L = sigmas(covariances), np.linalg.cholesky(correlations(covariances))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        both = np.stack([errors / sigma, slope / sigma], axis=-1)
        e, g = np.moveaxis(np.linalg.solve(L, both), -1, 0)
        curvature = np.sum(g * g, axis=-1)
        step = np.sum(g * e, axis=-1) / np.where(curvature > 0, curvature, 1.0)
        s = np.clip(1.0 - step, *SCALES)
        nees = np.sum((e + g * (s - 1)[..., None]) ** 2, axis=-1)
        return BeyondScale(nees, np.log(s), 1 / (s * np.sqrt(curvature)))


def _jointly(poses: Poses, joints: Joints) -> tuple[PerAxis, Squares, Scale]:
    """Fit one scale by the joint covariance: exact, each NEES has all its degrees of freedom.

    What is left of a run at its ŝ has the covariance `Σ − G Gᵀ/(Gᵀ Σ⁻¹ G)`.
    """
    (e, G), own, t = _affine(poses), poses.along_axes(), poses.covariances.shape[-1]
    left, (drift, sigma, nees) = own.copy(), (np.full(e.shape[:2], np.nan) for _ in range(3))
    log_scale = np.full(len(e), np.nan)
    for run, logged in enumerate(poses.logged):
        rows = (np.flatnonzero(logged)[:, None] * t + poses.axes).ravel()
        joint = joints[run][np.ix_(rows, rows)]
        s, information = _fitted(joint, e[run, logged].ravel(), G[run, logged].ravel(), run)
        if information <= 0 or s <= 0:
            continue
        log_scale[run] = np.log(s)
        e[run] += G[run] * (s - 1)
        left[run] -= (G[run, :, :, None] * G[run, :, None]) / information
    # The share of a covariance that is left where one pose alone determines the scale.
    left += 1e-9 * own
    told = poses.logged & np.isfinite(log_scale)[:, None] & (np.abs(G).max(axis=-1) > 0)
    h = np.linalg.solve(own[told], G[told][..., None])[..., 0]
    h /= np.sum(h * G[told], axis=-1)[:, None]
    away = np.sum(h * e[told], axis=-1)
    variance = np.einsum("ki,kij,kj->k", h, left[told], h)
    s = np.exp(np.broadcast_to(log_scale[:, None], told.shape)[told])
    drift[told], sigma[told], nees[told] = -away / s, np.sqrt(variance) / s, away**2 / variance
    return e, left, Scale(log_scale, drift, sigma, nees, 0.0, (0.0,) * e.shape[-1])


def _fitted(joint: Squares, e: Tangents, G: Tangents, run: int) -> tuple[float, float]:
    """The ŝ of a run, and the information of all its poses on it, Gᵀ Σ⁻¹ G. Raises ValueError."""
    scaling = 1 / np.sqrt(np.maximum(np.diagonal(joint), np.finfo(float).tiny))
    try:
        L = np.linalg.cholesky(joint * scaling * scaling[:, None])
    except np.linalg.LinAlgError:
        raise ValueError(
            f"the joint covariance of run {run} is not positive definite; NEES at one scale needs "
            "one that is, or only the covariances of single poses"
        ) from None
    residual, slope = np.linalg.solve(L, np.stack([e, G], axis=1) * scaling[:, None]).T
    information = float(slope @ slope)
    return (1 - float(slope @ residual) / information if information else 1.0), information


def of_aligned(poses: Poses, log_scale: Float[np.ndarray, " runs"]) -> Scale:
    """The drift of poses that a Sim(n) has aligned to the truth, about the middle of each run."""
    T, truth, split = poses.estimates.copy(), poses.truths.copy(), Convention("split")
    there = poses.logged[..., None, None]
    middle = np.mean(truth, axis=1, where=there, keepdims=True)[..., :-1, -1]
    for x in (T, truth):
        x[..., :-1, -1] -= middle
    P = converted(poses.covariances, poses.estimates, poses.convention, split)
    P = converted(P, T, split, poses.convention)
    moved = poses._replace(estimates=T, truths=truth, covariances=P)
    _, own_scale, sigma = _own_scales(*_affine(moved), moved.along_axes())
    told = poses.logged & np.isfinite(sigma)
    drift, sigma = np.where(told, own_scale, np.nan), np.where(told, sigma, 1.0)
    none = (0.0,) * len(poses.axes)
    return Scale(log_scale, drift, sigma, (drift / sigma) ** 2, 0.0, none)
