"""Is a filter consistent? From its errors and covariances, whoever's it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam.consistency.statistics import mean_band
from jaxslam.consistency.verdict import headline, run_verdict, sentences
from jaxslam.evaluation.arrays import normalised, paired, step_times, without_known
from jaxslam.evaluation.convention import Convention
from jaxslam.evaluation.identify import Identification
from jaxslam.files import json_numbers, write_json
from jaxslam.lookup import chosen

SCHEMA = 1
SIGMAS = 3
OUTSIDE = 0.0027
"""Share of a Gaussian beyond ±3σ."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What errors and covariances say of a filter; printed, it is its verdict and its table."""

    quantity: str
    """NEES, or NIS of innovations."""
    dof: int
    """Degrees of freedom: the NEES that a consistent filter has on average."""
    nees: Float[np.ndarray, "runs steps"]
    """Of every run and step; not finite of one that diverged."""
    errors: Float[np.ndarray, "runs steps n"]
    sigmas: Float[np.ndarray, "runs steps n"]
    """What the filter claims of every error."""
    times: Float[np.ndarray, " steps"]
    timed: bool
    """Whether they are seconds, or numbers of steps as nobody told times."""
    names: tuple[str, ...]
    """Of the axes."""
    convention: Convention | None = None
    """Of the covariances, where they are of poses."""
    alignment: str = "none"
    """By which the estimates were laid on the truth: `none`, `se3` or `sim3`."""
    identified: Identification | None = None
    """Which convention would make the data consistent, where it was asked."""
    notes: tuple[str, ...] = ()
    """What was left out, and what was assumed."""

    @property
    def runs(self) -> int:
        return len(self.nees)

    @property
    def steps(self) -> int:
        return self.nees.shape[1]

    @cached_property
    def verdict(self) -> dict[str, Any]:
        """Of one study over all steps, see `jaxslam.consistency.Tally.verdict`."""
        return run_verdict(self.nees, self.dof)

    @property
    def headline(self) -> str:
        """The verdict in a line."""
        return headline(self.verdict).replace("NEES", self.quantity, 1)

    @cached_property
    def finite(self) -> Bool[np.ndarray, " runs"]:
        """Which runs did not diverge: what means and band are of, as in `consistency.json`."""
        return np.asarray(np.isfinite(self.nees).all(axis=1))

    @property
    def mean(self) -> Float[np.ndarray, " steps"]:
        """Mean NEES of every step; NaN where no run is left."""
        if not self.finite.any():
            return np.full(self.steps, np.nan)
        return self.nees[self.finite].mean(axis=0)

    @property
    def band95(self) -> tuple[float, float]:
        """Exact bounds of the mean at one step (`jaxslam.mean_band`)."""
        return mean_band(self.dof, max(int(self.finite.sum()), 1))

    @property
    def rmse(self) -> Float[np.ndarray, "steps n"]:
        """Of every step and axis."""
        return _rms(self.errors)

    @property
    def sigma(self) -> Float[np.ndarray, "steps n"]:
        """Claimed, of every step and axis: the root of the mean variance."""
        return _rms(self.sigmas)

    @property
    def outside3sigma(self) -> Float[np.ndarray, " n"]:
        """Share of the errors of every axis beyond ±3σ; .27 % of Gaussian ones are."""
        return np.mean(np.abs(self.errors) > SIGMAS * self.sigmas, axis=(0, 1))

    @property
    def suggested(self) -> Convention | None:
        """Another convention, the only one that would make the data consistent."""
        return None if self.identified is None else self.identified.suggested

    def axis_verdict(self, axis: int) -> dict[str, Any]:
        """The verdict on one axis alone, of one degree of freedom."""
        with np.errstate(over="ignore"):
            return run_verdict((self.errors[..., axis] / self.sigmas[..., axis]) ** 2, 1)

    def asdict(self) -> dict[str, Any]:
        """The content of `evaluation.json`."""
        from jaxslam import __version__

        by_axis = {name: i for i, name in enumerate(self.names)}
        low, high = self.band95
        return {
            "schema": SCHEMA,
            "version": __version__,
            "quantity": self.quantity,
            "runs": self.runs,
            "steps": self.steps,
            "dof": self.dof,
            "time": json_numbers(self.times),
            "band95": [low, high],
            "nees": json_numbers(self.mean),
            "inside": float(np.mean((self.mean >= low) & (self.mean <= high))),
            "verdict": self.verdict,
            "outside3sigma": {n: float(self.outside3sigma[i]) for n, i in by_axis.items()},
            "rmse": {n: json_numbers(self.rmse[:, i]) for n, i in by_axis.items()},
            "sigma": {n: json_numbers(self.sigma[:, i]) for n, i in by_axis.items()},
            "axis_verdict": {n: self.axis_verdict(i) for n, i in by_axis.items()},
            "convention": None if self.convention is None else asdict(self.convention),
            "alignment": self.alignment,
            "suggested": None if self.suggested is None else asdict(self.suggested),
            "identified": None if self.identified is None else self.identified.asdict(),
            "notes": list(self.notes),
        }

    def save(self, folder: str | Path) -> Path:
        """Write `evaluation.json` into a folder, which is made; its path. Raises ValueError."""
        path = Path(folder) / "evaluation.json"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, self.asdict(), allow_nan=False)
        except OSError as error:
            raise ValueError(f"{folder}: cannot write there ({error.strerror})") from None
        return path

    def __str__(self) -> str:
        told = [line.replace("NEES", self.quantity) for line in sentences(self.verdict)]
        doubt = [] if self.identified is None else [self.identified.sentence]
        return "\n".join([*told, *doubt, "", *self._table(), *self.notes])

    def _table(self) -> list[str]:
        low, high = self.band95
        inside = np.mean((self.mean >= low) & (self.mean <= high))
        runs = f"{self.runs} run{'s' if self.runs > 1 else ''}"
        return [
            f"{runs} of {self.steps} steps; mean {self.quantity} of a consistent filter "
            f"{self.dof}, at one step in {low:.3f}–{high:.3f} with 95 %; "
            f"{inside:.0%} of the steps are inside",
            _columns("axis", "RMSE", "σ claimed", "σ should be ×", "99 % interval", "outside ±3σ"),
            *(self._row(i) for i in range(len(self.names))),
            _columns("consistent:", "", "", "1", "", f"{OUTSIDE:.2%}"),
        ]

    def _row(self, axis: int) -> str:
        found = self.axis_verdict(axis)
        rmse, sigma = (f"{_rms(x[:, axis]):.4g}" for x in (self.rmse, self.sigma))
        factor, low, high = (
            "–" if x is None else f"{x:.3f}" if x < 10 else f"{x:.3g}"
            for x in (found["sigma_factor"], *found["interval99"])
        )
        outside = f"{self.outside3sigma[axis]:.2%}"
        return _columns(self.names[axis], rmse, sigma, factor, f"[{low}, {high}]", outside)


def _columns(*cells: str) -> str:
    return f"{cells[0]:<14}" + "".join(f"{cell:>17}" for cell in cells[1:])


def evaluate(
    errors: ArrayLike,
    covariances: ArrayLike,
    *,
    times: ArrayLike | None = None,
    names: Sequence[str] = (),
    quantity: str = "NEES",
) -> Evaluation:
    """The verdict on a filter from its errors (runs, steps, n) and their covariances (runs, steps,
    n, n), or from innovations and theirs with `quantity="NIS"`, which needs no truth.

    Runs are independent of each other, steps of a run need not be. `times` (steps,) are seconds and
    `names` (n,) those of the axes. Steps at the beginning that every run knows exactly, with a
    covariance of zero, are left out. Raises ValueError, naming run and step, for what is not
    finite, not symmetric or not positive definite.
    """
    e, P = paired(errors, covariances)
    start = without_known(e, P)
    at = step_times(times, e.shape[1])
    e, P = e[:, start:], P[:, start:]
    return Evaluation(
        quantity=next(iter(chosen("quantity", quantity, dict.fromkeys(("NEES", "NIS"))))),
        dof=e.shape[-1],
        nees=normalised(e, P),
        errors=e,
        sigmas=np.sqrt(np.diagonal(P, axis1=-2, axis2=-1)),
        times=at[start:],
        timed=times is not None,
        names=_names(names, e.shape[-1]),
        notes=left_out(start),
    )


def _rms(values: np.ndarray) -> Any:
    """Root of the mean square over the first axis; infinite where it overflows."""
    with np.errstate(over="ignore"):
        return np.sqrt(np.mean(values**2, axis=0))


def left_out(start: int) -> tuple[str, ...]:
    """A word on the steps at the beginning that are known by definition."""
    steps = "the first step is" if start == 1 else f"the first {start} steps are"
    return (f"{steps} known exactly, and left out",) if start else ()


def _names(names: Sequence[str], n: int) -> tuple[str, ...]:
    told = tuple(str(name) for name in names) or tuple(str(i + 1) for i in range(n))
    if len(told) != n or len(set(told)) != n:
        raise ValueError(f"names must be {n} different ones, one an axis, not {list(told)}")
    return told
