"""What a study of posteriors says: numbers for JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from exact_posterior.ranks import ranks, uniformity
from jaxslam.statistics.bands import lost_threshold, mean_band

Arrays = Mapping[str, np.ndarray]

KINDS = ("exact", "gaussian_prior")
KEPT = 99
"""Draws that a truth is ranked among; their chains are nearly uncorrelated when so thinned."""


def summarise_nees(nees: Float[np.ndarray, " runs"], dof: int) -> dict[str, Any]:
    """Mean with its standard error and exact χ² band, median, share of lost runs."""
    finite = np.isfinite(nees)
    values = nees[finite]
    return {
        "runs": len(nees),
        "mean": _number(values.mean()) if len(values) else None,
        "standard_error": _number(values.std(ddof=1) / np.sqrt(len(values)))
        if len(values) > 1
        else None,
        "band95": list(mean_band(dof, max(len(values), 1))),
        "median": _number(np.median(np.where(finite, nees, np.inf))),
        "lost": float(np.mean(~(nees <= lost_threshold(dof)))),
    }


def summarise_sampler(records: Arrays, used: Bool[np.ndarray, " runs"]) -> dict[str, Any]:
    """How many runs' chains converged, and how well they mixed."""
    return {
        "runs": len(used),
        "used": int(used.sum()),
        "sampler": {kind: _sampler(records, kind) for kind in KINDS},
    }


def summarise_reference(records: Arrays, used: Bool[np.ndarray, " runs"]) -> dict[str, Any]:
    """The exact posterior and what approximates it, over the runs whose chains converged."""
    r = {name: value[used] for name, value in records.items()}
    dof = r["exact_error"].shape[1]
    return {
        **summarise_sampler(records, used),
        "calibration": _calibration(r),
        "nees": {
            "exact": summarise_nees(r["exact_nees"], dof),
            "gaussian_prior": summarise_nees(r["gaussian_prior_nees"], dof),
            "gaussian_prior_laplace": summarise_nees(r["gaussian_prior_laplace_nees"], dof),
        },
        "laplace": against_exact(
            {k.removeprefix("gaussian_prior_laplace_"): v for k, v in r.items()}, r
        ),
    }


def against_exact(filter_records: Arrays, reference: Arrays) -> dict[str, Any]:
    """σ and error of an estimate over those of the exact posterior, run by run."""
    n = position_dim(reference["exact_error"].shape[1])
    out: dict[str, Any] = {}
    for part, axes in (("position", slice(0, n)), ("orientation", slice(n, None))):
        own = _sigma(filter_records["covariance"], axes)
        exact = _sigma(reference["exact_covariance"], axes)
        errors = [
            np.sqrt(np.mean(np.sum(e[:, axes] ** 2, axis=1)))
            for e in (filter_records["error"], reference["exact_error"])
        ]
        out[part] = {
            "sigma_ratio": _number(np.median(own / exact)),
            "rmse_ratio": _number(errors[0] / errors[1]),
        }
    return out


def summarise_filter(
    filter_records: Arrays, reference: Arrays, used: Bool[np.ndarray, " runs"]
) -> dict[str, Any]:
    """A filter beside the exact posterior, over the runs whose chains converged."""
    f = {name: value[used] for name, value in filter_records.items()}
    r = {name: value[used] for name, value in reference.items()}
    return {
        "nees": summarise_nees(f["nees"], r["exact_error"].shape[1]),
        **against_exact(f, r),
        "kl": {"median": _number(np.median(f["kl"])), "mean": _number(np.mean(f["kl"]))},
    }


def _sampler(records: Arrays, kind: str) -> dict[str, float]:
    r = {key: records[f"{kind}_{key}"] for key in ("rhat", "ess", "divergent", "leapfrogs")}
    return {
        "rhat_median": float(np.median(r["rhat"])),
        "rhat_worst": float(np.max(r["rhat"])),
        "ess_median": float(np.median(r["ess"])),
        "ess_least": float(np.min(r["ess"])),
        "divergent": float(np.mean(r["divergent"])),
        "leapfrogs": float(np.mean(r["leapfrogs"])),
    }


def _calibration(r: Arrays) -> dict[str, Any]:
    """Simulation-based calibration of position, orientation and velocity."""
    n = position_dim(r["exact_error"].shape[1])
    axes = "xz" if n == 2 else "xyz"
    turns = ["θ"] if n == 2 else ["θx", "θy", "θz"]
    names = [*axes, *turns, *(f"v{axis}" for axis in axes), *(f"v{turn}" for turn in turns)]
    histograms, p = uniformity(ranks(r["exact_truth"], r["exact_draws"], KEPT), KEPT)
    return {
        "names": names,
        "histograms": histograms.tolist(),
        "p": [float(value) for value in p],
    }


def _sigma(P: Float[np.ndarray, "runs t t"], axes: slice) -> Float[np.ndarray, " runs"]:
    return np.sqrt(np.trace(P[:, axes, axes], axis1=1, axis2=2))


def position_dim(tangent_dim: int) -> int:
    """How many of a pose's numbers are of its position."""
    return {3: 2, 6: 3}[tangent_dim]


def _number(value: float) -> float | None:
    """For JSON, which has no NaN."""
    return float(value) if np.isfinite(value) else None
