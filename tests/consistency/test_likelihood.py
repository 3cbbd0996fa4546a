"""Gradients of the likelihood of a filter's numbers, through whole runs."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

import jaxslam
from jaxslam.consistency.likelihood import log_likelihood


@pytest.fixture(scope="module")
def case():
    return Case("matched", runs=24, steps=8, landmarks=5)


def scaled(slam, acceleration, pixel, focal=1.0):
    camera = slam.sensor.camera
    return replace(
        slam,
        motion=replace(slam.motion, noise_sigma=slam.motion.noise_sigma * acceleration),
        sensor=replace(
            slam.sensor,
            sigma=slam.sensor.sigma * pixel,
            camera=replace(camera, focal=camera.focal * focal),
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robocentric", "scale_gauge"])
def test_gradients_through_a_run_are_those_of_central_differences(case, name):
    slam, run = jaxslam.cast(case.filter(name), jnp.float64), case.run(0)
    found = eqx.filter_jit(eqx.filter_grad(log_likelihood))(slam, case.room, run)

    @quick_jit
    def value(factors):
        return log_likelihood(scaled(slam, *factors), case.room, run)

    by_factor = [
        found.motion.noise_sigma @ slam.motion.noise_sigma,
        found.sensor.sigma * slam.sensor.sigma,
        found.sensor.camera.focal @ slam.sensor.camera.focal,
    ]
    for i, derivative in enumerate(by_factor):
        h = 1e-5 * jnp.eye(3)[i]
        central = (value(1 + h) - value(1 - h)) / 2e-5
        np.testing.assert_allclose(derivative, central, rtol=1e-5, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "scenario", "options"),
    [
        ("world+scene50+mixture3", "matched-very-loose", {"steps": 8, "landmarks": 4}),
        ("robocentric+submaps", "laps", {"steps": 40, "landmarks": 12}),
    ],
)
def test_reverse_mode_through_work_that_is_done_only_where_it_is_wanted(name, scenario, options):
    """Members of a sum, splits, mergers, and submaps that end; alone and in a batch of runs."""
    case = Case(scenario, runs=2, **options)
    slam = jaxslam.cast(case.filter(name), jnp.float64)

    def value(factor, run):
        def sigma(slam):
            return slam.motion.noise_sigma

        return log_likelihood(eqx.tree_at(sigma, slam, factor * sigma(slam)), case.room, run)

    by_run = jax.vmap(value, (None, 0))
    found = quick_jit(jax.grad(lambda factor: jnp.sum(by_run(factor, case.runs))))(1.0)
    of_runs, h = quick_jit(by_run), 1e-4
    central = np.sum(of_runs(1 + h, case.runs) - of_runs(1 - h, case.runs)) / (2 * h)
    np.testing.assert_allclose(found, central, rtol=1e-6)


@pytest.mark.slow
def test_a_start_has_forward_mode_only_and_says_so():
    case = Case("matched-very-loose", steps=4, landmarks=3)
    slam = jaxslam.cast(case.filter("world+mixture3+rest2"), jnp.float64)
    with pytest.raises(NotImplementedError, match="forward mode"):
        eqx.filter_eval_shape(eqx.filter_grad(log_likelihood), slam, case.room, case.run(0))
