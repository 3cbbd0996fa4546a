"""The batch solution of a simulated run: all measurements at once, and who is who is known."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array, vstack
from scipy.sparse.linalg import splu

from jaxslam.filters.slam import Slam
from jaxslam.geometry import Pose, log, retract
from jaxslam.models.motion import Odometry
from jaxslam.simulation import Run

STEPS = 10
"""Of Levenberg–Marquardt, at the most, from the truth: the result is the best that there is."""
SIZE = 8192
"""Residuals of one kind are padded to a multiple of this."""


def batch_positions(slam: Slam, run: Run, dt: float) -> np.ndarray:
    """The positions of the camera in all frames, at the maximum of the posterior."""
    unknown = jax.tree.map(lambda x: x[1:], run.poses), _points(run), 0.0
    best, damping = np.inf, 1e-6
    for _ in range(STEPS):
        A, b = _system(slam, run, dt, *unknown)
        cost = float(b @ b)
        if best - 1e-3 < cost <= best:
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


def _system(slam: Slam, run: Run, dt: float, poses: Pose, points, common: float):
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
        (
            *_differentiated(_seen, slam, (_at(path, frames),), points[who], measured),
            [columns[frames], of_point[who]],
        )
    )
    first = np.unique(who, return_index=True)[1]
    if slam.sensor.hidden:
        last, sigma = np.full((len(first), 1), K * t + L * n), slam.depth.common or 1e-6
        both = np.hstack([points[who[first]], np.full((len(first), 1), common)])
        value, J = _differentiated(_prior, slam, (_at(path, frames[first]),), both)
        by = [columns[frames[first]], np.hstack([of_point[who[first]], last])]
        parts += [
            (value, J, by),
            (np.array([[common / sigma]]), [np.array([[[1 / sigma]]])], [last[:1]]),
        ]
    three = [np.maximum(np.arange(1, K + 1) - back, 0) for back in (2, 1, 0)]
    at, began = tuple(_at(path, k) for k in three), np.arange(K) == 0
    value, J = _differentiated(_driven, (slam, dt), at, None, run.controls, began)
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


def _differentiated(residual, pieces, poses, points, *data):
    """Values and Jacobians by the tangents of poses, and by points, of each of many, of a
    `residual(pieces, *poses, *points, *data)`."""
    count = len(jax.tree.leaves(poses)[0])
    if points is None:
        points = jnp.zeros((count, 0))
    # Of few lengths, since each has a program of its own.
    padding = -count % SIZE
    each = jax.tree.map(
        lambda x: np.concatenate([x, np.repeat(np.asarray(x[-1:]), padding, axis=0)]),
        (poses, jnp.asarray(points), data),
    )
    return jax.tree.map(lambda x: x[:count], _each(residual, pieces, *each))


@eqx.filter_jit
def _each(residual, pieces, poses, points, data):
    def one(poses, points, data):
        t = poses[0].tangent_dim

        def moved(*deltas):
            at = [retract(T, delta) for T, delta in zip(poses, deltas, strict=False)]
            return residual(pieces, *at, *([points + deltas[-1]] if points.size else []), *data)

        zeros = [jnp.zeros(t) for _ in poses] + ([jnp.zeros(points.size)] if points.size else [])
        arguments = tuple(range(len(zeros)))
        return moved(*zeros), jax.jacfwd(moved, argnums=arguments)(*zeros)

    return jax.vmap(one)(poses, points, data)


def _seen(slam, T_BC, point, measured):
    predicted = slam.sensor.measure(T_BC.inverse() @ point, 1.0)
    return slam.sensor.residual(measured, predicted) / slam.sensor.sigma


def _prior(slam, T_BC, both):
    """The prior on 1/z where a point was first seen."""
    inverse_depth = 1 / (T_BC.inverse() @ both[:-1])[-1:]
    return (inverse_depth - slam.depth.mean) / slam.depth.sigma - both[-1:]


def _driven(pieces, before, last, now, control, is_first):
    """What moves the camera: its odometry, or an acceleration."""
    slam, dt = pieces
    motion = slam.motion
    if isinstance(motion, Odometry):
        step = last.inverse() @ now
        read = jnp.concatenate([step.translation(), log(step.rotation())])
        return (control - read) / motion.noise_sigma
    mean, root = motion.start()
    start = jnp.sqrt(jnp.sum(root**2, axis=1) + (motion.noise_sigma * dt) ** 2)
    velocity = log(last.inverse() @ now) / dt
    earlier = jnp.where(is_first, mean, log(before.inverse() @ last) / dt)
    sigma = jnp.where(is_first, start, motion.noise_sigma * dt)
    return (velocity - earlier) / sigma
