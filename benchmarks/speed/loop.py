"""The same filter as a loop of NumPy over runs and steps: dense Jacobians, written by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.speed.workload import Inputs, Records, kept
from jaxslam.models.sensors import Pinhole


class Numbers(NamedTuple):
    """What a filter is told; of a point of n coordinates, a pose has t degrees of freedom."""

    dt: float
    focal: np.ndarray
    centre: np.ndarray
    R: np.ndarray
    """Of one measurement."""
    Q: np.ndarray
    """Of the acceleration, t × t."""
    D: np.ndarray
    """Of the calibration (f, c), drawn anew in every frame."""


def wedge(xi: np.ndarray) -> np.ndarray:
    """The matrix of se(2) or se(3), of a tangent (translation, rotation)."""
    if len(xi) == 3:
        return np.array([[0, -xi[2], xi[0]], [xi[2], 0, xi[1]], [0, 0, 0]])
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = hat(xi[3:]), xi[:3]
    return matrix


def hat(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def ad(xi: np.ndarray) -> np.ndarray:
    if len(xi) == 3:
        return np.array([[0, -xi[2], xi[1]], [xi[2], 0, -xi[0]], [0, 0, 0]])
    rotation = hat(xi[3:])
    return np.block([[rotation, hat(xi[:3])], [np.zeros((3, 3)), rotation]])


def series(A: np.ndarray, first: int) -> np.ndarray:
    """`Σ Aᵏ first! / (k + first)!`: exp A for first = 0, and of −ad the right Jacobian for 1."""
    total = identity = np.eye(len(A))
    for k in range(14, 0, -1):
        total = identity + A @ total / (k + first)
    return total


def adjoint(T: np.ndarray) -> np.ndarray:
    R, t = T[:-1, :-1], T[:-1, -1]
    if len(t) == 2:
        return np.block([[R, np.array([[t[1]], [-t[0]]])], [np.zeros((1, 2)), np.ones((1, 1))]])
    return np.block([[R, hat(t) @ R], [np.zeros((3, 3)), R]])


def log(T: np.ndarray) -> np.ndarray:
    """Of a small error: Newton's iteration on `exp`."""
    n, size = len(T) - 1, 3 if len(T) == 3 else 6
    xi = np.zeros(size)
    for _ in range(6):
        step = np.linalg.solve(series(wedge(xi), 0), T)
        turned = [step[1, 0]] if n == 2 else [step[2, 1], step[0, 2], step[1, 0]]
        first_order = np.concatenate([step[:n, n], turned])
        xi = xi + np.linalg.solve(series(-ad(xi), 1), first_order)
    return xi


def moved(X: np.ndarray, omega: float) -> np.ndarray:
    """Derivative of `Exp(−δ) X` for a homogeneous point (X, ω)."""
    turned = np.array([[X[1]], [-X[0]]]) if len(X) == 2 else hat(X)
    return np.hstack([-omega * np.eye(len(X)), turned])


def step(given: Numbers, T, v, x, P, pixels):
    """Update and composition. P is of pose, velocity, acceleration, landmarks."""
    t, (m, d) = len(v), x.shape
    n, p, dt = d - 1, d - 2, given.dt
    P = P.copy()
    P[2 * t : 3 * t], P[:, 2 * t : 3 * t] = 0, 0
    P[2 * t : 3 * t, 2 * t : 3 * t] = given.Q
    back = np.linalg.inv(series(wedge(v * dt), 0))[:n]
    J = series(-ad(v * dt), 1) * dt
    H, G, residual = np.zeros((m, p, len(P))), np.zeros((m, p, 2 * p)), np.zeros((m, p))
    for j in range(m):
        X = back @ x[j]
        ratio = X[:p] / X[p]
        by_point = np.hstack([np.diag(given.focal / X[p]), -(given.focal * ratio / X[p])[:, None]])
        H[j, :, t : 2 * t] = by_point @ moved(X, x[j, n]) @ J
        H[j, :, 2 * t : 3 * t] = dt * H[j, :, t : 2 * t]
        H[j, :, 3 * t + j * d : 3 * t + (j + 1) * d] = by_point @ back
        G[j] = np.hstack([np.diag(ratio), np.eye(p)])
        residual[j] = pixels[j] - given.focal * ratio - given.centre
    H, G = H.reshape(m * p, -1), G.reshape(m * p, -1)
    HP = H @ P
    S = HP @ H.T + G @ given.D @ G.T + np.kron(np.eye(m), given.R)
    K = np.linalg.solve(S, HP).T
    delta = K @ residual.ravel()
    P = P - K @ HP
    T = T @ series(wedge(delta[:t]), 0)
    v, a = v + delta[t : 2 * t], delta[2 * t : 3 * t]
    x = x + delta[3 * t :].reshape(m, d)

    v = v + a * dt
    back = np.linalg.inv(series(wedge(v * dt), 0))
    T = back @ T
    J, F = series(-ad(v * dt), 1) * dt, np.eye(len(P))
    both = np.hstack([np.eye(t), dt * np.eye(t)])
    F[:t, t : 3 * t] = -adjoint(np.linalg.inv(T)) @ J @ both
    F[t : 2 * t, t : 3 * t] = both
    x = x @ back.T
    for j in range(m):
        rows = slice(3 * t + j * d, 3 * t + (j + 1) * d)
        F[rows, rows] = back
        F[rows.start : rows.stop - 1, t : 3 * t] = moved(x[j, :n], x[j, n]) @ J @ both
    return T, v, x, F @ P @ F.T


def by_loop(inputs: Inputs) -> Callable[[], Records]:
    """The loop on these inputs."""
    slam, start = inputs.slam, inputs.start
    p, t = inputs.pixels.shape[3], slam.motion.geometry.tangent_dim
    sensor = slam.sensor
    assert isinstance(sensor, Pinhole)
    given = Numbers(
        float(inputs.seconds), np.asarray(sensor.camera.focal),
        np.asarray(sensor.camera.centre), np.eye(p) * float(sensor.sigma) ** 2,
        np.diag(np.asarray(slam.motion.noise_sigma) ** 2),
        np.diag(np.asarray(slam.calibration.sigma) ** 2),
    )  # fmt: skip
    index = np.insert(kept(slam, start), [2 * t] * t, np.arange(2 * t, 3 * t))
    keep = np.r_[: 2 * t, 3 * t : len(index)]
    poses, truth = np.asarray(start.core.pose.as_matrix()), np.asarray(inputs.poses.as_matrix())

    def run(i):
        T, v, x = poses[i], start.core.motion[i], start.landmarks[i]
        P, nees = start.covariance[i][np.ix_(index, index)], []
        for pixels, T_BC in zip(inputs.pixels[i], truth[i], strict=True):
            T, v, x, P = step(given, T, v, x, P, pixels)
            error = log(np.linalg.inv(T_BC @ T))
            nees.append(error @ np.linalg.solve(P[:t, :t], error))
        return nees, P[np.ix_(keep, keep)]

    def call() -> Records:
        nees, P = zip(*(run(i) for i in range(len(poses))), strict=True)
        return np.array(nees), np.array(P)

    return call
