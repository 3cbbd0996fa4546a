"""What a filter goes on from: the Gaussian of one mode at the window's newest frame.

**Scale.** No measurement changes with λ in `(t, v, a, ω) → (e^λ t, e^λ v, e^λ a, e^−λ ω)`: with s
the derivative of all whitened unknowns u by λ, the information A = I + JᵀJ has A s = s. So
`λ = sᵀ(u − û)/|s|²` has the variance 1/|s|² and is uncorrelated with everything that does not
scale: that is the gauge in which the filter goes on.

**The mean is not the maximum.** Along λ the density has the volume of all the rest, det A(λ)^−½,
and `½ d log det A/dλ = Σ_ω (1 − var) − Σ_a (1 − var)`: every inverse depth that the pixels tell
draws the mean to smaller scales, every acceleration to larger ones. The Gaussian stands where that
balances.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.forms.state import State
from jaxslam.geometry import identity, jacobian, scaled
from jaxslam.linalg import Cholesky, cholesky
from jaxslam.models.scale import ScaleGauge
from jaxslam.slam.filter import EkfSlam
from jaxslam.window.minimise import LANDMARK_STEPS, Minimum, landmarks
from jaxslam.window.problem import (
    Layout,
    Reduced,
    located,
    path,
    reduced,
)
from jaxslam.window.record import Record

MOST_SHIFT = 0.5
"""Of λ, from the maximum to the mean."""


class Direction(NamedTuple):
    """A derivative of the whitened unknowns."""

    x: Float[Array, " N"]
    y: Float[Array, "m q"]

    @property
    def squared(self) -> Float[Array, ""]:
        return jnp.sum(self.x**2) + jnp.sum(self.y**2)


def rescaled(
    slam: EkfSlam, record: Record, at: Minimum, log_scale: Float[Array, ""]
) -> tuple[Float[Array, " N"], Float[Array, "m q"]]:
    """The unknowns with all lengths e^λ times as large: the same pixels."""
    layout, motion = Layout.of(slam), slam.motion
    factor = jnp.exp(log_scale)
    mean, root = motion.start()
    steps = at.x[layout.whole :].reshape(record.frames - 1, -1)
    own = motion.noise_sigma.shape[-1]
    variables = mean + root @ at.x[: layout.start]
    larger, _ = motion.enlarged(variables, steps[0, :own], factor)
    start = root.T @ cholesky(root @ root.T).solve(larger - mean)
    noises = jax.vmap(lambda noise: motion.enlarged(variables, noise, factor)[1])(steps[:, :own])
    x = at.x.at[: layout.start].set(start)
    x = x.at[layout.whole :].set(steps.at[:, :own].set(noises).ravel())
    return x, _nearer(slam, record, at, factor)


def _nearer(slam, record, at: Minimum, factor) -> Float[Array, "m q"]:
    """Inverse depths divided by a factor, in their own part; the common error stays."""
    depth, layout = slam.depth, Layout.of(slam)
    common = at.x[layout.start : layout.start + layout.common]
    share = 0.0 if depth.common is None else jnp.sum(common) * depth.common
    p = slam.sensor.size
    hidden = depth.mean + depth.sigma * (depth.own * at.y[:, p:] + share)
    own = ((hidden / factor - depth.mean) / depth.sigma - share) / depth.own
    begun = jnp.any(record.seen, axis=0)
    return at.y.at[:, p:].set(jnp.where(begun[:, None], own, at.y[:, p:]))


def scaling(slam: EkfSlam, record: Record, at: Minimum) -> Direction:
    """s, the shortest of those that differ by what common and own errors of depth share."""
    zero = jnp.zeros((), at.x.dtype)
    _, (x, y) = jax.jvp(lambda l: rescaled(slam, record, at, l), (zero,), (zero + 1,))
    layout, depth = Layout.of(slam), slam.depth
    if depth.common is None:
        return Direction(x, y)
    begun, p = jnp.any(record.seen, axis=0), slam.sensor.size
    ratio = jnp.where(begun[:, None], depth.common / depth.own, 0.0)
    shared = jnp.sum(ratio * y[:, p:]) / (1 + jnp.sum(ratio**2))
    y = y.at[:, p:].add(-ratio * shared)
    return Direction(x.at[layout.start].add(shared), y)


def variances(local: Reduced, whitening: Float[Array, "N N"]) -> tuple[Array, Array]:
    """Diagonals of A⁻¹: of x, and of y."""
    by_x = jnp.sum(whitening**2, axis=0)
    spread = jnp.einsum("mqn,on->mqo", local.coupling, whitening)
    own = jax.vmap(lambda factor: jnp.sum(factor.whitening**2, axis=0))(local.landmarks)
    return by_x, own + jnp.sum(spread**2, axis=2)


def shift_of_scale(slam: EkfSlam, local: Reduced, s: Direction, factor: Cholesky):
    """λ of the mean, of a density that has its maximum at 0."""
    of_x, of_y = variances(local, factor.whitening)
    told = jnp.where(s.x != 0, 1 - of_x, 0.0)
    p = slam.sensor.size
    slope = jnp.sum(told) - jnp.sum(jnp.where(s.y[:, p:] != 0, 1 - of_y[:, p:], 0.0))
    return jnp.clip(slope / s.squared, -MOST_SHIFT, MOST_SHIFT)


def gauge_state(slam: EkfSlam, record: Record, mode: Minimum, like: State) -> State:
    """The filter's state of one mode, in a unit that is a metre at the mean."""
    local = reduced(slam, record, mode.x, mode.y)
    s = scaling(slam, record, mode)
    shift = shift_of_scale(slam, local, s, cholesky(local.information))
    x, y = rescaled(slam, record, mode, shift)
    y, _ = landmarks(slam, record, path(slam, record, x), y, LANDMARK_STEPS)
    at = replace(mode, x=x, y=y)
    local, s = reduced(slam, record, x, y), scaling(slam, record, at)
    factor = cholesky(local.information)
    # The rest moves to where it is likeliest at this scale.
    step = factor.solve(local.gradient)
    step = step - s.x * (s.x @ local.gradient) / s.squared
    return _state(slam, record, at, step, local, s, factor, like)


def _state(slam, record, at, step, local, s: Direction, factor: Cholesky, like: State) -> State:
    layout, k = Layout.of(slam), record.last
    parts, by_x = _parts(slam, record, at, local, layout)
    # λ, by x and by what is left of every y: y = ŷ − C (x − x̂) + e.
    scale_by_x = (s.x - jnp.einsum("mq,mqn->n", s.y, local.coupling)) / s.squared
    scale_by_y = s.y / s.squared
    is_gauge = isinstance(slam.scale, ScaleGauge)
    zero = jnp.zeros(1, at.x.dtype)

    def core_of(parts, log_scale):
        return _core(slam, like.core, parts, log_scale)

    def landmark_of(parts, first, y, measured, log_scale):
        return _landmark(slam, parts, first, y, measured, log_scale)

    core = core_of(parts, zero)
    G = jacobian(lambda both: core_of(*both), (parts, zero))
    by_parts, by_scale = G[:, :-1], G[:, -1]
    unit = by_scale if is_gauge else jnp.zeros_like(by_scale)
    core_by_x = by_parts @ by_x + jnp.outer(unit, scale_by_x)
    core_by_y = jnp.einsum("c,mq->cmq", unit, scale_by_y)

    firsts = jax.tree.map(lambda leaf: leaf[record.first], local.path.frames)
    begun = record.measured[record.first, jnp.arange(record.first.size)]
    S_first = local.by_x.frame[record.first]

    def one(first, y, measured, S_first, C):
        def of(everything):
            parts, first, y, log_scale = everything
            return landmark_of(parts, first, y, measured, log_scale)

        everything = parts, first, y, zero
        value = of(everything)
        J = jacobian(of, everything)
        ends = [by_x.shape[0], by_x.shape[0] + S_first.shape[0], J.shape[1] - 1]
        by_parts, by_first, by_y, by_scale = jnp.split(J, ends, axis=1)
        unit = by_scale[:, 0] if is_gauge else jnp.zeros_like(by_scale[:, 0])
        rows = by_parts @ by_x + by_first @ S_first - by_y @ C + jnp.outer(unit, scale_by_x)
        return value, rows, by_y, unit

    values, rows, by_own, units = jax.vmap(one)(firsts, at.y, begun, S_first, local.coupling)
    m, d = values.shape
    active = jnp.any(record.seen, axis=0)
    by_own = jnp.einsum("idq,ij->idjq", by_own, jnp.eye(m, dtype=at.x.dtype))
    by_others = by_own + jnp.einsum("id,jq->idjq", units, scale_by_y)
    whole_by_x = jnp.concatenate([core_by_x, jnp.where(active[:, None, None], rows, 0.0).reshape(m * d, -1)])
    by_others = jnp.where(active[:, None, None, None], by_others, 0.0).reshape(m * d, m, -1)
    whole_by_y = jnp.concatenate([core_by_y, by_others])
    V = factor.whitening @ whole_by_x.T
    U = jnp.einsum("mqo,nmo->mqn", local.landmarks.whitening, whole_by_y).reshape(-1, V.shape[1])
    covariance = V.T @ V + U.T @ U
    from jaxslam.forms.blocks import shifted

    moved = -whole_by_x @ step
    state = State(core, jnp.where(active[:, None], values, like.landmarks), active, covariance, like.memory)
    return shifted(state, moved)


def _parts(slam, record, at, local: Reduced, layout: Layout):
    """(frame, motion's variables, common error) at the newest frame, and their Jacobian by x."""
    k = record.last
    frame = jax.tree.map(lambda leaf: leaf[k], local.path.frames)
    shared = slice(layout.start, layout.start + layout.common)
    eye = jnp.eye(at.x.size, dtype=at.x.dtype)
    by_x = jnp.concatenate([local.by_x.frame[k], local.by_x.motion[k], eye[shared]])
    return (frame, local.path.motion[k], local.path.common), by_x


def _core(slam: EkfSlam, like, parts, log_scale):
    """The filter's core, with lengths in units of e^λ m."""
    frame, variables, common = parts
    unit = jnp.exp(-log_scale[0])
    variables, _ = slam.motion.enlarged(variables, like.noise, unit)
    kept = not slam.calibration.each_frame
    return replace(
        like,
        pose=slam.coordinates.hold(scaled(frame.pose, unit)),
        motion=variables,
        log_scale=None if like.log_scale is None else log_scale,
        calibration=frame.calibration if kept else like.calibration,
        depth_error=None if like.depth_error is None else _common_error(slam, common),
    )


def _common_error(slam, common):
    """The filter keeps c in σ of one landmark's prior."""
    return slam.depth.common * common


def _landmark(slam: EkfSlam, parts, first, y, measured, log_scale):
    """The landmark in the map frame of the newest camera, in units of e^λ m."""
    frame, _, common = parts
    seen, omega = located(slam, first.calibration, common, measured, y)
    unit = jnp.exp(-log_scale[0])
    held = slam.coordinates.hold(scaled(frame.pose, unit))
    T_AC = slam.coordinates.map_from_camera(held, identity(slam.motion.geometry, y.dtype))
    T_CF = frame.pose.inverse() @ first.pose
    landmark = slam.landmark.initialise(seen, omega / unit, jnp.asarray(slam.sensor.focal))
    return slam.landmark.transform(T_AC @ scaled(T_CF, unit), landmark)
