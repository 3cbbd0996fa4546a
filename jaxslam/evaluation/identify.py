"""Which convention would make the data consistent, where exactly one does.

A wrong convention keeps the determinant of a covariance, so that it raises the expected NEES, and
the one with the least NEES is the most likely, whatever the filter's σ is wrong by. It is told
from another where the runs' averages of NEES differ by more than they scatter, pair by pair; and it
*makes the data consistent* where the verdict on it says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxslam.consistency.statistics import PowerSums, mean_p_value
from jaxslam.consistency.verdict import VERDICT_CONFIDENCE, not_disproved, run_verdict
from jaxslam.evaluation.convention import Convention

NOTICEABLE = 0.05
"""NEES that differ by less than this share say the same of σ, to 2.5 %."""

_TOLD = 3
"""Conventions that cannot be told, of which a sentence speaks."""


@dataclass(frozen=True)
class Identification:
    """What the data say of the convention that was stated."""

    stated: Convention
    nees: dict[Convention, float]
    """Mean NEES under every convention that was tried."""
    consistent: tuple[Convention, ...]
    """Those that cannot be told from the best, if that is consistent; else none."""

    @property
    def convention(self) -> Convention | None:
        """The only one that makes the data consistent; None where that cannot be told."""
        return self.consistent[0] if len(self.consistent) == 1 else None

    @property
    def doubtful(self) -> bool:
        """Whether the stated convention is not among those that make the data consistent."""
        return bool(self.consistent) and self.stated not in self.consistent

    @property
    def suggested(self) -> Convention | None:
        """The convention, where it is another than the stated one."""
        return self.convention if self.doubtful else None

    @property
    def sentence(self) -> str:
        """What was found, in a line."""
        if not self.consistent:
            return "no other convention of the covariance would make the data consistent"
        if self.suggested is not None:
            return (
                f"the convention ({self.stated}) is doubtful: only with {self.suggested} would "
                f"the data be consistent, NEES {self.nees[self.suggested]:.2f}"
            )
        apart = [str(c) for c in self.consistent if c != self.stated]
        others = "; ".join(apart[:_TOLD])
        if len(apart) > _TOLD:
            others += f"; and {len(apart) - _TOLD} more"
        if self.doubtful:
            return f"the convention ({self.stated}) is doubtful, but these cannot be told: {others}"
        if others:
            return f"the convention ({self.stated}) cannot be told from: {others}"
        return f"the convention ({self.stated}) is the only one that makes the data consistent"

    def asdict(self) -> dict[str, Any]:
        """For `evaluation.json`."""
        return {
            "stated": asdict(self.stated),
            "convention": None if self.convention is None else asdict(self.convention),
            "consistent": [asdict(c) for c in self.consistent],
            "nees": [asdict(c) | {"nees": nees} for c, nees in self.nees.items()],
        }


def identify(
    stated: Convention, nees: Mapping[Convention, Float[np.ndarray, "runs steps"]], dof: int
) -> Identification:
    """The convention from the NEES that each of them gives, of the same runs; NaN where nothing was
    logged."""
    finite = {c: x for c, x in nees.items() if not np.isinf(x).any()}
    means = {c: float(np.nanmean(x)) for c, x in finite.items()}
    if not finite:
        return Identification(stated, means, ())
    best = min(finite, key=lambda c: means[c])
    if not not_disproved(run_verdict(finite[best], dof, logged=~np.isnan(finite[best]))):
        return Identification(stated, means, ())
    equal = tuple(c for c in finite if not _worse(finite[c], finite[best]))
    return Identification(stated, means, equal)


def _worse(nees: Float[np.ndarray, "runs steps"], least: Float[np.ndarray, "runs steps"]) -> bool:
    """Whether the one NEES is larger than the other beyond doubt, and noticeably."""
    if np.nanmean(nees) < (1 + NOTICEABLE) * np.nanmean(least):
        return False
    p = mean_p_value(PowerSums.of(np.nanmean(nees, axis=1) - np.nanmean(least, axis=1)), 0.0)
    return p < 1 - VERDICT_CONFIDENCE
