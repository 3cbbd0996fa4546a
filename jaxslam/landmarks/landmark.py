"""The interface of a landmark parametrization: pure functions on one landmark."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxslam._numerics.arrays import Number
from jaxslam.geometry import Homogeneous, Point, Pose, Scalar

Parameters = Float[Array, " d"]
ParametersCovariance = Float[Array, "d d"]


class AbstractLandmark(eqx.Module):
    """A way to write a point with d numbers, for points of n = 2 (planar) or 3 coordinates.

    A landmark of your own is one class with these functions; `jaxslam.check_landmark` checks that
    they agree. Two of one class with equal fields are equal, in every process.
    """

    name: ClassVar[str]
    """The name by which `LANDMARKS` and the commands know it."""
    parameters: ClassVar[str] = ""
    """What the numbers are, as the literature writes them, for a point of three coordinates."""
    point: ClassVar[str] = ""
    """The Euclidean point as a formula of the parameters."""
    source: ClassVar[str] = ""
    """The publication."""
    anchored: ClassVar[bool] = False
    """Whether the parameters are in the frame of the camera that saw the point first, an *anchor*
    that the state holds once for all landmarks of that camera. The last parameter is then a
    constant, the anchor's number, and `transform` is not used."""
    converts: ClassVar[bool] = False
    """Whether `convert` may write the point in another form."""

    @abstractmethod
    def size(self, n: int) -> int:
        """The number d of parameters of a point of n coordinates."""

    @abstractmethod
    def initialise(self, point: Point, omega: Scalar, focal: Scalar) -> Parameters:
        """The parameters, in the camera frame, of the point X/ω; a camera gives X = (x/z, y/z, 1)
        and ω = 1/z. `focal` is in pixels."""

    @abstractmethod
    def transform(self, T_ab: Pose, landmark: Parameters) -> Parameters:
        """The same point in frame a, from its parameters in frame b."""

    @abstractmethod
    def homogeneous(self, landmark: Parameters) -> Homogeneous:
        """`(X, ω)` such that the point is X/ω; ω may be 0 (a point at infinity) or negative."""

    @abstractmethod
    def scale(self, factor: Number, landmark: Parameters) -> Parameters:
        """The point enlarged, s X/ω; numbers that do not tell the point are kept."""

    def convert(
        self, camera: Point, landmark: Parameters, covariance: ParametersCovariance
    ) -> Parameters:
        """The same point in another form where the camera, at C in the landmark's frame, and the
        covariance recommend it; where it `converts`."""
        del camera, covariance
        return landmark
