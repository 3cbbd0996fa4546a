"""Tests of what is read from a state in its own unit, and of the side on which landmarks are."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

from jaxslam.filters.mixture.sum_state import SumState
from jaxslam.filters.readouts import (
    camera_pose,
    camera_pose_in_unit,
    landmark_samples,
    landmarks_in_unit,
    landmarks_in_world,
    landmarks_on_sides,
)

STEPS, COUNT = 4, 6


@cache
def case():
    return Case("matched-6dof-loose", steps=STEPS, landmarks=COUNT)


@cache
def begun():
    """A filter and its state of the first frame."""
    slam = case().filter("robocentric")
    return slam, quick_jit(partial(slam.init, case().capacity))(case().frames(0)[0])


@cache
def said(name, unit=None):
    """Pose and landmarks of the last frame, with and without the scale, in a metre so uncertain."""
    of = case()
    slam = of.filter(name)
    slam = replace(slam, depth=replace(slam.depth, unit=unit))
    slots = jnp.arange(COUNT)

    def run(first, known, new, controls):
        state = slam.init(of.capacity, first)
        for k in range(STEPS):
            at = jax.tree.map(lambda x, k=k: x[k], (known, new))
            state, _ = slam.step(state, controls[k], *at)
        return (
            camera_pose(slam, state)[1],
            (camera_pose_in_unit(slam, state)[1], camera_pose_in_unit(slam, state)[3]),
            landmarks_in_world(slam, state, slots)[1],
            landmarks_in_unit(slam, state, slots)[1],
            state,
        )

    return quick_jit(run)(*of.frames(0), of.controls())


@pytest.mark.slow
def test_in_the_unit_nothing_depends_on_what_is_known_of_the_metre():
    metric, (given, variance), points, points_given, _ = said("scale_gauge")
    wide, (same, wider), wide_points, same_points, _ = said("scale_gauge", 1.0)
    np.testing.assert_allclose(same, given, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(same_points, points_given, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(wider - variance, 1.0, rtol=1e-9)
    assert np.trace(wide) > 2 * np.trace(metric)
    assert np.all(np.trace(wide_points, axis1=1, axis2=2) > np.trace(points, axis1=1, axis2=2))


def wandered(state, by):
    """A state whose unit is taken for so many times e longer: nothing else is another."""
    core = state.core
    return replace(state, core=replace(core, log_scale=core.log_scale.at[0].add(by)))


@quick_jit
def in_unit(state):
    slam, slots = case().filter("scale_gauge"), jnp.arange(COUNT)
    metric = camera_pose(slam, state)[0].translation()
    return camera_pose_in_unit(slam, state), landmarks_in_unit(slam, state, slots), metric


@pytest.mark.slow
def test_what_the_filter_makes_of_the_metre_changes_nothing_in_its_unit():
    state = said("scale_gauge")[4]
    (before, points, metric), (after, same, larger) = in_unit(state), in_unit(wandered(state, 0.7))
    np.testing.assert_allclose(after.pose.as_matrix(), before.pose.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-9, atol=1e-15)
    for one, other in zip(same, points, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    assert float(after.log_scale - before.log_scale) == pytest.approx(0.7, rel=1e-12)
    np.testing.assert_allclose(larger, np.exp(0.7) * metric, rtol=1e-9)
    unit = np.exp(before.log_scale) * before.pose.translation()
    np.testing.assert_allclose(unit, metric, rtol=1e-9)


@pytest.mark.slow
def test_members_that_differ_about_the_metre_agree_about_the_path_in_their_unit():
    """A Gaussian sum: moments are of the pose in the unit, not of the pose in metres."""
    state, bank = said("scale_gauge")[4], case().filter("scale_gauge+mixture3")
    away = jnp.array([-0.6, 0.0, 0.6])
    members = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(wandered(state, by) for by in away))
    both = SumState(members, jnp.log(jnp.array([0.25, 0.5, 0.25])))
    one = in_unit(state)[0]
    summed = quick_jit(lambda state: camera_pose_in_unit(bank, state))(both)
    np.testing.assert_allclose(summed.pose.as_matrix(), one.pose.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(summed.covariance, one.covariance, rtol=1e-9, atol=1e-15)
    spread = summed.log_scale_variance - one.log_scale_variance
    assert float(spread) == pytest.approx(0.18, rel=1e-9)  # (0.6² + 0.6²)/4


@pytest.mark.slow
def test_of_a_filter_in_metres_the_scale_takes_nothing_away():
    metric, (given, variance), points, points_given, _ = said("robocentric")
    np.testing.assert_allclose(given, metric, rtol=0, atol=1e-15)
    np.testing.assert_allclose(points_given, points, rtol=0, atol=1e-12)
    assert variance == 0


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
