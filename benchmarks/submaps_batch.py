"""The batch solution of a simulated run: all measurements at once, and who is who is known."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array, vstack
from scipy.sparse.linalg import splu

from jaxslam.filters.ekf import EkfSlam
from jaxslam.geometry import Pose, log, retract
from jaxslam.models.motion import Odometry
from jaxslam.simulation import Run

STEPS = 10
"""Of Levenberg–Marquardt, at the most, from the truth: the result is the best that there is."""


def batch_positions(slam: EkfSlam, run: Run, dt: float) -> np.ndarray:
    """The positions of the camera in all frames, at the maximum of the posterior."""
    unknown = jax.tree.map(lambda x: x[1:], run.poses), _points(run), 0.0
    best, damping = np.inf, 1e-6
    for _ in range(STEPS):
        A, b = _system(slam, run, dt, *unknown)
        cost = float(b @ b)
        if best - 1e-6 < cost <= best:
            break
        if cost < best:
            kept, best, damping = (unknown, A, b), cost, damping / 10
        else:
            damping *= 100
        at, A, b = kept
        information = csc_array(A.T @ A)
        step = splu(information + diags_array(damping * information.diagonal(), format="csc"))
        unknown = _moved(*at, -step.solve(A.T @ b))
    positions = np.asarray(kept[0][0].translation())
    return np.concatenate([np.zeros((1, positions.shape[1])), positions])


def _points(run: Run) -> np.ndarray:
    """Every point by its number; those that are never seen are anywhere."""
    identity, points = np.asarray(run.identity), np.asarray(run.points)
    of_each = np.ones((identity.max() + 1, points.shape[-1]))
    seen = identity >= 0
    of_each[identity[seen]] = points[seen]
    return of_each


def _moved(poses, points, common: float, step) -> tuple[Pose, np.ndarray, float]:
    delta, of_points = np.split(step[:-1], [step.size - 1 - points.size])
    delta = jnp.asarray(delta).reshape(*poses.get_batch_axes(), -1)
    moved = jax.vmap(lambda T, delta: retract(T, delta))(poses, delta)
    moved = jax.vmap(lambda T: T.normalize())(moved)
    return moved, points + of_points.reshape(points.shape), common + step[-1]


def _system(slam: EkfSlam, run: Run, dt: float, poses: Pose, points, common: float):
    """The Jacobian of all whitened residuals, sparse, and the residuals.

    The unknowns are the poses, the points, and what the priors on 1/z have in common, in σ of one.
    """
    K, (L, n) = poses.get_batch_axes()[0], points.shape
    t = poses.tangent_dim
    frames, slots = np.nonzero(np.asarray(run.visible))
    who = np.asarray(run.identity)[frames, slots]
    origin = jax.tree.map(lambda x: x[:1], run.poses)
    path = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), origin, poses)
    columns, parts = np.arange((K + 1) * t).reshape(-1, t) - t, []
    of_point = K * t + np.arange(L * n).reshape(L, n)

    measured = np.asarray(run.measured)[frames, slots]
    parts.append(
        (*_seen(slam, _at(path, frames), points[who], measured), [columns[frames], of_point[who]])
    )
    first = np.unique(who, return_index=True)[1]
    if slam.sensor.hidden:
        last, sigma = np.full((len(first), 1), K * t + L * n), slam.depth.common or 1e-6
        both = np.hstack([points[who[first]], np.full((len(first), 1), common)])
        value, J = _prior(slam, _at(path, frames[first]), both)
        by = [columns[frames[first]], np.hstack([of_point[who[first]], last])]
        parts += [
            (value, J, by),
            (np.array([[common / sigma]]), [np.array([[[1 / sigma]]])], [last[:1]]),
        ]
    three = [np.maximum(np.arange(1, K + 1) - back, 0) for back in (2, 1, 0)]
    value, J = _driven(slam, dt, *(_at(path, k) for k in three), run.controls, np.arange(K) == 0)
    parts.append((value, J, [columns[k] for k in three]))

    rows = columns_of = np.zeros(0, int)
    values, residuals, height = np.zeros(0), np.zeros(0), 0
    for value, J, by in parts:
        m, p = value.shape
        row = height + np.arange(m * p).reshape(m, p)
        for slope, column in zip(J, by, strict=True):
            i, j = np.broadcast_arrays(row[:, :, None], column[:, None])
            rows, columns_of = np.append(rows, i.ravel()), np.append(columns_of, j.ravel())
            values = np.append(values, np.asarray(slope).ravel())
        residuals, height = np.append(residuals, np.asarray(value).ravel()), height + m * p
    there = columns_of >= 0  # the first pose is exact
    size = K * t + L * n + 1
    A = coo_array((values[there], (rows[there], columns_of[there])), (height, size)).tocsc()
    # What nothing is said of, as of a point that was never seen, stays where it is.
    still = np.flatnonzero(np.diff(A.indptr) == 0)
    rows = np.arange(len(still))
    stays = coo_array((np.ones(len(still)), (rows, still)), (len(still), size))
    return csc_array(vstack([A, stays])), np.append(residuals, np.zeros(len(still)))


def _at(poses: Pose, index) -> Pose:
    return jax.tree.map(lambda x: x[index], poses)


def _differentiated(function, poses, points, *data):
    """Values and Jacobians by the tangents of poses, and by points, of each of many."""
    count = len(jax.tree.leaves(poses)[0])

    def one(poses, points, *data):
        t = poses[0].tangent_dim

        def moved(*deltas):
            at = [retract(T, delta) for T, delta in zip(poses, deltas, strict=False)]
            return function(*at, *([points + deltas[-1]] if points.size else []), *data)

        zeros = [jnp.zeros(t) for _ in poses] + ([jnp.zeros(points.size)] if points.size else [])
        arguments = tuple(range(len(zeros)))
        return moved(*zeros), jax.jacfwd(moved, argnums=arguments)(*zeros)

    if points is None:
        points = jnp.zeros((count, 0))
    return jax.jit(jax.vmap(one))(poses, jnp.asarray(points), *data)


def _seen(slam, poses, points, measured):
    def residual(T_BC, point, measured):
        predicted = slam.sensor.measure(T_BC.inverse() @ point, 1.0)
        return slam.sensor.residual(measured, predicted) / slam.sensor.sigma

    return _differentiated(residual, (poses,), points, measured)


def _prior(slam, poses, points):
    """The prior on 1/z where a point was first seen."""

    def residual(T_BC, both):
        inverse_depth = 1 / (T_BC.inverse() @ both[:-1])[-1:]
        return (inverse_depth - slam.depth.mean) / slam.depth.sigma - both[-1:]

    return _differentiated(residual, (poses,), points)


def _driven(slam, dt, before, last, now, controls, is_first):
    motion = slam.motion
    if isinstance(motion, Odometry):

        def moved(before, last, now, control, is_first):
            del before, is_first
            step = last.inverse() @ now
            read = jnp.concatenate([step.translation(), log(step.rotation())])
            return (control - read) / motion.noise_sigma

        return _differentiated(moved, (before, last, now), None, controls, is_first)
    mean, root = motion.start()
    start = jnp.sqrt(jnp.sum(root**2, axis=1) + (motion.noise_sigma * dt) ** 2)

    def accelerated(before, last, now, control, is_first):
        del control
        velocity = log(last.inverse() @ now) / dt
        earlier = jnp.where(is_first, mean, log(before.inverse() @ last) / dt)
        sigma = jnp.where(is_first, start, motion.noise_sigma * dt)
        return (velocity - earlier) / sigma

    return _differentiated(accelerated, (before, last, now), None, controls, is_first)
