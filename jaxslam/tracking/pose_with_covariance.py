"""A camera's pose with its covariance, and what is known relative to it, in the world.

`T_wc` takes the camera's coordinates to the world's. The true pose is `T_wc Exp(e)`, e ~ N(0, P):
position in the camera's axes, then rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxslam.evaluation.convention import lever

Transform = Float[np.ndarray, "4 4"]
"""A pose as a matrix."""
Transforms = Float[np.ndarray, "n 4 4"]
"""Poses as matrices."""
Pixels = Float[np.ndarray, "k 2"]
"""Pixels (u, v) of k landmarks."""
Places = Float[np.ndarray, "n 2"]
"""Pixels (u, v) of n points."""
Positions = Float[np.ndarray, "n 3"]
"""n points."""
Depths = tuple[np.ndarray, np.ndarray]
"""Means and σ of 1/z of n points, (n, 1)."""
Spreads = Float[np.ndarray, "n 3 3"]
"""Their covariances."""


@dataclass(frozen=True)
class PoseWithCovariance:
    """A pose and the covariance P of its error; by default the origin, known exactly."""

    T_wc: Transform = field(default_factory=lambda: np.eye(4))
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def sigma_position(self) -> float:
        """Root of the summed variances along the three axes, map units."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_orientation(self) -> float:
        """Root of the summed variances about the three axes, rad."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def position_covariance(self) -> Float[np.ndarray, "3 3"]:
        """The covariance of the position, in the world's axes."""
        R = self.T_wc[:3, :3]
        return R @ self.covariance[:3, :3] @ R.T

    def then(self, step: PoseWithCovariance) -> PoseWithCovariance:
        """The pose `T_wc T_step`, of a camera that is located relative to this one.

        `T Exp(e) T_s Exp(s) = T T_s Exp(A e) Exp(s)` with `A = Ad(T_s⁻¹)`, so that the covariance
        is `A P Aᵀ + P_s`, to first order, of errors that are independent.
        """
        P = carried(self.covariance, np.linalg.inv(step.T_wc))
        covariance = (P + P.T) / 2 + step.covariance
        return PoseWithCovariance(self.T_wc @ step.T_wc, covariance)

    def scaled(self, scale: float) -> PoseWithCovariance:
        """Return the pose in a unit of length that is 1/scale as long."""
        T_wc, lengths = self.T_wc.copy(), np.array([scale] * 3 + [1.0] * 3)
        T_wc[:3, 3] *= scale
        return PoseWithCovariance(T_wc, lengths[:, None] * self.covariance * lengths)

    def points(self, points: Positions, covariances: Spreads) -> tuple[Positions, Spreads]:
        """Points seen from here, with their covariances, in the world.

        `R ((I + [θ]×) p + δ) + t`, so that to `p`'s covariance comes `J P Jᵀ`, `J = [I, −[p]×]`.
        """
        R, t = self.T_wc[:3, :3], self.T_wc[:3, 3]
        with np.errstate(invalid="ignore", over="ignore"):  # a point at infinity stays there
            J = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), lever(points)], axis=2)
            total = covariances + J @ self.covariance @ np.swapaxes(J, 1, 2)
            return points @ R.T + t, R @ total @ R.T


def adjoint(T: Transform) -> Float[np.ndarray, "6 6"]:
    """`Ad(T)`, with `T Exp(e) = Exp(Ad(T) e) T`: `[[R, [t]× R], [0, R]]`, position first."""
    R = T[:3, :3]
    return np.block([[R, -lever(T[:3, 3]) @ R], [np.zeros((3, 3)), R]])


def carried(P: Float[np.ndarray, "6 6"], T: Transform) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of a camera from which the one of this covariance is at T."""
    A = adjoint(T)
    return A @ P @ A.T


def positive(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the nearest symmetric matrix that has no negative eigenvalue."""
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    return P if values[0] >= 0 else (vectors * np.maximum(values, 0)) @ vectors.T
