"""A search for the one convention that would make the data consistent.

A wrong convention keeps the determinant of a covariance, so that it raises the expected NEES, and
the one with the least NEES is the most likely, whatever the filter's σ is wrong by. (Of a part of
the axes the determinant may change: `NEES det(P)^(1/dof)` is compared.) It is distinguished from
another where the runs' averages of NEES differ by more than they scatter, pair by pair, or where
few runs are far likelier with it. It *makes the data consistent* where nothing is proven against
the NEES of all axes, nor of position or rotation alone.

A scale that is fitted lowers NEES whatever the convention, of a right covariance that of the
position at least from n to n − 1. Only where it lowers it further, so that no σ explains it, is
the covariance one given the scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from jaxslam._runtime.files import Json
from jaxslam.evaluation.convention import Convention
from jaxslam.statistics.bands import PerStep, PowerSums, mean_p_value
from jaxslam.statistics.verdict import VERDICT_CONFIDENCE, Verdict, not_disproved, run_verdict

NOTICEABLE = 0.05
"""NEES that differ by less than this share say the same of σ, to 2.5 %."""
FEW = 30
"""The most runs that may be too few for their scatter, and are judged by likelihood too."""
LIKELIER = float(np.log(1000 * 100 * 24))
"""The log of how many times as likely the runs must be: 1000, for each of 100 factors that σ may
be wrong by with the better convention, and of the conventions of which that is the best."""
_TOLD = 3
"""The most indistinguishable conventions that a sentence names."""
_ALIKE = " (right and split errors are the same to first order)"


class Tried(NamedTuple):
    """The NEES of the data under a convention; NaN where nothing was logged."""

    nees: PerStep
    dof: int
    fitted: float = 0.0
    """The most degrees of freedom that a fit took from every NEES."""
    log_determinant: float = 0.0
    """The log determinant of the covariances, on average."""
    parts: Mapping[str, tuple[PerStep, int]] = MappingProxyType({})
    """The NEES of `position` and of `rotation` alone, where there are such axes, and their
    degrees of freedom."""
    right: bool = False
    """Whether nothing shows that σ is too small, by any test of the verdict."""

    def last(self, steps: int) -> Tried:
        """Return the same of the last steps alone."""
        parts = {what: (nees[:, -steps:], dof) for what, (nees, dof) in self.parts.items()}
        return self._replace(nees=self.nees[:, -steps:], parts=parts)

    @property
    def finite(self) -> bool:
        parts = (self.nees, *(nees for nees, _ in self.parts.values()))
        return not any(np.isinf(x).any() for x in parts)

    @property
    def whole(self) -> bool:
        """Whether nothing is proven against all axes together."""
        return not_disproved(_verdict(self.nees, self.dof, self.fitted))

    @property
    def consistent(self) -> bool:
        """Whether nothing is proven against it."""
        # The confidence of what is said against position or rotation alone, after all axes
        # together.
        return self.whole and all(
            _verdict(nees, dof, self.fitted * (what == "position"))["p"] >= 1 - 0.999
            for what, (nees, dof) in self.parts.items()
        )


def _verdict(nees: PerStep, dof: int, fitted: float) -> Verdict:
    return run_verdict(nees, dof, fitted, ~np.isnan(nees))


@dataclass(frozen=True)
class Identification:
    """The verdict of the data on the convention that was stated."""

    stated: Convention
    nees: dict[Convention, float]
    """The mean NEES under every convention that was tried."""
    consistent: tuple[Convention, ...]
    """The conventions not distinguishable from the best, if that is consistent; else none."""
    stands: bool = False
    """Whether the data are consistent with the stated one too, be another the better."""
    whole: bool = False
    """Whether all axes together are: position or rotation alone may not be."""
    possible: Convention | None = None
    """The best of those that are better, and under which nothing shows that σ is too small."""
    better: tuple[Convention, int, int] | None = None
    """Where none makes the data consistent, the one that certainly fits better than the stated
    one, in how many runs, and of how many."""

    @property
    def convention(self) -> Convention | None:
        """The only one that makes the data consistent, or fits them best; None if unknown."""
        return self.consistent[0] if len(self.consistent) == 1 else None

    @property
    def doubtful(self) -> bool:
        """Whether the stated convention is not among those that fit the data best."""
        return bool(self.consistent) and self.stated not in self.consistent

    @property
    def suggested(self) -> Convention | None:
        """The convention, where it is another than the stated one."""
        return self.convention if self.doubtful else None

    @property
    def sentence(self) -> str:
        """The result in a line."""
        if not self.consistent and self.whole:
            return "σ of position or rotation alone is wrong under every convention tried"
        if self.better is not None:
            other, count, runs = self.better
            return (
                f"no convention of the covariance makes the data consistent, but {other} fits "
                f"better than {self.stated} in {count} of {runs} runs, NEES "
                f"{self.nees[other]:.4g} instead of {self.nees[self.stated]:.4g}"
            )
        if not self.consistent:
            return "no other convention of the covariance would make the data consistent"
        alike = _ALIKE if self.consistent[0].error in ("right", "split") else ""
        doubtful = f"the convention ({self.stated}) is doubtful"
        if (other := self.suggested) is not None:
            nees = f"NEES {self.nees[other]:.2f}"
            if self.stands and self.stated in self.nees:
                nees += f" instead of {self.nees[self.stated]:.2f}"
                return f"{doubtful}: {other} fits the same runs better, {nees}{alike}"
            return f"{doubtful}: only with {other} would the data be consistent, {nees}{alike}"
        apart = [str(c) for c in self.consistent if c != self.stated]
        more = [f"and {len(apart) - _TOLD} more"] if len(apart) > _TOLD else []
        others = "; ".join(apart[:_TOLD] + more)
        if self.doubtful:
            return f"{doubtful}, but these fit equally well: {others}"
        if others:
            return f"the convention ({self.stated}) cannot be distinguished from: {others}"
        return f"of {len(self.nees)} conventions the stated one ({self.stated}) fits best{alike}"

    def asdict(self) -> dict[str, Json]:
        """Return the content for `evaluation.json`."""
        return {
            "stated": asdict(self.stated),
            "convention": self.convention and asdict(self.convention),
            "consistent": [asdict(c) for c in self.consistent],
            "better": None if self.better is None else asdict(self.better[0]),
            "nees": [asdict(c) | {"nees": nees} for c, nees in self.nees.items()],
        }


def identify(
    stated: Convention,
    tried: Mapping[Convention, Tried],
    given: Callable[[], Mapping[Convention, Tried]] = dict,
) -> Identification:
    """The convention from the NEES that each of them gives, of the same runs.

    Those `given` the scale are tried where none of the others makes the data consistent.
    """
    finite = _finite(tried)
    own, (best, equal) = finite.get(stated), _best(finite)
    better = None
    if own is not None and best not in (None, stated) and _distinguished(own, finite[best]):
        lower = np.nanmean(finite[best].nees, axis=1) < np.nanmean(own.nees, axis=1)
        better = best, int(lower.sum()), len(lower)
    if best is None or not finite[best].consistent:
        free = _finite(given())
        found, equal = _best(free)
        if (
            found is None
            or not free[found].consistent
            or (best is not None and not _scale_was_free(finite[best], free[found]))
        ):
            equal = ()
        finite |= free
    means = {c: float(np.nanmean(x.nees)) for c, x in finite.items()}
    stands, whole = own is not None and own.consistent, own is not None and own.whole
    # Of covariances as large, on average; a fit of the scale takes more than a wrong convention.
    fits = [(np.exp(x.log_determinant / x.dof) * means[c], c) for c, x in finite.items()]
    own_fit = next((fit for fit, c in fits if c == stated), 0.0)
    right = [(fit, c) for fit, c in fits if fit < own_fit and c in tried and finite[c].right]
    possible = min(right, key=lambda x: x[0])[1] if right else None
    return Identification(stated, means, equal, stands, whole, possible, None if equal else better)


def _finite(tried: Mapping[Convention, Tried]) -> dict[Convention, Tried]:
    """The finite ones, over the steps that all have: one may know a first pose exactly."""
    steps = min((x.nees.shape[1] for x in tried.values()), default=0)
    return {c: last for c, x in tried.items() if (last := x.last(steps)).finite}


def _best(tried: Mapping[Convention, Tried]) -> tuple[Convention | None, tuple[Convention, ...]]:
    """The most likely one, and all that cannot be distinguished from it."""
    if not tried:
        return None, ()
    size = {c: x.log_determinant / x.dof for c, x in tried.items()}
    best = min(tried, key=lambda c: size[c] + np.log(np.nanmean(tried[c].nees) + 1e-300))
    weight = {c: np.exp(min(size[c] - size[best], 300.0)) for c in tried}
    weighted = {c: x._replace(nees=weight[c] * x.nees) for c, x in tried.items()}
    return best, tuple(c for c, x in weighted.items() if not _distinguished(x, tried[best]))


def _scale_was_free(marginal: Tried, given: Tried) -> bool:
    """Whether a fitted scale takes more from the NEES of positions than any wrong σ explains."""
    if "position" not in marginal.parts or "position" not in given.parts:
        return False
    (nees, n), (fitted, _) = (x.parts["position"] for x in (marginal, given))
    return n > 1 and _worse(nees, n / (n - 1) * fitted)


def _distinguished(other: Tried, best: Tried) -> bool:
    """Whether the best is the better one beyond doubt: by the scatter of runs, or by likelihood.

    Of few runs along one path a wrong NEES is the square of one number a run, and scatters so much
    that nothing is known of its mean. But let the other be right up to a factor of σ, the likeliest
    one: then the best is k times as likely with a chance of 1/k, also of correlated steps, by the
    mean of their logs (Jensen).
    """
    if _worse(other.nees, best.nees):
        return True
    own, least = (np.nanmean(x.nees, axis=1) for x in (other, best))
    if not (np.mean(least) > 0 and 2 <= len(own) <= FEW):
        return False
    ratio = (best.dof - best.fitted) / 2 * len(own) * np.log(np.mean(own) / np.mean(least))
    in_most = np.mean(own > least) > 0.5  # not for one run that was lost
    return bool(in_most and ratio > LIKELIER)


def _worse(nees: PerStep, least: PerStep) -> bool:
    """Whether the one NEES is larger than the other beyond doubt, and noticeably."""
    if np.nanmean(nees) < (1 + NOTICEABLE) * np.nanmean(least):
        return False
    off = np.nanmean(nees, axis=1) - np.nanmean(least, axis=1)
    off /= max(float(np.abs(off).max()), 1e-300)  # whose third power is finite
    return mean_p_value(PowerSums.of(off), 0.0) < 1 - VERDICT_CONFIDENCE
