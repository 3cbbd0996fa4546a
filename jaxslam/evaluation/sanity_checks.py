"""The detection of mistakes of logging, which make the numbers of a right filter wrong.

Each check distinguishes a mistake from what a filter can do by itself, and states how rarely it
raises a false alarm.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Bool, Float

from jaxslam._runtime.files import Json
from jaxslam.io.logs.log import DEGREE
from jaxslam.statistics.bands import PerAxis, PerStep, shortfall_limit
from jaxslam.statistics.verdict import Verdict

FALSE_ALARM = 1e-4
"""The largest share of right studies taken for ones with runs and steps interchanged."""
_PERIODS = ((2 * np.pi, "2π", "(−π, π]"), (360.0, "360°", "(−180°, 180°]"))
_FAR, _NEAR = 8.0, 5.0
"""An error beyond so many σ is not one of its axis; within so many of a full turn it is."""
_WRONG = 5.0
"""An axis whose σ may be right up to this factor is in its unit."""
_LIKE = 2.0
"""A factor further from 57.3 than by so much is another one."""
_SLACK = 1.25
"""The factor by which the interval may miss it."""
_SHARE, _BELOW = 0.4, 5.0
"""The share of the samples that may be lower by so much: of 8 from χ² no more are, but for 3 %."""
_NARROW = 5.0
"""The widest interval of a factor, upper by lower end, of an axis that may be an angle or not: that
of 8 runs is narrower."""
_FEWEST = 300
"""The fewest NIS that show a gate."""
_MANY = 300
"""The most runs and steps whose correlations are tested."""
_ANGLES = re.compile(
    r"r[xyz]|rot.*|[θφψαβ].*|.*(theta|phi|psi|heading|yaw|roll|pitch|angle|orient|bearing"
    r"|attitude|azimuth|elevation).*",
    re.IGNORECASE,
)
_LENGTHS = re.compile(
    r"[ptv]?_?[xyz]|.*(pos|vel|speed|range|dist|depth|height|scale).*", re.IGNORECASE
)


class Mistake(NamedTuple):
    """A mistake that was found."""

    what: str
    """A name in a few words."""
    told: str
    """A sentence: where, by how much, and what to do."""
    nees: float | None = None
    """The mean NEES without it, where that was computed."""
    certain: bool = True
    """False of a cause that is only possible, as of few runs: nothing is wrong without it."""


class Logged(NamedTuple):
    """The data that are checked, NaN where nothing was logged."""

    errors: PerAxis
    sigmas: PerAxis
    names: Sequence[str]
    """The names of the axes."""
    runs: Sequence[str]
    """The names of the runs."""
    steps: Sequence[str]
    """The names of the steps, as `step 7`, from 0, or `0.3 s`."""
    factor: Callable[[int], Verdict]
    """The verdict on an axis, with `interval99`, and `samples` of innovations."""
    innovations: bool = False


def mistakes(logged: Logged) -> tuple[Mistake, ...]:
    """Return all mistakes that are found, of axes that by their names are angles, or may be."""
    kinds = [
        True if _ANGLES.fullmatch(name) else False if _LENGTHS.fullmatch(name) else None
        for name in logged.names
    ]
    return (*_unwrapped(logged, kinds), *_degrees(logged, kinds), *_interchanged(logged))


def gated(nis: PerStep, dof: int) -> Iterator[Mistake]:
    """Find NIS that have passed a gate: none is beyond a usual quantile of χ², and the rest is as
    it is below one.

    Of so many that are scaled to have the median of χ², none is beyond their largest with a chance
    of one in a million; and that is within 2 % of the gate.
    """
    x = nis[np.isfinite(nis)]
    if len(x) < _FEWEST or (middle := float(np.median(x))) <= 0:
        return
    largest, scale = float(x.max()), middle / scipy.special.chdtri(dof, 0.5)
    none_beyond = len(x) * np.log1p(-scipy.special.chdtrc(dof, largest / scale))
    for share in (0.1, 0.05, 0.025, 0.01, 0.003, 0.001):
        gate = scipy.special.chdtri(dof, share)
        if none_beyond < np.log(1e-6) and 0.98 * gate < largest <= gate * (1 + 1e-9):
            yield Mistake(
                "a gate in front of the NIS",
                f"none of {len(x)} NIS is above {gate:.4g}, where {len(x) * share:.0f} should be: "
                f"those beyond {1 - share:.1%} of χ² were not logged; log them before the gate",
            )
            return


def withheld(found: Verdict) -> Verdict:
    """Return a verdict with every word withheld, as the data are not what they are said to be."""

    def silent(part: Json) -> Json:
        if isinstance(part, list):
            return [silent(x) for x in part]
        return withheld(part) if isinstance(part, dict) else part

    parts = Verdict({key: silent(x) for key, x in found.items()})
    return parts | {"word": "cannot tell"} if "word" in found else parts


def _unwrapped(logged: Logged, kinds: Sequence[bool | None]) -> Iterator[Mistake]:
    """Find angles whose errors are near a full turn, and never between that and none.

    Of Gaussian errors with the σ that is claimed one number in 10¹⁵ is beyond 8 σ. Of one that is
    an outlier for another reason the chance to be so near to a turn is 10 σ of 2π, 1/36 for 1°.
    """
    for axis, angle in enumerate(kinds):
        if angle is False:
            continue
        e, sigma = logged.errors[..., axis], logged.sigmas[..., axis]
        for period, turn, wrapped in _PERIODS:
            # The distance from a full turn, rad, of what is known to be an angle and what may be.
            run = _turned(e, sigma, period, {True: 1.0, None: 0.5}[angle] * period / (2 * np.pi))
            if not run.any():
                continue
            where = run[:, None] & (np.abs(e) > period / 2)
            first = int(np.argmax(run))
            step = int(np.argmax(where[first]))
            others = f", and {where.sum() - 1} more" if where.sum() > 1 else ""
            others += f" in {run.sum()} runs" if run.sum() > 1 else ""
            yield Mistake(
                f"an angle is not wrapped ({logged.names[axis]})",
                f"errors of {logged.names[axis]} are near multiples of {turn} "
                f"and nowhere between: {e[first, step]:.4g} at {logged.steps[step]} of "
                f"{logged.runs[first]}{others}; wrap them to {wrapped}",
            )
            break


def _turned(e: PerStep, sigma: PerStep, period: float, widest: float) -> Bool[np.ndarray, " runs"]:
    """A mask of the runs with an error near a full turn, and no other far from none or a full one.

    None where most runs with errors as large have them anywhere.
    """
    there, turned = ~np.isnan(e), np.abs(e) > period / 2
    small = there & ~turned
    if not turned.any() or not (np.abs(e) < 1e3 * period)[turned].all():
        return np.zeros(len(e), bool)
    scale = float(np.median(sigma[there]))
    if small.any():
        scale = max(scale, float(np.sqrt(np.mean(e[small] ** 2))))
    near = ~there | (np.abs(e - period * np.round(e / period)) <= min(_NEAR * scale, widest))
    far = ~turned | (np.abs(e) > _FAR * np.maximum(sigma, scale))
    found = turned.any(axis=1) & near.all(axis=1) & far.all(axis=1)
    return found & (found.sum() > turned.any(axis=1).sum() / 2)


def _degrees(logged: Logged, kinds: Sequence[bool | None]) -> Iterator[Mistake]:
    """Find errors in degrees with covariances in radians, or the other way round.

    σ of the angles is wrong by 180/π, by an interval that excludes 5, and that of no length is.
    A filter whose σ is wrong by less than 5 is not named but where it is estimated at 29 or more
    with an interval that excludes 5; one whose angles alone are wrong by 30 to 100 times may be.
    """
    angles = [axis for axis, kind in enumerate(kinds) if kind]
    asked = angles or [axis for axis, kind in enumerate(kinds) if kind is None]
    lengths = [axis for axis, kind in enumerate(kinds) if kind is False]
    wrong = {axis: _Factor.of(logged, axis) for axis in (*asked, *lengths)}
    for factor, errors, covariances in (
        (1 / DEGREE, "degrees", "radians"), (DEGREE, "radians", "degrees"),
    ):  # fmt: skip
        found = [axis for axis in asked if wrong[axis].is_like(factor, known=bool(angles))]
        if not angles and found == asked:  # σ as a whole may be wrong
            ends = {axis: logged.factor(axis)["interval99"] for axis in found}
            # An interval of a verdict, which is of the runs' scatter too, must not be wider.
            found = [x for x, (low, high) in ends.items() if low and high and high < 4.0 * low]
        if not found or (angles and found != angles):
            continue
        if any(wrong[axis].is_like(factor, known=True) for axis in lengths):
            continue
        names = ", ".join(logged.names[axis] for axis in found)
        told = f"{'180/π' if factor > 1 else 'π/180'} is {factor:.3g}"
        yield Mistake(
            f"degrees instead of radians ({names})",
            f"errors of {names} appear to be in {errors} and the covariances in "
            f"{covariances}: σ should be {wrong[found[0]].by:.3g} times as large, and "
            f"{told}; give both in radians",
        )


class _Factor(NamedTuple):
    """The factor by which σ of an axis is wrong, if it is the same one in all runs, as of a unit.

    The interval is that of χ²: how the runs scatter would say nothing more of one factor, and widen
    it without bounds where runs are few. Where up to half of the runs are lost, the mean may be
    like a unit's by chance, but not the other half.
    """

    by: float
    low: float
    high: float
    of_share: float
    """The factor that `_SHARE` of the samples are below."""

    @staticmethod
    def of(logged: Logged, axis: int) -> _Factor:
        """Return the factor of the NEES of an axis; NaN where one is not finite."""
        with np.errstate(invalid="ignore", over="ignore"):
            nees = (logged.errors[..., axis] / logged.sigmas[..., axis]) ** 2
            there = ~np.isnan(logged.errors[..., axis])
            white = logged.innovations and logged.factor(axis)["samples"] == "steps"
            samples = nees[there] if white else nees.mean(axis=1, where=there)
            mean, n = np.mean(samples), len(samples)
            # The probability that the interval misses the factor that all covariances are wrong by.
            most, least = (shortfall_limit(n, 0.01, above=above) / n for above in (True, False))
            numbers = np.sqrt([mean, mean / most, mean / least, np.quantile(samples, _SHARE)])
        return _Factor(*map(float, numbers))

    def is_like(self, factor: float, *, known: bool) -> bool:
        """Whether σ is wrong by just this factor.

        Of few runs, whose interval is wide, only for what is `known` to be an angle.
        """
        if not factor / _LIKE <= self.by <= factor * _LIKE:
            return False
        apart = self.low > _WRONG if factor > 1 else self.high < 1 / _WRONG
        near = self.low / _SLACK < factor < self.high * _SLACK and self.of_share > factor / _BELOW
        return apart and near and (known or self.high < _NARROW * self.low)


def _interchanged(logged: Logged) -> Iterator[Mistake]:
    """Find arrays (steps, runs), where what is called a run is a step, and resembles the next one.

    Runs may be numbered in any order. Where their own order makes neighbours more alike than all
    of 10 000 drawn orders do, they are no independent runs; of independent ones once in 10 000
    studies. Neighbouring steps must be half as alike at the most, so that in practice it is rarer.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        x = np.nan_to_num((logged.errors / logged.sigmas)[:_MANY, :_MANY])
    x = x / np.hypot(1.0, x)  # an error that is far off counts as one that is somewhat so
    runs, steps = (_products(np.swapaxes(x, 0, axis)) for axis in (0, 1))
    ours, theirs = _alike(runs), _alike(steps)
    # Neighbours that correlate less may be strangers.
    if ours < 0.3 or theirs > ours / 2 or not _by_order(runs):
        return
    yield Mistake(
        "runs and steps appear to be swapped",
        f"errors of neighbouring runs correlate by {ours:.2f} and those of neighbouring steps by "
        f"{theirs:.2f}, as if steps came first and runs second; expected (runs, steps, …) of "
        "independent runs",
    )


def _products(x: Float[np.ndarray, "k ..."]) -> Float[np.ndarray, "k k"]:
    flat = x.reshape(len(x), -1)
    return flat @ flat.T


def _alike(products: Float[np.ndarray, "k k"]) -> float:
    """The correlation of neighbours beyond that of any two."""
    k = len(products)
    if k < 3:
        return 0.0
    own = float(np.trace(products)) / k
    any_two = (float(products.sum()) - own * k) / (k * (k - 1))
    near = float(np.mean(np.diagonal(products, 1)))
    return (near - any_two) / (own - any_two) if own > any_two else 0.0


def _by_order(products: Float[np.ndarray, "k k"]) -> bool:
    """Whether no other order that is drawn makes neighbours as alike."""
    rng, k = np.random.default_rng(0), len(products)
    own, drawn = float(np.sum(np.diagonal(products, 1))), round(1 / FALSE_ALARM) - 1
    for _ in range(drawn):
        order = rng.permutation(k)
        if np.sum(products[order[1:], order[:-1]]) >= own - 1e-9 * abs(own):
            return False
    return True
