"""The same filter by dynamax's extended Kalman filter under `vmap`; planar only.

    pip install dynamax

dynamax adds noise to the state and to what is measured. So the acceleration of the coming step and
the calibration's error of the frame are parts of the state, drawn anew by its Q, and composition is
its dynamics. Our pure functions are its models. Its pose is a vector (t, θ) where ours is one of a
group: the covariance of velocity and landmarks is the same but for the 1e-9 that dynamax adds to S
(`TOLERANCE`), NEES is not.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from benchmarks.speed.workload import Inputs, Records, kept
from jaxslam.geometry import PLANAR, exp, joined

TOLERANCE = 1e-7


def missing(inputs: Inputs) -> str | None:
    """Why it is not measured."""
    if importlib.util.find_spec("dynamax") is None:
        return "dynamax is not installed"
    if inputs.slam.motion.geometry is not PLANAR:
        return "only planar"
    return None


def by_dynamax(inputs: Inputs) -> Callable[[], Records]:
    """dynamax's filter on these inputs: NEES of the pose in its coordinates, and the covariance."""
    dynamax: Any = importlib.import_module("dynamax.nonlinear_gaussian_ssm")
    slam, seconds = inputs.slam, jnp.asarray(inputs.seconds)
    m = inputs.pixels.shape[2]
    Q, R = _noise(slam, m)
    wanted = ["predicted_means", "predicted_covariances"]

    def run(mean, P, pixels, truth):
        f, h = partial(_composed, slam, seconds), partial(_measured, slam, seconds)
        model = dynamax.ParamsNLGSSM(mean, P, f, Q, h, R)
        found = dynamax.extended_kalman_filter(model, pixels, output_fields=wanted)
        errors = found.predicted_means[:, :3] - truth
        errors = errors.at[:, 2].set(jnp.arctan2(jnp.sin(errors[:, 2]), jnp.cos(errors[:, 2])))
        poses = found.predicted_covariances[:, :3, :3]
        nees = jnp.einsum("ki,ki->k", errors, jnp.linalg.solve(poses, errors[..., None])[..., 0])
        return nees, found.predicted_covariances[-1]

    data = _prepared(inputs, Q)
    compiled = jax.jit(jax.vmap(run)).lower(*data).compile()
    keep = np.r_[:6, 11 : 11 + 3 * m]

    def call() -> Records:
        nees, covariance = jax.block_until_ready(compiled(*data))
        return np.asarray(nees), np.asarray(covariance[:, keep[:, None], keep])

    return call


def _parts(state):
    """Pose (t, θ), velocity, acceleration, calibration's error, landmarks."""
    pose, v, a, calibration, landmarks = jnp.split(state, [3, 6, 9, 11])
    return pose, v, a, calibration, landmarks.reshape(-1, 3)


def _pose(vector):
    return joined(exp(PLANAR.rotation_group, vector[2:]), vector[:2])


def _vector(pose):
    return jnp.append(pose.translation(), pose.rotation().log())


def _composed(slam, seconds, state):
    pose, v, a, calibration, landmarks = _parts(state)
    moved = slam.motion.displacement(v, a, seconds).inverse()
    landmarks = jax.vmap(partial(slam.landmark.transform, moved))(landmarks)
    v = slam.motion.next(v, a, seconds)
    zero = jnp.zeros_like(a), jnp.zeros_like(calibration)
    return jnp.concatenate([_vector(moved @ _pose(pose)), v, *zero, landmarks.ravel()])


def _measured(slam, seconds, state):
    _, v, a, calibration, landmarks = _parts(state)
    moved = slam.motion.displacement(v, a, seconds).inverse()
    sensor = slam.calibration.sensor(slam.sensor, calibration)

    def pixel(landmark):
        return sensor.measure(*slam.landmark.homogeneous(slam.landmark.transform(moved, landmark)))

    return jax.vmap(pixel)(landmarks).ravel()


def _noise(slam, m: int):
    a, c = (jnp.asarray(x) ** 2 for x in (slam.motion.noise_sigma, slam.calibration.sigma))
    Q = block_diag(jnp.zeros((6, 6)), jnp.diag(a), jnp.diag(c), jnp.zeros((3 * m, 3 * m)))
    return Q, jnp.kron(jnp.eye(m), jnp.asarray(slam.sensor.noise))


def _prepared(inputs: Inputs, Q):
    """Start, covariance with the first step's noise, pixels and true poses, of every run."""
    start, index = inputs.start, kept(inputs.slam, inputs.start)
    poses = jax.vmap(_vector)(start.core.pose)
    runs = len(poses)
    zero = jnp.zeros((runs, 5))
    landmarks = start.landmarks.reshape(runs, -1)
    mean = jnp.concatenate([poses, start.core.motion, zero, landmarks], axis=1)
    places = np.r_[:6, 11 : mean.shape[1]]
    P = (
        jnp.zeros((runs, *Q.shape))
        .at[:, places[:, None], places]
        .set(start.covariance[:, index[:, None], index])
    )
    truth = jax.vmap(jax.vmap(lambda T: _vector(T.inverse())))(inputs.poses)
    return mean, P + Q, jnp.asarray(inputs.pixels.reshape(*inputs.pixels.shape[:2], -1)), truth
