"""The convention of a pose covariance: the choice of error, which is seldom documented.

An estimate T̂ = (R̂, p̂) maps body coordinates to the world, T = (R, p) is the truth, and

    right   T = T̂ Exp(ξ): about the body, first along its own axes
    left    T = Exp(ξ) T̂: about the world's origin, so that a turn there moves the position
    split   p = p̂ + δp along the world's axes, and R = R̂ Exp(δθ) about the body's

are the errors. To first order right and split are the same but for the axes; left differs by the
adjoint of T̂. Every error may then be written along other axes, turned by R̂: `body`, `world` (ROS:
split, world) or `mixed`, the position along the world's and the rotation about the body's (MSCKF,
error-state filters: split, mixed; GTSAM: right, body, rotation-first). With `rpy` the rotation is
of roll, pitch and yaw, `R = Rz(yaw) Ry(pitch) Rx(roll)` (`robot_localization`: split, rpy). A
covariance is `marginal`, or `given` the scale of the world, of which its filter then knows nothing.

All matrices that change one into another have determinant one: a wrong convention keeps
`log det P` and raises the expected NEES, to `tr(P_wrong⁻¹ P)`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST, write_text
from jaxslam._runtime.lookup import lookup, suggestion
from jaxslam.geometry import PLANAR, SPATIAL, Geometry, Pose, jacobian, log
from jaxslam.io.logs import named
from jaxslam.io.logs.log import MIXED, WHOLE, Log, in_seconds, of_two_cells, symmetric
from jaxslam.io.logs.unnamed import is_deviations
from jaxslam.io.text import Table, read_table, without_values
from jaxslam.io.tum import table_text

Joints = Float[np.ndarray, "runs k k"]
"""Covariances of all poses of a run together."""
Values = Float[np.ndarray, "runs steps ..."]
"""Numbers, of any shape, for every step of every run."""


Matrices = Float[np.ndarray, "*batch d d"]
"""Poses, in space d = 4 and in the plane 3."""
Squares = Float[np.ndarray, "*batch t t"]
"""Covariances, or derivatives, of their errors."""
Tangents = Float[np.ndarray, "*batch t"]
"""Errors of poses."""
Axes = Int[np.ndarray, " m"]
"""The numbers of the axes used."""


Result = TypeVar("Result")
BLOCK, AT_ONCE = 8192, 512
"""The poses whose matrices are computed at once, and those whose errors are."""
CHOICES = {
    "error": ("right", "left", "split"),
    "axes": ("body", "world", "mixed", "rpy"),
    "order": ("position-first", "rotation-first"),
    "scale": ("marginal", "given"),
}
NATURAL_AXES = {"right": "body", "left": "world", "split": "world"}
"""The default axes of an error; of `split` those of ROS."""
_OWN_AXES = {"right": ("body", "body"), "left": ("world", "world"), "split": ("world", "body")}
"""The axes along which position and rotation of the errors come out, before they are turned."""
_PARTS = {
    "body": ("body", "body"), "world": ("world", "world"), "mixed": ("world", "body"),
    "rpy": ("world", "rpy"),
}  # fmt: skip


@dataclass(frozen=True)
class Convention:
    """The error that a covariance is of. Raises ValueError, naming what is accepted."""

    error: str = "right"
    """`right`, `left` or `split`."""
    axes: str = ""
    """`body`, `world`, `mixed` or `rpy`; by default the error's own (`NATURAL_AXES`)."""
    order: str = "position-first"
    """The order of the rows of a covariance: this, or `rotation-first`."""
    scale: str = "marginal"
    """`marginal`, or `given`: the covariance is that of a world whose scale is known."""

    def __post_init__(self) -> None:
        if not self.axes:
            object.__setattr__(self, "axes", NATURAL_AXES.get(self.error, "body"))
        for name, known in CHOICES.items():
            lookup(name, [getattr(self, name)], dict.fromkeys(known))

    def __str__(self) -> str:
        return " ".join(f"{name}={value}" for name, value in asdict(self).items())

    def names(self, geometry: Geometry) -> tuple[str, ...]:
        """The names of the components of an error, in their order."""
        position, turn = ("x", "y", "z"), ("rx", "ry", "rz")
        if geometry is PLANAR:
            position, turn = ("x", "y"), ("r",)
        return position + turn if self.order == "position-first" else turn + position


def alternatives(convention: Convention, geometry: Geometry) -> tuple[Convention, ...]:
    """All conventions that differ to first order, this one among them, of the same scale.

    The stated one keeps its kind of error, as right and split are not distinguished. In the plane
    no axes turn a rotation, and mixed is world.
    """
    ours = convention.error if convention.error != "left" else "right"
    turned = convention.axes if convention.axes != "body" else "world"
    axes = ("body", turned) if geometry is PLANAR else CHOICES["axes"]
    choices = product((ours, "left"), axes, CHOICES["order"])
    return tuple(
        Convention(error, axes, order, convention.scale)
        for error, axes, order in choices
        if axes != "rpy" or error == ours or convention.axes == "rpy"
    )


def geometry_of(poses: Matrices | Array) -> Geometry:
    """The geometry of matrices (…, 3, 3) or (…, 4, 4)."""
    return SPATIAL if poses.shape[-1] == 4 else PLANAR


def blocks(count: int, size: int = BLOCK) -> Iterator[slice]:
    """Slices of at most that size, one after another: matrices of so many stay in the cache."""
    yield from (slice(i, min(i + size, count)) for i in range(0, count, size))


def pose_errors(convention: Convention, estimates: Matrices, truths: Matrices) -> Tangents:
    """The error of every pose in the convention."""
    result = np.asarray(_in_float64(_error, convention.error, estimates, truths))
    T, e = estimates.reshape(-1, *estimates.shape[-2:]), result.reshape(-1, result.shape[-1])
    for part in blocks(len(T)):
        e[part] = np.einsum("kij,kj->ki", turning(convention, T[part]), e[part])
    return result


def truth_derivatives(
    convention: Convention, estimates: Matrices, truths: Matrices, firsts: Matrices
) -> tuple[Squares, Squares]:
    """Return J of `ξ → ξ + J η` where the truth is T Exp(η) instead, and M.

    M is that where instead the estimate is aligned to a pose F Exp(η) instead of F, one of
    `firsts`: it then is F Exp(η) F⁻¹ T̂.
    """
    both = _in_float64(_truth_derivatives, convention.error, estimates, truths, firsts)
    turn = turning(convention, estimates)
    return turn @ both[0], turn @ both[1]


def from_right(convention: Convention, estimates: Matrices) -> Squares:
    """Return M of `ξ = M ξ_right` to first order: `P = M P_right Mᵀ` is the covariance's."""
    n = estimates.shape[-1] - 1
    R, p = estimates[..., :n, :n], estimates[..., :n, n]
    M = np.zeros((*R.shape[:-2], *(2 * [geometry_of(estimates).tangent_dim])))
    M[..., :n, :n] = R if convention.error != "right" else np.eye(n)
    M[..., n:, n:] = _rotation_matrix(R) if convention.error == "left" else np.eye(M.shape[-1] - n)
    if convention.error == "left":
        M[..., :n, n:] = -lever(p) @ M[..., n:, n:]
    return turning(convention, estimates) @ M


def converted(covariances: Squares, poses: Matrices, old: Convention, new: Convention) -> Squares:
    """Convert covariances of poses from one convention to another."""
    T, result = poses.reshape(-1, *poses.shape[-2:]), np.array(covariances, np.float64, order="C")
    P = result.reshape(-1, *result.shape[-2:])
    for part in blocks(len(P)):
        J = change(T[part], old, new)
        P[part] = J @ P[part] @ np.swapaxes(J, -1, -2)
    return result


def change(poses: Matrices, old: Convention, new: Convention) -> Squares:
    """Return J of `ξ_new = J ξ_old`, to first order."""
    M = from_right(old, poses)
    # Blocks of rotations, but for the adjoint of left errors and the rates of angles.
    orthogonal = old.error != "left" and old.axes != "rpy"
    return from_right(new, poses) @ (np.swapaxes(M, -1, -2) if orthogonal else np.linalg.inv(M))


def turning(convention: Convention, estimates: Matrices) -> Squares:
    """The matrix that turns an error as computed to the axes and the order of the convention."""
    n, t = estimates.shape[-1] - 1, geometry_of(estimates).tangent_dim
    R = estimates[..., :n, :n]
    N = np.zeros((*R.shape[:-2], t, t))
    position, rotation = zip(_OWN_AXES[convention.error], _PARTS[convention.axes], strict=True)
    N[..., :n, :n] = _turned(R, *position)
    if rotation[1] == "rpy" and n == 3:
        N[..., n:, n:] = _by_angles(R) @ _turned(R, rotation[0], "world")
    else:
        N[..., n:, n:] = _turned(_rotation_matrix(R), *rotation)
    return N if convention.order == "position-first" else np.roll(N, t - n, axis=-2)


def _turned(R: np.ndarray, old: str, new: str) -> np.ndarray:
    if old == new:
        return np.broadcast_to(np.eye(R.shape[-1]), R.shape)
    return R if new == "world" else np.swapaxes(R, -1, -2)


def _by_angles(R: np.ndarray) -> np.ndarray:
    """The derivative of roll, pitch and yaw by a rotation along the axes of the world.

    The inverse of the axes of those turns, `Rz Ry e_x`, `Rz e_y` and `e_z`.
    """
    yaw, flat = np.arctan2(R[..., 1, 0], R[..., 0, 0]), np.hypot(R[..., 0, 0], R[..., 1, 0])
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    flat, sine = np.maximum(flat, 1e-9), -R[..., 2, 0]
    rows = (c / flat, s / flat, zero), (-s, c, zero), (c * sine / flat, s * sine / flat, zero + 1)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rotation_matrix(R: np.ndarray) -> np.ndarray:
    """The matrix that turns a rotation vector: R, or 1 in the plane."""
    return R if R.shape[-1] == 3 else np.ones((*R.shape[:-2], 1, 1))


def lever(p: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch n r"]:
    """The motion of points p by a small rotation about the origin: `ω ↦ ω × p`."""
    if p.shape[-1] == 2:
        return np.stack([-p[..., 1], p[..., 0]], axis=-1)[..., None]
    return np.cross(p[..., None, :], np.eye(3))


def _in_float64(function: Callable[..., Result], error: str, *arrays: Matrices) -> Result:
    """Apply a function of single poses to all of them, as NumPy's arrays.

    So many at once, of which the last are repeated, that one program serves logs of all sizes.
    """
    batch, flat = arrays[0].shape[:-2], [x.reshape(-1, *x.shape[-2:]) for x in arrays]
    places = np.minimum(np.arange(-(-len(flat[0]) // AT_ONCE) * AT_ONCE), len(flat[0]) - 1)
    with jax.enable_x64(True):
        parts = [
            jax.device_get(_of_each(function, error, *(x[part] for x in flat)))
            for part in places.reshape(-1, AT_ONCE)
        ]
    return jax.tree.map(
        lambda *x: np.concatenate(x)[: len(flat[0])].reshape(*batch, *x[0].shape[1:]), *parts
    )


def _error(error: str, estimate: Pose, truth: Pose) -> Float[Array, " t"]:
    """The error of one pose, along its own axes (`_OWN_AXES`), position first."""
    if error == "left":
        return log(truth @ estimate.inverse())
    if error == "right":
        return log(estimate.inverse() @ truth)
    turn = log(estimate.rotation().inverse() @ truth.rotation())
    return jnp.concatenate([truth.translation() - estimate.translation(), turn])


def _truth_derivatives(error: str, estimate: Pose, truth: Pose, first: Pose) -> tuple[Array, Array]:
    by_truth = jacobian(lambda T: _error(error, estimate, T), truth)
    return by_truth, jacobian(lambda F: _error(error, F @ first.inverse() @ estimate, truth), first)


@eqx.filter_jit
def _of_each(function: Callable[..., Result], error: str, *matrices: Matrices | Array) -> Result:
    of = geometry_of(matrices[0]).group.from_matrix
    return jax.vmap(lambda *T: function(error, *map(of, T)))(*matrices)


ANGLES = {"rad": 1.0, "deg": np.pi / 180, "half": 2.0}
"""Units of angles, in radians: `half` is the vector part of a quaternion, as in g2o."""
ROUNDED = 1e-6
"""The least eigenvalue, of the greatest number, of a covariance that was rounded."""
_ROWS, _COLUMNS = np.triu_indices(6)


class CovarianceText(NamedTuple):
    """The content of a file: angles in radians, lengths in the file's own unit."""

    times: Float[np.ndarray, " n"]
    covariances: Float[np.ndarray, "n t t"]
    convention: Convention
    """The convention of the header, and the default where it is silent."""


def write_covariances(
    path: str | Path,
    times: ArrayLike,
    covariances: ArrayLike,
    convention: Convention,
    *,
    length: str = "m",
    remark: str = "",
) -> None:
    """Write times (n,) in seconds and covariances (n, 6, 6), of m and rad, whole or not at all.

    `length` names another unit of length, in one word; the `remark` is for people.
    """
    table = np.asarray(covariances, dtype=float).reshape(-1, 6, 6)[:, _ROWS, _COLUMNS]
    names = convention.names(SPATIAL)
    pairs = " ".join(f"{names[i]}{names[j]}" for i, j in zip(_ROWS, _COLUMNS, strict=True))
    remark = f"; {remark}" if remark else ""
    header = f"{pairs} ({convention} angle=rad length={length}{remark})"
    write_text(path, table_text(header, times, table, "covariances", ".9e"))


def read_covariances(path: str | Path, t: int = 6) -> CovarianceText:
    """Read covariances (n, t, t) as `write_covariances`, or another program, wrote them.

    After its time a line has the upper triangle row by row, all t² numbers row by row, or t σ; or
    it is one of OpenVINS's deviations, `t σ_q σ_p` and more. With t = 3 they are of x, y, θ. Raises
    `ValueError`, naming the file, for a line of other numbers, or that are not finite, and for a
    word of the header that is not known.
    """
    found = covariances_of_file(path, t)
    return CovarianceText(found.times, found.covariances, Convention(**found.said))


def covariances_of_file(path: str | Path, t: int = 6, *, positions: bool = False) -> Log:
    """The same, as a log without poses; those of `positions` may be of x, y, z alone."""
    table = read_table(path, "covariances", "covariances", "a time and finite numbers")
    rows, count = table.rows, table.rows.shape[1]
    told, of_titles, assumed = named.covariances(table, flat=t == 3)
    one = None if told is not None or count < 3 else of_two_cells(rows)
    if one is not None:
        rows, count = one, count - 1
    alone = positions and told is None and count in (4, 7, 10)
    t = 3 if alone else t
    triangle = 1 + t * (t + 1) // 2
    kinds = {
        triangle: f"{triangle} finite numbers, the time and the upper triangle row by row",
        1 + t * t: f"{1 + t * t} finite numbers, the time and the covariance row by row",
        1 + t: f"{1 + t} finite numbers, the time and a σ for each axis",
    }
    deviations = t == 6 and is_deviations(rows)
    if deviations:
        kinds[count] = f"{count} finite numbers, OpenVINS's time and deviations"
    there, expected = ~without_values(rows), kinds.get(count, "; or ".join(kinds.values()))
    if told is None:
        table.check(~np.isfinite(rows[:, 0]) | [count not in kinds], expected)
        table.check(there & np.isnan(rows).any(axis=1), WHOLE)
    said, unit, stated = _said(table, MIXED if deviations else of_titles)
    P = np.full((len(rows), t, t), np.nan)
    time = 0 if told is None else named.meanings(table.titles).get("t", 0)
    times, notes = in_seconds(table, rows[:, time])
    if told is not None:
        P = told
    elif deviations or count == 1 + t:
        sigma = rows[there][:, [4, 5, 6, 1, 2, 3] if deviations else range(1, 1 + t)]
        for wrong in sigma[~((sigma >= 0) & (sigma <= LARGEST))][:1]:
            raise ValueError(f"{path}: a σ is {wrong:.3g}; expected 0 to {LARGEST:.0e}")
        P[there] = sigma[:, :, None] ** 2 * np.eye(t)
    elif count == 1 + t * t:
        P[there] = rows[there, 1:].reshape(-1, t, t)
    else:
        P[there], more = _of_triangle(path, rows[there, 1:], t)
        notes += more
    P = np.pad(P, ((0, 0), (0, 3), (0, 3))) if alone else P
    names = Convention(**said).names(SPATIAL if P.shape[-1] == 6 else PLANAR)
    scale = np.array([unit if name.startswith("r") else 1.0 for name in names])
    P, assumed = scale[:, None] * P * scale, assumed and not stated
    return Log(times, np.empty((0, 4, 4)), P, said, notes, assumed=assumed)


def _of_triangle(path: str | Path, values: np.ndarray, t: int) -> tuple[Squares, tuple[str, ...]]:
    """Covariances of upper triangles row by row; or column by column, where only so they are any.

    Column by column is also a lower triangle row by row.
    """
    both = np.triu_indices(t), np.tril_indices(t)
    by_row, by_column = (symmetric(values, np.transpose(places), t) for places in both)

    def least(P):
        return np.linalg.eigvalsh(P)[:, 0] / np.maximum(np.abs(P).max(axis=(1, 2)), 1e-300)

    finite = np.abs(values).max(initial=0.0) <= LARGEST
    if not finite or not (least(by_row) < -ROUNDED).any() or (least(by_column) < 0).any():
        return by_row, ()
    note = (
        f"{path}: its numbers make no covariance as an upper triangle row by row, but do column by "
        "column; taken as that"
    )
    return by_column, (note,)


def _said(table: Table, default: Mapping[str, str]) -> tuple[dict[str, str], float, bool]:
    """The words of a convention in a header, its unit of angles, in radians, and whether there are
    any words. Raises ValueError for misspelt keys and unknown values."""
    told = dict(re.findall(r"\b([a-z]+)=([^\s,;()]+)", " ".join(table.comments)))
    known = {**CHOICES, "angle": tuple(ANGLES), "length": ()}
    try:
        for key in told:
            if meant := suggestion(key, known) if key not in known else "":
                raise ValueError(
                    f"unknown key {key!r} in the header{meant}; known: {', '.join(known)}"
                )
            if known.get(key):
                lookup(key, [told[key]], dict.fromkeys(known[key]))
    except ValueError as error:
        raise ValueError(f"{table.path}: {error}") from None
    said = {key: value for key, value in told.items() if key in CHOICES}
    return {**default, **said}, ANGLES[told.get("angle", "rad")], bool(said)
