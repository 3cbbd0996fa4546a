"""The scale gauge: (λ, ṽ, ω̃) with v = e^λ ṽ and ω = e^−λ ω̃ say what the prior on v and ω says."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

from jaxslam.filters.readouts import camera_pose
from jaxslam.models.scale import ScaleGauge, velocity_in_gauge


def moments_of_products(mean, covariance, powers):
    """Mean and covariance of `x_i e^(p_i λ)`, x Gaussian and λ the last of it, in closed form."""
    mean, C, p = (np.asarray(x, float) for x in (mean, covariance, powers))
    c, s = C[-1], p[:, None] + p
    first = (mean + p * c) * np.exp(p * mean[-1] + p**2 * c[-1] / 2)
    both = (mean[:, None] + s * c[:, None]) * (mean + s * c) + C
    return first, both * np.exp(s * mean[-1] + s**2 * c[-1] / 2) - np.outer(first, first)


def velocity_and_scale(mean, covariance, n):
    """Moments of the n + m numbers of the velocity, in metres, and of λ."""
    return moments_of_products(mean, covariance, np.arange(len(mean)) < n)


def assert_moments(found, mean, covariance, bound):
    """In σ, and in products of them."""
    sigma = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose((found[0] - mean) / sigma, 0, atol=bound)
    np.testing.assert_allclose((found[1] - covariance) / np.outer(sigma, sigma), 0, atol=bound)


@pytest.mark.parametrize(
    ("velocity", "sigma", "n"),
    [
        ((1.2, 0, 0), (0.1, 0.1, 0.05), 2),
        ((0.7, -0.4, 0.6), (0.3, 0.3, 0.2), 2),
        ((0, 1.2, 2.0), (0.5, 0.5, 0.5), 2),
        ((0.3, 0.8, -0.5, 1, 2, -3), (0.2, 0.2, 0.2, 0.3, 0.3, 0.3), 3),
    ],
)
def test_the_velocity_keeps_its_mean_and_all_its_covariance(velocity, sigma, n):
    """Turning too, where what turns is no length: λ and the angular velocity are independent."""
    mean, covariance = velocity_in_gauge(jnp.asarray(velocity), jnp.diag(jnp.asarray(sigma)), n)
    assert (np.diagonal(covariance) >= 0).all()
    assert np.linalg.eigvalsh(covariance).min() > -1e-15
    found, C = velocity_and_scale(mean, covariance, n)
    assert_moments((found[:-1], C[:-1, :-1]), velocity, np.diag(np.square(sigma)), 1e-12)
    P = np.log1p(sigma[0] ** 2 / np.dot(velocity[:n], velocity[:n]))
    expected = np.diag([*np.square(sigma[n:]), P])
    assert_moments((found[n:], C[n:, n:]), [*velocity[n:], -P / 2], expected, 1e-12)


def test_a_velocity_correlated_in_itself_keeps_its_moments_to_second_order():
    """As a member of a Gaussian sum has it; and however it is correlated, a covariance results."""
    velocity, root = np.array([1.0, 0.5, 0.3]), np.tril(0.1 * np.ones((3, 3)))
    mean, covariance = velocity_in_gauge(jnp.asarray(velocity), jnp.asarray(root), 2)
    found, C = velocity_and_scale(mean, covariance, 2)
    assert_moments((found[:-1], C[:-1, :-1]), velocity, root @ root.T, covariance[-1, -1])
    along = np.outer(velocity, [1.0, 0, 0])  # all in one direction: nothing but correlation
    _, covariance = velocity_in_gauge(jnp.asarray(velocity), jnp.asarray(along), 2)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


@pytest.mark.parametrize("velocity", [(0.0, 0, 0), (0.0, 0, 0.3)])
def test_from_standstill_the_scale_is_known_and_the_velocity_has_its_prior(velocity):
    root = np.diag([0.5, 0.5, 0.25])  # whose squares are exact
    mean, covariance = velocity_in_gauge(jnp.asarray(velocity), jnp.asarray(root), 2)
    np.testing.assert_array_equal(mean, [*velocity, 0])
    np.testing.assert_array_equal(covariance, np.pad(root**2, ((0, 1), (0, 1))))


@pytest.mark.parametrize("variance", [0.0, 0.02, 0.3])
def test_an_inverse_depth_has_its_exact_moments_in_the_unit_of_the_state(variance):
    """Those of `e^λ ρ` by quadrature, λ ~ N(0, P): the mean, the slope by λ, and what is left."""
    rho, sigma = np.array([0.1, 0.4]), np.array([0.05, 0.3])
    node, weight = np.polynomial.hermite_e.hermegauss(30)
    weight = weight / weight.sum()
    unit = np.exp(np.sqrt(variance) * node)
    mean = weight @ unit * rho
    square = weight @ unit**2 * (rho**2 + sigma**2)
    found, left = ScaleGauge().prior(rho, sigma, jnp.asarray(variance))
    np.testing.assert_allclose(found, mean, rtol=1e-12)
    np.testing.assert_allclose(left, np.sqrt(square - mean**2 * (1 + variance)), rtol=1e-12)


def test_a_new_landmark_has_the_moments_of_its_prior():
    """Drawn after frame 0: `e^λ ω`, which the filter holds, exactly, ω to second order in λ."""
    of = Case("matched-6dof-loose", landmarks=5)
    slam = of.filter("scale_gauge")
    state = quick_jit(partial(slam.init, of.capacity))(of.frames(0)[0])
    c, d = state.core_dim, state.landmarks.shape[1]
    assert state.core.log_scale.shape == (1,)
    index = [*(c + d * slot + d - 1 for slot in (0, 1)), state.core.part("log_scale").start]
    focal = float(slam.sensor.focal)
    unit = np.array([focal, focal, 1])
    mean = np.append(state.landmarks[:2, -1], state.core.log_scale[0]) / unit
    covariance = np.asarray(state.covariance)[np.ix_(index, index)] / np.outer(unit, unit)
    rho, sigma_rho = float(slam.depth.mean), float(slam.depth.sigma)
    P = covariance[-1, -1]
    # λ ~ N(−P/2, P) and ω ~ N(ρ, σ²), independent: the moments of e^λ ω and λ.
    prior = np.diag([sigma_rho**2] * 2 + [P])
    expected = moments_of_products([rho, rho, -P / 2], prior, [1, 1, 0])
    assert_moments((mean, covariance), *expected, 2 * P**2)
    omega, C = moments_of_products(mean, covariance, [-1, -1, 0])
    assert_moments((omega[:2], C[:2, :2]), [rho, rho], prior[:2, :2], 5 * P)


def test_a_metre_that_is_not_known_is_in_the_metric_covariance_and_nowhere_else():
    """Of a camera that has moved; new landmarks say nothing of it."""
    of = Case("matched-turn", 1, steps=1)
    slam = of.filter("scale_gauge")
    unknown = replace(slam, depth=replace(slam.depth, unit=0.4))

    @quick_jit
    def told(first):
        states = [x.init(of.capacity, first) for x in (slam, unknown)]
        moved = of.run(0).poses
        at = slam.frame.from_base_pose(jax.tree.map(lambda x: x[-1], moved))
        states = [replace(s, core=replace(s.core, pose=at)) for s in states]
        return *(camera_pose(slam, s) for s in states), states[1]

    (pose, P), (same, wide), state = told(of.frames(0)[0])
    np.testing.assert_array_equal(same.parameters(), pose.parameters())
    # T Exp(δ): the displacement in the camera's axes, all of it with the metre.
    along = np.concatenate([pose.inverse().rotation() @ pose.translation(), [0.0]])
    np.testing.assert_allclose(wide - P, 0.16 * np.outer(along, along), rtol=1e-9, atol=1e-12)
    assert np.linalg.norm(along) > 0.01
    metre = state.core.part("log_scale").start + 1
    row = np.delete(np.asarray(state.covariance[metre]), metre)
    np.testing.assert_allclose(row, 0, atol=1e-15)
