"""All frames of a window at once: unknowns, residuals, and the least squares of them.

Everything random since frame 0 is written as standard normal numbers, x and y. What all landmarks
have in common is x: the motion's start, the common error of the depths, the calibration, and the
noise of every step. Each landmark's own is y: its true first measurement, and what that hides. With
the measurements z, `−log p(x, y | z) = ½ (|x|² + |y|² + |r(x, y)|²)` up to a constant.

A landmark depends on x and on its own y alone: given x the landmarks are eliminated one by one
(Schur), so that a step costs what the path costs.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.window.record import Record
from jaxslam.geometry import Pose, Scalar, homogeneous_apply, identity, jacobian, nudge, retract
from jaxslam.linalg import Cholesky, cholesky
from jaxslam.models.motion import Control

X = Float[Array, " N"]
"""x, of what all landmarks have in common."""
Y = Float[Array, "m q"]
"""y, of each landmark."""


class CalibratedPose(eqx.Module):
    """The dependences of a measurement beside the landmark; of one frame, or of all."""

    pose: Pose
    """T_BC, B the camera of frame 0."""
    calibration: Float[Array, "*F k"]
    """δ, and behind it the velocity, as in `CameraInMap`."""


class Path(eqx.Module):
    """The quantities that x stands for."""

    frames: CalibratedPose
    motion: Float[Array, "F v"]
    """The motion's variables after every step."""
    common: Float[Array, " c"]
    """The error that all depths have in common; empty where there is none."""


class PathLayout(NamedTuple):
    """The layout of x: the count of numbers for each quantity."""

    start: int
    common: int
    calibration: int
    """Drawn once."""
    step: int
    """The motion's noise in every step."""
    each: int
    """Calibration drawn in every frame."""

    @staticmethod
    def of(slam: AbstractSlam) -> PathLayout:
        _, root = slam.motion.start()
        own = slam.calibration.sigma.size
        each = own if slam.calibration.each_frame else 0
        common = 0 if slam.depth.common is None else 1
        # What depths have in common stays within a window.
        step = slam.motion.noise_sigma.shape[-1] + slam.calibration.drift_sigma.size
        return PathLayout(len(root), common, own - each, step, each)

    @property
    def whole(self) -> int:
        """Numbers that are not of one frame alone, those of frame 0 among them."""
        return self.start + self.common + self.calibration + self.each

    def size(self, frames: int) -> int:
        """N, of so many frames."""
        return self.whole + (frames - 1) * (self.step + self.each)


def path(slam: AbstractSlam, record: Record, x: X) -> Path:
    """Poses, velocities and calibrations of all frames. After the last, nothing moves."""
    layout, motion = PathLayout.of(slam), slam.motion
    mean, root = motion.start()
    ends = [layout.start, layout.start + layout.common, layout.whole - layout.each, layout.whole]
    start, common, once, first, steps = jnp.split(x, ends)
    steps = steps.reshape(record.frames - 1, layout.step + layout.each)
    drawn = jnp.asarray(slam.calibration.sigma)
    begin, in_motion = retract(mean, root @ start), slam.model.in_motion

    def move(state, data):
        k, *step = data
        there = _moved(slam, state, *step)
        there = jax.tree.map(lambda new, old: jnp.where(k < record.last, new, old), there, state)
        return there, there

    origin = identity(motion.geometry, x.dtype)
    begun = origin, begin, in_motion(drawn * (first if layout.each else once), begin)
    data = (jnp.arange(record.frames - 1), *_driven_by(record), steps)
    _, later = jax.lax.scan(move, begun, data)
    poses, variables, deltas = jax.tree.map(
        lambda one, more: jnp.concatenate([one[None], more]), begun, later
    )
    return Path(CalibratedPose(poses, deltas), variables, common)


def _driven_by(record: Record) -> tuple[Control, Float[Array, " steps"], Bool[Array, " steps"]]:
    """The known quantities of every step: the arguments of `_moved` before the last."""
    return record.controls, record.merged, record.restarted


def _moved(slam: AbstractSlam, state, control, merged: Scalar, restarted: Bool[Array, ""], numbers):
    """Pose, motion's variables and calibration one step on.

    The mean of m white accelerations has σ/√m, the sum of m drifts √m σ. A velocity that is drawn
    anew has the numbers of an acceleration, and no acceleration.
    """
    (pose, variables, delta), layout, motion = state, PathLayout.of(slam), slam.motion
    own = motion.noise_sigma.shape[-1]
    noise, drift = jnp.split(slam.model.noise_sigma[: layout.step] * numbers[: layout.step], [own])
    noise, drift = noise / jnp.sqrt(merged), drift * jnp.sqrt(merged)
    mean, root = motion.start()
    anew = retract(mean, root @ numbers[: layout.start])
    variables = jax.tree.map(lambda new, old: jnp.where(restarted, new, old), anew, variables)
    noise = jnp.where(restarted, 0.0, noise)
    step, variables = slam.model.moved(variables, noise, control)
    delta = slam.calibration.next(delta[: slam.calibration.sigma.size], drift)
    if layout.each:
        delta = jnp.asarray(slam.calibration.sigma) * numbers[layout.step :]
    return pose @ step, variables, slam.model.in_motion(delta, variables)


def located(
    slam: AbstractSlam,
    calibration: Float[Array, " k"],
    common: Float[Array, " c"],
    measured: Float[Array, " p"],
    noise_factor: Scalar,
    y: Float[Array, " q"],
) -> tuple[Float[Array, " n"], Scalar]:
    """The homogeneous point of a landmark, in the camera of the frame that first measured it."""
    sensor, p = slam.model.sensor_at(calibration), measured.size
    pixel = measured + jnp.sqrt(noise_factor) * (cholesky(sensor.noise).root @ y[:p])
    return sensor.locate(pixel, hidden(slam, common, y[p:]))


def hidden(
    slam: AbstractSlam, common: Float[Array, " c"], own: Float[Array, "*m o"]
) -> Float[Array, "*m o"]:
    """`1/z = mean + σ (e_i + common c)`, 1/m: what a measurement hides."""
    depth = slam.depth
    shared = 0.0 if depth.common is None else jnp.sum(common) * depth.common
    return depth.mean + depth.sigma * (own + shared)


class Sight(NamedTuple):
    """The point of a landmark in the camera that first saw it, and its Jacobians.

    Homogeneous points (X, ω) have h = n + 1 numbers.
    """

    point: Float[Array, " n"]
    omega: Scalar
    by_pose: Float[Array, "h t"]
    """The derivative of (X, ω) by the tangent of that camera's pose."""
    by_calibration: Float[Array, "h k"]
    by_common: Float[Array, "h c"]
    by_y: Float[Array, "h q"]


def sights(slam: AbstractSlam, record: Record, at: Path, y: Y) -> Sight:
    """The sights of all landmarks, from the frames in which they were first seen."""
    calibrations = at.frames.calibration[record.first]

    def one(measured, noise_factor, calibration, y):
        def of(calibration, common, y):
            return jnp.append(*located(slam, calibration, common, measured, noise_factor, y))

        arguments = calibration, at.common, y
        there = of(*arguments)
        slopes = jax.jacfwd(of, argnums=(0, 1, 2))(*arguments)
        return Sight(there[:-1], there[-1], _by_motion(slam, there[:-1], there[-1]), *slopes)

    return jax.vmap(one)(*record.begun_by, calibrations, y)


def _by_motion(slam: AbstractSlam, point: Float[Array, " n"], omega: Scalar) -> Array:
    """Jacobian of the homogeneous point (Exp(δ) X, ω) by δ at 0."""
    still = identity(slam.motion.geometry, point.dtype)

    def moved(delta):
        return jnp.append(homogeneous_apply(nudge(still, delta), point, omega), omega)

    return jax.jacfwd(moved)(jnp.zeros(still.tangent_dim, point.dtype))


def _relative(record: Record, at: Path) -> Float[Array, "F m n h"]:
    """(R, t) of every frame in the axes of every landmark's first one: T_CF."""
    firsts = jax.tree.map(lambda x: x[record.first], at.frames.pose)

    def one(pose, first):
        moved = pose.inverse() @ first
        return jnp.column_stack([moved.rotation().as_matrix(), moved.translation()])

    return jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(at.frames.pose, firsts)


class Seen(NamedTuple):
    """Whitened residuals of all measurements that are compared, zero elsewhere; and where a
    measured landmark cannot be seen."""

    residual: Float[Array, "F m p"]
    impossible: Bool[Array, "F m"]
    by_point: Float[Array, "F m p h"]
    """Jacobian by (X, ω) in the camera."""
    by_calibration: Float[Array, "F m p k"]
    points: Float[Array, "F m h"]
    """(X, ω) in the camera."""


def _compared(slam: AbstractSlam, record: Record, at: Path, y: Y) -> tuple[Sight, Seen, Array]:
    """The sights, what is seen of them in every frame, and its Jacobian by (X, ω) in the camera of
    the first sight."""
    sight, relative = sights(slam, record, at, y), _relative(record, at)
    seen = _seen(slam, record, at, relative, sight)
    by_point, by_omega = seen.by_point[..., :-1], seen.by_point[..., -1]
    by_sight = jnp.einsum("kmpn,kmno->kmpo", by_point, relative)
    return sight, seen, by_sight.at[..., -1].add(by_omega)


def _seen(slam: AbstractSlam, record: Record, at: Path, relative, sight: Sight) -> Seen:
    whitening = cholesky(slam.sensor.noise).whitening

    def one(T, calibration, point, omega, measured, noise_factor):
        here = jnp.append(T @ jnp.append(point, omega), omega)

        def wrong(here, calibration):
            sensor = slam.model.sensor_at(calibration)
            predicted = sensor.measure(here[:-1], here[-1])
            return whitening @ sensor.residual(measured, predicted) / jnp.sqrt(noise_factor)

        slopes = jax.jacfwd(wrong, argnums=(0, 1))(here, calibration)
        impossible = ~slam.model.sensor_at(calibration).possible(here[:-1])
        return Seen(wrong(here, calibration), impossible, *slopes, here)

    of_frame = jax.vmap(one, in_axes=(0, None, 0, 0, 0, 0))
    of_all = jax.vmap(of_frame, in_axes=(0, 0, None, None, 0, 0))
    measured = record.measured, record.noise_factor
    found = of_all(relative, at.frames.calibration, sight.point, sight.omega, *measured)
    used = record.compared

    def masked(x):
        return jnp.where(used.reshape(used.shape + (1,) * (x.ndim - 2)), x, 0.0)

    residual, impossible, by_point, by_calibration, points = found
    return Seen(
        masked(residual), impossible & used, masked(by_point), masked(by_calibration), points
    )


def landmark_slopes(
    slam: AbstractSlam, record: Record, at: Path, y: Y
) -> tuple[Float[Array, "m q q"], Y, Float[Array, " m"]]:
    """The information, gradient and |y|² + |r|² of every landmark given the path; the last is ∞
    if it is measured and cannot be seen."""
    sight, seen, by_sight = _compared(slam, record, at, y)
    B = jnp.einsum("kmpo,moq->kmpq", by_sight, sight.by_y)
    information = jnp.einsum("kmpq,kmpo->mqo", B, B) + jnp.eye(y.shape[1], dtype=y.dtype)
    gradient = jnp.einsum("kmpq,kmp->mq", B, seen.residual) + y
    cost = jnp.sum(seen.residual**2, axis=(0, 2)) + jnp.sum(y**2, axis=1)
    possible = ~jnp.any(seen.impossible, axis=0) & jnp.isfinite(cost)
    return information, gradient, jnp.where(possible, cost, jnp.inf)


def residuals(slam: AbstractSlam, record: Record, at: Path, y: Y) -> Float[Array, "F m p"]:
    """`(z − h)/σ` of all measurements that are compared, zero elsewhere."""
    sight = sights(slam, record, at, y)
    return _seen(slam, record, at, _relative(record, at), sight).residual


class Sensitivities(NamedTuple):
    """Jacobians by x: of the frames' tangents, pose and then calibration, and of the motion's
    variables."""

    frame: Float[Array, "F a N"]
    motion: Float[Array, "F v N"]


def sensitivities(slam: AbstractSlam, record: Record, x: X, at: Path) -> Sensitivities:
    """Step by step, by the chain rule."""
    begun, driving = _driven(slam, record, x)
    states = len(begun)

    def move(S, data):
        slope, driving = data
        S = slope[:, :states] @ S + slope[:, states:] @ driving
        return S, S

    _, later = jax.lax.scan(move, begun, (_slopes(slam, record, x, at), driving))
    every = jnp.concatenate([begun[None], later])
    t, v = slam.motion.geometry.tangent_dim, PathLayout.of(slam).start
    frame = jnp.concatenate([every[:, :t], every[:, t + v :]], axis=1)
    return Sensitivities(frame, every[:, t : t + v])


def _driven(
    slam: AbstractSlam, record: Record, x: X
) -> tuple[Float[Array, "s N"], Float[Array, "steps w N"]]:
    """Jacobians by x of (pose, motion, calibration) in frame 0, and of what drives every step."""
    layout, eye = PathLayout.of(slam), jnp.eye(x.size, dtype=x.dtype)
    ends = [layout.start, layout.start + layout.common, layout.whole]
    start, _, drawn, driving = jnp.split(eye, ends)
    _, root = slam.motion.start()
    sigma = jnp.asarray(slam.calibration.sigma)[:, None]
    pose = jnp.zeros((slam.motion.geometry.tangent_dim, x.size), x.dtype)
    moving = [root @ start] if slam.sensor.rolling else []
    begun = jnp.concatenate([pose, root @ start, sigma * drawn, *moving])
    return begun, driving.reshape(record.frames - 1, -1, x.size)


def _slopes(slam: AbstractSlam, record: Record, x: X, at: Path) -> Float[Array, "steps s d"]:
    """Jacobian of every step by the state before it and by what drives it, d = s + w numbers."""
    states = at.frames.pose, at.motion, at.frames.calibration
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    numbers = x[PathLayout.of(slam).whole :].reshape(record.frames - 1, -1)

    def local(state, numbers, *given):
        return jacobian(lambda both: _moved(slam, both[0], *given, both[1]), (state, numbers))

    slopes = jax.vmap(local)(before, numbers, *_driven_by(record))
    happened = (jnp.arange(record.frames - 1) < record.last)[:, None, None]
    return jnp.where(happened, slopes, jnp.eye(*slopes.shape[1:], dtype=x.dtype))


class Linear(NamedTuple):
    """All residuals r, and their Jacobians by what each depends on; zero where none is."""

    residual: Float[Array, "F m p"]
    by_frame: Float[Array, "F m p a"]
    """By the frame's tangent: pose, then calibration."""
    by_first: Float[Array, "F m p a"]
    """By that of the frame in which the landmark was first seen."""
    by_common: Float[Array, "F m p c"]
    by_y: Float[Array, "F m p q"]


def linearised(slam: AbstractSlam, record: Record, at: Path, y: Y) -> Linear:
    """The residuals at a path and landmarks."""
    sight, seen, by_sight = _compared(slam, record, at, y)
    here = jax.vmap(jax.vmap(lambda X: _by_motion(slam, X[:-1], X[-1])))(seen.points)
    # T_C Exp(δ) moves a point by −δ in the camera's axes.
    by_pose = -jnp.einsum("kmpn,kmnt->kmpt", seen.by_point, here)
    of_first = jnp.concatenate([sight.by_pose, sight.by_calibration], -1)
    return Linear(
        seen.residual,
        jnp.concatenate([by_pose, seen.by_calibration], -1),
        jnp.einsum("kmpn,mna->kmpa", by_sight, of_first),
        jnp.einsum("kmpn,mnc->kmpc", by_sight, sight.by_common),
        jnp.einsum("kmpn,mnq->kmpq", by_sight, sight.by_y),
    )


def _in_first(record: Record, each: Float[Array, "m ..."]) -> Float[Array, "F ..."]:
    """The sum of what landmarks add to the frames in which they were first seen."""
    return jnp.einsum("m...,mf->f...", each, _is_first(record, each.dtype))


def _is_first(record: Record, dtype: DTypeLike) -> Float[Array, "m F"]:
    return (record.first[:, None] == jnp.arange(record.frames)).astype(dtype)


def _information(record: Record, J: Linear) -> Float[Array, "z z"]:
    """`JᵀJ`, by the tangents of all frames one after the other (F a numbers), then by the common
    error: z numbers in all, as of the following."""
    A, first, common = J.by_frame, J.by_first, J.by_common
    side = jnp.einsum("kmpa,kmpc->kac", A, common)
    side += _in_first(record, jnp.einsum("kmpa,kmpc->mac", first, common))
    side = side.reshape(record.frames * A.shape[-1], -1)
    corner = jnp.einsum("kmpc,kmpd->cd", common, common)
    return jnp.block([[_between_frames(record, A, first), side], [side.T, corner]])


def _between_frames(
    record: Record, A: Float[Array, "F m p a"], first: Float[Array, "F m p a"]
) -> Float[Array, "n n"]:
    """`JᵀJ` of all frames' tangents, n = F a: a residual ties its frame to the landmark's first."""
    pairs = jnp.einsum("kmpa,kmpb->kmab", A, first)
    crossed = jnp.einsum("kmab,mf->kafb", pairs, _is_first(record, A.dtype))
    own = jnp.einsum("kmpa,kmpb->kab", A, A)
    own += _in_first(record, jnp.einsum("kmpa,kmpb->mab", first, first))
    index = jnp.arange(record.frames)
    both = crossed + jnp.transpose(crossed, (2, 3, 0, 1))
    both = both.at[index, :, index, :].add(own)
    return both.reshape(record.frames * A.shape[-1], -1)


def _gradient(record: Record, J: Linear) -> Float[Array, " z"]:
    """`Jᵀr`."""
    frames = jnp.einsum("kmpa,kmp->ka", J.by_frame, J.residual)
    frames += _in_first(record, jnp.einsum("kmpa,kmp->ma", J.by_first, J.residual))
    return jnp.append(frames.ravel(), jnp.einsum("kmpc,kmp->c", J.by_common, J.residual))


def _with_landmarks(record: Record, J: Linear) -> Float[Array, "z m q"]:
    """`JᵀB`, B the Jacobian by y."""
    own = jnp.einsum("kmpa,kmpq->kamq", J.by_frame, J.by_y)
    first = jnp.einsum("kmpa,kmpq->maq", J.by_first, J.by_y)
    own += jnp.einsum("maq,mf->famq", first, _is_first(record, first.dtype))
    common = jnp.einsum("kmpc,kmpq->cmq", J.by_common, J.by_y)
    return jnp.concatenate([own.reshape(-1, *own.shape[2:]), common])


def _of_landmarks(y: Y, J: Linear) -> tuple[Float[Array, "m q q"], Y]:
    """Information and gradient of every landmark given the path."""
    information = jnp.einsum("kmpq,kmpo->mqo", J.by_y, J.by_y) + jnp.eye(y.shape[1], dtype=y.dtype)
    return information, jnp.einsum("kmpq,kmp->mq", J.by_y, J.residual) + y


class Reduced(NamedTuple):
    """The quadratic at (x, y), and what is left of it when the landmarks are eliminated."""

    path: Path
    by_x: Sensitivities
    linear: Linear
    information: Float[Array, "N N"]
    """The information of x, the landmarks eliminated."""
    gradient: Float[Array, " N"]
    landmarks: Cholesky
    """Information of every landmark given x."""
    coupling: Float[Array, "m q N"]
    """C, so that y given x has the mean ŷ − C (x − x̂)."""


def reduced(slam: AbstractSlam, record: Record, x: X, y: Y) -> Reduced:
    """One linearisation: normal equations by the frames' tangents, without the landmarks; then
    by x."""
    at = path(slam, record, x)
    S, J = sensitivities(slam, record, x, at), linearised(slam, record, at, y)
    information, slope = _of_landmarks(y, J)
    own = cholesky_each(information)
    W = _with_landmarks(record, J)
    half = jnp.einsum("zmq,moq->zmo", W, own.whitening).reshape(len(W), -1)
    whitened = jnp.einsum("mqo,mo->mq", own.whitening, slope).ravel()
    to_x = _to_x(slam, S)
    left = _information(record, J) - half @ half.T
    gradient = to_x.T @ (_gradient(record, J) - half @ whitened) + x
    by_x = (half.T @ to_x).reshape(*slope.shape, -1)
    coupling = jnp.einsum("moq,mon->mqn", own.whitening, by_x)
    eye = jnp.eye(x.size, dtype=x.dtype)
    return Reduced(at, S, J, to_x.T @ (left @ to_x) + eye, gradient, own, coupling)


def left_out(
    slam: AbstractSlam, record: Record, local: Reduced, y: Y, factor: Cholesky
) -> Float[Array, " m"]:
    """By how much `|x|² + |y|² + |r|²` falls at a minimum, to first order, where all that was seen
    of one landmark is left out and the rest is minimised anew; `factor` is of x's information.

    It is `rᵀ (1 − G Σ Gᵀ)⁻¹ r`, r being the landmark's own numbers, its y among them, and G their
    Jacobian by x where y follows x (deletion of cases: Cook, Weisberg, *Residuals and Influence in
    Regression*, 1982). It is a χ² with a degree of freedom for each measurement after the first.
    """
    J, S, C = local.linear, local.by_x, local.coupling
    common = _to_x(slam, S)[record.frames * J.by_frame.shape[-1] :]
    A = jnp.einsum("kmpa,kan->mkpn", J.by_frame, S.frame)
    A += jnp.einsum("kmpa,man->mkpn", J.by_first, S.frame[record.first])
    A += jnp.einsum("kmpc,cn->mkpn", J.by_common, common)
    A -= jnp.einsum("kmpq,mqn->mkpn", J.by_y, C)
    m, n = len(y), C.shape[-1]
    G = jnp.concatenate([A.reshape(m, -1, n), -C], axis=1) @ factor.whitening.T
    r = jnp.concatenate([jnp.swapaxes(J.residual, 0, 1).reshape(m, -1), y], axis=1)
    own = cholesky_each(jnp.eye(r.shape[1], dtype=y.dtype) - G @ jnp.swapaxes(G, 1, 2))
    return jnp.sum(jax.vmap(lambda L, r: L.whitening @ r)(own, r) ** 2, axis=1)


def _to_x(slam: AbstractSlam, S: Sensitivities) -> Float[Array, "z N"]:
    """Jacobian by x of all frames' tangents and the common error."""
    layout, size = PathLayout.of(slam), S.frame.shape[-1]
    eye = jnp.eye(size, dtype=S.frame.dtype)
    common = eye[layout.start : layout.start + layout.common]
    return jnp.concatenate([S.frame.reshape(-1, size), common])


def cholesky_each(A: Float[Array, "m q q"]) -> Cholesky:
    """The Cholesky factors of every landmark's matrix."""
    return jax.vmap(cholesky)(A)
