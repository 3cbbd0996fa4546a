"""The state from which a filter goes on: the Gaussian of one mode at the newest frame.

It stands at the mean of the scale (`jaxslam.filters.window.scale`), in the gauge in which λ is
uncorrelated with everything that does not scale.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.linear.blocks import plus
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import Core
from jaxslam.filters.window.minimise import Minimum
from jaxslam.filters.window.problem import PathLayout, Reduced, located
from jaxslam.filters.window.record import Record
from jaxslam.filters.window.scale import Direction, scaling
from jaxslam.geometry import identity, jacobian, scaled
from jaxslam.linalg import Cholesky, cholesky


def gauge_state(
    slam: AbstractSlam, record: Record, at: Minimum, local: Reduced, like: State
) -> State:
    """The filter's state of one mode where its mean is, in a unit that is a metre there."""
    s, factor = scaling(slam, record, at), cholesky(local.information)
    # The rest moves to where it is likeliest at this scale.
    step = factor.solve(local.gradient)
    step = step - s.x * (s.x @ local.gradient) / s.squared
    return _state(slam, record, at, step, local, s, factor, like)


def _state(slam, record, at, step, local, s: Direction, factor: Cholesky, like: State) -> State:
    """The Gaussian of x, and of what is left of every y given x, as one of the filter's numbers;
    x moves back by a step."""
    newest, by_x = _newest(slam, record, at, local)
    scale = _scale(slam, local, s)
    core, of_core = _core_rows(slam, newest, by_x, scale, like.core)
    values, of_landmarks, own = _landmark_rows(slam, record, at, local, (newest, by_x), scale)
    active = jnp.any(record.seen, axis=0)
    rows = _stacked(of_core, of_landmarks, active)
    own = jnp.where(active[:, None, None], own, 0.0)
    landmarks = jnp.where(active[:, None], values, like.landmarks)
    covariance = _with_metre(_covariance(local, factor, rows, own, scale), like)
    return plus(State(core, landmarks, active, covariance), -rows.x @ step)


class Rows(NamedTuple):
    """Jacobians of the filter's numbers, by x and by λ: λ depends on what is left of every y given
    x, and so do a landmark's numbers on its own."""

    x: Float[Array, "*n N"]
    unit: Float[Array, "*n"]


def _scale(slam: AbstractSlam, local: Reduced, s: Direction) -> Direction:
    """The derivative of λ by x and by e, what is left of every y; zero in a filter without.

    `y = ŷ − C (x − x̂) + e`.
    """
    squared = s.squared if slam.scale.free else jnp.inf
    by_x = s.x - jnp.einsum("mq,mqn->n", s.y, local.coupling)
    return Direction(by_x / squared, s.y / squared)


def _newest(slam, record, at: Minimum, local: Reduced):
    """(frame, motion's variables, common error) at the newest frame, and their Jacobian by x."""
    layout, k = PathLayout.of(slam), record.last
    frame = jax.tree.map(lambda leaf: leaf[k], local.path.frames)
    eye = jnp.eye(at.x.size, dtype=at.x.dtype)
    common = eye[layout.start : layout.start + layout.common]
    by_x = jnp.concatenate([local.by_x.frame[k], local.by_x.motion[k], common])
    return (frame, local.path.motion[k], local.path.common), by_x


def _core_rows(slam, newest, by_x, scale: Direction, like) -> tuple[Core, Rows]:
    """The filter's core and its Jacobians."""
    zero = jnp.zeros(1, by_x.dtype)
    J = jacobian(lambda both: _core(slam, like, *both), (newest, zero))
    by_newest, unit = J[:, :-1], J[:, -1]
    rows = by_newest @ by_x + jnp.outer(unit, scale.x)
    return _core(slam, like, newest, zero), Rows(rows, unit)


def _with_metre(covariance: Float[Array, "n n"], like: State) -> Float[Array, "n n"]:
    """The covariance with that of the metre, behind λ, as it was: nothing observes it."""
    part = like.core.part("log_scale")
    metre = slice(part.start + 1, part.stop)
    return covariance.at[metre, metre].set(like.covariance[metre, metre])


def _landmark_rows(
    slam, record, at: Minimum, local: Reduced, newest, scale: Direction
) -> tuple[Float[Array, "m d"], Rows, Float[Array, "m d q"]]:
    """All landmarks and their Jacobians, the last by its own y each."""
    (newest, by_x), zero = newest, jnp.zeros(1, at.x.dtype)
    firsts = jax.tree.map(lambda leaf: leaf[record.first], local.path.frames)
    of_firsts = local.by_x.frame[record.first]

    def one(first, of_first, measured, y, coupling):
        def of(everything):
            newest, first, y, log_scale = everything
            return _landmark(slam, newest, first, y, *measured, log_scale)

        everything = newest, first, y, zero
        J = jacobian(of, everything)
        ends = [len(by_x), len(by_x) + len(of_first), J.shape[1] - 1]
        by_newest, by_first, by_y, unit = jnp.split(J, ends, axis=1)
        rows = by_newest @ by_x + by_first @ of_first - by_y @ coupling
        return of(everything), rows + unit * scale.x, by_y, unit[:, 0]

    values, rows, by_own, units = jax.vmap(one)(
        firsts, of_firsts, record.begun_by, at.y, local.coupling
    )
    return values, Rows(rows, units), by_own


def _stacked(core: Rows, landmarks: Rows, active: Bool[Array, " m"]) -> Rows:
    """The rows of the whole state; zero where no landmark is."""

    def whole(of_core, of_each):
        kept = jnp.where(active.reshape(-1, *(1,) * (of_each.ndim - 1)), of_each, 0.0)
        return jnp.concatenate([of_core, kept.reshape(-1, *of_each.shape[2:])])

    return Rows(*map(whole, core, landmarks))


def _covariance(
    local: Reduced, factor: Cholesky, rows: Rows, own: Float[Array, "m d q"], scale: Direction
) -> Float[Array, "n n"]:
    """The covariance of numbers with these Jacobians. With B of their own y and u of λ, whose
    derivative by y is s: `(B + u sᵀ) Λ⁻¹ (B + u sᵀ)ᵀ`, B and Λ in blocks."""
    whitened = factor.whitening @ rows.x.T
    B = jnp.einsum("mqo,mdo->mdq", local.landmarks.whitening, own)
    s = jnp.einsum("mqo,mo->mq", local.landmarks.whitening, scale.y)
    m, d, _ = own.shape
    c, u = len(rows.unit) - m * d, rows.unit
    across = jnp.pad(jnp.einsum("mdq,mq->md", B, s).ravel(), (c, 0)) + u * jnp.sum(s**2) / 2
    covariance = whitened.T @ whitened + jnp.outer(u, across) + jnp.outer(across, u)
    place = c + jnp.arange(m * d).reshape(m, d)
    blocks = jnp.einsum("mdq,meq->mde", B, B)
    return covariance.at[place[:, :, None], place[:, None]].add(blocks)


def _core(slam: AbstractSlam, like, newest, log_scale):
    """The filter's core, with lengths in units of e^λ m."""
    frame, variables, common = newest
    unit = jnp.exp(-log_scale[0])
    variables, _ = slam.motion.enlarged(variables, jnp.asarray(slam.motion.noise_sigma), unit)
    kept = not slam.calibration.each_frame
    return replace(
        like,
        pose=slam.frame.from_base_pose(scaled(frame.pose, unit)),
        motion=variables,
        log_scale=None if like.log_scale is None else like.log_scale.at[:1].set(log_scale),
        calibration=frame.calibration[: like.calibration.size] if kept else like.calibration,
        # The filter keeps c in σ of one landmark's prior.
        depth_error=None if like.depth_error is None else slam.depth.common * common,
        base_motion=None if like.base_motion is None else variables,
    )


def _landmark(slam: AbstractSlam, newest, first, y, measured, noise_factor, log_scale):
    """The landmark in the map frame of the newest camera, in units of e^λ m."""
    frame, _, common = newest
    seen, omega = located(slam, first.calibration, common, measured, noise_factor, y)
    unit = jnp.exp(-log_scale[0])
    held = slam.frame.from_base_pose(scaled(frame.pose, unit))
    T_AC = slam.frame.map_from_camera(held, identity(slam.motion.geometry, y.dtype))
    T_CF = frame.pose.inverse() @ first.pose
    landmark = slam.landmark.initialise(seen, omega / unit, jnp.asarray(slam.sensor.focal))
    return slam.landmark.transform(T_AC @ scaled(T_CF, unit), landmark)
