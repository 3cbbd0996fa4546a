"""The scale gauge: (λ, ṽ, ω̃) with v = e^λ ṽ and ω = e^−λ ω̃ say what the prior on v and ω says."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit, run_filter

from jaxslam.models.scale import ScaleGauge, velocity_in_gauge

DRAWS = 400_000
ERRORS = 5.0
"""Standard errors that a moment of so many draws may be off: one test in a million fails."""


def gaussian_draws(mean, covariance, seed=1):
    """Draws of N(mean, covariance), of any rank."""
    values, vectors = np.linalg.eigh(covariance)
    normal = np.random.default_rng(seed).normal(size=(DRAWS, len(mean)))
    return mean + (normal * np.sqrt(np.maximum(values, 0))) @ vectors.T


def velocities(mean, covariance, n):
    """Draws of v and λ from the Gaussian of (ṽ, λ)."""
    draws = gaussian_draws(np.asarray(mean), np.asarray(covariance))
    v, log_scale = draws[:, :-1], draws[:, -1]
    v[:, :n] *= np.exp(log_scale)[:, None]
    return v, log_scale


def assert_moments(draws, mean, covariance, also=0.0):
    """Mean and every covariance of draws, within their Monte Carlo error and `also`, relative."""
    sigma = np.sqrt(np.diagonal(covariance))
    off = (draws.mean(axis=0) - mean) / sigma
    np.testing.assert_allclose(off, 0, atol=ERRORS / np.sqrt(DRAWS) + also)
    correlation = (np.cov(draws.T) - covariance) / np.outer(sigma, sigma)
    np.testing.assert_allclose(correlation, 0, atol=ERRORS * np.sqrt(2 / DRAWS) + also)


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
    prior = np.diag(np.square(sigma))
    mean, covariance = velocity_in_gauge(jnp.asarray(velocity), jnp.diag(jnp.asarray(sigma)), n)
    assert (np.diagonal(covariance) >= 0).all()
    assert np.linalg.eigvalsh(covariance).min() > -1e-15
    v, log_scale = velocities(mean, covariance, n)
    assert_moments(v, velocity, prior)
    P = np.log1p(sigma[0] ** 2 / np.dot(velocity[:n], velocity[:n]))
    assert_moments(
        np.column_stack([v[:, n:], log_scale]),
        [*velocity[n:], -P / 2],
        np.diag([*np.square(sigma[n:]), P]),
    )


def test_a_velocity_correlated_in_itself_keeps_its_moments_to_second_order():
    """As a member of a Gaussian sum has it; and however it is correlated, a covariance results."""
    velocity, root = np.array([1.0, 0.5, 0.3]), np.tril(0.1 * np.ones((3, 3)))
    prior = root @ root.T
    mean, covariance = velocity_in_gauge(jnp.asarray(velocity), jnp.asarray(root), 2)
    q = covariance[-1, -1]
    assert_moments(velocities(mean, covariance, 2)[0], velocity, prior, also=q)
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
    place = c - state.core.calibration.size - state.core.noise.size - 1
    assert state.core.log_scale.shape == (1,)
    index = [place, *(c + d * slot + d - 1 for slot in (0, 1))]
    focal = float(slam.sensor.focal)
    mean = [float(state.core.log_scale[0]), *np.asarray(state.landmarks)[:2, -1] / focal]
    scale = np.array([1, focal, focal])
    covariance = np.asarray(state.covariance)[np.ix_(index, index)] / np.outer(scale, scale)
    draws = gaussian_draws(np.array(mean), covariance)
    log_scale, held = draws[:, :1], draws[:, 1:]
    rho, sigma_rho = float(slam.depth.mean), float(slam.depth.sigma)
    P = covariance[0, 0]
    # λ ~ N(−P/2, P) and ω ~ N(ρ, σ²), independent: the moments of λ and e^λ ω.
    common = rho**2 * np.expm1(P)
    expected = np.full((3, 3), common)
    expected[0, :] = expected[:, 0] = [P, rho * P, rho * P]
    expected[[1, 2], [1, 2]] += sigma_rho**2 * np.exp(P)
    assert_moments(np.column_stack([log_scale, held]), [-P / 2, rho, rho], expected, also=2 * P**2)
    omega = held * np.exp(-log_scale)
    assert_moments(omega, [rho, rho], np.diag([sigma_rho**2] * 2), also=5 * P)


@pytest.mark.slow
def test_a_metre_that_is_not_known_is_in_the_metric_covariance_and_nowhere_else():
    """Nothing that is seen tells of it, and it tells nothing of what is seen."""
    of = Case("matched-turn", 1, steps=8)
    slam = of.filter("scale_gauge")
    unknown = replace(slam, depth=replace(slam.depth, unit=0.4))
    (known, P, _, nis), (poses, wide, _, same_nis) = (
        quick_jit(partial(run_filter, of.capacity, x))(of.controls(), *of.frames(0))[1]
        for x in (slam, unknown)
    )
    np.testing.assert_allclose(same_nis, nis, rtol=1e-9)
    np.testing.assert_allclose(poses.parameters(), known.parameters(), atol=1e-12)
    pose = jax.tree.map(lambda x: x[-1], poses)
    # T Exp(δ): the displacement in the camera's axes, all of it with the metre.
    along = np.concatenate([pose.inverse().rotation() @ pose.translation(), [0.0]])
    np.testing.assert_allclose(wide[-1] - P[-1], 0.16 * np.outer(along, along), atol=1e-9)
    assert np.linalg.norm(along) > 0.1
