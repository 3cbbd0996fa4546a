"""Tests of the noise that is found while the filter runs."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit
from scipy.stats import multivariate_normal

from jaxslam.consistency import run_through
from jaxslam.filters.wrappers.adaptive_process_noise import (
    FACTORS,
    AdaptiveProcessNoise,
    _foreseen,
    _heard,
    _told,
)
from jaxslam.models.motion import ConstantVelocity

RUNS, STEPS = 16, 50


@cache
def world():
    return Case("matched-loose", RUNS, steps=STEPS)


@cache
def octaves(told):
    """Mean and σ of log₂ of the linear and angular factor after every frame of all runs, of a
    filter that is told so many times the σ with which the worlds move."""
    of = world()
    slam = of.filter("scale_gauge+noise")
    assert isinstance(slam, AdaptiveProcessNoise)
    sigma = told * np.asarray(slam.base.motion.noise_sigma)
    slam = eqx.tree_at(lambda slam: slam.base.motion.noise_sigma, slam, sigma)

    def believed(state, innovation, frame):
        weights, octave = jnp.exp(state.log_weights), jnp.log2(jnp.asarray(FACTORS))
        mean = weights @ octave
        return mean, jnp.sqrt(weights @ octave**2 - mean**2)

    through = jax.vmap(lambda run: run_through(slam, of.room, run, believed)[1])
    return tuple(np.asarray(x) for x in quick_jit(through)(of.runs))


@pytest.mark.parametrize("told", [0.25, 1.0, 4.0])
def test_the_true_noise_is_found_whatever_was_told(told):
    """Within what is believed of it, and a quarter of an octave of prior that is left."""
    mean, sigma = (x[:, -1] for x in octaves(told))
    wrong = mean + np.log2(told)
    standard = wrong.std(axis=0) / np.sqrt(RUNS)
    assert (np.abs(wrong.mean(axis=0)) < 3 * standard + 0.25).all()
    assert (sigma.mean(axis=0) < 1.0).all()
    assert (wrong.std(axis=0) < 2 * sigma.mean(axis=0)).all()


def test_before_the_motion_shows_it_the_noise_is_as_wide_as_the_prior():
    _, sigma = octaves(1.0)
    assert (sigma[:, 0] > 1.3).all()


def chain(steps=30, factor=4.0, seed=2):
    """A velocity driven by noise of a known size, and measured directly."""
    draw = np.random.default_rng(seed)
    motion = ConstantVelocity([0.5, 0.5, 0.2], np.zeros(3), [1.0, 1.0, 1.0])
    noise = factor * motion.noise_sigma * draw.standard_normal((steps, 3))
    velocity = np.cumsum(noise * 0.1, axis=0)
    R = np.diag([0.05, 0.1, 0.02]) ** 2
    return motion, velocity + draw.multivariate_normal(np.zeros(3), R, steps), R


def kalman(motion, factor, measured, R):
    """Log likelihood of all measurements, and the filter's means and covariances."""
    v, V, total = np.zeros(3), np.eye(3), 0.0
    before, after = [], []
    for z in measured:
        V = V + np.diag(factor * motion.noise_sigma * 0.1) ** 2
        before.append((v, V))
        total += multivariate_normal(v, V + R).logpdf(z)
        K = V @ np.linalg.inv(V + R)
        v, V = v + K @ (z - v), V - K @ V
        after.append((v, V))
    return total, before, after


def test_where_the_velocity_is_measured_weights_are_the_evidence_of_whole_filters():
    """The filter that tells of it has a noise of its own, which does not matter."""
    motion, measured, R = chain()
    _, before, after = kalman(motion, 0.5, measured, R)
    totals = []

    @quick_jit
    def heard(factor, v, V, before, after):
        return _heard(_told(before, after), *_foreseen(motion, 0.1, factor, v, V))

    for factor in (0.5, 4.0):
        v, V, total = jnp.zeros(3), jnp.eye(3), 0.0
        for both in zip(before, after, strict=True):
            evidence, v, V = heard(factor, v, V, *jax.tree.map(jnp.asarray, both))
            total += evidence
        whole, _, expected = kalman(motion, factor, measured, R)
        np.testing.assert_allclose(v, expected[-1][0], rtol=1e-6)
        np.testing.assert_allclose(V, expected[-1][1], atol=1e-12)
        totals.append((total, whole))
    (few, few_whole), (many, many_whole) = totals
    np.testing.assert_allclose(many - few, many_whole - few_whole, rtol=1e-6)
    assert many - few > 5


def test_an_update_that_told_nothing_changes_nothing():
    v, V = jnp.array([1.0, 2.0, 3.0]), jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    told = _told((v, V), (v, V))
    assert not told.information.any()
    _, now, covariance = _heard(told, v + 1, 2 * V)
    np.testing.assert_allclose(now, v + 1, rtol=1e-12)
    np.testing.assert_allclose(covariance, 2 * V, rtol=1e-12)


def test_the_filter_goes_on_with_the_root_of_the_mean_variance():
    slam = world().filter("scale_gauge+noise")
    state = slam.init(world().capacity)
    weights = np.zeros((2, FACTORS.size))
    weights[0, [4, 6]], weights[1, 2] = 0.5, 1.0
    with np.errstate(divide="ignore"):
        state = replace(state, log_weights=jnp.log(jnp.asarray(weights)))
    sigma = slam.fitted(state).motion.noise_sigma / slam.base.motion.noise_sigma
    np.testing.assert_allclose(sigma, [np.sqrt(8.5)] * 2 + [0.25], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scale_gauge+noise0", "1 frame at least, not 0"),
        ("robocentric+lag3+noise", "takes a frame in stages, which FixedLag does not"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_has_no_noise_to_fit_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        world().filter(name)


@pytest.mark.usefixtures("unchecked")
def test_odometry_is_refused():
    of = Case("matched", 1, steps=1, motion="odometry")
    with pytest.raises(ValueError, match="noise fitted is of a velocity, which Odometry lacks"):
        of.filter("robocentric+noise")
