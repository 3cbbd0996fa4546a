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

from jaxslam.filters import ekf
from jaxslam.filters.gauge import check_gauge, unobservable_directions
from jaxslam.filters.slam import SlamFilter, SlamModel
from jaxslam.filters.state import Features, Innovation, State
from jaxslam.filters.transport import CovarianceForm, carried, check_plain, read_from
from jaxslam.geometry import tangent_dim


def update(
    model: SlamModel,
    state: State,
    features: Features,
    noise: Float[Array, "*m p p"],
    context: Any,
    considered: slice = slice(0, 0),
) -> tuple[State, Innovation]:
    """That of `ekf`, then the transport to the corrected estimate."""
    after, innovation = ekf.update(model, state, features, noise, context, considered)
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
    return N_after - N, read_from(N, tangent_dim((before.core.pose, before.core.velocity)))


OBSERVABILITY_CONSTRAINED = CovarianceForm(update=update)


def with_observability_constraint(slam_filter: SlamFilter, number: int | None = None) -> SlamFilter:
    """`+oc`. Raises ValueError where there is nothing to constrain, or N is not known."""
    if number is not None:
        raise ValueError(f"modifier oc takes no number, not {number}")
    check_plain(slam_filter, "oc")
    check_gauge(slam_filter.model)
    return replace(slam_filter, engine=OBSERVABILITY_CONSTRAINED)
