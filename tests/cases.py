"""What the core's tests share: quick compilation, central differences, poses, filter runs.

Exactly equal is only what no processor can round: what is copied, set or masked, sums with zero,
one addition, and one compiled program on the same numbers. Whatever is computed in two ways, or by
two programs (one may contract `a b + c`, or vectorise), has a bound, and never one that is relative
alone where zero is expected.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxslam.filters.protocol import AbstractFilter, AbstractStaged
from jaxslam.filters.readouts import camera_pose
from jaxslam.filters.slam import Slam
from jaxslam.filters.window.record import Record
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import GEOMETRIES
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.camera import Camera
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.sensors import Pinhole
from jaxslam.simulation import Room, features, scenario, sightings, simulate

each_geometry = list(GEOMETRIES.values())
each_landmark = list(LANDMARKS.values())
FALSE_ALARM = 1e-6
"""Share of seeds on which a statistical test would fail although nothing is wrong."""


def quick_rows(count, rows):
    """So many of the rows of a parametrization; the others are slow, as they would find a fault of
    theirs alone."""
    others = (x if type(x) is tuple else (x,) for x in rows[count:])
    return [*rows[:count], *(pytest.param(*x, marks=pytest.mark.slow) for x in others)]


def standard_normal(numbers):
    """Have independent numbers the variance and the mean of standard normal ones, but for
    FALSE_ALARM?"""
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], numbers.size)
    assert low < np.sum(np.square(numbers)) < high
    centred(numbers)


def centred(numbers):
    assert abs(numbers.mean()) * np.sqrt(numbers.size) < stats.norm.isf(FALSE_ALARM / 2)


def named(value):
    """Test ids for geometries, parametrizations and frames."""
    return getattr(value, "name", None)


@cache
def quick_options():
    """The compiler options of XLA's that this version of it knows."""
    options = {
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
        "xla_cpu_use_fusion_emitters": False,
        "xla_cpu_parallel_codegen_split_count": 1,
    }
    known = {}
    for name, value in options.items():
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except RuntimeError:  # "No such compile option"
            continue
        known[name] = value
    return known


def quick_jit(function):
    """`jax.jit` for tests, which compile much and compute little: a third of the time."""
    return jax.jit(function, compiler_options=quick_options())


def simulated(chosen, seed=0):
    """A run of a scenario, in one program: op by op it is hundreds of them."""
    return quick_jit(partial(simulate, chosen))(jax.random.key(seed))


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


def a_filter(geometry, landmark=None, frame=None, **pieces):
    """A filter for what its numbers do not matter to: no noise, and a unit camera, so that its
    Jacobians are of the same size as the rest; the paper's, or of other pieces."""
    t, p = geometry.tangent_dim, geometry.pixel_dim
    unit: dict[str, Any] = {
        "motion": ConstantVelocity(*np.zeros((3, t))),
        "sensor": Pinhole(Camera(np.ones(p), np.zeros(p)), 0.0),
    }
    given = {"landmark": landmark, "frame": frame}
    given = {name: piece for name, piece in given.items() if piece is not None}
    return Slam(**{**unit, **given, **pieces})


def run_filter(capacity, slam, controls, first, known, new):
    """A whole run; the poses, covariances and NIS of every step, and the last state."""
    state = slam.init(capacity, first)

    def step(state, frame):
        state, innovation = slam.step(state, *frame)
        pose, pose_covariance = camera_pose(slam, state)
        whole = getattr(state, "covariance", None)  # which a Gaussian sum has for each member
        return state, (pose, pose_covariance, whole, innovation.nis)

    return jax.lax.scan(step, state, (controls, known, new))


class Case:
    """A scenario, `runs` simulated runs, their features, and a filter compiled for them."""

    def __init__(self, name, runs=1, seed=0, **fields):
        self.scenario = scenario(name, fields)
        chosen = self.scenario

        def draw(indices):
            keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(seed), i))(indices)
            drawn = jax.vmap(lambda key: simulate(chosen, key))(keys)
            return drawn, jax.tree.map(jnp.max, jax.vmap(sightings)(drawn))

        self.runs, most = quick_jit(draw)(jnp.arange(runs))
        most = jax.tree.map(int, most)
        self.room = Room(most.landmarks, most.first, most.known, most.new)
        self.capacity = most.landmarks
        self.features = quick_jit(jax.vmap(lambda run: features(run, self.room)))(self.runs)

    def run(self, i):
        return jax.tree.map(lambda x: x[i], self.runs)

    def pieces(self, calibration=None):
        """Motion, sensor, calibration and depth prior of the scenario, as `Slam` takes them."""
        return scenario_pieces(self.scenario, calibration)

    def controls(self, i=0):
        return jax.tree.map(lambda x: x[i], self.runs.controls)

    def filter(self, name, landmark="inverse_scaling", calibration=None):
        """A filter by its name, modifiers and all, with the scenario's numbers."""
        return make_filter(name, landmark=LANDMARKS[landmark], **self.pieces(calibration))

    @cache  # noqa: B019 - cases live as long as the tests
    def compiled(self, name, landmark="inverse_scaling", calibration=None):
        """`(controls, first, known, new) → run` of such a filter; see `run_filter`."""
        slam = self.filter(name, landmark, calibration)
        return quick_jit(partial(run_filter, self.capacity, slam))

    def frames(self, i):
        """Features of run i: first, known, new."""
        return jax.tree.map(lambda x: x[i], self.features)


def keys_used(monkeypatch, function):
    """What a function gives, and the data of every key that it draws from or splits."""
    found, data = [], jax.random.key_data

    def recorded(use):
        def used(key, *arguments, **options):
            jax.debug.callback(lambda key: found.append(tuple(key.tolist())), data(key))
            return use(key, *arguments, **options)

        return used

    with monkeypatch.context() as patch:
        for name in ("split", "normal", "uniform", "truncated_normal", "bernoulli"):
            patch.setattr(jax.random, name, recorded(getattr(jax.random, name)))
        value = jax.block_until_ready(function())
        jax.effects_barrier()
    return value, found


class FourFunctions(AbstractFilter):
    """A filter of no more functions than a study needs, which asks another; with something that is
    done to the result of a step."""

    estimator: AbstractFilter
    done: Callable[[Any], Any] = lambda result: result

    def init(self, capacity, first=None, known=None):
        return self.estimator.init(capacity, first, known)

    def step(self, state, control, seen, new):
        return self.done(self.estimator.step(state, control, seen, new))

    def marginal(self, state, function):
        return self.estimator.marginal(state, function)

    def landmark_marginal(self, state, function, slots):
        return self.estimator.landmark_marginal(state, function, slots)


class Around(AbstractStaged):
    """A filter that the package does not know, with a state of its own: it asks another."""

    estimator: Slam

    def init(self, capacity, first=None, known=None):
        inside = self.estimator.init(capacity, first, known)
        return {"inside": inside, "frame": jnp.zeros((), int)}

    def predict(self, state, control):
        return state | {"inside": self.estimator.predict(state["inside"], control)}

    def predict_features(self, state, control, slots):
        return self.estimator.predict_features(state["inside"], control, slots)

    def update(self, state, control, seen):
        inside, innovation = self.estimator.update(state["inside"], control, seen)
        return state | {"inside": inside}, innovation

    def compose(self, state, control):
        return state | {"inside": self.estimator.compose(state["inside"], control)}

    def close(self, state, new):
        return {"inside": self.estimator.close(state["inside"], new), "frame": state["frame"] + 1}

    def remove(self, state, gone):
        return state | {"inside": self.estimator.remove(state["inside"], gone)}

    def marginal(self, state, function):
        return self.estimator.marginal(state["inside"], function)

    def landmark_marginal(self, state, function, slots):
        return self.estimator.landmark_marginal(state["inside"], function, slots)

    def in_map(self, state):
        return self.estimator.in_map(state["inside"])


def whole_record(controls, measured, seen, first):
    """The record of a window whose frames all moved and whose noise is alike."""
    steps = len(seen) - 1
    ones, no = jnp.ones(steps, measured.dtype), jnp.zeros(steps, bool)
    moved, alike = jnp.zeros((), bool), jnp.ones(seen.shape, measured.dtype)
    return Record(jnp.asarray(steps), controls, ones, no, moved, measured, alike, seen, first)
