"""What somebody meets who runs her own log: clear errors before anything is computed."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxslam

pytestmark = pytest.mark.usefixtures("unchecked")

CAMERA = jaxslam.Camera([650.0], [320.0])
PLANAR = jaxslam.ConstantVelocity([0.1] * 3, [1.2, 0.0, 0.0], [0.1] * 3)


def a_filter(**pieces):
    own: dict[str, Any] = {"motion": PLANAR, "sensor": jaxslam.Pinhole(CAMERA, 0.3), **pieces}
    return jaxslam.Slam(**own)


def features(m, p=1):
    return jaxslam.Features(jnp.arange(m), jnp.full((m, p), 320.0), jnp.ones(m, bool))


def test_a_step_with_the_wrong_control_says_what_is_asked_for():
    slam = a_filter()
    state = jax.eval_shape(lambda: slam.init(2, features(2)))
    nothing = replace(features(1), valid=jnp.zeros(1, bool))
    with pytest.raises(ValueError, match=r"control of ConstantVelocity is .* \(\), not .* \(6,\)"):
        jax.eval_shape(lambda state: slam.step(state, jnp.zeros(6), features(2), nothing), state)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda: (2, features(2, p=2)), "features.measured has shape"),
        (
            lambda: (2, replace(features(2), slots=jnp.arange(3))),
            "features.(slots|measured) has shape",
        ),
        *[(lambda x=x: (x,), "capacity is of so many landmarks") for x in (0, -1, 2.5, "many")],
    ],
)
def test_features_and_capacities_of_another_kind_are_refused_by_name(given, message):
    with pytest.raises(ValueError, match=message):
        a_filter().init(*given())


@pytest.mark.parametrize(
    ("pieces", "message"),
    [
        ({"sensor": 0.5}, "sensor is a"),
        ({"motion": "velocity"}, "motion is a"),
        ({"sensor": jaxslam.Pinhole(jaxslam.Camera([1.0, 1.0], [0.0, 0.0]), 1.0)}, "points have 2"),
        ({"calibration": jaxslam.White([1.0, 2.0, 3.0])}, "does not fit the sensor"),
        ({"sensor": jaxslam.Position(0.1), "scale": jaxslam.ScaleGauge()}, "or Position has none"),
    ],
)
def test_pieces_that_do_not_go_together_are_refused_when_they_are_put_together(pieces, message):
    with pytest.raises(ValueError, match=message):
        a_filter(**pieces)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jaxslam.ConstantVelocity([0.1] * 4, [0.0] * 4, [0.1] * 4), r"\(4,\)"),
        (lambda: jaxslam.ConstantVelocity([0.1] * 3, [0.0] * 6, [0.1] * 3), "the velocity has"),
        (lambda: jaxslam.Camera([650.0], [320.0, 240.0]), "the camera's centre"),
        (lambda: jaxslam.Pinhole(CAMERA, [0.1, 0.2]), "a pixel's sigma"),
    ],
)
def test_numbers_of_the_wrong_shape_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make().geometry  # noqa: B018


def test_numbers_may_be_given_as_they_are_written():
    """Floats, lists, tuples and arrays; one program for all numbers of one shape."""
    for sigma in (0.3, np.float32(0.3), jnp.asarray(0.3), [0.3]):
        slam = a_filter(sensor=jaxslam.Pinhole(CAMERA, sigma))
        assert jax.eval_shape(lambda slam=slam: slam.init(1)).covariance.shape
    traced = []

    @eqx.filter_jit
    def start(slam):
        traced.append(1)
        return slam.init(2).covariance

    for sigma in (0.1, 0.2):
        start(a_filter(sensor=jaxslam.Pinhole(CAMERA, sigma)))
    assert len(traced) == 1


def test_the_precision_is_that_of_the_filters_numbers():
    single = jaxslam.cast(a_filter(), "float32")
    assert jax.eval_shape(lambda: a_filter().init(2)).covariance.dtype == jnp.float64
    assert jax.eval_shape(lambda: single.init(2)).covariance.dtype == jnp.float32
    state = jax.eval_shape(lambda: single.init(2, features(2)))
    numbers = [x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]
    assert {x.dtype for x in numbers} == {jnp.dtype("float32")}


def test_single_precision_by_oversight_warns_once_and_by_choice_never():
    program = (
        "import warnings, jaxslam\n"
        "slam = jaxslam.Slam(motion=jaxslam.Odometry([.1] * 3),"
        " sensor=jaxslam.Position(0.1))\n"
        "with warnings.catch_warnings(record=True) as seen:\n"
        "    for _ in range(3): slam.init(2)\n"
        "assert len(seen) == 1 and 'jax_enable_x64' in str(seen[0].message), seen\n"
        "with warnings.catch_warnings(record=True) as seen:\n"
        "    jaxslam.cast(slam, 'float32').init(2)\n"
        "assert not seen, seen\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=200)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("scenarios", "scenario"),
        ("AbstractLandmarks", "AbstractLandmark"),
        ("montecarlo", "monte_carlo"),
    ],
)
def test_a_guessed_name_is_told_the_right_one(name, meant):
    with pytest.raises(AttributeError, match=rf"no attribute '{name}' \(did you mean {meant}\?\)"):
        getattr(jaxslam, name)


def test_one_filter_takes_its_landmark_by_name():
    pieces: dict[str, Any] = {"motion": PLANAR, "sensor": jaxslam.Pinhole(CAMERA, 0.3)}
    made = jaxslam.make_filter("robocentric", landmark="inverse_depth", **pieces)
    assert isinstance(made, jaxslam.Slam)
    assert made.landmark is jaxslam.LANDMARKS["inverse_depth"]
    with pytest.raises(ValueError, match=r"inverse_scale.* \(did you mean inverse_scaling\?\)"):
        jaxslam.make_filter("robocentric", landmark="inverse_scale", **pieces)
    with pytest.raises(ValueError, match=r"make_filter lacks motion, sensor; .* make_filters"):
        jaxslam.make_filter("robocentric", landmark="inverse_scaling")
