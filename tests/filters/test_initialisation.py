"""Tests of delayed initialisations: depth particles and Gaussian-sum rays, in a planar world."""

from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from cases import quick_jit

from jaxslam.filters.readouts import landmarks_in_camera
from jaxslam.filters.rivals.depth_particles import DepthParticles
from jaxslam.filters.rivals.rays import RaySum
from jaxslam.filters.words import make_filter
from jaxslam.landmarks import Cartesian
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features
from jaxslam.models.sensors import Pinhole

FOCAL, CENTRE, SIGMA = 650.0, 320.0, 0.5
DT, SPEED = 0.1, 0.4


def pixels(*values, valid=True):
    """One feature a value, of landmarks 0, 1, …"""
    count = len(values)
    slots, measured = jnp.arange(count), jnp.asarray(values)[:, None]
    return Features(slots, measured, jnp.full(count, valid))


NONE = pixels(0.0, valid=False)


def plain(base, motion_sigma=0.0, speed=SPEED, speed_sigma=0.0, depth=(0.2, 0.1)):
    """A camera that moves along x, with a velocity that is known unless said."""
    return make_filter(
        base,
        landmark=Cartesian(),
        motion=ConstantVelocity([motion_sigma] * 3, [speed, 0.0, 0.0], [speed_sigma] * 3),
        sensor=Pinhole(Camera([FOCAL], [CENTRE]), SIGMA),
        depth=InverseDepth(*depth),
    )


def the_filter(base, word, **numbers):
    """With a delayed initialisation of that word, which has these numbers; others are `plain`'s."""
    own = {name: numbers.pop(name) for name in list(numbers) if name in RIVALS}
    return replace(plain(f"{base}+{word}", **numbers), **own)


RIVALS = {piece.name for rival in (DepthParticles, RaySum) for piece in fields(rival)}


def begun(slam, first):
    """The state after frame 0, and a compiled step."""
    return quick_jit(partial(slam.init, first.slots.size))(first), quick_jit(
        lambda *x: slam.step(*x)
    )


def seen_at(depth, bearing, step):
    """The pixel of the point at that depth on the ray of frame 0."""
    return FOCAL * (bearing - step * SPEED * DT / depth) + CENTRE


def test_particles_are_the_posterior_of_depth_when_camera_and_ray_are_known():
    slam, bearing = the_filter("world", "particles", count=40, agreement=1e-6), 0.2
    state, step = begun(slam, pixels(FOCAL * bearing + CENTRE))
    known = jnp.zeros_like(state.gaussian.covariance)
    state = replace(state, gaussian=replace(state.gaussian, covariance=known))
    noise = np.array([0.4, -0.7, 0.1])
    measured = np.array([seen_at(2.1, bearing, k + 1) for k in range(3)]) + noise

    for u in measured:
        state, _ = step(state, DT, pixels(u), NONE)

    distances = np.linspace(0.5, 5.0, 40)
    depths = distances / np.hypot(1.0, bearing)
    predicted = np.array([seen_at(depths, bearing, k + 1) for k in range(3)])
    likelihood = np.exp(-(((measured[:, None] - predicted) / SIGMA) ** 2).sum(axis=0) / 2)
    np.testing.assert_allclose(
        state.weights[0], likelihood / likelihood.sum(), rtol=1e-6, atol=1e-12
    )


def test_a_pending_ray_does_not_change_the_camera():
    numbers = {"motion_sigma": 0.1, "speed_sigma": 0.02}
    slam = the_filter("robocentric", "particles", agreement=1e-6, **numbers)
    state, step = begun(slam, pixels(400.0))
    c = state.gaussian.core_dim
    seen = pixels(395.0)
    with_ray, innovation = step(state, DT, seen, NONE)
    without, _ = step(state, DT, replace(seen, valid=~seen.valid), NONE)
    assert not np.allclose(with_ray.weights, without.weights)
    assert innovation.nis == 0
    one, other = with_ray.gaussian, without.gaussian
    jax.tree.map(np.testing.assert_array_equal, one.core, other.core)
    np.testing.assert_array_equal(one.covariance[:c, :c], other.covariance[:c, :c])


def is_point(state):
    return state.gaussian.landmarks[:, -1] == 1


def test_a_ray_becomes_a_point_with_the_mean_and_variance_of_its_particles():
    slam, bearing = the_filter("robocentric", "particles", count=40, speed=0.0), 0.2
    state, step = begun(slam, pixels(FOCAL * bearing + CENTRE))
    assert not is_point(step(state, DT, NONE, NONE)[0]).any()

    distances = np.linspace(0.5, 5.0, 40)
    weights = np.exp(-(((distances - 2.0) / 0.3) ** 2) / 2)
    weights /= weights.sum()
    state = replace(state, weights=jnp.asarray(weights)[None])
    state, _ = step(state, DT, NONE, NONE)
    assert is_point(state).all()

    mean = weights @ distances
    variance = weights @ (distances - mean) ** 2 + (distances[1] - distances[0]) ** 2 / 12
    ray = np.array([bearing, 1.0]) / np.hypot(1.0, bearing)
    across = mean * SIGMA / FOCAL / (1 + bearing**2) * np.array([ray[1], -ray[0]])
    wanted = variance * np.outer(ray, ray) + np.outer(across, across)
    one = state.gaussian
    start, d = one.core_dim, one.landmarks.shape[1]
    np.testing.assert_allclose(one.landmarks[0, :2], mean * ray, rtol=1e-12)
    own = one.covariance[start:, start:]
    np.testing.assert_allclose(own[:2, :2], wanted, rtol=1e-9, atol=1e-15)
    assert not np.any(own[2:d]), "the numbers of the other form are constants"


def test_a_pending_ray_is_reported_with_the_moments_of_inverse_depth():
    slam = the_filter("world", "particles", count=40)
    state, _ = begun(slam, pixels(CENTRE))

    @quick_jit
    def in_camera(state):
        return landmarks_in_camera(slam, state, jnp.arange(1), slam.model.sensor)

    chart, covariance = in_camera(state)
    inverse = 1 / np.linspace(0.5, 5.0, 40)
    np.testing.assert_allclose(chart[0], [0.0, inverse.mean()], atol=1e-12)
    np.testing.assert_allclose(covariance[0, 1, 1], inverse.var(), rtol=1e-12)


def test_a_ray_that_no_particle_explains_is_dropped():
    slam = the_filter("world", "particles", count=40)
    state, step = begun(slam, pixels(CENTRE))
    state, _ = step(state, DT, pixels(CENTRE + 60), NONE)
    assert not state.gaussian.active.any()
    assert not state.gaussian.covariance.any()


THREE = {"nearest": 1.0, "farthest": 15.0}
"""The range of a ray of three members."""


def test_members_are_weighed_by_bayes_rule():
    slam, bearing = the_filter("robocentric", "rays", **THREE, threshold=0.0), 0.2
    state, step = begun(slam, pixels(FOCAL * bearing + CENTRE))
    measured = seen_at(4.0, bearing, 1) + 0.3
    state, _ = step(state, DT, pixels(measured), NONE)

    s = np.array([1 / 0.7, 3 / 0.7, 9 / 0.7])
    predicted = seen_at(s, bearing, 1)
    # The pixel of frame 0 moves a point across; depth moves it along its ray.
    by_pixel, by_depth = 1.0, FOCAL * SPEED * DT / s**2
    variance = by_pixel * SIGMA**2 + (by_depth * 0.3 * s) ** 2 + SIGMA**2
    likelihood = np.exp(-((measured - predicted) ** 2) / variance / 2) / np.sqrt(variance)
    np.testing.assert_allclose(state.weights[0], likelihood / likelihood.sum(), rtol=1e-9)


def test_unlikely_members_are_pruned_until_one_is_left():
    slam = the_filter("world", "rays", **THREE)
    state, step = begun(slam, pixels(CENTRE))
    assert state.gaussian.active.sum() == slam.slots_each == 3
    for k in range(1, 5):
        measured = seen_at(3 / 0.7, 0.0, k)
        state, _ = step(state, DT, pixels(measured), NONE)
    one = state.gaussian
    np.testing.assert_array_equal(one.active, [False, True, False])
    np.testing.assert_array_equal(state.weights[0], [0.0, 1.0, 0.0])
    first, left, last = np.split(np.asarray(one.covariance)[one.core_dim :], 3)
    assert left.any()
    assert not first.any(), "a pruned member leaves nothing"
    assert not last.any(), "a pruned member leaves nothing"
    reported = slam.collapsed(state)
    np.testing.assert_array_equal(reported.landmarks[0], one.landmarks[1])
    np.testing.assert_array_equal(reported.covariance[-2:, -2:], left[:, -4:-2])


def test_one_member_is_the_plain_filter():
    depth = 1.4 / 0.7
    numbers = dict(motion_sigma=0.1, speed_sigma=0.05, depth=(1 / depth, 0.3 / depth))
    single, states = the_filter("robocentric", "rays", nearest=1.4, farthest=1.5, **numbers), []
    assert single.slots_each == 1
    for slam in (plain("robocentric", **numbers), single):
        state, step = begun(slam, pixels(330.0, 250.0))
        for u in (320.0, 309.0):
            state, _ = step(state, DT, pixels(u, u - 80), NONE)
        states.append(getattr(state, "gaussian", state))
    for one, other in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)


def test_every_member_has_the_noise_of_its_measurement():
    """A noise factor of the sensor's is one of each member's share too."""
    twice = replace(pixels(330.0), noise_factor=jnp.array([4.0]))
    slam = the_filter("world", "rays", **THREE)
    factors = slam._of_members(twice, jnp.array([[0.5, 0.25, 0.25]])).noise_factor
    np.testing.assert_allclose(factors, [8.0, 16.0, 16.0])
