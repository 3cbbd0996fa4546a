"""What is defined outside the package is studied, tracks and has gradients like what is in it.

A sensor and a motion of one's own are studied in `docs/own-data.md` too.
"""

import inspect
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from additions import Bearing, BiasedVelocity, DriftingFocal, Huber, Pixels, PlainHomogeneous
from cases import quick_jit

import jaxslam
from jaxslam.filters.words import scenario_pieces
from jaxslam.statistics import not_disproved


def verdict(scenario, slam, runs=40, **models):
    study = jaxslam.monte_carlo(scenario, {"mine": slam}, runs=runs, chunk=runs, **models)
    found = jaxslam.summarise(study)["filters"]["mine"]
    assert found["diverged"] == 0
    assert not any(found["status"].values())
    return found["verdict"]


def paper(scenario, **pieces):
    return jaxslam.Slam(**{**scenario_pieces(scenario), **pieces})


@pytest.mark.parametrize(
    ("addition", "most"),
    [(PlainHomogeneous, 50), (Bearing, 40), (Pixels, 40), (BiasedVelocity, 40), (DriftingFocal, 30),
     (Huber, 80)],
)  # fmt: skip
def test_an_addition_is_one_short_class(addition, most):
    assert len(inspect.getsource(addition).splitlines()) <= most


def test_range_and_bearing_behind_the_sensor_wrap():
    sensor = jaxslam.RangeBearing((0.1, 0.02))
    behind = sensor.measure(jnp.array([-1e-3, -2.0]), jnp.ones(()))
    other = sensor.measure(jnp.array([1e-3, -2.0]), jnp.ones(()))
    assert abs(behind[1] - other[1]) > 6
    np.testing.assert_allclose(sensor.residual(behind, other), [0.0, 1e-3], atol=2e-6)
    point, omega = sensor.locate(behind, jnp.zeros(0))
    np.testing.assert_allclose(point / omega, [-1e-3, -2.0], atol=1e-12)


@pytest.mark.parametrize(
    ("sensor", "pieces"),
    [
        (jaxslam.RangeBearing((0.1, 0.02)), {"landmark": jaxslam.Cartesian()}),
        # One's own, of all directions: an angle that jumps by 2π is no error.
        pytest.param(
            Bearing(0.02), {"depth": jaxslam.InverseDepth(0.3, 0.15)}, marks=pytest.mark.slow
        ),
    ],
)
def test_a_sensor_that_sees_what_is_behind_is_simulated_and_studied(sensor, pieces):
    scenario = jaxslam.scenario("positions", steps=12, landmarks=6)
    slam = paper(scenario, sensor=sensor, calibration=jaxslam.Known(), **pieces)
    found = verdict(scenario, slam, sensor=sensor)
    assert found["sigma_factor"] < 1.4, found


@pytest.mark.slow
@pytest.mark.parametrize(
    "pieces",
    [{"landmark": PlainHomogeneous()}, {"correction": Huber()}],
    ids=["landmark", "remedy"],
)
def test_a_landmark_and_a_remedy_of_ones_own_are_studied(pieces):
    """What they would lack: a quick test has range and bearing."""
    scenario = jaxslam.scenario("matched-tight", steps=8)
    assert not_disproved(verdict(scenario, paper(scenario, **pieces)))


@pytest.mark.slow
def test_a_motion_with_a_bias_is_studied_and_learns_it():
    """A filter that does not know of the bias is over-confident on the same runs."""
    s = scenario = jaxslam.scenario("matched", steps=15)
    sigma = s.acceleration_sigma, s.velocity, s.velocity_sigma
    motion = BiasedVelocity(*sigma, (0.5, 0.5, 0.3))
    assert not_disproved(verdict(scenario, paper(scenario, motion=motion), motion=motion))
    assert verdict(scenario, paper(scenario), motion=motion)["word"] == "over-confident"


@pytest.mark.slow
def test_a_treatment_of_ones_own_is_studied():
    """What the camera may be off by makes it less sure of where it is."""
    scenario = jaxslam.scenario("matched", steps=10)
    slams = {"drifting": paper(scenario, calibration=DriftingFocal([0.005], [0.001]))}
    slams["known"] = paper(scenario)
    study = jaxslam.monte_carlo(scenario, slams, runs=20, chunk=20)
    sigma = {name: study[name].sigma.position[-1] for name in slams}
    assert sigma["drifting"] > sigma["known"]


@pytest.mark.slow
def test_a_remedy_of_ones_own_resists_outliers():
    scenario = jaxslam.scenario("matched-tight", steps=8)
    new = jaxslam.Features(
        jnp.array([0, 1]), jnp.array([[300.0], [350.0]]), jnp.array([True, True])
    )
    wrong = replace(new, measured=new.measured + jnp.array([[0.0], [40.0]]))
    none, moved = replace(new, valid=~new.valid), []
    for slam in (paper(scenario), paper(scenario, correction=Huber())):
        state = quick_jit(lambda new, slam=slam: slam.close(slam.init(2), new))(new)
        step = quick_jit(partial(type(slam).step, slam))
        after, _ = step(state, jnp.asarray(1 / 30), wrong, none)
        moved.append(abs(after.landmarks[1, 0] - state.landmarks[1, 0]))
    assert moved[1] < moved[0]
