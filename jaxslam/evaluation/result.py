"""The consistency of a filter, of any program, from its errors and covariances."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam._runtime import plotted
from jaxslam._runtime.files import Json, json_numbers, write_json
from jaxslam._runtime.lookup import lookup, suggestion
from jaxslam.evaluation.convention import Convention, Squares
from jaxslam.evaluation.convention_search import Identification
from jaxslam.evaluation.inputs import (
    at,
    check_every_run,
    filled,
    numbers,
    of_one_dof,
    padded,
    paired,
    sigmas,
    squared,
    step_times,
    whitened,
    without_known,
)
from jaxslam.evaluation.sanity_checks import Logged, Mistake, gated, mistakes, withheld
from jaxslam.evaluation.scale import Scale
from jaxslam.statistics import calibration
from jaxslam.statistics.bands import Mask, PerAxis, PerStep, exact_band
from jaxslam.statistics.looks import VERDICT_CONFIDENCE
from jaxslam.statistics.verdict import (
    Verdict,
    headline,
    innovation_verdict,
    lost_runs,
    run_verdict,
    sentences,
)

_MOST_DOF = 1_000_000
_LISTED = 20
"""The most lost runs that are named in the text; the file names all."""
OUTSIDE = 0.0027
"""The share of a Gaussian beyond ±3σ."""
MOST = 1000.0
"""The factor above which the end of an interval says nothing."""


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """The evaluation of a filter by its errors and covariances; prints as verdict and table.

    It shows itself in a notebook, draws itself by `plot`, and is written by `save`.
    """

    quantity: str
    """`NEES`, or `NIS` of innovations."""
    dof: int
    """The degrees of freedom: the NEES that a consistent filter has on average."""
    nees: PerStep
    """The NEES of every run and step; infinite if diverged, NaN where nothing was logged."""
    errors: PerAxis
    """The error of every run, step and axis; NaN where nothing was logged."""
    sigmas: PerAxis
    """The σ that the filter claims of every error."""
    whitened: PerAxis
    """The whitened errors `L⁻¹ e`, `P = L Lᵀ`; without axes where NEES alone is known."""
    times: Float[np.ndarray, " steps"]
    """The time of every step, s, or its number."""
    timed: bool
    """Whether they are seconds, or numbers of steps as times are unknown."""
    names: tuple[str, ...]
    """The names of the axes."""
    convention: Convention | None = None
    """The convention of the covariances, where they are of poses."""
    alignment: str = "none"
    """The alignment of the estimates to the truth: `none`, `yaw`, `se3` or `sim3`."""
    identified: Identification | None = None
    """The convention that would make the data consistent, where it was searched for."""
    notes: tuple[str, ...] = ()
    """Remarks on what was left out, and what was assumed."""
    scale: Scale | None = None
    """The scale of the runs and its drift, where poses are given the scale or aligned by Sim(3)."""
    truth_sigma: tuple[float, float] | None = None
    """The σ of the truth that the covariances hold too, m and degrees; None of an exact one."""
    run_names: tuple[str, ...] = ()
    """The names of the runs, where they have any."""
    time_offset: tuple[float, float] | None = None
    """By how many seconds the stamps of the estimate are late and its σ, where that was found."""
    most: PerStep | None = None
    """The most that NEES/dof of a right filter is on average, if errors of different poses, which
    the alignment takes as independent, are not; None where it takes none so."""
    causes: tuple[Mistake, ...] = ()
    """What lies between the logs and makes NEES wrong (`jaxslam.evaluation.causes`)."""

    @property
    def runs(self) -> int:
        """The number of runs."""
        return len(self.nees)

    @property
    def steps(self) -> int:
        """The number of steps of the longest run."""
        return self.nees.shape[1]

    @property
    def fitted(self) -> float:
        """The most degrees of freedom that a fit of the scale of a run took from every NEES."""
        return 0.0 if self.scale is None else self.scale.fitted

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict on one study over all steps, see `jaxslam.statistics.Tally.verdict`.

        It is over-confident too where the scale drifts more than σ allows.
        """
        found = self.of_nees
        if self.mistakes:
            return withheld(found)
        if self.scale is None or not self.scale.disproved or found["word"] == "lost":
            return found
        p = min(found["p"], (self.scale.verdict or found)["p"])
        return found | {"word": "over-confident", "p": p}

    @cached_property
    def of_nees(self) -> Verdict:
        """The verdict of NEES alone, whatever mistakes there are."""
        with np.errstate(over="ignore"):
            z = self.errors / self.sigmas
            found = self._verdict(z, self.whitened, self.dof, self.fitted)
            if self.most is None or found["word"] not in ("over-confident", "under-confident"):
                return found
            # Of a right filter σ may seem too large by any factor, and too small by this one.
            least = np.sqrt(self.most)[..., None]
            certain = self._verdict(z / least, self.whitened / least, self.dof, self.fitted)
        over = found["word"] == certain["word"] == "over-confident"
        return found if over else found | {"word": "cannot tell", "p": 1.0}

    def _verdict(self, normalised: PerAxis, whitened: PerAxis, dof: int, fitted: float) -> Verdict:
        """The verdict on whitened errors, which are over their σ `normalised`."""
        nees = np.where(self.logged, squared(whitened), np.nan) if self.names else self.nees
        if self.quantity == "NEES":
            return run_verdict(nees, dof, fitted, self.logged, whitened)
        if self.names:
            return innovation_verdict(nees, normalised, dof)
        return run_verdict(nees, dof, logged=self.logged) | {"samples": "runs"}

    @cached_property
    def mistakes(self) -> tuple[Mistake, ...]:
        """The mistakes of logging that are recognised; with any there is no verdict."""
        if self.causes:
            return self.causes
        numbers = [f"{time:g} s" if self.timed else f"step {time - 1:g}" for time in self.times]
        runs, nis = [_run(self, run) for run in range(self.runs)], self.quantity == "NIS"
        of = self.errors, self.sigmas, self.names, runs, numbers, self.axis_verdict, nis
        return (*mistakes(Logged(*of)), *(gated(self.nees, self.dof) if nis else ()))

    @property
    def headline(self) -> str:
        """The verdict in a line."""
        if self.mistakes:
            return f"no verdict: {', '.join(mistake.what for mistake in self.mistakes)}"
        told = headline(self.of_nees, self.quantity)
        drifts = self.scale is not None and self.scale.disproved
        return f"{told}; {self.scale.sentence}" if drifts and self.scale else told

    @cached_property
    def logged(self) -> Mask:
        """A mask of the steps of every run that are there."""
        return ~np.isnan(self.nees)

    @cached_property
    def finite(self) -> Bool[np.ndarray, " runs"]:
        """A mask of the runs that did not diverge, which means and band are of.

        It is that of `consistency.json`.
        """
        return np.asarray((np.isfinite(self.nees) | ~self.logged).all(axis=1))

    @cached_property
    def runs_of_step(self) -> Int[np.ndarray, " steps"]:
        """The number of runs that a step's mean and band are of."""
        return np.sum(self.logged & self.finite[:, None], axis=0)

    @property
    def lost_runs(self) -> list[str]:
        """The names of the runs that are lost at any step."""
        return [_run(self, run) for run in lost_runs(self.nees, self.dof, self.logged)]

    @property
    def mean(self) -> Float[np.ndarray, " steps"]:
        """The mean NEES of every step, over the runs that have it; NaN where no run is left."""
        return _mean(self.nees[self.finite], self.logged[self.finite])

    @property
    def band95(self) -> tuple[float, float]:
        """The exact bounds of the mean at one step that no run lacks (`jaxslam.mean_band`)."""
        return self._band(max(int(self.finite.sum()), 1))

    @property
    def band95_of_step(self) -> Float[np.ndarray, "steps 2"]:
        """The same of every step, of as many runs as have it."""
        counts, place = np.unique(np.maximum(self.runs_of_step, 1), return_inverse=True)
        return np.array([self._band(int(count)) for count in counts])[place]

    def _band(self, runs: int) -> tuple[float, float]:
        """The band, its low end with all that may be fitted, its high end with nothing fitted."""
        left, high = int(self.dof - self.fitted), exact_band(self.dof, runs)[1]
        return (exact_band(left, runs)[0] if left >= 1 else 0.0), high

    @property
    def inside(self) -> float:
        """The share of the steps that any run has whose mean is in its band."""
        low, high = self.band95_of_step.T
        inside = np.sum((self.mean >= low) & (self.mean <= high))
        return float(inside / max(np.count_nonzero(self.runs_of_step), 1))

    @property
    def rmse(self) -> Float[np.ndarray, "steps n"]:
        """The root mean square error of every step and axis."""
        return _rms(self.errors, self.logged)

    @property
    def sigma(self) -> Float[np.ndarray, "steps n"]:
        """The claimed σ of every step and axis: the root of the mean variance."""
        return _rms(self.sigmas, self.logged)

    @property
    def outside3sigma(self) -> Float[np.ndarray, " n"]:
        """The share of the errors of every axis beyond ±3σ; .27 % of Gaussian ones are."""
        return np.sum(np.abs(self.errors) > 3 * self.sigmas, axis=(0, 1)) / np.sum(self.logged)

    @cached_property
    def coverage(self) -> dict[str, float]:
        """The shares of all steps inside the 50, 90 and 99 % sets of their covariances."""
        shares = calibration.coverage(self.nees, self.dof, self.logged)
        return {f"{100 * p:g}": x for p, x in zip(calibration.SETS, shares, strict=True)}

    @cached_property
    def bias(self) -> calibration.Bias | None:
        """The mean errors over σ, of the runs that did not diverge; None of NEES alone."""
        kept = self.finite
        if not self.names or not kept.any():
            return None
        return calibration.bias(self.errors[kept] / self.sigmas[kept], self.logged[kept])

    @cached_property
    def correlation(self) -> calibration.Correlation | None:
        """The correlations of whitened errors, of the same runs; None of a single axis."""
        kept = self.finite
        if len(self.names) < 2 or not kept.any():
            return None
        return calibration.correlation(self.whitened[kept], self.logged[kept])

    @property
    def suggested(self) -> Convention | None:
        """The only convention that would make the data consistent, if not the stated one."""
        return None if self.identified is None else self.identified.suggested

    def axis_verdict(self, axis: int) -> Verdict:
        """The verdict on one axis alone, of one degree of freedom."""
        return self._axis_verdicts[axis]

    @cached_property
    def _axis_verdicts(self) -> list[Verdict]:
        with np.errstate(over="ignore"):
            normalised = np.split(self.errors / self.sigmas, len(self.names), axis=-1)
            fitted = (0.0,) * len(normalised) if self.scale is None else self.scale.axis_fitted
            return [self._verdict(z, z, 1, f) for z, f in zip(normalised, fitted, strict=True)]

    def plot(self, path: str | Path | None = None, *, column: bool = False) -> Any:
        """Return the figure of the evaluation, see `jaxslam.plots.plot_evaluation`."""
        return plotted("plot_evaluation")(self, path, column=column)

    def asdict(self) -> dict[str, Json]:
        """The content of `evaluation.json`."""
        return _as_json(self)

    to_dict = asdict

    def save(self, folder: str | Path) -> Path:
        """Write `evaluation.json` into a folder, made if missing; return its path.

        Raises ValueError.
        """
        path = Path(folder) / "evaluation.json"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, self.asdict(), allow_nan=False)
        except OSError as error:
            raise ValueError(f"{folder}: cannot write there ({error.strerror})") from None
        return path

    def _repr_html_(self) -> str:
        return _html(self, _told(self))

    def __getattr__(self, name: str) -> NoReturn:
        meant = suggestion(name, dir(type(self)))
        raise AttributeError(f"an Evaluation has no attribute {name!r}{meant}")

    def __str__(self) -> str:
        table = _in_columns(*_rows(self)) if self.names else []
        counted = [_counted(self), _covered(self)]
        return "\n".join([_told(self), "", *counted, *table, *self.remarks])

    __repr__ = __str__

    @property
    def remarks(self) -> list[str]:
        """All remarks: what is missing, what was left out, what was assumed."""
        return [*_missing(self), *self.notes]

    @property
    def expected(self) -> str:
        """The mean NEES of a consistent filter: `6`, or `5–6` where a scale was fitted."""
        return f"{self.dof - self.fitted:g}–{self.dof}" if self.fitted else str(self.dof)


def _told(evaluation: Evaluation) -> str:
    """The verdict in lines, or the mistakes of the log in its place."""
    if evaluation.mistakes:
        return "\n".join([evaluation.headline, *(x.told for x in evaluation.mistakes)])
    # Lost runs are named below, by their names here.
    more = sentences(evaluation.of_nees | {"lost_runs": None}, evaluation.quantity)[1:]
    told, lost = [evaluation.headline, *more], evaluation.lost_runs
    if evaluation.scale is not None and not evaluation.scale.disproved:
        told.append(evaluation.scale.sentence)
    told += _beyond_nees(evaluation)
    if lost:
        others = f" and {len(lost) - _LISTED} more" if len(lost) > _LISTED else ""
        what = "lost" if evaluation.quantity == "NEES" else "outlying"
        told.append(f"{what}: {', '.join(lost[:_LISTED])}{others}")
    if evaluation.identified is not None:
        told.append(evaluation.identified.sentence)
    return "\n".join(told)


def _as_json(evaluation: Evaluation) -> dict[str, Json]:
    from jaxslam._version import __version__

    names, bias, found = [*enumerate(evaluation.names)], evaluation.bias, evaluation.correlation
    outside, rmse, sigma = evaluation.outside3sigma, evaluation.rmse, evaluation.sigma
    plain = "quantity", "runs", "steps", "dof", "inside", "lost_runs", "coverage", "fitted"
    return {
        "schema": 1,
        "version": __version__,
        **{name: getattr(evaluation, name) for name in plain},
        "time": json_numbers(evaluation.times),
        "band95": list(evaluation.band95),
        "nees": json_numbers(evaluation.mean),
        "runs_of_step": evaluation.runs_of_step.tolist(),
        "band95_of_step": evaluation.band95_of_step.tolist(),
        "verdict": evaluation.verdict,
        "run_names": list(evaluation.run_names),
        "outside3sigma": {name: float(outside[i]) for i, name in names},
        "rmse": {name: json_numbers(rmse[:, i]) for i, name in names},
        "sigma": {name: json_numbers(sigma[:, i]) for i, name in names},
        "axis_verdict": {name: evaluation.axis_verdict(i) for i, name in names},
        "effective_samples": evaluation.of_nees.get("effective"),
        "time_offset": evaluation.time_offset
        and dict(zip(("seconds", "sigma"), evaluation.time_offset, strict=True)),
        "causes": [
            dict(zip(("cause", "evidence", "nees_without", "certain"), x, strict=True))
            for x in evaluation.mistakes
        ],
        "bias": bias
        and {x: {"mean": float(bias.mean[i]), "p": float(bias.p[i])} for i, x in names},
        "correlation": found
        and {"axes": [evaluation.names[i] for i in found.axes], "p": found.p}
        | {"matrix": found.matrix.tolist()},
        "alignment": evaluation.alignment,
        "convention": evaluation.convention and asdict(evaluation.convention),
        "truth_sigma": evaluation.truth_sigma and list(evaluation.truth_sigma),
        "scale": evaluation.scale and evaluation.scale.asdict(),
        "suggested": evaluation.suggested and asdict(evaluation.suggested),
        "identified": evaluation.identified and evaluation.identified.asdict(),
        "mistakes": [mistake.told for mistake in evaluation.mistakes],
        "notes": evaluation.remarks,
    }


def described(found: Evaluation, **words: Any) -> Evaluation:
    """The same errors with other words about them, times, or causes."""
    result = replace(found, **words)
    for name in ("of_nees", "_axis_verdicts"):  # which take long, and are of errors alone
        if name in found.__dict__:
            result.__dict__[name] = found.__dict__[name]
    return result


def _html(evaluation: Evaluation, told: str) -> str:
    rows = _rows(evaluation) if evaluation.names else []
    cells = ("".join(f"<td>{html.escape(x)}</td>" for x in row) for row in rows)
    table = f"<table><tr>{'</tr><tr>'.join(cells)}</tr></table>" if rows else ""
    notes = [_counted(evaluation), _covered(evaluation), *evaluation.remarks]
    told = html.escape(told).replace("\n", "<br>")
    return f"<p>{told}</p>{table}<p>{'<br>'.join(map(html.escape, notes))}</p>"


def latex(evaluation: Evaluation) -> str:
    """The table of axes for LaTeX (booktabs), and the verdict with its exact band as a comment."""
    first, *rows = _rows(evaluation)
    symbols = {"σ": r"$\sigma$", "×": r"$\times$", "±": r"$\pm$", "%": r"\%", "∞": r"$\infty$"}
    lines = [r"\begin{tabular}{l" + "r" * (len(first) - 1) + "}", r"\toprule"]
    for row in (first, *rows):
        line = " & ".join(row)
        for symbol, name in symbols.items():
            line = line.replace(symbol, name)
        lines += [line + r" \\", r"\midrule"] if row is first else [line + r" \\"]
    comments = [f"% {line}" for line in (*_told(evaluation).splitlines(), _counted(evaluation))]
    return "\n".join([*comments, *lines, r"\bottomrule", r"\end{tabular}", ""])


def _covered(evaluation: Evaluation) -> str:
    shares = [f"{share:.1%}" for share in evaluation.coverage.values()]
    what = "errors" if evaluation.quantity == "NEES" else "innovations"
    return f"sets of 50, 90 and 99 % hold {shares[0]}, {shares[1]} and {shares[2]} of the {what}"


def _beyond_nees(evaluation: Evaluation) -> Iterator[str]:
    """A sentence on a mean error, and one on a correlation, where they are more than chance.

    Either is said of a right filter in one study of 200.
    """
    names, bias, found = evaluation.names, evaluation.bias, evaluation.correlation

    def beyond_chance(p: float) -> str:
        if p >= (1 - VERDICT_CONFIDENCE) / 2:
            return ""
        return f", more than chance ({f'p = {p:.2g}' if p >= 1e-4 else 'p < 0.0001'})"

    if bias is not None and (chance := beyond_chance(len(names) * np.min(bias.p))):
        axis = int(np.lexsort((-np.abs(bias.mean), bias.p))[0])
        yield f"the mean error of {names[axis]} is {bias.mean[axis]:.2f} σ{chance}"
    if found is not None and (chance := beyond_chance(found.p)):
        first, second = (names[i] for i in found.axes)
        by = f"{found.matrix[found.axes]:.2f}"
        yield f"whitened errors of {first} and {second} correlate by {by}{chance}"


def _counted(evaluation: Evaluation) -> str:
    low, high = evaluation.band95
    runs = f"{evaluation.runs} run{'s' if evaluation.runs > 1 else ''}"
    steps = f"{evaluation.steps} step{'s' if evaluation.steps > 1 else ''}"
    return (
        f"{runs} of {steps}; mean {evaluation.quantity} of a consistent filter "
        f"{evaluation.expected}, at one step in {low:.3f}–{high:.3f} with 95 %; "
        f"{evaluation.inside:.0%} of the steps are inside"
    )


def _missing(evaluation: Evaluation) -> list[str]:
    """A sentence on the steps of runs that are not there."""
    missing = np.sum(~evaluation.logged, axis=1)
    if not missing.any():
        return []
    # Three runs are named as examples.
    most = np.argsort(-missing, kind="stable")[: min(3, np.count_nonzero(missing))]
    told = ", ".join(f"{_run(evaluation, int(run))}: {missing[run]}" for run in most)
    more = np.count_nonzero(missing) - len(most)
    told += f", and {more} more run{'s' if more > 1 else ''}" if more else ""
    return [
        f"{missing.sum()} of {evaluation.nees.size} steps are not compared ({told}); each run is "
        "averaged over the steps that it has, each step over the runs that have it"
    ]


def _run(evaluation: Evaluation, run: int) -> str:
    return evaluation.run_names[run] if evaluation.run_names else f"run {run}"


def _rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """The cells of the table: titles, a row of each axis, and what they are of a right filter."""
    errors = "RMSE, m or rad" if evaluation.convention and not evaluation.scale else "RMSE"
    rows = [("axis", errors, "σ claimed", "σ should be ×", "99 % interval", "outside ±3σ")]
    there, outside = evaluation.logged.any(axis=0), evaluation.outside3sigma
    for axis, name in enumerate(evaluation.names):
        found = evaluation.axis_verdict(axis)
        rmse, sigma = (f"{_rms(x[there, axis]):.4g}" for x in (evaluation.rmse, evaluation.sigma))
        factor, low, high = (
            "–" if x is None else f"{x:.3f}" if x < 10 else f"{x:.3g}"
            for x in (found["sigma_factor"], *found["interval99"])
        )
        if (found["interval99"][1] or 0) > MOST:
            high = f"> {MOST:g}"
        rows.append((name, rmse, sigma, factor, f"[{low}, {high}]", f"{outside[axis]:.2%}"))
    return [*rows, ("consistent:", "", "", "1", "", f"{OUTSIDE:.2%}")]


def _in_columns(*rows: tuple[str, ...]) -> list[str]:
    """Lines of cells, as wide as the longest of their column needs, two spaces apart at least."""
    first, *others = (max(len(cell) + 2 for cell in column) for column in zip(*rows, strict=True))
    wide = [max(width, 17) for width in others]
    return [
        f"{name:<{max(first, 14)}}"
        + "".join(f"{cell:>{width}}" for cell, width in zip(cells, wide, strict=True))
        for name, *cells in rows
    ]


def evaluate(
    errors: ArrayLike,
    covariances: ArrayLike,
    *,
    times: ArrayLike | None = None,
    names: Sequence[str] = (),
    quantity: str = "NEES",
) -> Evaluation:
    """The verdict on a filter from its errors and their covariances.

    `errors` are (runs, steps, n) and `covariances` (runs, steps, n, n); with `quantity="NIS"` they
    are innovations and theirs, which needs no truth. Runs are independent of each other, steps of a
    run need not be. `times` (steps,) are seconds and `names` (n,) those of the axes. Runs need not
    be equally long: where an error and its covariance are both all NaN, nothing was logged. Steps
    at the beginning that a run knows exactly, with a covariance of zero, are left out. Raises
    ValueError, naming run and step, for what else is not finite, not symmetric or not positive
    definite.
    """
    quantity = next(iter(lookup("quantity", quantity, dict.fromkeys(("NEES", "NIS")))))
    if quantity == "NIS":
        errors, covariances, dof = padded(errors, covariances)
    e, P, logged = paired(errors, covariances)
    if quantity == "NIS" and len(np.unique(dof[logged])) > 1:
        nis = squared(whitened(e, P))
        return evaluate_nees(np.where(logged, nis, np.nan), dof, times=times, quantity="NIS")
    start, logged, notes = without_known(e, P, logged)
    P = filled(P[:, start:], logged[:, start:], np.eye(e.shape[-1]))
    return of_steps(
        e[:, start:],
        P,
        logged[:, start:],
        quantity=quantity,
        times=step_times(times, e.shape[1])[start:],
        timed=times is not None,
        names=_names(names, e.shape[-1]),
        notes=notes,
    )


def of_steps(errors: PerAxis, P: Squares, logged: Mask, **words: Any) -> Evaluation:
    """The evaluation of errors and their covariances at the steps that were logged."""
    z = whitened(errors, P)
    return Evaluation(
        dof=errors.shape[-1],
        nees=filled(squared(z), logged, np.nan),
        whitened=filled(z, logged, np.nan),
        errors=filled(errors, logged, np.nan),
        sigmas=filled(sigmas(P), logged, np.nan),
        **words,
    )


def evaluate_nees(
    nees: ArrayLike, dof: ArrayLike, *, times: ArrayLike | None = None, quantity: str = "NEES"
) -> Evaluation:
    """The verdict on a filter from its `nees` (runs, steps) alone, of `dof` degrees of freedom: one
    whole number, or one for every step, (runs, steps) or (steps,).

    With `quantity="NIS"` it is that of innovations, whose runs are the samples. `times` (steps,)
    are seconds. A step that is NaN was not logged. Raises ValueError, naming run and step, for a
    NEES that is negative.
    """
    values = numbers(quantity, nees, 2, "(runs, steps), with one run nees[None]")
    try:
        each = np.broadcast_to(np.array(dof).astype(np.float64, casting="same_kind"), values.shape)
    except (ValueError, TypeError):
        each = np.zeros(values.shape)
    told = each[~np.isnan(values)]
    if not ((told >= 1) & (told <= _MOST_DOF) & (told == np.round(told))).all():
        raise ValueError(
            f"dof must be one whole number from 1 to {_MOST_DOF}, or one for every step, "
            f"{values.shape}"
        )
    check_every_run(~np.isnan(values))
    for place in np.argwhere(values < 0)[:1]:
        raise ValueError(f"{quantity} of {at(place)} is {values[tuple(place)]:.3g}; 0 or more")
    none = np.empty((*values.shape, 0))
    values, one, notes = of_one_dof(values, each)
    return Evaluation(
        quantity=next(iter(lookup("quantity", quantity, dict.fromkeys(("NEES", "NIS"))))),
        dof=one,
        nees=values,
        errors=none,
        sigmas=none,
        times=step_times(times, values.shape[1]),
        timed=times is not None,
        names=(),
        notes=notes,
        whitened=none,
    )


def _rms(values: np.ndarray, there: np.ndarray | None = None) -> Any:
    """The root of the mean square over the first axis; infinite where it overflows."""
    with np.errstate(over="ignore"):
        return np.sqrt(np.mean(values**2, axis=0) if there is None else _mean(values**2, there))


def _mean(values: np.ndarray, there: Mask) -> Float[np.ndarray, "steps ..."]:
    """The mean over the runs that have a step; NaN where none has it."""
    count = np.sum(there, axis=0).reshape(-1, *[1] * (values.ndim - 2))
    total = np.sum(filled(values, there, 0.0), axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _names(names: Sequence[str], n: int) -> tuple[str, ...]:
    told = tuple(str(name) for name in names) or tuple(str(i + 1) for i in range(n))
    if len(told) != n or len(set(told)) != n:
        raise ValueError(f"names must be {n} different ones, one an axis, not {list(told)}")
    return told


def neighbours_correlate(nis: Evaluation) -> float | None:
    """The correlation of innovations, over their σ, with those of the next step; None if unclear.

    `ρ = Σ zₜ·zₜ₊₁ / Σ zₜ²`. The innovations of an optimal gain are white; with a gain too small the
    estimate lags, and neighbours have one sign; with one too large it overshoots (Mehra 1970).
    """
    z = np.clip(np.nan_to_num(nis.errors / nis.sigmas), -1e140, 1e140)
    squared = float(np.sum(z**2))
    pairs = np.count_nonzero(nis.logged[:, 1:] & nis.logged[:, :-1]) * z.shape[-1]
    if squared == 0 or not pairs:
        return None
    rho = float(np.sum(z[:, 1:] * z[:, :-1]) / squared)
    # Beyond three σ of white innovations is one in 370 of a right filter; and a correlation below
    # 0.02 says nothing of the gain, however many steps show it.
    return rho if abs(rho) > max(0.02, 3.0 / np.sqrt(pairs)) else None


def advice(nis: Evaluation, nees: Evaluation | None = None) -> str:
    """What to turn, of the innovations of a filter and, where there is a truth, of its errors.

    R and Q are the covariances of the noise of the measurement and of the motion. S, which NIS
    tests, grows with both. The gain, which the correlation of innovations tests, grows with Q and
    falls with R. Both together tell one from the other. What NEES alone says is no noise's fault:
    NIS sees only what is measured. Of a filter whose model is linear, right but for one of them.
    """
    word, rho = nis.verdict["word"], neighbours_correlate(nis)
    size = {"over-confident": "too small", "outlying": "too small", "under-confident": "too large"}
    if nis.mistakes or word not in (*size, "consistent"):
        return "innovations cannot tell what to turn; more steps or runs would"
    if word == "under-confident" and nees is not None and nees.verdict["word"] == "consistent":
        return (
            "NIS is too small, but NEES of the same filter is right: these are no innovations of "
            "it; log z − h(x) before the update, not after it, and H P Hᵀ + R with the P of then"
        )
    if word == "consistent" and rho is None:
        return f"NIS is right and innovations are white: Q and R fit each other{_of_nees(nees)}"
    gain = "" if rho is None else f", and the gain too {'small' if rho > 0 else 'large'}"
    seen = "" if rho is None else f" (innovations of neighbouring steps correlate by {rho:.2f})"
    if word == "consistent":
        what = "Q too small and R too large" if rho and rho > 0 else "Q too large and R too small"
        return f"NIS is right{gain}{seen}: try {what}, by factors that cancel in S"
    wrong = size[word]
    if rho is None:
        what = f"Q and R, and P with them, {wrong} by one factor"
    else:
        what = f"{'Q' if (rho > 0) == (wrong == 'too small') else 'R'} {wrong}"
    return f"NIS says that S is {wrong}{gain}{seen}: most likely {what}"


def _of_nees(nees: Evaluation | None) -> str:
    word = None if nees is None else nees.verdict["word"]
    if word in ("over-confident", "lost"):
        return (
            "; NEES is too large all the same: look at the model (linearisation, biases, errors "
            "that are correlated), at P of the start, and at directions that nothing measures"
        )
    if word == "under-confident":
        return "; NEES is too small all the same: P of the start, or noise of what nothing measures"
    return "; NEES is right too" if word == "consistent" else ""
