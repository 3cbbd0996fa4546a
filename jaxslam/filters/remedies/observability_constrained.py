"""Observability-constrained EKF (Huang, Mourikis, Roumeliotis, IJRR 2010; Hesch et al., IJRR 2014).

The published filters change the Jacobians so that the linearised system cannot see more than the
true one, `H* N_{k|k-1} = 0` and `Φ* N_{k|k-1} = N_{k+1|k}`. Here N is taken at the latest
estimates, landmarks included, so that H needs no change, and `Φ* = Φ M` (`transport`). It serves
both frames, and the scale of a monocular filter, in metres or in a unit of its own.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxslam.filters.linear.kalman import AbstractCorrection, checked_steps, gauss_newton
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import SlamModel
from jaxslam.filters.remedies.gauge import scale_is_free, unobservable_directions
from jaxslam.filters.remedies.transport import carried, read_from, read_scale_too
from jaxslam.geometry import tangent_dim


class ObservabilityConstrained(AbstractCorrection):
    """The covariance carried along the gauge after every update, and between the steps of one."""

    name: ClassVar[str] = "oc"
    knows_gauge: ClassVar[bool] = True

    steps: int = eqx.field(static=True, default=1, converter=checked_steps)
    """Steps of Gauss–Newton in an update: an EKF has one. Where a second goes far from the first,
    as it does for a large acceleration, the first would be wrong, and carried on."""

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        data = features, noise, context, considered
        return gauss_newton(model, state, self.steps, partial(follow, model), *data)


def follow(model: SlamModel, before: State, after: State) -> State:
    """`after` an update, with its covariance carried from N(before) to N(after)."""
    return replace(after, covariance=carried(after.covariance, *transport(model, before, after)))


def transport(
    model: SlamModel, before: State, after: State
) -> tuple[Float[Array, "n g"], Float[Array, "g n"]]:
    """`N(x⁺) − N(x)` and L: the frame is read from the pose, the scale from velocity or landmarks.

    Least squares over the whole error for the frame too, landmarks included, is measurably worse:
    what is read should be what is known best.
    """
    N, N_after = (unobservable_directions(model, state) for state in (before, after))
    pose, frame = tangent_dim(before.core.pose), model.geometry.tangent_dim
    L = read_from(N[:, :frame], pose)
    if scale_is_free(model):
        velocity = slice(pose, pose + model.geometry.point_dim)
        landmarks = slice(before.core_dim, before.covariance.shape[0])
        L = read_scale_too(N, L, before.covariance, velocity, landmarks)
    return N_after - N, L
