"""The causes of a wrong NEES that lie between the logs, not in the filter.

Quaternions with w first, a constant rotation and lever arm between the bodies, two worlds, an
alignment of what the filter observes, half angles, runs that are the same. Each is named only
on strong evidence, with a number and the NEES without it; then there is no verdict.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import scipy  # of which `special` is imported when it is first used
from jaxtyping import Float

from jaxslam.evaluation.alignment import (
    TURNED,
    aligned,
    angles,
    apart,
    nearest_rotation,
    similarity,
)
from jaxslam.evaluation.comparison import compared
from jaxslam.evaluation.convention import Matrices, Squares
from jaxslam.evaluation.inputs import Poses
from jaxslam.evaluation.result import Evaluation
from jaxslam.evaluation.sanity_checks import Mistake
from jaxslam.io.logs.log import DEGREE
from jaxslam.io.tum import poses as poses_of
from jaxslam.io.tum import quaternions

ROUNDS, SMALL = 4, 1e-4
"""Steps of Gauss and Newton to the mounting, and those of its derivatives, in σ."""
UNDETERMINED = 0.05
"""The share of the largest singular value below which motion does not determine a direction."""
CLEARLY = 1.5
"""The factor of NEES below which a cause explains as much as another, which has more numbers."""
LESS = 3.0
"""The factor by which a constant that is fitted lessens the errors that it explains."""
HEADED = np.radians(60)
"""A rotation between worlds that is no error of a filter's first heading."""
UNEXPLAINED = 5.0
"""Errors that a constant leaves, in σ of the worst axis, beyond which the filter is wrong."""
FAR, ABSURD = np.log(2.0), np.log(10.0)
"""Logs of factors of σ: from which on it is asked what else covariances may be, and one that no
filter has."""
HALF = 1.3
"""How near σ of all rotations, or positions, is to half angles (the right ones), as a factor."""
MANY = 10
"""Poses that are equal by chance are fewer."""
LENGTHS = 10.0, 100.0, 1000.0, 3.2808
"""Factors between units of length."""
WORSE = ("over-confident", "lost")
Transform = Float[np.ndarray, "d d"]
FEWEST, ALPHA = 4, 1e-3
"""The fewest runs that a constant can be common to, and the chance that one is found of none."""


def causes(poses: Poses, found: Evaluation, used: tuple[str, ...] = ()) -> Iterator[Mistake]:
    """The causes of an evaluation whose errors are larger than σ says, or far smaller; of the axes
    used if any were named."""
    yield from _repeated(poses)
    wrong = suspect(found)
    if poses.convention.scale == "given" or not (wrong or np.abs(_factors(found)).max() > FAR):
        return
    if (few := poses.some()) is not poses:
        poses, found = few, compared(few)
    turns, told = any(name.startswith("r") for name in found.names), list[Mistake]()
    of_poses = (_misread, _tilt, _between) if turns else (_tilt, _between)
    for look in (*(of_poses if wrong else ()), partial(_written, used)):
        # A first pose that is known exactly would not be; or positions coincide.
        with suppress(ValueError):
            told += filter(None, [look(poses, found)])
        if any(x.certain and _left(x) < UNEXPLAINED**2 * found.dof for x in told):
            break
    # What is possible and explains as much leaves nothing certain.
    least = min((_left(x) for x in told if not x.certain), default=np.inf)
    certain = [x for x in told if x.certain and CLEARLY * _left(x) < least]
    # What explains far more than the first comes before it.
    better = [x for x in certain if LESS * _left(x) < _left(certain[0])]
    yield from better[-1:] or certain[:1] or map(_possible, told)


def _left(cause: Mistake) -> float:
    """The NEES that a cause leaves, as computed for each of them."""
    return cause.nees or 0.0


def _possible(cause: Mistake) -> Mistake:
    """The same, in words that do not say that it is there."""
    what = cause.what.replace(" are ", " may be ", 1).replace(" have ", " may have ", 1)
    return cause._replace(what=what, certain=False)


def suspect(found: Evaluation) -> bool:
    """Whether errors are larger than σ says, or are taken for ones in degrees for that."""
    return bool(found.mistakes) or found.verdict["word"] in WORSE


def explained(found: Evaluation) -> bool:
    """Whether nothing is left to be wrong by the verdict, which may allow for much, nor by what one
    right pose in 200 reaches, upwards or downwards."""
    share = float(scipy.special.chdtr(found.dof, _nees(found)))
    right = 0.005 < share < 0.995 and found.of_nees["word"] not in WORSE
    return right and not suspect(found)


def _nees(found: Evaluation) -> float:
    return float(np.mean(found.nees[found.logged]))


def _instead(fixed: Evaluation, found: Evaluation) -> str:
    """The NEES without a cause, and with it."""
    return f"NEES is {_nees(fixed):.4g} instead of {_nees(found):.4g}"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _repeated(poses: Poses) -> Iterator[Mistake]:
    """Runs, said to be independent, with the same rows: their poses are equal to the last digit."""
    if len(poses.logged) < 2:
        return
    rows = [
        {pose.tobytes() for pose in run[logged]}
        for run, logged in zip(poses.estimates, poses.logged, strict=True)
    ]
    # Poses that every run shares, such as a first one, are no copies.
    rows = [own - set.intersection(*rows) for own in rows] if len(rows) > 2 else rows
    for (first, own), (second, other) in combinations(enumerate(rows), 2):
        fewest, same = min(len(own), len(other)), len(own & other)
        if same >= MANY and same > 0.5 * fewest:
            yield Mistake(
                "the same run twice",
                f"run {first} and run {second} share {same} of {fewest} estimates to the last "
                "digit: they are one run, not two independent ones; leave one out",
            )
            return


class Reading(NamedTuple):
    """Another way to read poses."""

    what: str
    are: str
    write: str
    """What to write instead."""
    change: Callable[[Matrices], Matrices]
    of: tuple[str, ...] = ("estimate", "truth")
    """Whose poses are changed: the truth's alone where either may be meant, as covariances are
    along the axes of the estimate."""
    flat: bool = True
    """Whether poses in the plane may be meant too."""


def _misread(poses: Poses, found: Evaluation) -> Mistake | None:
    """Poses that are to be read in another way (`READINGS`)."""
    n, there = poses.estimates.shape[-1] - 1, poses.logged

    def off(of: Poses) -> float:
        world = aligned(of._replace(used=())).poses
        return apart(*(x[there][:, :n, :n] for x in (world.estimates, world.truths)))

    before, ones = off(poses), list[Mistake]()
    for way, name in [(x, name) for x in READINGS if n == 3 or x.flat for name in x.of]:
        read: dict[str, Any] = {f"{name}s": way.change(getattr(poses, f"{name}s"))}
        changed = poses._replace(**read)
        after = off(changed)
        fixed = compared(changed) if after < before else found
        # σ of rotations may be as large as what is left.
        far, near, less = before > TURNED, after < before / 4, _nees(found) / _nees(fixed)
        if (far and near and less > CLEARLY) or (less > 10 and explained(fixed)):
            certain = bool(far and (near or len(there) >= FEWEST))
            one = Mistake(
                f"{way.what} of the {name} {way.are}",
                f"rotations differ by {np.degrees(before):.3g}° (median); without that "
                f"{_instead(fixed, found)}; write {way.write}",
                _nees(fixed),
                certain,
            )
            ones.append(one)
    return min(ones, key=_left, default=None)


def _w_first(T: Matrices) -> Matrices:
    """Poses whose quaternions, read as x, y, z, w, are w, x, y, z."""
    flat = T.reshape(-1, 4, 4)
    q = quaternions(flat[:, :3, :3])[:, [1, 2, 3, 0]]
    return poses_of(flat[:, :3, 3], q).reshape(T.shape)


def _along(world: np.ndarray, body: np.ndarray, T: Matrices) -> Matrices:
    """Poses along other axes of the world and of the body; in the plane along their x and y."""
    kept = [0, 1, 2, 3] if T.shape[-1] == 4 else [0, 1, 3]
    return world[np.ix_(kept, kept)] @ T @ body[np.ix_(kept, kept)]


def _turned(change: Callable[[Matrices], Matrices], T: Matrices) -> Matrices:
    """Poses whose rotations alone are changed."""
    result = change(T)
    result[..., :-1, -1] = T[..., :-1, -1]
    return result


NED, FRD = np.diag([1.0, 1, -1, 1])[[1, 0, 2, 3]], np.diag([1.0, -1, -1, 1])
"""North, east, down of east, north, up; forward, right, down of forward, left, up. Each undoes
itself."""
RIGHT = np.diag([1.0, -1, 1, 1])
UNITY = np.diag([-1.0, 1, 1, 1]) @ np.eye(4)[[1, 2, 0, 3]]
"""Forward, right, up (CARLA), and right, up, forward, of forward, left, up: left-handed."""
mirrored, _navigation = partial(_along, RIGHT, RIGHT), partial(_along, NED, FRD)
_NED = "are north, east, down and the estimate's east, north, up, or conversely"
_LEFT = (
    "axes", "are left-handed and the estimate's right-handed, or conversely (Unity, CARLA)",
    "both right-handed, as y and the turns about x and z with the other sign",
)  # fmt: skip
READINGS = (
    Reading("quaternions", "have w first", "qx qy qz qw, or name the columns", _w_first,
            flat=False),
    Reading("quaternions", "are conjugated (JPL)", "the rotation of the body in the world",
            partial(_turned, np.linalg.inv), flat=False),
    Reading("poses", "are inverse", "poses of the body in the world", np.linalg.inv),
    Reading("axes", _NED, "both along the same axes", _navigation, ("truth",)),
    Reading("axes", _NED, "both along the same axes", partial(_along, NED, np.eye(4)), ("truth",),
            flat=False),
    Reading("headings", "are clockwise from north and the estimate's anticlockwise from east, or "
            "conversely", "both alike, as 90° − heading", partial(_turned, _navigation),
            ("truth",)),
    Reading(*_LEFT, mirrored, ("truth",)),
    *(Reading(*_LEFT, partial(_along, axes, axes.T), ("truth",), flat=False)
      for axes in (UNITY, UNITY.T)),
)  # fmt: skip


def _between(poses: Poses, found: Evaluation) -> Mistake | None:
    """Two bodies or two worlds, whichever explains more; a world has fewer numbers."""
    body, world = _mounting(poses, found), None
    with suppress(ValueError):  # positions coincide
        if poses.align == "none":
            world = _worlds(poses, found)
            other = _worlds(poses._replace(truths=mirrored(poses.truths)), found)
            most = min(UNEXPLAINED**2 * found.dof, _left(world) if world else np.inf)
            if other and LESS * _left(other) < min(_nees(found), most):
                told = f"{other.told}, of a truth that is mirrored: one of both is left-handed"
                world = other._replace(told=told)
        most = CLEARLY * max(_left(world), found.dof) if world else np.inf
        if world and not (body and _left(body) < most):
            return world
    return body


def _worlds(poses: Poses, found: Evaluation) -> Mistake | None:
    """Positions that agree after an alignment, by a large rotation, of first poses apart, or of
    another unit of length."""
    n = poses.estimates.shape[-1] - 1
    rows = [
        _apart(*(x[run, there, :n, n] for x in (poses.estimates, poses.truths)))
        for run, there in enumerate(poses.logged)
    ]
    rms, left, scaled, scale, first, angle, tilt = np.median(rows, axis=0)
    own = found.sigmas[found.logged][:, [not name.startswith("r") for name in found.names]]
    sigma = float(np.median(own)) * (1 if len(rows) >= FEWEST else 2) if own.size else 0.0
    by = "yaw" if n == 3 and tilt < np.radians(2) else "se3"
    by, left = ("sim3", scaled) if scaled < left / LESS else (by, left)
    apart = first > max(0.2 * rms, 5 * sigma) or angle > HEADED
    apart |= by == "sim3" and np.isclose(max(scale, 1 / scale), LENGTHS, rtol=0.02).any()
    if rms <= 5 * max(left, 1e-12) or not apart:
        return None
    fixed = compared(poses._replace(align=by))
    return Mistake(
        "estimate and truth are not in one world",
        f"positions differ by {rms:.3g} m (RMS) and by {left:.3g} m once aligned, by "
        f"{np.degrees(angle):.3g}°{f' and a factor of {scale:.4g}' * (by == 'sim3')}: with "
        f"--align {by} {_instead(fixed, found)}",
        _nees(fixed),
    )


def _apart(p: Float[np.ndarray, "k n"], true: Float[np.ndarray, "k n"]) -> list[float]:
    """How far positions of a run are from true ones (RMS): as they are, aligned, and scaled too;
    the scale; the first of them; and the angle of the alignment, and that of its vertical."""
    fits = [similarity(p, true, scaled=scaled) for scaled in (False, True)]
    moved = (x.scale * p @ x.rotation.T + x.translation for x in fits)
    R, first = fits[0].rotation, float(np.linalg.norm(p[0] - true[0]))
    tilt = float(np.arccos(np.clip(R[-1, -1], -1, 1)))
    off = (_rms(x - true) for x in (p, *moved))
    return [*off, fits[1].scale, first, float(angles(R, np.eye(len(R)))), tilt]


def _tilt(poses: Poses, found: Evaluation) -> Mistake | None:
    """An alignment of roll and pitch, which the filter observes; or of yaw alone, in two worlds."""
    others = {
        "se3": ("yaw", "the filter knows roll and pitch, which se3 aligns too"),
        "yaw": ("se3", "the verticals of both worlds differ"),
    }
    if poses.estimates.shape[-1] != 4 or poses.align not in others:
        return None
    other, why = others[poses.align]
    fixed = compared(poses._replace(align=other))
    if not explained(fixed) or _nees(fixed) > _nees(found) / 1.2:
        return None
    told = f"{why}: with --align {other} {_instead(fixed, found)}"
    certain = len(poses.logged) >= FEWEST
    what = f"an alignment by {poses.align}{'' if certain else ' may be wrong'}"
    return Mistake(what, told, _nees(fixed), certain)


def _mounting(poses: Poses, found: Evaluation) -> Mistake | None:
    """A constant X between the bodies, `T = W T̂ X`: its rotation, and its lever arm."""
    best, X = found, np.eye(poses.estimates.shape[-1])
    for arm, gain in ((False, 1.5), (True, 1.2)):
        other = _mounted(poses, found, X, arm=arm)
        fixed = _without(poses, other)
        if _nees(fixed) < _nees(best) / gain or explained(best) < explained(fixed):
            best, X = fixed, other
    if best is found:
        return None
    moved = poses._replace(truths=poses.truths @ np.linalg.inv(X))
    n = len(X) - 1
    angle, metres = float(angles(X[:n, :n], np.eye(n))), float(np.linalg.norm(X[:n, n]))
    certain = _of_body(poses, found, best, angle)
    certain = bool(certain or (explained(best) and _in_all_runs(X, moved)))
    if not certain and not explained(best):
        return None
    parts = [f"a constant rotation of {np.degrees(angle):.4g}°"] if angle > 0 else []
    parts += [f"a lever arm of {metres:.3g} m"] if metres > 0 else []
    turns = tuple(name for name in found.names if name.startswith("r"))
    of = {"position": tuple(x for x in found.names if x not in turns), "rotation": turns}
    alone = [
        f"{what} {_nees(compared(moved._replace(used=axes))):.3g} of {len(axes)}"
        for what, axes in of.items()
        if axes
    ]
    by_part = f" ({', '.join(alone)})" if len(alone) > 1 else ""
    return Mistake(
        "estimate and truth are of two bodies",
        f"{' and '.join(parts)} between them, the same at every pose: without it "
        f"{_instead(best, found)}{by_part}; give the truth of the body that is estimated",
        _nees(best),
        certain,
    )


def _mounted(poses: Poses, found: Evaluation, X: Transform, *, arm: bool) -> Transform:
    """X that makes NEES least, by Gauss and Newton, from the mean rotation.

    Its arm is zero along directions that the rotations do not determine. Without an arm it is of
    rotations alone, whose positions one may move.
    """
    n, unit = len(X) - 1, np.eye(len(X))
    turns = tuple(name for name in found.names if name.startswith("r"))
    if not arm and turns:
        world = aligned(poses._replace(used=())).poses
        X, poses = X.copy(), poses._replace(used=turns)
        R, true = (x[poses.logged][:, :n, :n] for x in (world.estimates, world.truths))
        X[:n, :n] = nearest_rotation((np.swapaxes(R, 1, 2) @ true).mean(axis=0))
    own = dict(zip(found.names, np.median(found.sigmas[found.logged], axis=0), strict=True))
    sigma = [np.median([own[x] for x in own if (x in turns) == turn] or 1.0) for turn in (0, 1)]
    pairs = [(i, j) for i, j in combinations(range(n + 1), 2) if arm or j < n]
    steps = np.array([sigma[j < n] * np.outer(unit[i], unit[j]) for i, j in pairs])
    steps = steps - np.swapaxes(steps, 1, 2)
    steps[:, n] = 0.0

    def moved(by: Float[np.ndarray, " k"]) -> Transform:
        result = X @ (unit + np.tensordot(by, steps, 1))
        result[:n, :n] = nearest_rotation(result[:n, :n])
        return result

    for _ in range(ROUNDS):
        each = (moved(SMALL * x) for x in np.eye(len(steps) + 1)[:, 1:])
        z, *others = (_without(poses, x).whitened[found.logged].ravel() for x in each)
        if not np.isfinite([z, *others]).all():
            break
        J = (np.array(others) - z).T / SMALL
        X = moved(np.linalg.lstsq(J, -z, rcond=UNDETERMINED)[0])
    return X


def _without(poses: Poses, X: Transform) -> Evaluation:
    return compared(poses._replace(truths=poses.truths @ np.linalg.inv(X)))


def _of_body(poses: Poses, found: Evaluation, fixed: Evaluation, angle: float) -> bool:
    """Whether the constant is one of a body beyond doubt, and leaves little to be explained.

    A constant error of a filter is one in its world, where a turn moves positions as well: it is
    one of the body if positions are no worse for it, or the body turns against its world.
    """
    turns = np.array([name.startswith("r") for name in found.names])
    ratio, left = (np.exp(_factors(x)) for x in (found, fixed))
    n = poses.estimates.shape[-1] - 1
    R = poses.estimates[:, :, :n, :n][poses.logged]
    axis = poses.truths[:, :, :n, :n][poses.logged] @ np.swapaxes(R, 1, 2)
    constant = angles(axis, nearest_rotation(axis.mean(axis=0)))
    in_world = turns.any() and _rms(constant) < 0.5 * angle
    few = ratio[turns].max(initial=0.0) < LESS * ratio[~turns].max(initial=0.0)
    # Of few runs errors of a filter are alike too.
    least = LESS if len(poses.logged) >= FEWEST else LESS**2
    most = (ratio > least) & (ratio > LESS * left)
    return bool(most.any() and left.max() < UNEXPLAINED and not (in_world and few))


def _in_all_runs(X: Transform, unmounted: Poses) -> bool:
    """Whether X is more than the scatter of what every run alone would add to it."""
    n, moved = len(X) - 1, aligned(unmounted._replace(used=())).poses
    if len(moved.logged) < FEWEST:
        return False

    def parts(T: Matrices) -> np.ndarray:
        S = T[:, :n, :n] - np.swapaxes(T[:, :n, :n], 1, 2)
        return np.column_stack([T[:, :n, n], S[:, *np.triu_indices(n, 1)]])

    runs = zip(moved.estimates, moved.truths, moved.logged, strict=True)
    each = np.array(
        [parts(np.linalg.inv(T[own]) @ true[own]).mean(axis=0) for T, true, own in runs]
    )
    return _beyond_scatter(parts(X[None])[0], each)


def _beyond_scatter(values: np.ndarray, each: Float[np.ndarray, "runs k"]) -> bool:
    """Whether any value is more than what runs scatter by, by a t-test."""
    t = np.abs(values) / (each.std(axis=0, ddof=1) / np.sqrt(len(each)))
    return bool(2 * scipy.special.stdtr(len(each) - 1, -t).min() * len(t) < ALPHA)


def _written(used: tuple[str, ...], poses: Poses, found: Evaluation) -> Mistake | None:
    """Covariances that are other numbers, with which σ of positions and of rotations are right."""
    P, turn = poses.covariances, np.array([name.startswith("r") for name in poses.names])

    def scaled(by: float) -> Squares:
        scale = np.where(turn, by, 1.0)
        return scale[:, None] * P * scale

    half = "angle=half in their header (g2o)"
    ways = [
        Way("of half angles", lambda: scaled(2.0), half, doubtful=suspect(found)),
        Way("of angles in degrees", lambda: scaled(DEGREE), "angle=deg in their header"),
        Way("information matrices", lambda: np.linalg.pinv(P, hermitian=True), "their inverses"),
    ]
    if not np.any(P * ~np.eye(len(turn), dtype=bool)):
        ways += [
            Way("σ in place of variances", lambda: P**2, "their squares"),
            Way("of variances in place of σ", lambda: np.sqrt(P), "their roots"),
        ]
    ones = [_instead_of(poses._replace(used=used), found, way) for way in ways]
    return min(filter(None, ones), key=lambda x: not x.certain, default=None)


class Way(NamedTuple):
    """Something else that the numbers of covariances may be."""

    what: str
    covariances: Callable[[], Squares]
    write: str
    """What to write instead."""
    doubtful: bool = False
    """Whether it is possible even where the σ of an axis stands out."""


def _instead_of(poses: Poses, found: Evaluation, way: Way) -> Mistake | None:
    """The cause that covariances are something else, where nothing is wrong once they are changed:
    in no part, and beyond doubt if the σ of no axis stands out, and as they are it is wrong by far.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"), suppress(ValueError):
        whole = poses._replace(covariances=way.covariances())
        fixed, off = compared(whole), np.abs(_factors(found))
        names = [[x for x in fixed.names if x.startswith("r") == of] for of in (False, True)]
        parts = [compared(whole._replace(used=tuple(x))) for x in names if x and explained(fixed)]
        if not parts or not all(map(explained, parts)):
            return None
        # Of one axis the factor scatters; of a filter whose heading is wrong, one axis stands out.
        few = len(poses.logged) < FEWEST
        left, width = [_factors(part) for part in parts], (1 + few) * np.log(HALF)
        near = all(abs(x.mean()) < width and np.ptp(x) < 3 * width for x in left)
        doubtful = few or found.most is not None or _alike(found)
        certain = bool(near and (off.max() > ABSURD or not doubtful))
        if not near and not way.doubtful:
            return None
        told = (
            f"σ is wrong by up to {np.exp(off.max()):.3g} as they are: with {way.write} "
            f"{_instead(fixed, found)}. If they are what they are said to be, the filter is wrong"
        )
        return Mistake(f"the covariances are {way.what}", told, _nees(fixed), certain)
    return None


def _alike(found: Evaluation) -> bool:
    """Whether σ of positions and of rotations may be wrong by one factor, as runs scatter."""
    turns = np.array([name.startswith("r") for name in found.names])
    if turns.all() or not turns.any():
        return False
    z = np.clip(found.errors / found.sigmas, -1e150, 1e150) ** 2
    off = [np.log(np.nanmean(z[..., part], axis=(1, 2)) + 1e-300) for part in (turns, ~turns)]
    each = np.subtract(*off)[:, None]
    return not _beyond_scatter(each.mean(axis=0), each)


def _factors(found: Evaluation) -> Float[np.ndarray, " n"]:
    """The logs of the factors by which σ of every axis is too small."""
    z = np.clip(found.errors[found.logged] / found.sigmas[found.logged], -1e150, 1e150)
    return np.log(np.mean(z**2, axis=0) + 1e-300) / 2
