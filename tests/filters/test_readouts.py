"""Tests of what is read from a state in its own unit, and of the side on which landmarks are."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from cases import Case, quick_jit

from jaxslam.filters.readouts import landmark_samples, landmarks_on_sides

STEPS, COUNT = 4, 6


@cache
def case():
    return Case("matched-6dof-loose", steps=STEPS, landmarks=COUNT)


@cache
def begun():
    """A filter and its state of the first frame."""
    slam = case().filter("robocentric")
    return slam, quick_jit(partial(slam.init, case().capacity))(case().frames(0)[0])


def test_landmarks_are_surely_in_front_surely_behind_or_neither():
    (slam, state), slots = begun(), jnp.arange(COUNT)
    omega = state.landmarks[:, 3]
    d, c = state.landmarks.shape[1], state.core_dim
    own = c + d * np.arange(COUNT) + 3
    sure = state.covariance.at[own, own].set(1e-6 * omega**2)
    sides = quick_jit(lambda state: landmarks_on_sides(slam, state, slots))
    assert [int(n) for n in sides(state)] == [0, 0]
    assert [int(n) for n in sides(replace(state, covariance=sure))] == [COUNT, 0]
    turned = state.landmarks.at[:2, 3].set(-omega[:2])
    turned = replace(state, covariance=sure, landmarks=turned)
    assert [int(n) for n in sides(turned)] == [COUNT - 2, 2]


def test_draws_of_a_landmark_have_its_own_moments():
    """Of x, y and ω in the camera, which are linear in the state; each landmark has another σ."""
    (slam, state), slots, count = begun(), jnp.array([1, 4]), 20_000
    own = state.core_dim + state.landmarks.shape[1] * np.arange(COUNT) + 3
    wider = state.covariance.at[own, own].multiply(np.arange(1.0, COUNT + 1))
    state = replace(state, covariance=wider)

    def seen(view):
        return jnp.append(view.point[:2], view.omega)

    def run(state, key):
        draws = landmark_samples(slam, state, slots, key, count, seen)
        return draws, slam.landmark_marginal(state, seen, slots)

    draws, (means, covariances) = quick_jit(run)(state, jax.random.key(0))
    for sample, mean, covariance in zip(*map(np.asarray, (draws, means, covariances)), strict=True):
        sigma = np.sqrt(np.diagonal(covariance))
        off = (sample.mean(axis=0) - mean) / sigma
        np.testing.assert_allclose(off, 0, atol=5 / np.sqrt(count))
        scatter, scale = np.cov(sample.T), np.outer(sigma, sigma)
        np.testing.assert_allclose((scatter - covariance) / scale, 0, atol=5 * np.sqrt(2 / count))
