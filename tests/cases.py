"""What the tests of the core share: quick compilation, central differences, poses and filter runs."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filters import FILTERS, Parameters
from jaxslam.geometry import GEOMETRIES
from jaxslam.landmarks import LANDMARKS
from jaxslam.simulation import features, parameters, scenario, sightings, simulate

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Tests compile much and compute little: without optimisation they take half the time."""

each_geometry = list(GEOMETRIES.values())
each_landmark = list(LANDMARKS.values())


def named(value):
    """Test ids for geometries, parametrizations and frames."""
    return getattr(value, "name", None)


def quick_jit(function):
    return jax.jit(function, compiler_options=QUICK)


def central(function, x, step=1e-6):
    """Jacobian by central differences: wrong by O(step²) and by rounding of about 1e-16/step.

    The step is relative to coordinates that are larger than 1, such as pixels.
    """
    steps = step * np.maximum(1.0, np.abs(x))
    columns = [
        (function(x + d) - function(x - d)) / (2 * s)
        for s, d in zip(steps, np.diag(steps), strict=True)
    ]
    return np.stack(columns, axis=-1)


def pose(geometry, seed, scale=0.3):
    """A pose away from the identity, the same for the same seed."""
    tangent = scale * np.random.default_rng(seed).uniform(-1, 1, geometry.tangent_dim)
    return geometry.group.exp(jnp.asarray(tangent))


def close(actual, desired, relative):
    """Equal within `relative` of the largest entry: entries of one matrix share their rounding."""
    desired = np.asarray(desired)
    np.testing.assert_allclose(actual, desired, rtol=0, atol=relative * np.abs(desired).max())


def run_filter(slam, chosen, capacity, parameters, first, known, new):
    """A whole run; the errors, covariances and NIS of every step, and the last state."""
    dtype = parameters.pixel_sigma.dtype
    state = slam.start(
        parameters,
        capacity,
        jnp.asarray(chosen.velocity, dtype),
        jnp.asarray(chosen.velocity_sigma, dtype),
    )
    state = slam.first(state, parameters, first)
    dt = jnp.asarray(1 / chosen.rate, dtype)

    def step(state, frame):
        state, innovation = slam.step(state, parameters, dt, *frame)
        pose, pose_covariance = slam.camera_pose(state)
        return state, (pose, pose_covariance, state.covariance, innovation.nis)

    return jax.lax.scan(step, state, (known, new))


class Case:
    """A scenario, `runs` simulated runs, their features, and a filter compiled for them."""

    def __init__(self, name, runs=1, seed=0, **fields):
        self.scenario = scenario(name, fields)
        keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(seed), i))(jnp.arange(runs))
        chosen = self.scenario
        self.runs = quick_jit(jax.vmap(lambda key: simulate(chosen, key)))(keys)
        most = jax.tree.map(lambda x: int(x.max()), jax.vmap(sightings)(self.runs))
        self.capacity = most.landmarks
        self.features = quick_jit(jax.vmap(lambda run: features(run, most)))(self.runs)

    def run(self, i):
        return jax.tree.map(lambda x: x[i], self.runs)

    def parameters(self, dtype=None) -> Parameters:
        return parameters(self.scenario, dtype)

    def function(self, slam):
        """`(parameters, first, known, new) → run`, to be compiled and mapped."""
        return lambda *data: run_filter(slam, self.scenario, self.capacity, *data)

    def filter(self, kind, landmark, calibration=None):
        calibration = calibration or self.scenario.calibration
        return FILTERS[kind](self.scenario.world, LANDMARKS[landmark], calibration)

    @lru_cache(maxsize=None)  # noqa: B019 - cases live as long as the tests
    def compiled(self, kind, landmark, calibration=None):
        return quick_jit(self.function(self.filter(kind, landmark, calibration)))

    def frames(self, i):
        """Features of run i: first, known, new."""
        return jax.tree.map(lambda x: x[i], self.features)
