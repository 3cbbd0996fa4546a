"""Errors and covariances as somebody else's program logged them: checked, named, whitened."""

from __future__ import annotations

from typing import Any, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam.io.tum import check_seconds

ASYMMETRY = 1e-5
"""Of a covariance, in σ of its two axes: what rounding to six digits leaves is less."""
ROUNDING = 1e-8
"""Nine decimals of two files: their poses can differ by 4e-9 (map units, rad), and be the same."""


def numbers(what: str, values: ArrayLike, ndim: int, shape: str) -> Float[np.ndarray, ...]:
    """An array of float64 of so many axes, finite or not. Raises ValueError."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise ValueError
        array = array.astype(np.float64)
    except (ValueError, TypeError):
        raise ValueError(f"{what} must be numbers, an array {shape}") from None
    if array.ndim != ndim or not array.size:
        raise ValueError(f"{what} must be an array {shape}, not {array.shape}")
    return array


def check_finite(
    what: str, array: Float[np.ndarray, ...], logged: Bool[np.ndarray, "runs steps"] | None = None
) -> None:
    """Raise ValueError, naming run and step, for what is not finite at a step that was logged."""
    wrong = ~np.isfinite(array)
    if logged is not None:
        wrong &= logged.reshape(*logged.shape, *[1] * (array.ndim - 2))
    if wrong.any():
        place = np.argwhere(wrong)[0]
        raise ValueError(f"{what} of {at(place)} holds {array[tuple(place)]}; only finite numbers")


def all_nan(array: Float[np.ndarray, "runs steps ..."]) -> Bool[np.ndarray, "runs steps"]:
    """Where every number of a step is NaN, so that nothing was logged."""
    return np.asarray(np.isnan(array).all(axis=tuple(range(2, array.ndim))))


def filled(
    array: Float[np.ndarray, "runs steps ..."],
    logged: Bool[np.ndarray, "runs steps"],
    value: ArrayLike,
) -> Float[np.ndarray, "runs steps ..."]:
    """With a value at every step that was not logged."""
    return np.where(logged.reshape(*logged.shape, *[1] * (array.ndim - 2)), array, value)


def check_every_run(logged: Bool[np.ndarray, "runs steps"]) -> None:
    """Raise ValueError for a run of which no step was logged."""
    if not logged.any(axis=1).all():
        run = int(np.argmin(logged.any(axis=1)))
        raise ValueError(f"run {run} has no step: all of it is NaN; runs with a step are accepted")


def at(place: Any) -> str:
    """`run 3, step 17`, counted from 0."""
    return f"run {place[0]}, step {place[1]}"


class Paired(NamedTuple):
    """Errors and covariances that belong together."""

    errors: Float[np.ndarray, "runs steps n"]
    covariances: Float[np.ndarray, "runs steps n n"]
    logged: Bool[np.ndarray, "runs steps"]
    """Which steps of which run are there; the others are zeros, with a covariance of one."""


def paired(errors: ArrayLike, covariances: ArrayLike) -> Paired:
    """Errors and covariances, and where they are.

    A step whose error and covariance are both all NaN was not logged. Raises ValueError, naming
    run and step, for any other number that is not finite, and for a run without a step.
    """
    e = numbers("errors", errors, 3, "(runs, steps, n), with one run errors[None]")
    P = numbers("covariances", covariances, 4, "(runs, steps, n, n)")
    if P.shape != (*e.shape, e.shape[-1]):
        wanted = (*e.shape, e.shape[-1])
        raise ValueError(f"errors are {e.shape}, so covariances must be {wanted}, not {P.shape}")
    logged = ~(all_nan(e) & all_nan(P))
    check_finite("errors", e, logged)
    check_finite("covariances", P, logged)
    check_every_run(logged)
    return Paired(filled(e, logged, 0.0), filled(P, logged, np.eye(e.shape[-1])), logged)


def step_times(times: ArrayLike | None, steps: int) -> Float[np.ndarray, " steps"]:
    """Seconds of every step; its number where nobody told. Raises ValueError."""
    if times is None:
        return np.arange(1.0, steps + 1)
    try:
        real = not np.iscomplexobj(times)
        array = np.asarray(times, np.float64) if real else np.empty(0)
    except (ValueError, TypeError):
        array = np.empty(0)
    if array.shape != (steps,) or not np.isfinite(array).all() or (np.diff(array) < 0).any():
        raise ValueError(f"times must be {steps} finite seconds, one a step, that do not decrease")
    check_seconds("times", array)
    return array


def exactly_known(
    covariances: Float[np.ndarray, "*batch n n"],
) -> Bool[np.ndarray, "*batch"]:
    """Which covariances are zero: what is known by definition, as a first camera at the origin.

    It has no degree of freedom, and no part in a NEES.
    """
    return ~np.any(covariances, axis=(-2, -1))


class Compared(NamedTuple):
    """The steps that have a part in a verdict."""

    start: int
    """Before it no run has one."""
    logged: Bool[np.ndarray, "runs steps"]
    """Which, of all steps."""
    notes: tuple[str, ...]
    """A word on those that are known by definition."""


def without_known(
    errors: Float[np.ndarray, "runs steps n"],
    covariances: Float[np.ndarray, "runs steps n n"],
    logged: Bool[np.ndarray, "runs steps"],
) -> Compared:
    """All steps that were logged but those at the beginning of a run that it knows by definition.

    Raises ValueError where one is wrong all the same, or where of a run nothing else is left.
    """
    known = exactly_known(covariances) & logged
    wrong = known & (np.abs(errors).max(axis=-1) > ROUNDING)
    if wrong.any():
        run, step = np.argwhere(wrong)[0]
        raise ValueError(
            f"the covariance of {at((run, step))} is zero, and its error is not: "
            f"{np.abs(errors[run, step]).max():.3g}; a positive definite one is accepted"
        )
    if (known == logged).all():
        raise ValueError("all covariances are zero; positive definite ones are accepted")
    before = np.logical_and.accumulate(known | ~logged, axis=1)
    if before.all(axis=1).any():
        run = int(np.argmax(before.all(axis=1)))
        raise ValueError(
            f"all covariances of run {run} are zero; positive definite ones are accepted"
        )
    left = logged & ~before
    start = int(np.argmax(left.any(axis=0)))
    return Compared(start, left, _left_out(known & before, start))


def _left_out(known: Bool[np.ndarray, "runs steps"], start: int) -> tuple[str, ...]:
    """A word on the steps at the beginning that are known by definition."""
    if not known.any():
        return ()
    if known[:, :start].all() and not known[:, start:].any():
        steps = "the first step is" if start == 1 else f"the first {start} steps are"
        return (f"{steps} known exactly, and left out",)
    many = f"{known.sum()} steps are" if known.sum() > 1 else "one step is"
    return (f"at the beginning of runs {many} known exactly, and left out",)


def normalised(
    errors: Float[np.ndarray, "runs steps n"], covariances: Float[np.ndarray, "runs steps n n"]
) -> Float[np.ndarray, "runs steps"]:
    """`eᵀ P⁻¹ e`, by a Cholesky factor of the correlations.

    Raises ValueError, naming run and step, unless every P is symmetric and positive definite.
    """
    variance = np.diagonal(covariances, axis1=-2, axis2=-1)
    if (variance <= 0).any():
        run, step, axis = np.argwhere(variance <= 0)[0]
        told = f"variance {variance[run, step, axis]:.3g} at place {axis}"
        _refuse((run, step), f"has {told}")
    sigma = np.sqrt(variance)
    with np.errstate(over="ignore"):
        correlation = covariances / sigma[..., :, None] / sigma[..., None, :]
    if not np.isfinite(correlation).all():
        place = tuple(np.argwhere(~np.isfinite(correlation))[0])
        _refuse(place[:2], f"has {covariances[place]:.3g} where its variances allow less")
    skewed = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(axis=(-2, -1))
    if (skewed > ASYMMETRY).any():
        place = np.argwhere(skewed > ASYMMETRY)[0]
        _refuse(place, f"is not symmetric (by {skewed[tuple(place)]:.2g} in σ)")
    with np.errstate(over="ignore", invalid="ignore"):  # infinite: of a run that diverged
        whitened = np.linalg.solve(_factors(correlation), (errors / sigma)[..., None])[..., 0]
        nees = np.sum(whitened**2, axis=-1)
    return np.where(np.isnan(nees), np.inf, nees)


def _factors(correlation: Float[np.ndarray, "runs steps n n"]) -> np.ndarray:
    try:
        return np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(correlation)[..., 0]
        place = np.argwhere(least <= max(float(least.min()), 0.0))[0]
        _refuse(place, f"has an eigenvalue {least[tuple(place)]:.3g} times its variances")


def _refuse(place: Any, fault: str) -> NoReturn:
    raise ValueError(
        f"the covariance of {at(place)} {fault}; a symmetric, positive definite one is accepted"
    )
