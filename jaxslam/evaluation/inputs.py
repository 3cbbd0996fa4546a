"""The errors, poses and covariances that another program logged: read, and checked."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST, read_arrays
from jaxslam.evaluation.convention import (
    BLOCK,
    CHOICES,
    Axes,
    Convention,
    Squares,
    Tangents,
    Values,
    blocks,
    geometry_of,
    pose_errors,
)
from jaxslam.io.logs.log import check_seconds, in_degrees, symmetric
from jaxslam.io.text import read_table, vector_of
from jaxslam.io.tum import not_rigid, of_xytheta, poses
from jaxslam.statistics.bands import Mask, PerAxis, PerStep

RunAndStep = Sequence[int | np.integer] | np.ndarray
"""The numbers of a run, and of a step."""
ASYMMETRY = 0.1
"""The largest asymmetry of a covariance, in σ of its axes: a filter in float32 makes less. What is
evaluated is its symmetric part."""
UNKNOWN = 1e12
"""A variance of what is not known, m² or rad²."""
ROUNDING = 1e-8
"""Nine decimals of two files: their poses can differ by 4e-9 (map units, rad), and be the same."""


def numbers(what: str, values: ArrayLike, ndim: int, shape: str) -> Float[np.ndarray, ...]:
    """An array of float64 of so many axes, finite or not. Raises ValueError."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise ValueError
        array = array.astype(np.float64, copy=ndim < 4)  # matrices are large, and no result
    except (ValueError, TypeError):
        raise ValueError(f"{what} must be numbers, an array {shape}") from None
    if array.ndim != ndim or not array.size:
        raise ValueError(f"{what} must be an array {shape}, not {array.shape}")
    return array


def check_finite(what: str, array: Values, logged: Mask) -> None:
    """Raise ValueError, naming run and step, for what is not finite at a step that was logged."""
    unknown = " (inf is of an axis that is unknown at every pose)" * (array.ndim == 4)
    for place in np.argwhere(~np.isfinite(filled(array, logged, 0.0)))[:1]:
        raise ValueError(
            f"{what} of {at(place)} holds {array[tuple(place)]}; only finite numbers{unknown}"
        )


def all_nan(array: Values) -> Mask:
    """A mask of the steps whose every number is NaN, so that nothing was logged."""
    return np.asarray(np.isnan(array).all(axis=tuple(range(2, array.ndim))))


def filled(array: Values, logged: Mask, value: ArrayLike) -> Values:
    """Return the array with a value at every step that was not logged; itself, if all were."""
    if logged.all():
        return array
    return np.where(logged.reshape(*logged.shape, *[1] * (array.ndim - 2)), array, value)


def check_every_run(logged: Mask) -> None:
    """Raise ValueError for a run of which no step was logged."""
    for run in np.flatnonzero(~logged.any(axis=1))[:1]:
        raise ValueError(f"run {run} is all NaN; every run needs at least one step")


def at(place: RunAndStep) -> str:
    """Name a place as `run 3, step 17`, counted from 0."""
    return f"run {place[0]}, step {place[1]}"


def paired(errors: ArrayLike, covariances: ArrayLike) -> tuple[PerAxis, Squares, Mask]:
    """Return errors and covariances, and a mask of the steps that have them; the others are zeros,
    of unit covariance.

    A step whose error or covariance is all NaN was not logged. Raises ValueError, naming
    run and step, for any other number that is not finite, and for a run without a step.
    """
    e = numbers("errors", errors, 3, "(runs, steps, n), with one run errors[None]")
    P = numbers("covariances", covariances, 4, "(runs, steps, n, n)")
    if P.shape != (*e.shape, e.shape[-1]):
        wanted = (*e.shape, e.shape[-1])
        raise ValueError(f"errors are {e.shape}, so covariances must be {wanted}, not {P.shape}")
    logged = ~(all_nan(e) | all_nan(P))
    check_finite("errors", e, logged)
    check_finite("covariances", P, logged)
    check_every_run(logged)
    return filled(e, logged, 0.0), filled(P, logged, np.eye(e.shape[-1])), logged


def padded(
    errors: ArrayLike, covariances: ArrayLike
) -> tuple[Float[np.ndarray, ...], Float[np.ndarray, ...], Int[np.ndarray, "runs steps"]]:
    """Innovations and their covariances without the NaN of what was not measured, and the numbers
    of those that were: of one that is NaN the innovation is 0, of variance 1, and independent."""
    e, P = np.array(errors), np.array(covariances)
    shapes = e.ndim == 3 and P.shape == (*e.shape, e.shape[-1])
    if not shapes or any(x.dtype.kind not in "fiu" for x in (e, P)):
        return e, P, np.zeros(e.shape[:2], int)
    e, P = e.astype(np.float64), P.astype(np.float64)
    there = ~(np.isnan(e) & np.isnan(np.diagonal(P, axis1=-2, axis2=-1)))
    without = ~there & there.any(axis=-1, keepdims=True)
    e, P = np.where(without, 0.0, e), np.where(without[..., None] | without[..., None, :], 0.0, P)
    P[..., range(e.shape[-1]), range(e.shape[-1])] += without
    return e, P, there.sum(axis=-1)


def of_one_dof(values: PerStep, dof: PerStep) -> tuple[PerStep, int, tuple[str, ...]]:
    """NIS of many degrees of freedom as those of one, the median, of the same probability.

    Where they are so improbable that it cannot be told, they grow in proportion.
    """
    there = ~np.isnan(values) & (dof > 0)
    if np.ptp(dof[there]) == 0:
        return np.where(there, values, np.nan), int(dof[there][0]), ()
    one = int(np.median(dof[there]))
    result = np.full_like(values, np.nan)
    chi2 = scipy.special
    above = chi2.chdtrc(dof[there], values[there])
    below = chi2.chdtr(dof[there], values[there])
    alike = np.where(above < 0.5, chi2.chdtri(one, above), 2 * chi2.gammaincinv(one / 2, below))
    in_proportion = values[there] * one / dof[there]
    result[there] = np.where(above > 1e-300, alike, in_proportion)
    note = (
        f"degrees of freedom are {dof[there].min():g} to {dof[there].max():g}: each value is that "
        f"of {one} with the same probability"
    )
    return result, one, (note,)


def step_times(times: ArrayLike | None, steps: int) -> Float[np.ndarray, " steps"]:
    """The time of every step in seconds; its number where times are unknown. Raises ValueError."""
    if times is None:
        return np.arange(1.0, steps + 1)
    array = None if np.iscomplexobj(times) else vector_of(times, steps)
    if array is None or not np.isfinite(array).all() or (np.diff(array) < 0).any():
        raise ValueError(
            f"times must be {steps} finite, non-decreasing values in seconds, one per step"
        )
    check_seconds("times", array)
    return array


def exactly_known(covariances: Float[np.ndarray, "*batch n n"]) -> Bool[np.ndarray, "*batch"]:
    """A mask of the covariances that are zero, of what is known by definition.

    A first camera at the origin is: it has no degree of freedom, and no part in a NEES.
    """
    return ~np.any(covariances, axis=(-2, -1))


def without_known(errors: PerAxis, P: Squares, logged: Mask) -> tuple[int, Mask, tuple[str, ...]]:
    """The steps that were logged, but for those that a run knows by definition at its beginning:
    the first at which any run has one, a mask of them, and a word on what is known.

    Raises ValueError where one of those is nevertheless wrong, or where a run has no other step.
    """
    known = exactly_known(P) & logged
    if (known == logged).all():
        raise ValueError("all covariances are zero; they must be positive definite")
    largest = np.abs(errors).max(axis=-1)
    for place in np.argwhere(known & (largest > ROUNDING))[:1]:
        raise ValueError(
            f"the covariance of {at(place)} is zero, and its error is not: "
            f"{largest[tuple(place)]:.3g}; it must be positive definite. Leave out what is from "
            "before the filter began; another frame or unit needs an alignment (--align se3, sim3)"
        )
    # In part: what such a pose knows exactly has no degree of freedom.
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    in_part = (variance == 0) & (np.abs(errors) <= ROUNDING)
    in_part = in_part.any(axis=-1) & (in_part == (variance == 0)).all(axis=-1)
    before = np.logical_and.accumulate(known | in_part | ~logged, axis=1)
    for run in np.flatnonzero(before.all(axis=1))[:1]:
        raise ValueError(
            f"all covariances of run {run} are zero, or zero on an axis without errors; they must "
            "be positive definite"
        )
    left = logged & ~before
    start = int(np.argmax(left.any(axis=0)))
    return start, left, _left_out(logged & before, start)


def _left_out(known: Mask, start: int) -> tuple[str, ...]:
    """A word on the steps at the beginning that are known by definition."""
    if not known.any():
        return ()
    if known[:, :start].all() and not known[:, start:].any():
        steps = "the first step is" if start == 1 else f"the first {start} steps are"
        return (f"{steps} known exactly, and left out",)
    many = f"{known.sum()} steps are" if known.sum() > 1 else "one step is"
    return (f"at the beginning of runs {many} known exactly, and left out",)


def sigmas(covariances: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch n"]:
    """The roots of the variances."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def correlations(covariances: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """The covariances over the σ of both axes."""
    sigma = sigmas(covariances)
    return covariances / sigma[..., :, None] / sigma[..., None, :]


def squared(whitened: PerAxis) -> PerStep:
    """Return the sum of squares over the axes; infinite where it is not a number."""
    with np.errstate(over="ignore", invalid="ignore"):
        nees = np.sum(whitened**2, axis=-1)
    return np.where(np.isnan(nees), np.inf, nees)


def whitened(errors: PerAxis, covariances: Float[np.ndarray, "runs steps n n"]) -> PerAxis:
    """Return `L⁻¹ e`, with `P = L Lᵀ`, by a Cholesky factor of the correlations.

    Raises ValueError, naming run and step, unless every P is symmetric and positive definite.
    """
    (*_, steps, n), result = errors.shape, np.empty(errors.shape)
    e, P, z = errors.reshape(-1, n), covariances.reshape(-1, n, n), result.reshape(-1, n)
    for part in blocks(len(e), BLOCK):
        z[part] = _whitened(e[part], P[part], lambda k, part=part: divmod(part.start + k, steps))
    return result


def _whitened(e: Tangents, P: Squares, place: Callable[[np.integer], RunAndStep]) -> Tangents:
    """The same of a row of errors, of which `place` tells run and step."""

    def refuse(k: np.integer, fault: str) -> NoReturn:
        must = "it must be symmetric and positive definite"
        raise ValueError(f"the covariance of {at(place(k))} {fault}; {must}")

    variance = np.diagonal(P, axis1=1, axis2=2)
    for k, axis in np.argwhere(variance <= 0)[:1]:
        refuse(k, f"has variance {variance[k, axis]:.3g} at place {axis}")
    with np.errstate(over="ignore"):
        correlation = correlations(P)
    for k, *entry in np.argwhere(~np.isfinite(correlation))[:1]:
        refuse(k, f"has {P[k, *entry]:.3g} where its variances allow less")
    transposed = np.swapaxes(correlation, 1, 2)
    skewed = np.abs(correlation - transposed).max(axis=(1, 2))
    for k in np.flatnonzero(skewed > ASYMMETRY)[:1]:
        refuse(k, f"is not symmetric (by {skewed[k]:.2g} in σ)")
    correlation = correlation / 2 + transposed / 2
    try:
        L = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(correlation)[:, 0]
        k = np.flatnonzero(least <= max(float(least.min()), 0.0))[0]
        refuse(k, f"has an eigenvalue {least[k]:.3g} times its variances")
    with np.errstate(over="ignore", invalid="ignore"):  # infinite: of a run that diverged
        return np.linalg.solve(L, (e / np.sqrt(variance))[..., None])[..., 0]


MOST = 20_000
"""The most poses by which what needs no more of them is decided."""


class Poses(NamedTuple):
    """Runs of estimated poses T_wc, their covariances, the truth, and how they are compared."""

    estimates: Float[np.ndarray, "runs steps d d"]
    covariances: Float[np.ndarray, "runs steps t t"]
    truths: Float[np.ndarray, "runs steps d d"]
    logged: Mask
    """A mask of the steps that are there; the others are identities, of unit covariance."""
    convention: Convention
    """The errors that the covariances are of."""
    joint: Float[np.ndarray, "runs steps*t steps*t"] | None = None
    """The covariance of all poses of a run, where it is known."""
    align: str = "none"
    used: tuple[str, ...] = ()
    """The names of the axes that are compared; none where they are to be found."""
    truth_sigma: tuple[float, float] | None = None
    """The σ of the true poses, m and degrees; None of exact ones."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all axes, in the order of a covariance."""
        return self.convention.names(geometry_of(self.estimates))

    @property
    def axes(self) -> Axes:
        """The places of the axes that are compared, or of all."""
        return np.array([i for i, x in enumerate(self.names) if x in (self.used or self.names)])

    def errors(self) -> Tangents:
        """The exact errors of the stated kind, along these axes."""
        return pose_errors(self.convention, self.estimates, self.truths)[..., self.axes]

    def along_axes(self) -> Squares:
        """The covariances of these errors."""
        axes, P = self.axes, self.covariances
        return P if len(axes) == P.shape[-1] else P[..., axes[:, None], axes]

    def some(self) -> Poses:
        """Steps of equal distances, with the first one of every run: `MOST` poses, or all."""
        every = -(-self.logged.size // MOST)
        if every < 2 or self.joint is not None:
            return self
        first = np.argmax(self.logged, axis=1)
        steps = np.union1d(np.arange(0, self.logged.shape[1], every), first)
        return self.at((slice(None), steps))

    def later(self, start: int, logged: Mask) -> Poses:
        """Those from a step on that have a part in the verdict."""
        t, there = self.covariances.shape[-1], logged[:, start:]
        joint = None if self.joint is None else self.joint[:, start * t :, start * t :]
        poses = self.at((slice(None), slice(start, None)), joint)
        return poses._replace(covariances=filled(poses.covariances, there, np.eye(t)), logged=there)

    def at(self, places: tuple[Any, ...], joint: np.ndarray | None = None) -> Poses:
        """Those at some places, and their joint covariance."""
        T, P, truths, logged, *compared = self
        arrays = (x[places] for x in (T, P, truths, logged))
        return Poses(*arrays, *compared)._replace(joint=joint)


def of_sigmas(sigmas: ArrayLike) -> Float[np.ndarray, "runs steps n n"]:
    """The diagonal covariances of σ (runs, steps, n). Raises ValueError for a negative one."""
    sigma = numbers("sigmas", sigmas, 3, "(runs, steps, n)")
    for place in np.argwhere(sigma < 0)[:1]:
        raise ValueError(
            f"sigmas of {at(place)} must not be negative, not {sigma[tuple(place)]:.3g}"
        )
    with np.errstate(over="ignore"):
        squared = sigma[..., None] * sigma[..., None, :]
    there = all_nan(sigma)[..., None, None] | np.eye(sigma.shape[-1], dtype=bool)
    return np.where(there, squared, 0.0)


def checked_poses(
    estimates: ArrayLike, covariances: ArrayLike, truths: ArrayLike, convention: Convention
) -> Poses:
    """Return the poses of arrays that belong together. Raises ValueError, naming run and step."""
    matrices = "(runs, steps, 4, 4) or (…, 6), in the plane (runs, steps, 3, 3) or (…, 3)"
    T, truth = _matrices("estimates", estimates, matrices), _matrices("truths", truths, matrices)
    if T.shape != truth.shape:
        raise ValueError(
            f"estimates are {T.shape}, so truths must have the same shape, not {truth.shape}"
        )
    runs, steps, t = *T.shape[:2], geometry_of(T).tangent_dim
    each, joint = (runs, steps, t, t), (runs, steps * t, steps * t)
    P = numbers("covariances", covariances, 3 if np.ndim(covariances) == 3 else 4, str(each))
    if P.shape not in (each, joint):
        raise ValueError(
            f"covariances of {runs} runs of {steps} poses must be {each}, or the joint ones "
            f"{joint}, not {P.shape}"
        )
    joints, P = (P, P) if P.shape == joint else (None, without_unknown(P, marked=False))
    if joints is not None:
        blocks = joints.reshape(runs, steps, t, steps, t)
        P = np.moveaxis(blocks[:, range(steps), :, range(steps)], 0, 1)
    logged = ~(all_nan(T[..., :-1, :]) | all_nan(P) | all_nan(truth[..., :-1, :]))
    check_every_run(logged)
    if joints is not None:
        rows = np.repeat(logged, t, axis=1)
        joints = np.where(rows[:, :, None] & rows[:, None], joints, 0.0)
        for run, *_ in np.argwhere(~(np.abs(joints) <= LARGEST))[:1]:
            told = f"numbers that are not finite, or beyond {LARGEST:.0e}"
            raise ValueError(f"covariances of run {run} hold {told}")
    for what, x in (("estimates", T), ("truths", truth), ("covariances", P)):
        check_finite(what, x, logged)
        known = filled(x, logged, 0.0)
        if (largest := max(known.max(), -known.min())) > LARGEST:
            raise ValueError(f"{what} contain {largest:.2g}; the limit is {LARGEST:.0e}")
    T, truth = (filled(x, logged, np.eye(x.shape[-1])) for x in (T, truth))
    for what, x in (("estimates", T), ("truths", truth)):
        # The tolerance of a rotation's orthonormality: rounding to six digits makes less.
        for place in np.argwhere(not_rigid(x, 1e-4))[:1]:
            told = "is not a rigid motion [R t; 0 1] with a rotation R"
            raise ValueError(f"{what} of {at(place)} {told}")
    return Poses(T, filled(P, logged, np.eye(t)), truth, logged, convention, joints)


def without_unknown(P: Squares, *, marked: bool = True) -> Squares:
    """The covariances, with a variance of `UNKNOWN`, and none with others, on the axes where that
    of every pose is that or larger: what programs write of what they do not estimate. In files it
    may be `marked` by −1."""
    variance = np.diagonal(P, axis1=2, axis2=3)
    there = ~np.isnan(variance)
    unknown = ((marked & (variance == -1)) | (variance >= UNKNOWN) | ~there).all(axis=(0, 1))
    if not unknown.any() or unknown.all():
        return P
    alone = np.where(np.isnan(P), np.nan, np.diag(np.where(unknown, UNKNOWN, 0.0)))
    return np.where(unknown | unknown[:, None], alone, P)


def _matrices(what: str, given: ArrayLike, expected: str) -> np.ndarray:
    T = numbers(what, given, 3 if np.ndim(given) == 3 else 4, expected)
    if T.ndim == 3 and T.shape[-1] == 3:
        if all(in_degrees(run[:, 2:], run[:, :2]) for run in T[:10]):
            raise ValueError(f"{what} have θ in degrees, as their course shows; expected radians")
        T = of_xytheta(T)
    if T.ndim == 3 and T.shape[-1] == 6:
        from scipy.spatial.transform import Rotation  # slow to import

        position, turn = np.split(T.reshape(-1, 6), 2, axis=1)
        turn = Rotation.from_rotvec(turn).as_quat()
        T = poses(position, turn).reshape(*T.shape[:2], 4, 4)
    if T.ndim != 4 or T.shape[-2:] not in ((3, 3), (4, 4)):
        raise ValueError(f"{what} must be matrices {expected}, not {T.shape}")
    return T


_LOAD = """import faulthandler, pickle, sys, scipy.io; faulthandler.dump_traceback_later(99, exit=1)
pickle.dump(scipy.io.loadmat(sys.argv[1]), sys.stdout.buffer)"""
"""A program that writes the arrays of a mat file, within 99 s."""


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a mat file of MATLAB up to version 7; nothing in it is run."""
    # SciPy trusts the bytes of a file: by damaged ones the process that reads them may end.
    done = subprocess.run([sys.executable, "-c", _LOAD, path], capture_output=True, check=False)
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2] or "it is damaged"
        raise ValueError(
            f"{path}: cannot be read ({textwrap.shorten(last, 200)}); expected a mat file, up to "
            "version 7 (save -v7)"
        )
    arrays = {k: x for k, x in pickle.loads(done.stdout).items() if not k.startswith("__")}
    for name in {"names", *CHOICES} & arrays.keys():  # cells, or a matrix of letters
        arrays[name] = np.array([str(np.ravel(x)[0]).strip() for x in arrays[name].ravel()])
    return {k: x.ravel() if k == "times" or x.size == 1 else x for k, x in arrays.items()}


def by_runs(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of one run, which have no axis of runs, as those of runs; and those of MATLAB, errors
    (n, steps) and covariances (n, n, steps), with their steps first."""
    P, each = arrays.get("covariances", np.empty(0)), {*_OF_STEPS} & arrays.keys()
    if P.ndim > 2 and P.shape[0] == P.shape[1] and P.shape[-1] != P.shape[-2]:
        arrays = arrays | {key: arrays[key].T for key in each}
    one = any(arrays[key].ndim == _OF_STEPS[key] for key in each)
    return arrays | {key: arrays[key][None] for key in each if one and arrays[key].ndim}


_OF_STEPS = {"nees": 1, "nis": 1, "errors": 2, "innovations": 2, "estimates": 2} | dict.fromkeys(
    ("covariances", "sigmas", "truths", "dof"), -1
)
"""The numbers of axes of arrays that have none of runs, where that shows it."""
ARRAYS = {".npz": read_arrays, ".mat": read_mat}
"""What reads the arrays of a file."""
_COLUMNS = "4 for n = 1, 7 for 2, 11 for 3, 29 for 6"
STEP_FIRST = ("step", "steps", "time", "t", "k", "frame", "timestamp")
"""First words of a table without a column of runs."""
_SIGMA = re.compile(r"(σ|sigma|std|sd)", re.IGNORECASE)


def read_csv(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...], tuple[str, ...]]:
    """Read lines `run, step, n errors, n (n + 1)/2 of the upper triangle`; a first one of names.

    In place of the triangle there may be all n² numbers, row by row, or n σ, whose names then begin
    with `sigma`. Where the first name is `step`, or `time`, there is one run and no column of runs.
    Names `run, step, nees, dof` (or `nis`) are of these alone. Returns the arrays, and the names of
    runs and steps in the file.
    """
    row = "numbers run, step, n errors and the n (n + 1)/2 of the upper triangle row by row"
    table = read_table(path, "log", "errors", row)
    # Each σ may stand beside its error.
    order = sorted(range(len(table.titles)), key=lambda i: bool(_SIGMA.match(table.titles[i])))
    titles = [table.titles[i] for i in order]
    rows = table.rows[:, order] if order else table.rows
    found = _columns(titles, rows)
    if found is None:
        told = f" ({', '.join(titles)})" if titles else ""
        raise ValueError(
            f"{path}: {rows.shape[1]} columns{told}; expected {row}: {_COLUMNS} columns; or all n² "
            "numbers, n σ named sigma…, or nees and dof by these names. A trajectory needs --truth"
        )
    before, n, kind = found
    errors, P = (np.isnan(x) for x in np.split(rows[:, before:], [max(n, 1)], axis=1))
    without, finite = errors.all(axis=1) | (P.all(axis=1) & (n > 0)), np.isfinite(rows)
    table.check(~finite[:, :before].all(axis=1) | ~(without | finite.all(axis=1)), row)
    told = rows[:, :2] if before == 2 else np.column_stack([np.zeros(len(rows)), rows[:, 0]])
    places, runs, steps = _rectangle(path, told, table.lines)

    values = np.full((len(runs), len(steps), rows.shape[1] - before), np.nan)
    values[places] = rows[:, before:]
    if kind in ("nees", "nis"):
        arrays = {kind: values[..., 0], "dof": values[..., 1]}
    else:
        arrays = {"errors": values[..., :n], kind: values[..., n:]}
        if kind == "covariances":
            P = values[..., n:].reshape(-1, values.shape[-1] - n)
            P = P if P.shape[1] == n * n else symmetric(P, np.transpose(np.triu_indices(n)), n)
            arrays[kind] = P.reshape(len(runs), len(steps), n, n)
        if titles:
            arrays["names"] = np.array(titles[before : before + n])
    return arrays, tuple(f"run {x:g}" for x in runs), tuple(f"step {x:g}" for x in steps)


def read_pose_log(
    path: str | Path, runs: int, steps: int, names: Sequence[str]
) -> tuple[Float[np.ndarray, "runs steps n"], Float[np.ndarray, "runs steps n n"]]:
    """Read such lines with poses of these names in place of errors, and their covariances.

    Raises ValueError, naming the file, unless they are all steps from 1 of all runs from 0.
    """
    arrays, *held = read_csv(Path(path))
    logged = arrays.get("errors", np.empty((0, 0, 0)))
    if logged.shape[-1] != len(names) or [*arrays.get("names", names)] != [*names]:
        raise ValueError(f"{path}: expected run, step, {', '.join(names)} and their covariance")
    every = [f"run {i}" for i in range(runs)], [f"step {i}" for i in range(1, steps + 1)]
    wrong = [x for a, b in zip(every, held, strict=True) for x in (*a, *b) if (x in a) != (x in b)]
    wrong += [at((i, k + 1)) for i, k in np.argwhere(np.isnan(logged[..., 0]))]
    if wrong:
        expected = f"expected all steps from 1 to {steps} of runs 0 to {runs - 1}"
        raise ValueError(f"{path}: {wrong[0]} is missing or duplicated; {expected}")
    return logged, of_sigmas(arrays["sigmas"]) if "sigmas" in arrays else arrays["covariances"]


def _columns(titles: list[str], rows: Float[np.ndarray, "k c"]) -> tuple[int, int, str] | None:
    """Where a table has what: so many columns before, n of errors, and what the others are:
    `covariances` or `sigmas`; or `nees` or `nis`, which is followed by `dof`."""
    low = [title.lower() for title in titles]
    before = 1 if low and low[0] in STEP_FIRST and "run" not in low[1:2] else 2
    left = rows.shape[1] - before
    if low[before:] in (["nees", "dof"], ["nis", "dof"]):
        return before, 0, low[before]
    half = left // 2
    if left > 0 and left == 2 * half and all(_SIGMA.match(x) for x in low[before + half :]) and low:
        return before, half, "sigmas"
    upper = round((np.sqrt(9 + 8 * left) - 3) / 2) if left > 1 else 0
    full = round((np.sqrt(1 + 4 * left) - 1) / 2) if left > 1 else 0
    if full > 1 and full * (full + 1) == left:
        P = rows[:, before + full :].reshape(-1, full, full)
        # 20 numbers are 4 and 16, or 5 and a triangle of 15, which is not symmetric so.
        if upper * (upper + 3) != 2 * left or (np.swapaxes(P, 1, 2) == P).all():
            return before, full, "covariances"
    of_triangle = upper and upper * (upper + 3) == 2 * left
    return (before, upper, "covariances") if of_triangle else None


def _rectangle(
    path: Path, places: Float[np.ndarray, "k 2"], lines: tuple[int, ...]
) -> tuple[tuple[np.ndarray, np.ndarray], Float[np.ndarray, " r"], Float[np.ndarray, " s"]]:
    """The run and the step of every row, and the numbers of runs and of steps.

    A run need not have all steps.
    """
    (runs, run), (steps, step) = (np.unique(x, return_inverse=True) for x in places.T)
    pairs, first = np.unique(places, axis=0, return_index=True)
    if len(pairs) < len(places):
        twice = np.setdiff1d(np.arange(len(places)), first)[0]
        r, s = places[twice]
        raise ValueError(f"{path}, line {lines[twice]}: run {r:g}, step {s:g} appears twice")
    longest = int(np.bincount(run).max())
    # All runs have at most twice as many different steps as the longest.
    if len(steps) > 2 * longest:
        raise ValueError(
            f"{path}: the runs have {len(steps)} different steps, but none has more than "
            f"{longest}; steps must be counted alike in all runs, for example from the start of "
            "each"
        )
    return (run, step), runs, steps
