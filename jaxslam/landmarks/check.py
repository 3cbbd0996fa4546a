"""The check of a landmark of your own: what every parametrization owes its Euclidean point."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam._runtime.programs import QUICK, Program
from jaxslam.geometry import GEOMETRIES, Geometry, Point, joined
from jaxslam.landmarks.landmark import AbstractLandmark, Parameters

_FOCAL = 650.0
_BEARING = (0.31, -0.22)
_INVERSE_DEPTHS = (0.02, 0.15, 1.3)
_BEHIND = -3.0
"""m along the axis: where a camera that has passed the point has it."""
_LARGER = 1.7
_CLOSE = 1e-6
"""Of the largest number: far above rounding, and what central differences are good to."""
_STEP = 1e-6


_WHAT = (
    "initialise: its point", "transform: the moved point",
    "transform by T and T⁻¹: the parameters", "homogeneous: x/z of the moved point",
    "scale: the enlarged point", "convert: the point", "the derivative of initialise",
    "the derivative of transform", "the derivative of transform by the pose",
    "the derivative of homogeneous", "transform: the point moved behind the camera",
    "the derivative of that",
)  # fmt: skip
"""What is compared, in the order of `_compared`."""
_Pair = tuple[Float[Array, "..."], Float[Array, "..."]]


def check_landmark(landmark: AbstractLandmark, geometry: Geometry | None = None) -> None:
    """Check that a parametrization's functions agree, for points at three depths.

    Shapes are (d,), (n,) and (). `initialise(X, ω, f)` puts the point at X/ω. `transform` moves it
    by T, back by T⁻¹ to the same parameters; its x/z and y/z are then where a pinhole sees the
    moved point, behind the camera too. `scale` enlarges the point and `convert` leaves it where it
    is. All derivatives are finite, and those of central differences.
    Points are of the plane and of space, or of the `geometry` alone (`jaxslam.PLANAR`,
    `jaxslam.SPATIAL`). Raises ValueError with the first that does not hold.
    """
    if not isinstance(landmark, AbstractLandmark):
        raise ValueError(f"a jaxslam.AbstractLandmark is accepted, not {type(landmark).__name__}")
    with jax.enable_x64(True):
        for one in GEOMETRIES.values() if geometry is None else (geometry,):
            try:
                _check(landmark, one)
            except _Fault as fault:
                raise ValueError(f"{landmark.name}, {one.name}: {fault}") from None


class _Fault(Exception):
    """What does not hold."""


def _check(landmark: AbstractLandmark, geometry: Geometry) -> None:
    n = geometry.point_dim
    size = _called("size", landmark.size, n)
    if not isinstance(size, int) or size < 1:
        raise _Fault(f"size({n}) is {size!r}; a whole number of parameters is accepted")
    _check_shapes(landmark, geometry, size)
    compared = Program(partial(_compared, landmark, geometry), QUICK)
    for omega in _INVERSE_DEPTHS:
        found = compared(jnp.array([*_BEARING[: n - 1], omega]))
        for what, pair in zip(_WHAT, found, strict=True):
            if pair is not None:
                _check_close(f"{what} at 1/z = {omega:g}", *map(np.asarray, pair))


def _check_shapes(landmark: AbstractLandmark, geometry: Geometry, size: int) -> None:
    n, number = geometry.point_dim, jax.ShapeDtypeStruct((), jnp.float64)
    point, parameters = (jax.ShapeDtypeStruct((k,), jnp.float64) for k in (n, size))
    P, T = jax.ShapeDtypeStruct((size, size), jnp.float64), geometry.group.identity()
    calls = (
        ("initialise", landmark.initialise, (point, number, number), (size,)),
        ("transform", landmark.transform, (T, parameters), (size,)),
        ("homogeneous", landmark.homogeneous, (parameters,), ((n,), ())),
        ("scale", landmark.scale, (number, parameters), (size,)),
        ("convert", landmark.convert, (point, parameters, P), (size,)),
    )
    for what, function, given, accepted in calls:
        made = _called(what, partial(jax.eval_shape, function), *given)
        shape = jax.tree.map(jnp.shape, made)
        if shape != accepted:
            raise _Fault(f"{what} is of shape {shape}; {accepted} is accepted")


def _compared(
    landmark: AbstractLandmark, geometry: Geometry, seen: Float[Array, " n"]
) -> list[_Pair | None]:
    """What is to be equal, in the order of `_WHAT`."""
    T = geometry.group.exp(0.3 * jnp.linspace(-1.0, 1.0, geometry.tangent_dim))
    there = jnp.append(seen[:-1], 1.0) / seen[-1]
    first = _first(landmark, seen)
    moved = landmark.transform(T, first)
    other = landmark.convert(T.translation(), first, 1e-6 * jnp.eye(first.size))
    behind = geometry.group.identity()
    behind = joined(behind.rotation(), jnp.zeros(there.size).at[-1].set(_BEHIND - there[-1]))
    derivatives: tuple[tuple[Callable, Array], ...] = (
        (lambda x: _first(landmark, x), seen),
        (lambda p: landmark.transform(T, p), first),
        (
            lambda e: landmark.transform(T @ geometry.group.exp(e), first),
            jnp.zeros(geometry.tangent_dim),
        ),
        (lambda p: jnp.append(*landmark.homogeneous(p)), first),
    )

    def seen_behind(parameters):
        return _bearing(landmark.homogeneous(landmark.transform(behind, parameters))[0])

    return [
        (_point(landmark, first), there),
        (_point(landmark, moved), T @ there),
        None if landmark.anchored else (landmark.transform(T.inverse(), moved), first),
        (_bearing(landmark.homogeneous(moved)[0]), _bearing(T @ there)),
        (_point(landmark, landmark.scale(_LARGER, moved)), _LARGER * (T @ there)),
        (_point(landmark, other), there),
        *((jax.jacfwd(function)(at), _central(function, at)) for function, at in derivatives),
        (_point(landmark, landmark.transform(behind, first)), behind @ there),
        (jax.jacfwd(seen_behind)(first), _central(seen_behind, first)),
    ]


def _central(function: Callable, at: Float[Array, " k"]) -> Float[Array, "d k"]:
    """The derivative by central differences."""
    steps = jnp.diag(_STEP * jnp.maximum(1.0, jnp.abs(at)))
    ends = jax.vmap(function)(at + steps) - jax.vmap(function)(at - steps)
    return ends.T / (2 * jnp.diag(steps))


def _first(landmark: AbstractLandmark, seen: Float[Array, " n"]) -> Parameters:
    ray = jnp.append(seen[:-1], 1.0)
    return jnp.asarray(landmark.initialise(ray, seen[-1], jnp.asarray(_FOCAL)))


def _point(landmark: AbstractLandmark, parameters: Parameters) -> Point:
    X, omega = landmark.homogeneous(parameters)
    return X / omega


def _bearing(point):
    return point[:-1] / point[-1]


def _called(what: str, function: Callable, *given):
    try:
        return function(*given)
    except Exception as error:
        told = textwrap.shorten(f"{type(error).__name__}: {error}", 300)
        raise _Fault(f"{what} fails: {told}") from None


def _check_close(what: str, value: np.ndarray, wanted: np.ndarray) -> None:
    largest = np.abs(wanted).max()
    off = np.abs(value - wanted).max()
    if not np.isfinite(value).all():
        raise _Fault(f"{what} is not finite")
    if not off <= _CLOSE * max(largest, 1.0):
        told = (np.array2string(np.ravel(x)[:7], precision=5) for x in (value, wanted))
        raise _Fault(
            "{} is {}, and should be {}".format(what, *(" ".join(x.split()) for x in told))
        )
