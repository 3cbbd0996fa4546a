"""The decoupled right-invariant EKF (Yang, Chen, Lee, Huang: Decoupled Right Invariant Error States
for Consistent Visual-Inertial Navigation, RA-L 2022; the DRI-EKF of Song et al., arXiv:2412.10809).

The error of the pose is that of its group, and landmarks have their own, by addition:

    pose ← Exp(ξ) pose,    landmark ← landmark + δ_l.

H has the pose at the prediction and landmarks at their first estimates, so that N is constant. In
the coordinates of every other filter here, which add a correction to the position, that is the
covariance of first estimates; what differs is how a correction is applied to the pose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import jax.numpy as jnp

from jaxslam.filters.linear.blocks import minus
from jaxslam.filters.remedies.first_estimates import AbstractFirstEstimates
from jaxslam.filters.remedies.invariant import rigid_directions
from jaxslam.geometry import exp


class DecoupledInvariant(AbstractFirstEstimates):
    """First estimates, with a correction of the pose that is read as a ξ."""

    name: ClassVar[str] = "decoupled"

    def corrected(self, model, before, after):
        _, L = rigid_directions(model, before)
        delta = minus(after, before)
        moved = exp(model.geometry.group, L @ delta)
        pose = model.frame.acted(before.core.pose, moved, jnp.ones((), delta.dtype))
        return replace(after.core, pose=pose)
