"""All frames of a window at once: unknowns, residuals, and the least squares of them.

Everything random since frame 0 is written as standard normal numbers: x of what all landmarks
have in common (the motion's start, the common error of the depths, the calibration, and the noise of
every step), and y of each landmark (its true first measurement, and what that hides). With the
measurements z, `−log p(x, y | z) = ½ (|x|² + |y|² + |r(x, y)|²)` up to a constant.

A landmark depends on x and on its own y alone: given x the landmarks are eliminated one by one
(Schur), so that a step costs what the path costs.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.geometry import Pose, homogeneous_apply, identity, jacobian, nudge, retract
from jaxslam.linalg import Cholesky, cholesky
from jaxslam.slam.filter import EkfSlam
from jaxslam.window.record import Record


class Frame(eqx.Module):
    """What a measurement depends on beside the landmark; of one frame, or of all."""

    pose: Pose
    """T_BC, B the camera of frame 0."""
    calibration: Float[Array, "*F k"]


class Path(eqx.Module):
    """What x stands for."""

    frames: Frame
    motion: Float[Array, "F v"]
    """The motion's variables after every step."""
    common: Float[Array, " c"]
    """The error that all depths have in common; empty where there is none."""


class Layout(NamedTuple):
    """How many numbers of x are of what."""

    start: int
    common: int
    calibration: int
    """Drawn once."""
    step: int
    """Of every step."""
    each: int
    """Calibration drawn in every frame."""

    @staticmethod
    def of(slam: EkfSlam) -> Layout:
        _, root = slam.motion.start()
        own = slam.calibration.sigma.size
        each = own if slam.calibration.each_frame else 0
        common = 0 if slam.depth.common is None else 1
        return Layout(len(root), common, own - each, slam.model.noise_sigma.size, each)

    @property
    def whole(self) -> int:
        """Numbers that are not of one frame alone, those of frame 0 among them."""
        return self.start + self.common + self.calibration + self.each

    def size(self, frames: int) -> int:
        """N, of so many frames."""
        return self.whole + (frames - 1) * (self.step + self.each)


def path(slam: EkfSlam, record: Record, x: Float[Array, " N"]) -> Path:
    """Poses, velocities and calibrations of all frames. After the last, nothing moves."""
    layout, motion = Layout.of(slam), slam.motion
    mean, root = motion.start()
    ends = [layout.start, layout.start + layout.common, layout.whole - layout.each, layout.whole]
    start, common, once, first, steps = jnp.split(x, ends)
    steps = steps.reshape(record.frames - 1, layout.step + layout.each)
    drawn = jnp.asarray(slam.calibration.sigma)

    def move(state, data):
        k, control, numbers = data
        there = _moved(slam, state, (k, control), numbers)
        there = jax.tree.map(lambda new, old: jnp.where(k < record.last, new, old), there, state)
        return there, there

    origin = identity(motion.geometry, x.dtype)
    begun = origin, retract(mean, root @ start), drawn * (first if layout.each else once)
    data = jnp.arange(record.frames - 1), record.controls, steps
    _, later = jax.lax.scan(move, begun, data)
    poses, variables, deltas = jax.tree.map(
        lambda one, more: jnp.concatenate([one[None], more]), begun, later
    )
    return Path(Frame(poses, deltas), variables, common)


def _moved(slam: EkfSlam, state, data, numbers):
    """Pose, motion's variables and calibration one step on."""
    pose, variables, delta = state
    layout, (_, control) = Layout.of(slam), data
    own = slam.motion.noise_sigma.shape[-1]
    noise, drift = jnp.split(slam.model.noise_sigma * numbers[: layout.step], [own])
    sigma = jnp.asarray(slam.calibration.sigma)
    return (
        pose @ slam.motion.displacement(variables, noise, control),
        slam.motion.next(variables, noise, control),
        sigma * numbers[layout.step :] if layout.each else slam.calibration.next(delta, drift),
    )


def located(
    slam: EkfSlam,
    calibration: Float[Array, " k"],
    common: Float[Array, " c"],
    measured: Float[Array, " p"],
    y: Float[Array, " q"],
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The homogeneous point of a landmark, in the camera of the frame that first measured it."""
    sensor, depth = slam.calibration.sensor(slam.sensor, calibration), slam.depth
    p = measured.size
    hidden = depth.mean + depth.sigma * (depth.own * y[p:] + jnp.sum(common) * _share(slam))
    return sensor.locate(measured + cholesky(sensor.noise).root @ y[:p], hidden)


def _share(slam: EkfSlam) -> Array:
    """σ of the depths' common error, in σ of one."""
    return jnp.zeros(()) if slam.depth.common is None else jnp.asarray(slam.depth.common)


class Sight(NamedTuple):
    """The point of a landmark in the camera that first saw it, and its Jacobians."""

    point: Float[Array, " n"]
    omega: Float[Array, ""]
    by_pose: Float[Array, "n+1 t"]
    """Of (X, ω), by the tangent of that camera's pose."""
    by_calibration: Float[Array, "n+1 k"]
    by_common: Float[Array, "n+1 c"]
    by_y: Float[Array, "n+1 q"]


def sights(slam: EkfSlam, record: Record, at: Path, y: Float[Array, "m q"]) -> Sight:
    """Of all landmarks, from the frames in which they were first seen."""
    first = record.measured[record.first, jnp.arange(record.first.size)]
    calibrations = at.frames.calibration[record.first]

    def one(measured, calibration, y):
        def of(calibration, common, y):
            return jnp.append(*located(slam, calibration, common, measured, y))

        arguments = calibration, at.common, y
        there = of(*arguments)
        slopes = jax.jacfwd(of, argnums=(0, 1, 2))(*arguments)
        return Sight(there[:-1], there[-1], _by_motion(slam, there[:-1], there[-1]), *slopes)

    return jax.vmap(one)(first, calibrations, y)


def _by_motion(slam: EkfSlam, point: Float[Array, " n"], omega: Float[Array, ""]) -> Array:
    """Jacobian of the homogeneous point (Exp(δ) X, ω) by δ at 0."""
    still = identity(slam.motion.geometry, point.dtype)

    def moved(delta):
        return jnp.append(homogeneous_apply(nudge(still, delta), point, omega), omega)

    return jax.jacfwd(moved)(jnp.zeros(still.tangent_dim, point.dtype))


def _relative(record: Record, at: Path) -> Float[Array, "F m n n+1"]:
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
    by_point: Float[Array, "F m p n+1"]
    """Jacobian by (X, ω) in the camera."""
    by_calibration: Float[Array, "F m p k"]
    points: Float[Array, "F m n+1"]
    """(X, ω) in the camera."""


def _seen(slam: EkfSlam, record: Record, at: Path, relative, sight: Sight) -> Seen:
    whitening = cholesky(slam.sensor.noise).whitening

    def one(T, calibration, point, omega, measured):
        here = jnp.append(T @ jnp.append(point, omega), omega)

        def wrong(here, calibration):
            sensor = slam.calibration.sensor(slam.sensor, calibration)
            predicted = sensor.measure(here[:-1], here[-1])
            return whitening @ sensor.residual(measured, predicted)

        slopes = jax.jacfwd(wrong, argnums=(0, 1))(here, calibration)
        sensor = slam.calibration.sensor(slam.sensor, calibration)
        impossible = ~sensor.possible(here[:-1])
        return Seen(wrong(here, calibration), impossible, *slopes, here)

    of_frame = jax.vmap(one, in_axes=(0, None, 0, 0, 0))
    found = jax.vmap(of_frame, in_axes=(0, 0, None, None, 0))(
        relative, at.frames.calibration, sight.point, sight.omega, record.measured
    )
    used = record.compared

    def masked(x):
        return jnp.where(used.reshape(used.shape + (1,) * (x.ndim - 2)), x, 0.0)

    residual, impossible, by_point, by_calibration, points = found
    return Seen(masked(residual), impossible & used, masked(by_point), masked(by_calibration), points)


def _by_first(seen: Seen, relative) -> Float[Array, "F m p n+1"]:
    """Jacobian of the residuals by (X, ω) in the camera of the first sight."""
    by_point, by_omega = seen.by_point[..., :-1], seen.by_point[..., -1]
    E = jnp.einsum("kmpn,kmno->kmpo", by_point, relative)
    return E.at[..., -1].add(by_omega)


def landmark_slopes(
    slam: EkfSlam, record: Record, at: Path, y: Float[Array, "m q"]
) -> tuple[Float[Array, "m q q"], Float[Array, "m q"], Float[Array, " m"]]:
    """Of every landmark given the path: information, gradient, and |y|² + |r|², which is ∞ if it
    is measured and cannot be seen."""
    sight, relative = sights(slam, record, at, y), _relative(record, at)
    seen = _seen(slam, record, at, relative, sight)
    B = jnp.einsum("kmpo,moq->kmpq", _by_first(seen, relative), sight.by_y)
    information = jnp.einsum("kmpq,kmpo->mqo", B, B) + jnp.eye(y.shape[1], dtype=y.dtype)
    gradient = jnp.einsum("kmpq,kmp->mq", B, seen.residual) + y
    cost = jnp.sum(seen.residual**2, axis=(0, 2)) + jnp.sum(y**2, axis=1)
    possible = ~jnp.any(seen.impossible, axis=0) & jnp.isfinite(cost)
    return information, gradient, jnp.where(possible, cost, jnp.inf)


def residuals(
    slam: EkfSlam, record: Record, at: Path, y: Float[Array, "m q"]
) -> Float[Array, "F m p"]:
    """`(z − h)/σ` of all measurements that are compared, zero elsewhere."""
    sight, relative = sights(slam, record, at, y), _relative(record, at)
    return _seen(slam, record, at, relative, sight).residual


class Sensitivities(NamedTuple):
    """Jacobians by x: of the frames' tangents, pose and then calibration, and of the motion's
    variables."""

    frame: Float[Array, "F a N"]
    motion: Float[Array, "F v N"]


def sensitivities(
    slam: EkfSlam, record: Record, x: Float[Array, " N"], at: Path
) -> Sensitivities:
    """Step by step, by the chain rule."""
    layout, size = Layout.of(slam), x.size
    eye = jnp.eye(size, dtype=x.dtype)
    states = at.frames.pose, at.motion, at.frames.calibration
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    steps = x[layout.whole :].reshape(record.frames - 1, -1)
    each = jnp.arange(record.frames - 1), record.controls

    def local(state, data, numbers):
        return jacobian(lambda both: _moved(slam, both[0], data, both[1]), (state, numbers))

    slopes = jax.vmap(local)(before, each, steps)
    happened = (each[0] < record.last)[:, None, None]
    still = jnp.eye(slopes.shape[1], slopes.shape[2], dtype=x.dtype)
    slopes = jnp.where(happened, slopes, still)
    ends = [layout.start, layout.start + layout.common, layout.whole]
    start, _, drawn, driving = jnp.split(eye, ends)
    _, root = slam.motion.start()
    sigma = jnp.asarray(slam.calibration.sigma)[:, None]
    t = slam.motion.geometry.tangent_dim
    begun = jnp.concatenate([jnp.zeros((t, size), x.dtype), root @ start, sigma * drawn])
    driving = driving.reshape(record.frames - 1, -1, size)

    def move(S, data):
        slope, driving = data
        S = slope[:, : len(S)] @ S + slope[:, len(S) :] @ driving
        return S, S

    _, later = jax.lax.scan(move, begun, (slopes, driving))
    every = jnp.concatenate([begun[None], later])
    v = layout.start
    frame = jnp.concatenate([every[:, :t], every[:, t + v :]], axis=1)
    return Sensitivities(frame, every[:, t : t + v])


class Reduced(NamedTuple):
    """The quadratic at (x, y), and what is left of it when the landmarks are eliminated."""

    path: Path
    by_x: Sensitivities
    information: Float[Array, "N N"]
    """Of x, the landmarks eliminated."""
    gradient: Float[Array, " N"]
    landmarks: Cholesky
    """Information of every landmark given x."""
    coupling: Float[Array, "m q N"]
    """C, so that y given x has the mean ŷ − C (x − x̂)."""


def reduced(
    slam: EkfSlam, record: Record, x: Float[Array, " N"], y: Float[Array, "m q"]
) -> Reduced:
    """One linearisation: normal equations by the frames' tangents, then by x."""
    at = path(slam, record, x)
    S = sensitivities(slam, record, x, at)
    sight, relative = sights(slam, record, at, y), _relative(record, at)
    seen = _seen(slam, record, at, relative, sight)
    E, r = _by_first(seen, relative), seen.residual
    here = jax.vmap(jax.vmap(lambda X: _by_motion(slam, X[:-1], X[-1])))(seen.points)
    # T_C Exp(δ) moves a point by −δ in the camera's axes.
    A = jnp.concatenate([-jnp.einsum("kmpn,kmnt->kmpt", seen.by_point, here), seen.by_calibration], -1)
    by_first = jnp.concatenate([sight.by_pose, sight.by_calibration], -1)
    first = jnp.einsum("kmpn,mna->kmpa", E, by_first)
    B = jnp.einsum("kmpn,mnq->kmpq", E, sight.by_y)
    common = jnp.einsum("kmpn,mnc->kmpc", E, sight.by_common)

    frames, a, c = record.frames, A.shape[-1], common.shape[-1]
    where = (record.first[:, None] == jnp.arange(frames)).astype(x.dtype)  # m F
    index = jnp.arange(frames)
    size = frames * a + c
    own = jnp.einsum("kmpa,kmpb->kab", A, A)
    crossed = jnp.einsum("kmab,mf->kafb", jnp.einsum("kmpa,kmpb->kmab", A, first), where)
    firsts = jnp.einsum("mab,mf->fab", jnp.einsum("kmpa,kmpb->mab", first, first), where)
    M = crossed + jnp.transpose(crossed, (2, 3, 0, 1))
    M = M.at[index, :, index, :].add(own + firsts).reshape(frames * a, -1)
    by_common = jnp.einsum("kmpa,kmpc->kac", A, common)
    by_common += jnp.einsum("mac,mf->fac", jnp.einsum("kmpa,kmpc->mac", first, common), where)
    side = by_common.reshape(frames * a, c)
    corner = jnp.einsum("kmpc,kmpd->cd", common, common)
    M = jnp.block([[M, side], [side.T, corner]])

    gradient = jnp.einsum("kmpa,kmp->ka", A, r)
    gradient += jnp.einsum("ma,mf->fa", jnp.einsum("kmpa,kmp->ma", first, r), where)
    gradient = jnp.append(gradient.ravel(), jnp.einsum("kmpc,kmp->c", common, r))

    W = jnp.einsum("kmpa,kmpq->kamq", A, B)
    W += jnp.einsum("maq,mf->famq", jnp.einsum("kmpa,kmpq->maq", first, B), where)
    W = jnp.concatenate([W.reshape(frames * a, *B.shape[1::2]), jnp.einsum("kmpc,kmpq->cmq", common, B)])

    information = jnp.einsum("kmpq,kmpo->mqo", B, B) + jnp.eye(y.shape[1], dtype=y.dtype)
    own_factor = cholesky_each(information)
    slope = jnp.einsum("kmpq,kmp->mq", B, r) + y

    layout = Layout.of(slam)
    eye = jnp.eye(x.size, dtype=x.dtype)
    to_x = jnp.concatenate([S.frame.reshape(frames * a, -1), eye[layout.start : layout.start + c]])
    half = jnp.einsum("imq,moq->imo", W, own_factor.whitening).reshape(size, -1)
    left = M - half @ half.T
    whitened = jnp.einsum("mqo,mo->mq", own_factor.whitening, slope).ravel()
    H = to_x.T @ (left @ to_x) + eye
    g = to_x.T @ (gradient - half @ whitened) + x
    by_x = (half.T @ to_x).reshape(*slope.shape, -1)
    coupling = jnp.einsum("moq,mon->mqn", own_factor.whitening, by_x)
    return Reduced(at, S, H, g, own_factor, coupling)


def cholesky_each(A: Float[Array, "m q q"]) -> Cholesky:
    return jax.vmap(cholesky)(A)
