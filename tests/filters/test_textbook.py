"""Tests against the textbook's EKF-SLAM of a robot that measures relative positions in a plane.

The filter below is Thrun, Burgard, Fox, Probabilistic Robotics, chapter 10, with positions for
its ranges and bearings: dense matrices in numpy, nothing of the library in it.
"""

from functools import cache

import jax
import numpy as np
import pytest
from cases import Case, quick_rows

STEPS = 30


def rotation(theta):
    """Robot to map; θ turns from x towards z."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def rotation_derivative(theta):
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[-s, -c], [c, -s]])


def predicted(x, P, reading, Q):
    """`p ← p + R(θ) u`, `θ ← θ + ω`; the errors of the reading are additive."""
    x, theta = x.copy(), x[2]
    F, G = np.eye(len(x)), np.zeros((len(x), 3))
    F[:2, 2] = rotation_derivative(theta) @ reading[:2]
    G[:2, :2], G[2, 2] = rotation(theta), 1.0
    x[:2] += rotation(theta) @ reading[:2]
    x[2] += reading[2]
    return x, F @ P @ F.T + G @ Q @ G.T


def updated(x, P, seen, R):
    """All of `seen`, pairs of a landmark's place in the state and a measurement, at once."""
    back, derivative = rotation(x[2]).T, rotation_derivative(x[2]).T
    H, residual = np.zeros((2 * len(seen), len(x))), np.zeros(2 * len(seen))
    for i, (at, z) in enumerate(seen):
        row, away = slice(2 * i, 2 * i + 2), x[at : at + 2] - x[:2]
        residual[row] = z - back @ away
        H[row, :2], H[row, 2], H[row, at : at + 2] = -back, derivative @ away, back
    S = H @ P @ H.T + np.kron(np.eye(len(seen)), R)
    K = P @ H.T @ np.linalg.inv(S)
    return x + K @ residual, (np.eye(len(x)) - K @ H) @ P, residual @ np.linalg.solve(S, residual)


def extended(x, P, z, R):
    """A new landmark at `p + R(θ) z`."""
    J = np.zeros((2, len(x)))
    J[:, :2], J[:, 2] = np.eye(2), rotation_derivative(x[2]) @ z
    V = rotation(x[2])
    cross = J @ P
    P = np.block([[P, cross.T], [cross, cross @ J.T + V @ R @ V.T]])
    return np.concatenate([x, x[:2] + V @ z]), P


def textbook(run, scenario):
    """Landmarks in the order of their places, mean, covariance and NIS after every step."""
    Q = np.diag(np.square(scenario.motion.noise_sigma))
    R = scenario.sensor.sigma**2 * np.eye(2)
    x, P, order = np.zeros(3), np.zeros((3, 3)), []
    for k in range(1, scenario.steps + 1):
        x, P = predicted(x, P, run.controls[k - 1], Q)
        visible = np.flatnonzero(run.visible[k])
        seen = [(3 + 2 * order.index(j), run.measured[k, j]) for j in visible if j in order]
        nis = 0.0
        if seen:
            x, P, nis = updated(x, P, seen, R)
        for j in visible:
            if j not in order:
                x, P = extended(x, P, run.measured[k, j], R)
                order.append(j)
        yield list(order), x, P, nis


def test_in_the_world_frame_the_filter_is_the_textbooks():
    case = Case("positions", steps=STEPS, seed=5)
    run = jax.tree.map(np.asarray, case.run(0))
    last, (poses, _, covariances, nis) = case.compiled("world", "cartesian")(
        case.controls(), *case.frames(0)
    )
    sizes = []
    for k, (order, x, P, one_nis) in enumerate(textbook(run, case.scenario)):
        # The library's state has three numbers for the noise of a step, between pose and map.
        places = np.concatenate([[0, 1, 2], *[[6 + 2 * j, 7 + 2 * j] for j in order]]).astype(int)
        np.testing.assert_allclose(poses.translation()[k], x[:2], rtol=0, atol=1e-8)
        turned = np.asarray(poses.rotation().as_radians()[k])
        np.testing.assert_allclose(np.sin((turned - x[2]) / 2), 0, atol=1e-8)
        np.testing.assert_allclose(covariances[k][np.ix_(places, places)], P, rtol=0, atol=1e-8)
        np.testing.assert_allclose(nis[k], one_nis, rtol=1e-8)
        sizes.append(len(order))
    np.testing.assert_allclose(last.landmarks[np.array(order)].ravel(), x[3:], rtol=0, atol=1e-8)
    # The run is worth its name: the robot turns, the map grows on the way, landmarks are left.
    assert x[2] > 1
    assert 0 < sizes[0] < sizes[-1]
    assert (run.visible[1] & ~run.visible[-1]).any()
    assert np.trace(P[:3, :3]) > 1e-3


@cache
def straight():
    """The heading is known, and everything linear."""
    return Case("positions", steps=8, landmarks=6, odometry_sigma=(0.05, 0.05, 0.0))


OTHERS = ("world+oc", "world+fej", "world+decoupled", "invariant")


@pytest.mark.parametrize(
    "name", quick_rows(3, ["robocentric", "keyframe", "robocentric+submaps", *OTHERS])
)
def test_where_the_heading_is_known_every_filter_is_the_textbooks(name):
    """One filter in every coordinates."""
    case = straight()
    run = jax.tree.map(np.asarray, case.run(0))
    frames = case.controls(), *case.frames(0)
    _, (poses, covariances, _, nis) = case.compiled(name, "cartesian")(*frames)
    for k, (_, x, P, one_nis) in enumerate(textbook(run, case.scenario)):
        np.testing.assert_allclose(poses.translation()[k], x[:2], rtol=0, atol=1e-10)
        R = rotation(x[2])  # the pose's error is in the camera's axes
        np.testing.assert_allclose(covariances[k][:2, :2], R.T @ P[:2, :2] @ R, atol=1e-10)
        np.testing.assert_allclose(nis[k], one_nis, rtol=1e-8)
    assert np.trace(P[:2, :2]) > 1e-3
