"""The interface of a landmark parametrization: pure functions on one landmark."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar

Parameters = Float[Array, " d"]
ParametersCovariance = Float[Array, "d d"]


@dataclass(frozen=True)
class Parametrization:
    """A way to write a point with d numbers, for points of n = 2 (planar) or 3 coordinates."""

    name: str
    """By which `LANDMARKS` and the commands know it."""
    parameters: str
    """What the numbers are, as the literature writes them, for a point of three coordinates."""
    point: str
    """The Euclidean point."""
    source: str
    """Who published it."""
    size: Callable[[int], int]
    """`size(n)`: how many parameters a landmark has."""
    initialise: Callable[[Point, Scalar, Scalar], Parameters]
    """`initialise(X, ω, focal)`: parameters, in the camera frame, of the point X/ω; a camera gives
    X = (x/z, y/z, 1) and ω = 1/z. `focal` in pixels."""
    transform: Callable[[Pose, Parameters], Parameters]
    """`transform(T_ab, parameters_in_b)`: the same point in frame a."""
    homogeneous: Callable[[Parameters], Homogeneous]
    """`(X, ω)` such that the point is X/ω; ω may be 0 (a point at infinity) or negative."""
    scale: Callable[[Number, Parameters], Parameters]
    """`scale(s, parameters)`: the point s X/ω, numbers that do not tell the point kept."""
    convert: Callable[[Point, Parameters, ParametersCovariance], Parameters] | None = None
    """`convert(C, parameters, covariance)`: the same point in another form where the camera, at C
    in the landmark's frame, and the covariance recommend it; None where there is one form."""
    anchored: bool = False
    """Whether the parameters are in the frame of the camera that saw the point first, an *anchor*
    that the state holds once for all landmarks of that camera. The last parameter is then a
    constant, the anchor's number, and `transform` is not used."""
