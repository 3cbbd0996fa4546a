"""The verdict on innovations, which need no truth: those of a right filter are white.

So every step is a sample of its own (Bar-Shalom, Li, Kirubarajan 2001, §5.4.2), and one long run
tells as much as many short ones. Whether they are white is tested first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincc

from jaxslam.statistics.bands import PowerSums
from jaxslam.statistics.looks import VERDICT_CONFIDENCE
from jaxslam.statistics.verdict import THIRDS, Tally, run_verdict

_LAGS = 10
_LEAST = 20
"""Pairs of steps of which a correlation is told."""


def innovation_verdict(
    nis: Float[np.ndarray, "runs steps"], normalised: Float[np.ndarray, "runs steps n"], dof: int
) -> dict[str, Any]:
    """As `run_verdict`, of every step (`samples`: steps) where innovations seem white, else of
    every run.

    `normalised` are innovations over their σ; steps that a run lacks are NaN in `nis`. `white` is
    the p of `whiteness_p_value`, None where steps are too few or a NIS is not finite. A run that
    has a NIS above the quantile of lost runs is outlying: nothing is lost.
    """
    found = run_verdict(nis, dof, logged=~np.isnan(nis))
    p = None if found["diverged"] else whiteness_p_value(nis, normalised)
    white = p is not None and p >= 1 - VERDICT_CONFIDENCE
    if white:
        found |= _of_steps(nis, dof, found["lost_runs"]).verdict() | {
            "lost_runs": found["lost_runs"]
        }
    word = "outlying" if found["word"] == "lost" else found["word"]
    return found | {"word": word, "samples": "steps" if white else "runs", "white": p}


def whiteness_p_value(
    nis: Float[np.ndarray, "runs steps"], normalised: Float[np.ndarray, "runs steps n"]
) -> float | None:
    """Of white innovations, by their autocorrelations and by those of NIS; None of too few.

    Of each axis, and of NIS about its mean, `Q = Σₗ rₗ² Nₗ`, the Nₗ pairs of steps l apart having
    the correlation rₗ, is χ² (Ljung and Box, Biometrika 1978; of all runs); the least p of them by
    Bonferroni. The mean of innovations is not taken away: one with a bias is not white.
    """
    lags = min(_LAGS, nis.shape[1] // 4)
    there = ~np.isnan(nis)
    if not lags or np.sum(there[:, 1:] & there[:, :-1]) < _LEAST:
        return None
    series = [*np.moveaxis(normalised, -1, 0), nis - np.mean(nis, where=there)]
    with np.errstate(over="ignore", invalid="ignore"):
        p = [_portmanteau(np.where(there, x, 0.0), there, lags) for x in series]
    return min(1.0, len(p) * float(np.nanmin(p)))


def _portmanteau(values: np.ndarray, there: np.ndarray, lags: int) -> float:
    total, power = 0.0, np.sum(values**2) / np.sum(there)
    for lag in range(1, lags + 1):
        pairs = max(np.sum(there[:, lag:] & there[:, :-lag]), 1)
        total += (np.sum(values[:, lag:] * values[:, :-lag]) / power) ** 2 / pairs
    return float(gammaincc(lags / 2, total / 2))


def _of_steps(nis: Float[np.ndarray, "runs steps"], dof: int, outlying: list[int]) -> Tally:
    """A tally to which every step is a run, but for the counts of runs."""
    there = ~np.isnan(nis)
    steps = there.sum(axis=1, keepdims=True)
    third = len(THIRDS) * (np.cumsum(there, axis=1) - 1) // steps
    first, second, last = (PowerSums.of(nis[there & (third == i)]) for i in range(len(THIRDS)))
    kept = np.ones(len(nis), bool)
    kept[outlying] = False
    at_end = nis[range(len(nis)), nis.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1)]
    return Tally(
        dof=dof,
        runs=len(nis),
        diverged=0,
        lost=len(outlying),
        average=PowerSums.of(nis[there]),
        end=PowerSums.of(at_end),
        never_lost=PowerSums.of(nis[there & kept[:, None]]),
        thirds=(first, second, last),
    )
