"""Noise, and other numbers of a filter, by the likelihood of its innovations.

The innovations of a right filter are independent and `N(0, S)`, so that the measurements have the
log likelihood `−½ Σ (rᵀ S⁻¹ r + log det S)` (Schweppe 1965). Its maximum is where a filter's
numbers are likeliest, with the covariance of the inverse Hessian there. What no noise explains is
seen at that maximum: innovations that are still correlated from frame to frame, or that have a
mean, are those of a wrong model (Mehra 1970).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Array, Bool, Float

from jaxslam._numerics.arrays import AnyArray, cast, is_number
from jaxslam._runtime.lookup import lookup
from jaxslam.consistency.likelihood import cost_of
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import whitened_innovation
from jaxslam.filters.run import Frames, MeasuredRun, run
from jaxslam.models.observations import Capacity, Features, Innovation
from jaxslam.statistics.bands import normalised_squared, whiteness_p_value

NOISE = ("motion.noise_sigma", "sensor.sigma")
"""The numbers that are tuned unless others are named: σ of process and measurement."""


@dataclass(frozen=True)
class TuningSettings:
    """How far a tuning looks, and what it calls a wrong model."""

    factor: float = 1000.0
    """The largest factor on a σ without bounds, either way."""
    outlier: float = 3.0
    """What a filter leaves out, by its gate, costs as much as what is so many σ off, in the filter
    of the start: else the smallest σ, which leaves out the most, is the likeliest."""
    tolerance: float = 1e-6
    """The change at which the search ends, of the mean log likelihood and of logarithms of σ."""
    steps: int = 64
    """The most steps of the search."""
    correlation: float = 0.05
    """The least correlation, and the least mean in σ, that is called a wrong model's."""
    significance: float = 1e-3
    """Their p by chance, at most."""


@dataclass(frozen=True)
class LogFit:
    """How well a filter fits logs: the statistics of its innovations and, with truth, errors."""

    log_likelihood: float
    """The log likelihood of all measurements, up to a constant that all filters have."""
    nis: float
    """The mean NIS per degree of freedom: 1 of a right filter."""
    nees: float | None
    """The mean NEES of the pose per degree of freedom, of the logs that have a truth."""
    correlation: float | None
    """The correlation of innovations, whitened by S, with those of the same landmark a frame later:
    0 of a right filter; None where the filter keeps no S."""
    mean: float | None
    """The largest of the means of the numbers of a whitened innovation: 0 of a right filter."""
    p: float | None
    """The p of white innovations without a mean; None of too few."""
    left_out: float
    """The share of measurements that were not used."""

    def __str__(self) -> str:
        def told(value: float | None) -> str:
            return "–" if value is None else f"{value:.2f}"

        return (
            f"NIS/dof {self.nis:.2f}, NEES/dof {told(self.nees)}, correlation of innovations "
            f"{told(self.correlation)}, mean {told(self.mean)}, {self.left_out:.1%} left out"
        )


@dataclass(frozen=True)
class Tuning:
    """The result of `tune`."""

    slam: AbstractFilter
    """The filter with the numbers that were found."""
    start: Mapping[str, np.ndarray]
    """The numbers of the filter that was given, by name."""
    found: Mapping[str, np.ndarray]
    """Those that are likeliest."""
    sigma: Mapping[str, np.ndarray]
    """Their σ, by the Hessian: NaN at a bound, and where the logs do not tell."""
    before: LogFit
    """How the filter that was given fits the logs."""
    after: LogFit
    """How the tuned one does."""
    held_out: tuple[LogFit, LogFit] | None
    """Both on the logs that were held out, if any."""
    converged: bool
    """Whether the search ended at a maximum."""
    settings: TuningSettings
    """The settings of the search."""

    @property
    def word(self) -> str:
        """What explains the innovations: `noise`, a wrong `model`, or `cannot tell`.

        `model` where those of the tuned filter are still correlated from frame to frame, or have a
        mean, by more than `settings.correlation`, with p below `settings.significance`.
        """
        fit, most = self.after, self.settings
        if not self.converged or fit.p is None or fit.correlation is None or fit.mean is None:
            return "cannot tell"
        large = max(abs(fit.correlation), abs(fit.mean)) > most.correlation
        return "model" if large and fit.p < most.significance else "noise"

    def to_dict(self) -> dict[str, object]:
        """All results as numbers, lists and words, for JSON."""
        names = {
            name: {
                "start": self.start[name].tolist(),
                "found": self.found[name].tolist(),
                "sigma": self.sigma[name].tolist(),
            }
            for name in self.found
        }
        fits = {"before": self.before, "after": self.after}
        if self.held_out is not None:
            fits |= dict(zip(("held_out_before", "held_out_after"), self.held_out, strict=True))
        told = {name: vars(fit) for name, fit in fits.items()}
        return {"word": self.word, "converged": self.converged, "numbers": names, **told}

    def __str__(self) -> str:
        lines = [_SENTENCES[self.word] if self.converged else _UNFINISHED]
        for name, found in self.found.items():
            rows = (np.ravel(x) for x in (self.start[name], found, self.sigma[name]))
            for i, (was, now, sigma) in enumerate(zip(*rows, strict=True)):
                which = f"{name}[{i}]" if found.ndim else name
                doubt = f"± {sigma:.2g}" if np.isfinite(sigma) else "(σ unknown)"
                lines.append(f"  {which:<24}{was:>10.4g} →{now:>10.4g} {doubt}")
        lines += [f"  before: {self.before}", f"  after:  {self.after}"]
        if self.held_out is not None:
            before, after = self.held_out
            lines += [f"  held out, before: {before}", f"  held out, after: {after}"]
        return "\n".join(lines)


_UNFINISHED = "The search did not end at a maximum: more steps, bounds or priors are needed."
_SENTENCES = {
    "noise": "The noise below explains the innovations: they are white with it.",
    "model": "No noise explains the innovations, which are correlated or have a mean with the "
    "likeliest, too: look at the model (biases, clocks, wrong identities, errors that last).",
    "cannot tell": "These logs do not tell whether noise is all that is wrong.",
}


def tune(
    slam: AbstractFilter,
    logs: Sequence[MeasuredRun],
    names: Sequence[str] = NOISE,
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    held_out: Sequence[MeasuredRun] = (),
    settings: TuningSettings | None = None,
) -> Tuning:
    """Find the numbers of a filter that make the measurements of logs the likeliest.

    `names` are fields of the filter, such as `sensor.sigma` or `sensor.camera.focal`, all whose
    numbers are searched; a σ is searched by its logarithm, and one of 0 stays. `bounds` are the
    least and greatest value of a named field. `priors` are a value and a σ of it, which for a
    named σ is a factor: (0.1, 2) means 0.05 to 0.2. A field that is no σ needs one of both.

    Logs are those of `measured_run`, all at once; those `held_out` are judged with the numbers of
    the others. Minimised by BFGS (optimistix) through all frames, in forward mode, in the precision
    of JAX. Raises ValueError for names, bounds or logs that do not serve.
    """
    settings, bounds, priors = settings or TuningSettings(), bounds or {}, priors or {}
    logs, held_out = (list(x) if isinstance(x, Iterable) else [x] for x in (logs, held_out))
    if not logs or not all(isinstance(log, MeasuredRun) for log in logs + held_out):
        raise ValueError("tune needs logs as `measured_run` makes them, at least one")
    dtype = jnp.result_type(float)
    slam, logs, held_out = cast(slam, dtype), cast(logs, dtype), cast(held_out, dtype)
    search = _Search.of(slam, names, bounds, priors, settings)
    before, sums = _fit_and_sums(slam, logs)
    if not math.isfinite(before.log_likelihood):
        raise ValueError(
            "the filter diverges in these logs with the numbers that it starts with; start from "
            "larger σ"
        )
    given = _Given(search, _grouped(logs), *_outliers(sums, settings))
    theta, converged, hessian = _minimised(given, settings)
    tuned, found = search.filter_of(theta), search.values(theta)
    spread = search.sigmas(theta, hessian)
    aside = (fit_of(slam, held_out), fit_of(tuned, held_out)) if held_out else None
    start = search.values(search.first)
    after = fit_of(tuned, logs)
    return Tuning(tuned, start, found, spread, before, after, aside, converged, settings)


class _Search(eqx.Module):
    """The coordinates in which numbers are searched: logarithms of σ, other numbers in the unit of
    their prior or bounds, each between bounds by a logistic function with slope 1 in its middle."""

    slam: AbstractFilter
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    start: tuple[Float[AnyArray, " _"], ...]
    """Of each name, in coordinates."""
    low: tuple[Float[AnyArray, " _"], ...]
    high: tuple[Float[AnyArray, " _"], ...]
    prior: tuple[Float[AnyArray, " 2"] | None, ...]

    @staticmethod
    def of(slam, names, bounds, priors, settings: TuningSettings) -> _Search:
        """Raises ValueError."""
        known = {
            jax.tree_util.keystr(path).lstrip("."): np.asarray(leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(slam)
            if is_number(leaf)
        }
        chosen = lookup("number of the filter", names, known)
        for kind, table in (("bounds", bounds), ("priors", priors)):
            if unused := set(table) - set(chosen):
                raise ValueError(f"{kind} of what is not tuned: {', '.join(sorted(unused))}")
        parts = []
        for name, value in chosen.items():
            flat = np.ravel(value).astype(float)
            logarithmic = name.endswith("sigma")
            if not logarithmic and name not in bounds and name not in priors:
                raise ValueError(f"{name} is no σ: it needs bounds, or a prior")
            prior = priors.get(name)
            if prior is not None:
                prior = np.log(prior) if logarithmic else np.array(prior, float)
            low, high = _limits(name, flat, logarithmic, bounds.get(name), prior, settings)
            with np.errstate(divide="ignore"):
                start = np.log(flat) if logarithmic else flat
            start = np.where(np.isfinite(start), start, low)
            if np.any((start < low) | (start > high)):
                raise ValueError(f"{name} starts at {value}, outside its bounds")
            inside = np.clip((start - low) / np.where(high > low, high - low, 1), 1e-3, 1 - 1e-3)
            start = (high - low) / 4 * np.log(inside / (1 - inside))
            parts.append((logarithmic, start, low, high, prior))
        columns = tuple(zip(*parts, strict=True))
        return _Search(slam, tuple(chosen), columns[0], *columns[1:])

    @property
    def first(self) -> Float[Array, " k"]:
        return jnp.concatenate([jnp.asarray(x) for x in self.start])

    def coordinates(self, theta: Float[Array, " k"]) -> list[Float[Array, " _"]]:
        """Logarithms of σ, and other numbers, of each name."""
        found, at = [], 0
        for start, low, high in zip(self.start, self.low, self.high, strict=True):
            part, at = theta[at : at + len(start)], at + len(start)
            width = jnp.asarray(high - low)
            share = jax.nn.sigmoid(4 * part / jnp.where(width > 0, width, 1.0))
            found.append(low + width * share)
        return found

    def filter_of(self, theta: Float[Array, " k"]) -> AbstractFilter:
        """The filter with these numbers; a σ of 0 stays 0."""
        slam = self.slam
        for name, new, log in zip(
            self.names, self.coordinates(theta), self.logarithmic, strict=True
        ):
            old = jnp.asarray(attrgetter(name)(slam))
            new = jnp.reshape(jnp.exp(new) if log else new, old.shape).astype(old.dtype)
            new = jnp.where(old == 0, 0.0, new) if log else new
            slam = eqx.tree_at(attrgetter(name), slam, new)
        return slam

    def values(self, theta: Float[Array, " k"]) -> dict[str, np.ndarray]:
        slam = self.filter_of(theta)
        return {name: np.asarray(attrgetter(name)(slam)) for name in self.names}

    def prior_cost(self, theta: Float[Array, " k"]) -> Float[Array, ""]:
        """Minus the logarithm of the priors' density."""
        pairs = zip(self.coordinates(theta), self.prior, strict=True)
        costs = [jnp.sum(((x - p[0]) / p[1]) ** 2) / 2 for x, p in pairs if p is not None]
        return sum(costs, start=jnp.zeros(()))

    def sigmas(self, theta: Float[Array, " k"], hessian: np.ndarray) -> dict[str, np.ndarray]:
        """σ of the values, by the inverse Hessian in θ; NaN near a bound and of no curvature."""
        slopes = np.diagonal(jax.jacfwd(lambda t: jnp.concatenate(self.coordinates(t)))(theta))
        moving = slopes > 0.05  # of 1 in the middle between bounds
        variances = np.full(len(slopes), np.nan)
        inner = hessian[np.ix_(moving, moving)]
        if moving.any() and np.all(np.linalg.eigvalsh(inner) > 0):
            variances[moving] = np.diagonal(np.linalg.inv(inner))
        spread, found, at = np.sqrt(variances) * slopes, {}, 0
        for name, value, log in zip(
            self.names, self.values(theta).values(), self.logarithmic, strict=True
        ):
            part, at = spread[at : at + value.size].reshape(value.shape), at + value.size
            found[name] = np.where(value == 0, 0.0, part * value) if log else part
        return found


def _limits(name, value, logarithmic: bool, bounds, prior, settings: TuningSettings):
    """The least and greatest coordinate of each of these numbers."""
    if bounds is not None:
        low, high = bounds
        if not low < high or (logarithmic and low <= 0):
            raise ValueError(f"bounds of {name} need a least and a greatest value, not {bounds}")
        ends = np.log(bounds) if logarithmic else np.array(bounds, float)
        low, high = (np.full(len(value), end) for end in ends)
    elif logarithmic:
        around = np.log(np.where(value > 0, value, 1.0))
        low, high = around - np.log(settings.factor), around + np.log(settings.factor)
    else:
        low, high = (np.minimum(value, prior[0] - 6 * prior[1]), value)
        high = np.maximum(high, prior[0] + 6 * prior[1])
    fixed = logarithmic & (value == 0)
    return np.where(fixed, 0.0, low), np.where(fixed, 0.0, high)


def _grouped(logs: Sequence[MeasuredRun]) -> list[MeasuredRun]:
    """Batches of logs that are alike."""
    alike: dict[object, list[MeasuredRun]] = {}
    for log in _of_one_length(logs):
        leaves, structure = jax.tree.flatten(log)
        alike.setdefault((structure, *map(np.shape, leaves)), []).append(log)
    return [jax.tree.map(lambda *x: jnp.stack(x), *same) for same in alike.values()]


def _of_one_length(logs: Sequence[MeasuredRun]) -> list[MeasuredRun]:
    """Logs padded by frames and features that measure nothing to the longest, so that one program
    serves all."""
    capacity = Capacity(*np.max([log.capacity for log in logs], axis=0).tolist())
    steps = max(log.frames.seen.valid.shape[0] for log in logs)
    return [_padded(log, steps, capacity) for log in logs]


def _padded(log: MeasuredRun, steps: int, capacity: Capacity) -> MeasuredRun:
    def features(of: Features, width: int) -> Features:
        def wider(x):
            room = [(0, steps - x.shape[0]), (0, width - x.shape[1])]
            return jnp.pad(x, room + [(0, 0)] * (x.ndim - 2))

        return jax.tree.map(wider, of)

    def longer(x):
        return jnp.pad(x, [(0, steps - x.shape[0])] + [(0, 0)] * (x.ndim - 1), mode="edge")

    seen = features(log.frames.seen, capacity.seen)
    new = features(log.frames.new, capacity.new)
    control, gone, truth = jax.tree.map(longer, (log.frames.control, log.frames.gone, log.truth))
    if gone is not None:
        gone = jnp.pad(gone, ((0, 0), (0, capacity.landmarks - gone.shape[1])))
    return replace(log, frames=Frames(control, seen, new, gone), capacity=capacity, truth=truth)


class _Records(NamedTuple):
    """Of every frame of a log."""

    cost: Float[Array, ""]
    """`½ (rᵀ S⁻¹ r + log det S)`."""
    log_det: Float[Array, ""]
    nis: Float[Array, ""]
    dof: Float[Array, ""]
    left_out: Float[Array, ""]
    """Numbers that were measured and not used."""


def _records(innovation: Innovation, frame) -> _Records:
    dof = innovation.nis_dof.astype(innovation.nis.dtype)
    valid = frame.seen.valid.sum() * innovation.residual.shape[-1]
    cost, nis = cost_of(innovation), innovation.nis
    return _Records(cost, 2 * cost - nis, nis, dof, valid - dof)


def _cost(slam: AbstractFilter, group: MeasuredRun, outlier: Float[Array, ""]) -> Float[Array, ""]:
    """Minus the log likelihood of a batch of logs; `outlier` is the cost of what is left out."""

    def of(log: MeasuredRun) -> Float[Array, ""]:
        def output(_, innovation, frame):
            found = _records(innovation, frame)
            return found.cost + outlier * found.left_out

        return jnp.sum(run(slam, log.frames, log.start(slam), output)[1])

    return jnp.sum(jax.vmap(of)(group))


def _outliers(total: _Records, settings: TuningSettings) -> tuple[Float[Array, ""], float]:
    """The cost of one number that is left out, and the count of all that were measured."""
    if not total.dof:
        raise ValueError("no measurement of these logs is used: there is no innovation")
    cost = (settings.outlier**2 + total.log_det / total.dof) / 2
    return jnp.asarray(cost), float(total.dof + total.left_out)


class _Given(NamedTuple):
    """The data of a search."""

    search: _Search
    groups: list[MeasuredRun]
    outlier: Float[Array, ""]
    count: float
    """The number of all that was measured."""


@jax.custom_jvp
def _mean_cost(theta: Float[Array, " k"], given: _Given) -> Float[Array, ""]:
    """Minus the log likelihood, and the priors', of one number that was measured."""
    slam = given.search.filter_of(theta)
    costs = [_cost(slam, group, given.outlier) for group in given.groups]
    return (sum(costs[1:], start=costs[0]) + given.search.prior_cost(theta)) / given.count


@_mean_cost.defjvp
def _(at, moved):
    """The gradient at once, by as many tangents as there are numbers: linearised through all frames
    it would keep every matrix of every frame."""
    slope, value = jax.jacfwd(lambda t: 2 * (_mean_cost.fun(t, at[1]),), has_aux=True)(at[0])
    return value, slope @ moved[0]


_slope = eqx.filter_jit(jax.jacfwd(_mean_cost.fun))


@eqx.filter_jit
def _minimum(given: _Given, settings: TuningSettings) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    import optimistix

    solution = optimistix.minimise(
        _mean_cost,
        optimistix.BFGS(rtol=settings.tolerance, atol=settings.tolerance),
        given.search.first,
        args=given,
        max_steps=settings.steps,
        throw=False,
    )
    return solution.value, solution.result == optimistix.RESULTS.successful


def _minimised(
    given: _Given, settings: TuningSettings
) -> tuple[Float[Array, " k"], bool, np.ndarray]:
    """The likeliest θ, whether it was found, and the Hessian of minus the log likelihood there."""
    theta, found = _minimum(given, settings)
    steps = 1e-4 * np.eye(len(theta))
    rows = [np.asarray(_slope(theta + h, given) - _slope(theta - h, given)) for h in steps]
    hessian = np.array(rows) / 2e-4 * given.count
    return theta, bool(found), (hessian + hessian.T) / 2


class _OfFrames(NamedTuple):
    """Whitened innovations by slot, NaN where there are none, and NEES."""

    white: Float[Array, "frames slots p"] | None
    nees: Float[Array, " frames"] | None


@eqx.filter_jit
def _run_records(slam: AbstractFilter, log: MeasuredRun) -> tuple[_Records, _OfFrames]:
    """The records of every frame of a log, and its whitened innovations and errors."""

    def output(state, innovation, frame):
        white = whitened_innovation(innovation)
        if white is not None:
            none = jnp.full((log.capacity.landmarks, white.shape[1]), jnp.nan)
            place = jnp.where(innovation.used, frame.seen.slots, len(none))
            white = none.at[place].set(white, mode="drop")
        return (*_records(innovation, frame), white, state)

    *found, white, states = run(slam, log.frames, log.start(slam), output)[1]
    nees = None
    if log.truth is not None:
        nees = jax.vmap(lambda s, T: normalised_squared(*slam.pose_error(s, T)))(states, log.truth)
    return _Records(*found), _OfFrames(white, nees)


def fit_of(slam: AbstractFilter, logs: Sequence[MeasuredRun]) -> LogFit:
    """Return how well a filter fits logs, which may be of any length."""
    return _fit_and_sums(slam, logs)[0]


def _fit_and_sums(slam: AbstractFilter, logs: Sequence[MeasuredRun]) -> tuple[LogFit, _Records]:
    """How well it does, and the sums of the records of all frames."""
    lengths = [log.frames.seen.valid.shape[0] for log in logs]
    runs = [
        jax.tree.map(lambda x, steps=steps: np.asarray(x)[:steps], _run_records(slam, log))
        for log, steps in zip(_of_one_length(logs), lengths, strict=True)
    ]
    total = _Records(*np.sum([[np.sum(part) for part in found] for found, _ in runs], axis=0))
    nees = [of.nees for _, of in runs if of.nees is not None]
    degrees = [log.truth.tangent_dim for log in logs if log.truth is not None]
    correlation = mean = p = None
    if all(of.white is not None for _, of in runs):
        correlation, mean, p = _whiteness([of.white for _, of in runs])
    fit = LogFit(
        log_likelihood=-float(total.cost),
        nis=float(total.nis / total.dof) if total.dof else math.nan,
        nees=float(np.mean(np.concatenate(nees))) / degrees[0] if nees else None,
        correlation=correlation,
        mean=mean,
        p=p,
        left_out=float(total.left_out / max(total.dof + total.left_out, 1)),
    )
    return fit, total


def _whiteness(white: list[np.ndarray]) -> tuple[float | None, float | None, float | None]:
    """The correlation of neighbours, the largest mean, and the p of white innovations without one:
    twice the least of that of neighbours and that of `Σ nᵢ m̄ᵢ²`, which is χ², over the means of all
    numbers of all slots of all logs."""
    steps = max(len(x) for x in white)
    rows = np.concatenate([
        np.pad(np.swapaxes(x, 0, 1), ((0, 0), (0, steps - len(x)), (0, 0)), constant_values=np.nan)
        for x in white
    ])  # fmt: skip
    there = np.isfinite(rows[..., 0])
    if not (there[:, 1:] & there[:, :-1]).any():
        return None, None, None
    filled = np.where(there[..., None], rows, 0.0)
    power = np.sum(filled**2) / np.sum(there)
    pairs = np.sum(there[:, 1:] & there[:, :-1])
    correlation = np.sum(filled[:, 1:] * filled[:, :-1]) / pairs / power
    means = np.sum(filled, axis=(0, 1)) / np.sum(there)
    largest = means[np.argmax(np.abs(means))]
    p = whiteness_p_value(np.where(there, np.sum(filled**2, axis=-1), np.nan), rows)
    if p is not None:
        sums, count = np.sum(filled, axis=1), np.sum(there, axis=1)[:, None]
        chi2 = np.sum(sums**2 / np.maximum(count, 1))
        dof = sums.shape[1] * np.sum(count > 0)
        p = min(1.0, 2 * min(p, float(scipy.special.gammaincc(dof / 2, chi2 / 2))))
    return float(correlation), float(largest), p
