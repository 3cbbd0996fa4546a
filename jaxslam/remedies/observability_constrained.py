"""Observability-constrained EKF (Huang, Mourikis, Roumeliotis, IJRR 2010; Hesch et al., IJRR 2014).

The published filters change the Jacobians so that the linearised system cannot see more than the
true one, `H* N_{k|k-1} = 0` and `Φ* N_{k|k-1} = N_{k+1|k}`. Here N is taken at the latest
estimates, landmarks included, so that H needs no change, and `Φ* = Φ M` (`transport`); M changes
the columns of pose and velocity alone. It serves both frames, and the scale of a monocular filter.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jaxtyping import Array, Float

from jaxslam.forms.covariance import Covariance
from jaxslam.forms.state import State
from jaxslam.geometry import tangent_dim
from jaxslam.remedies.gauge import check_gauge, unobservable_directions
from jaxslam.remedies.transport import carried, check_plain, read_from
from jaxslam.slam.model import SlamModel


class ObservabilityConstrained(Covariance):
    """The covariance carried along the gauge after every update."""

    def check(self, slam: Any) -> None:
        """Raise ValueError where there is nothing to constrain, or N is not known."""
        check_plain(slam, "oc")
        check_gauge(slam.model)

    def update(self, model, state, features, noise, context, considered=slice(0, 0)):
        after, innovation = super().update(model, state, features, noise, context, considered)
        return follow(model, state, after), innovation


def follow(model: SlamModel, before: State, after: State) -> State:
    """`after` an update, with its covariance carried from N(before) to N(after)."""
    return replace(after, covariance=carried(after.covariance, *transport(model, before, after)))


def transport(
    model: SlamModel, before: State, after: State
) -> tuple[Float[Array, "n g"], Float[Array, "g n"]]:
    """`N(x⁺) − N(x)` and L: the frame is read from the pose, the scale from the velocity.

    Least squares over the whole error, landmarks included, would be an L as well. It is measurably
    worse: what is read should be what is known best. Of a camera at rest the scale is not read.
    """
    N, N_after = (unobservable_directions(model, state) for state in (before, after))
    return N_after - N, read_from(N, tangent_dim((before.core.pose, before.core.motion)))
