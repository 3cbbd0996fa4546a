"""Tests of jaxslam.simulation: the built-in scenarios, their overrides, and what is drawn."""

import dataclasses
import json
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import keys_used, quick_jit, simulated
from scipy import stats

from jaxslam._numerics.arrays import cast
from jaxslam.models.camera import Camera, project
from jaxslam.models.imu import Imu
from jaxslam.models.motion import ConstantVelocity, Odometry
from jaxslam.models.sensors import Pinhole, Position
from jaxslam.simulation import (
    BUILT_IN,
    Room,
    features,
    gone,
    scenario,
    sightings,
    simulate,
)
from jaxslam.simulation.scenario import parse_override

FALSE_ALARM = 1e-6
"""Share of seeds on which a statistical test here would fail although nothing is wrong."""


def keys(count, seed=0):
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(seed), i))(jnp.arange(count))


def batch(chosen, count, seed=0):
    return quick_jit(jax.vmap(lambda key: simulate(chosen, key)))(keys(count, seed))


# --- the built-in scenarios, as interface.md words them -----------------------------------------

PLANAR_MATCHED = {
    # acceleration σ, initial velocity σ
    "tight": ((0.02, 0.02, 0.02), (0.002, 0.002, 0.002)),
    "": ((0.1, 0.1, 0.1), (0.01, 0.01, 0.01)),
    "loose": ((0.5, 0.5, 0.3), (0.1, 0.1, 0.05)),
    "very-loose": ((3.0, 3.0, 1.0), (0.1, 0.1, 0.05)),
}
SPATIAL_MATCHED = {
    "tight": ((0.02,) * 6, (0.002,) * 6),
    "": ((0.1,) * 6, (0.01,) * 6),
    "loose": ((0.5, 0.5, 0.5, 0.3, 0.3, 0.3), (0.1, 0.1, 0.1, 0.05, 0.05, 0.05)),
    "very-loose": ((3.0, 3.0, 3.0, 1.0, 1.0, 1.0), (0.1, 0.1, 0.1, 0.05, 0.05, 0.05)),
}
CIRCLE = {
    "tight": PLANAR_MATCHED["tight"],
    "": PLANAR_MATCHED[""],
    "loose": ((0.3, 0.3, 0.5), (0.05, 0.05, 0.1)),
}
FROM_REST = {"": (PLANAR_MATCHED["loose"][0], (0.5, 0.5, 0.2))}
SPATIAL_FROM_REST = {"": (SPATIAL_MATCHED["loose"][0], (0.5, 0.5, 0.5, 0.2, 0.2, 0.2))}
AHEAD = {noise: PLANAR_MATCHED[noise] for noise in ("", "loose")}

MATCHED: dict[str, Any] = {
    "geometry": "planar",
    "rate": 30.0,
    "steps": 60,
    "landmarks": 12,
    "placement": "prior",
    "first_pixels": ((20.0, 620.0),),
    "nearest_depth": 3.0,
    "least_inverse_depth": 0.001,
    "calibration": "known",
    "true_calibration": "nominal",
    "image": (640.0,),
    "focal": (650.0,),
    "centre": (320.0,),
    "focal_sigma": 3.0,
    "centre_sigma": 2.0,
    "pixel_sigma": 0.3,
}
SPATIAL = MATCHED | {
    "geometry": "spatial",
    "landmarks": 30,
    "first_pixels": ((20.0, 620.0), (20.0, 460.0)),
    "image": (640.0, 480.0),
    "focal": (650.0, 650.0),
    "centre": (320.0, 240.0),
}
ON_CIRCLE = MATCHED | {
    "steps": 200,
    "landmarks": 36,
    "placement": "ring",
    "ring_radius": 8.0,
    "calibration": "white",
    "true_calibration": "white",
}
del ON_CIRCLE["first_pixels"], ON_CIRCLE["least_inverse_depth"]  # the prior's, not the ring's

FAMILIES = {
    "matched": (PLANAR_MATCHED, MATCHED, (1.2, 0.0, 0.0)),
    "matched-forward": (AHEAD, MATCHED, (0.0, 1.2, 0.0)),
    "matched-turn": (AHEAD, MATCHED, (0.0, 1.2, 0.3)),
    "matched-6dof": (SPATIAL_MATCHED, SPATIAL, (1.2, 0.0, 0.0, 0.0, 0.0, 0.0)),
    "standstill": (FROM_REST, MATCHED | {"still_frames": 0}, (0.0,) * 3),
    "standstill-6dof": (SPATIAL_FROM_REST, SPATIAL, (0.0,) * 6),
    "circle": (CIRCLE, ON_CIRCLE, (0.0, 1.2, 0.3)),
}
EXPECTED = {
    "-".join(filter(None, (family, noise))): fields
    | {"velocity": velocity, "acceleration_sigma": acceleration, "velocity_sigma": start}
    for family, (noises, fields, velocity) in FAMILIES.items()
    for noise, (acceleration, start) in noises.items()
}

EXPECTED["handheld"] = SPATIAL | {
    "trajectory": "",
    "steps": 150,
    "velocity": (0.0,) * 6,
    "velocity_sigma": (1.0,) * 6,
    "acceleration_sigma": (4.0,) * 3 + (6.0,) * 3,
    "placement": "rays",
    "depth_range": (1.0, 6.0),
    "nearest_depth": 1.0,
}
EXPECTED["drifting-patches"] = EXPECTED["handheld"] | {
    "velocity": (1.2, 0.0, 0.0, 0.0, 0.0, 0.0),
    "acceleration_sigma": SPATIAL_MATCHED["loose"][0],
    "velocity_sigma": SPATIAL_MATCHED["loose"][1],
    "drift_sigma": 0.2,
    "drift_frames": 20.0,
    "drift_wrong": 0.05,
}
DEGREE = np.pi / 180
ODOMETRY = {"motion": "odometry", "true_calibration": "nominal", "calibration": "known"}
EXPECTED["room"] = ODOMETRY | {
    "geometry": "spatial",
    "rate": 10.0,
    "steps": 200,
    "velocity": pytest.approx((0.0, 0.0, 0.8, 0.0, -9 * DEGREE, 0.0)),
    "odometry_sigma": pytest.approx((0.005,) * 3 + (0.05 * DEGREE,) * 3),
    "velocity_sigma": (0.0,) * 6,
    "placement": "room",
    "landmarks": 72,
    "sensor": "camera",
    "image": (640.0, 480.0),
    "focal": (320.0, 320.0),
    "centre": (320.0, 240.0),
    "pixel_sigma": 1.0,
    "inverse_depth": (0.01, 0.5),
    "first_landmarks": 10,
    "new_landmarks": 1,
    "known_landmarks": 10,
}
for suffix, slip in (("", 0.02), ("-loose", 0.04)):
    EXPECTED["positions" + suffix] = ODOMETRY | {
        "geometry": "planar",
        "rate": 1.0,
        "steps": 400,
        "velocity": (0.0, 0.25, 0.075),
        "velocity_sigma": (0.0,) * 3,
        "odometry_sigma": pytest.approx((0.001, slip / np.sqrt(2), 2 * np.sqrt(2) * slip)),
        "placement": "ring",
        "landmarks": 15,
        "ring_radius": pytest.approx(0.25 / 0.075 + 2.5),
        "sensor": "position",
        "range": (0.5, 5.0),
        "position_sigma": 0.1,
        "first_frame": 1,
    }
EXPECTED["laps"] = {
    "geometry": "planar", "rate": 30.0, "steps": 3150, "velocity": (0.0, 1.2, 0.3),
    "acceleration_sigma": (0.02,) * 3, "placement": "ring", "landmarks": 144, "in_view": 24,
}  # fmt: skip
EXPECTED["laps-6dof"] = {
    "geometry": "spatial", "rate": 10.0, "steps": 1050, "motion": "odometry",
    "velocity": (0.0, 0.0, 1.2, 0.0, -0.3, 0.0), "velocity_sigma": (0.0,) * 6,
    "placement": "ring", "landmarks": 144, "in_view": 20,
}  # fmt: skip


EXPECTED["imu"] = {
    "geometry": "spatial", "rate": 10.0, "steps": 300, "motion": "imu", "readings": 40,
    "velocity": (0.0, 0.0, 1.2, 0.0, -0.3, 0.0), "sway": (0.5, 0.3, 0.5, 0.2, 0.2, 0.2),
    "placement": "rays", "landmarks": 20, "depth_range": (2.0, 10.0), "pixel_sigma": 1.0,
    "inverse_depth": pytest.approx((np.log(5) / 8, np.sqrt(0.05 - (np.log(5) / 8) ** 2)), rel=1e-3),
    "inertial_density": (1.7e-4, 2e-3), "inertial_walk": (2e-5, 3e-3),
    "inertial_start_sigma": (0.01, 0.017), "inertial_bias_sigma": (0.01, 0.01),
}  # fmt: skip
EXPECTED["imu-loose"] = EXPECTED["imu"] | {
    "inertial_density": (1.7e-3, 2e-2), "inertial_walk": (2e-4, 3e-3),
    "inertial_start_sigma": (0.1, 0.05), "inertial_bias_sigma": (0.05, 0.2),
}  # fmt: skip


MOMENTS = np.log(6) / 5, np.sqrt(1 / 6 - (np.log(6) / 5) ** 2)  # of 1/z, z uniform in 1–6 m
for space, moving, axes in (
    ("", {"geometry": "planar", "landmarks": 12, "velocity": (0.0, 1.2, 0.3)}, 3),
    ("-6dof", SPATIAL | {"landmarks": 20, "velocity": (0.0, 0.0, 1.2, 0.0, -0.3, 0.0)}, 6),
):
    thrown = moving | {
        "rate": 30.0, "steps": 3000, "placement": "rays", "in_view": 0, "inverse_depth": (),
        "nearest_depth": 3.0, "depth_range": (1.0, 6.0),
        "acceleration_sigma": (0.02,) * axes,
    }  # fmt: skip
    prior = thrown | {"inverse_depth": pytest.approx(MOMENTS)}
    EXPECTED |= {
        f"laps-thrown{space}": thrown,
        f"laps-prior{space}": prior,
        f"laps-change{space}": prior | {"depth_range": (1.0, 6.0, 5.0, 50.0)},
    }


@pytest.mark.parametrize("name", EXPECTED)
def test_built_in_scenarios_hold_the_published_numbers(name):
    chosen = scenario(name)
    assert chosen.name == name
    found = chosen.fields
    assert {field: found[field] for field in EXPECTED[name]} == EXPECTED[name]


def test_every_built_in_scenario_is_checked_here():
    assert set(BUILT_IN) == set(EXPECTED)


def test_the_filter_starts_from_the_true_priors():
    chosen = scenario("matched-6dof-loose", nearest_depth=2.0)
    depth, sensor, motion = chosen.depth, chosen.sensor, chosen.motion
    assert isinstance(sensor, Pinhole)
    assert isinstance(motion, ConstantVelocity)
    assert depth.mean == 1 / 4
    assert depth.sigma == 1 / 8
    assert sensor.sigma == 0.3
    np.testing.assert_array_equal(chosen.calibration.sigma, [3, 3, 2, 2])
    np.testing.assert_array_equal(sensor.camera.intrinsics, [650, 650, 320, 240])
    np.testing.assert_array_equal(motion.noise_sigma, chosen.acceleration_sigma)
    np.testing.assert_array_equal(motion.velocity, chosen.velocity)
    np.testing.assert_array_equal(motion.velocity_sigma, chosen.velocity_sigma)
    assert cast(sensor, jnp.float32).sigma.dtype == jnp.float32


def test_the_filter_is_told_of_the_motion_and_the_sensor_that_it_has():
    chosen = scenario("positions", inverse_depth=[0.3, 0.1])
    motion, sensor, depth = chosen.motion, chosen.sensor, chosen.depth
    np.testing.assert_array_equal(motion.noise_sigma, chosen.odometry_sigma)
    assert sensor.sigma == chosen.position_sigma
    assert (depth.mean, depth.sigma) == (0.3, 0.1)
    assert (type(motion), type(sensor)) == (Odometry, Position)
    assert (motion.geometry.name, sensor.point_dim) == ("planar", 2)


# --- overrides and files ------------------------------------------------------------------------


def test_overrides_replace_fields_and_take_the_type_of_the_field():
    chosen = scenario("matched", {"steps": 5.0, "focal": 500}, pixel_sigma=1)
    assert (chosen.steps, chosen.focal, chosen.pixel_sigma) == (5, (500.0,), 1.0)
    assert isinstance(chosen.steps, int)
    rest = {"steps", "focal", "pixel_sigma"}
    before = BUILT_IN["matched"].fields
    assert {field for field, value in chosen.fields.items() if value != before[field]} == rest


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("steps=5", ("steps", 5)),
        (" velocity = [1, 0.5, 0] ", ("velocity", [1, 0.5, 0])),
        ("calibration=white", ("calibration", "white")),
        ('name="a = b"', ("name", "a = b")),
        ("pixel_sigma=nan", ("pixel_sigma", pytest.approx(np.nan, nan_ok=True))),
    ],
)
def test_an_override_is_read_as_toml(text, expected):
    assert parse_override(text) == expected


@pytest.mark.parametrize("text", ["steps", "=5", ""])
def test_a_malformed_override_is_refused(text):
    with pytest.raises(ValueError, match="field=value"):
        parse_override(text)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pixl_sigma": 1}, r"pixl_sigma.*did you mean pixel_sigma\?"),
        ({"xyzzy": 1}, r"unknown scenario field 'xyzzy'; known: name, geometry"),
        ({"pixel_sigma": float("nan")}, "pixel_sigma holds nan"),
        ({"velocity": [1.2, float("inf"), 0.0]}, "velocity holds inf"),
        ({"first_pixels": [[20.0, float("nan")]]}, "first_pixels"),
        ({"steps": float("nan")}, "steps must be a whole number"),
        ({"steps": 2.5}, "steps must be a whole number"),
        ({"steps": 0}, "steps must be positive"),
        ({"landmarks": -1}, "landmarks must be positive"),
        ({"rate": 0}, "rate must be positive"),
        ({"pixel_sigma": -0.3}, "pixel_sigma must be positive"),
        ({"acceleration_sigma": [0.1, -0.1, 0.1]}, "acceleration_sigma must be positive"),
        ({"velocity_sigma": [0.1, 0.1, -0.1]}, "velocity_sigma must not be negative"),
        ({"focal_sigma": -1}, "focal_sigma must not be negative"),
        ({"velocity": [1.2, 0.0]}, "velocity needs 3 values in a planar world, not 2"),
        ({"geometry": "spatial"}, "needs 6 values in a spatial world, not 3"),
        ({"focal": [650, 650]}, "focal needs 1 values in a planar world, not 2"),
        ({"first_pixels": [[20, 620], [20, 460]]}, "first_pixels needs 1 values"),
        ({"first_pixels": [[620, 20]]}, r"first_pixels needs \[low, high\] pairs"),
        ({"first_pixels": 20}, r"first_pixels must be a list of \[low, high\] pairs, not 20"),
        ({"pixel_sigma": "much"}, "pixel_sigma must be a number, not 'much'"),
        ({"steps": True}, "steps must be a number, not True"),
        ({"velocity": ["fast", 0, 0]}, "velocity must be a number, not 'fast'"),
        ({"geometry": 2}, "geometry must be a word, not 2"),
        ({"geometry": "flat"}, "geometry is 'flat'; known: planar, spatial"),
        ({"placement": "grid"}, "placement is 'grid'; known: prior, ring"),
        ({"calibration": "black"}, "calibration is 'black'; known: .*white"),
        ({"true_calibration": "known"}, "true_calibration is 'known'; known: nominal"),
        ({"placement": "ring"}, "ring needs a nominal path that turns"),
        ({"placement": "room"}, "room is for a spatial geometry and 72 landmarks"),
        ({"motion": "wheels"}, "motion is 'wheels'; known: velocity, odometry"),
        ({"sensor": "sonar"}, "sensor is 'sonar'; known: camera, position"),
        (
            {"motion": "odometry", "odometry_sigma": [0.1]},
            "odometry_sigma needs 3 values in a planar world, not 1",
        ),
        ({"odometry_sigma": [0.1, -0.1, 0.1]}, "odometry_sigma must not be negative"),
        ({"odometry_sigma": [0.1, float("nan"), 0.1]}, "odometry_sigma holds nan"),
        ({"inverse_depth": [0.1]}, "inverse_depth needs a mean and a σ"),
        ({"inverse_depth": [0.1, 0.0]}, "inverse_depth needs a mean and a σ"),
        ({"inverse_depth": [float("inf"), 0.1]}, "inverse_depth holds inf"),
        ({"still_frames": -1}, "still_frames must not be negative"),
        ({"still_frames": 2, "motion": "odometry"}, "still_frames: odometry has the nominal"),
        ({"depth_range": [5.0]}, "depth_range needs a least and a greatest depth, or several"),
        ({"depth_range": [1.0, 6.0, 5.0]}, "depth_range needs a least and a greatest depth"),
        ({"depth_range": [1.0, 6.0, 5.0, 4.0]}, "depth_range needs a least and a greatest depth"),
        ({"depth_range": [5.0, 2.0]}, "depth_range needs a least and a greatest depth"),
        ({"depth_range": [0.0, 2.0]}, "depth_range must be positive"),
        ({"placement": "rays", "known_landmarks": 3}, "known_landmarks: placement rays has no"),
        ({"placement": "rays", "sensor": "position"}, "placement rays is for a camera"),
        ({"first_frame": -1}, "first_frame must not be negative"),
        ({"first_landmarks": -1}, "first_landmarks must not be negative"),
        ({"new_landmarks": 1.5}, "new_landmarks must be a whole number"),
        ({"new_landmarks": -1}, "new_landmarks must not be negative"),
        ({"known_landmarks": -2}, "known_landmarks must not be negative"),
        ({"range": [5.0, 0.5]}, "range needs a least and a greatest one"),
        ({"range": [-1.0, 5.0]}, "range must not be negative"),
        ({"range": 5.0}, "range needs 2 values"),
        ({"position_sigma": 0.0}, "position_sigma must be positive"),
        ({"sensor": "position", "calibration": "white"}, "calibration: a Position sensor has none"),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_a_scenario_that_makes_no_sense_is_refused_by_field(fields, message):
    with pytest.raises(ValueError, match=message):
        scenario("matched", fields)


def test_a_ring_is_only_for_the_planar_world():
    velocity = [0.0, 0.0, 1.2, 0.0, 0.0, 0.3]
    with pytest.raises(ValueError, match="ring"):
        scenario("matched-6dof", placement="ring", velocity=velocity)


def test_an_unknown_scenario_is_refused_with_a_suggestion():
    with pytest.raises(
        ValueError, match=r"'cirle' \(did you mean circle\?\); known: matched-tight"
    ):
        scenario("cirle")


def as_toml(chosen, leave_out=()):
    """The scenario's fields as TOML; lists and numbers are written as in JSON."""
    lines = [
        f"{field} = {json.dumps(value)}"
        for field, value in chosen.to_dict().items()
        if field not in leave_out
    ]
    return "\n".join(lines)


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_scenario_survives_a_toml_file(tmp_path, name):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(BUILT_IN[name]))
    assert scenario(path) == BUILT_IN[name]
    assert scenario(str(path), steps=7) == scenario(BUILT_IN[name], steps=7)


def test_a_toml_file_may_start_from_a_built_in_scenario(tmp_path):
    path = tmp_path / "wide.toml"
    path.write_text('base = "circle"\nfocal = 400\n')
    assert scenario(path) == scenario("circle", name="wide", focal=(400.0,))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("steps = ", "wrong.toml: "),
        ('base = "cirle"', "unknown base 'cirle'; known: .*circle"),
        ("stepz = 5", r"did you mean steps\?"),
        ("pixel_sigma = nan", "pixel_sigma holds nan"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, message):
    path = tmp_path / "wrong.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=message):
        scenario(path)


# --- what is drawn ------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_does_not_depend_on_its_batch():
    """Run i is drawn from fold_in(key, i)."""
    chosen = scenario("circle", steps=20)
    whole = batch(chosen, 6)
    part = quick_jit(jax.vmap(lambda key: simulate(chosen, key)))(keys(6)[3:5])
    alone = quick_jit(lambda key: simulate(chosen, key))(jax.random.fold_in(jax.random.key(0), 4))
    for a, b, c in zip(*(jax.tree.leaves(run) for run in (whole, part, alone)), strict=True):
        # Rounding of pixels and metres, should the compiler vectorise another way.
        np.testing.assert_allclose(a[4], b[1], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(a[4], c, rtol=1e-12, atol=1e-12)
    assert np.abs(whole.measured[4] - whole.measured[3]).max() > 0.1


@pytest.mark.parametrize(
    ("name", "count"),
    [
        # Split: the run's, the motion's, the world's; drawn: velocity, accelerations, pixels,
        # depths, intrinsics and noise.
        ("matched", 9),
        # Split: the run's; drawn: readings, which landmarks are measured, and noise.
        ("room", 4),
    ],
)
def test_motion_world_camera_and_noise_share_no_random_key(monkeypatch, name, count):
    """So that they are independent: the same numbers in two of them would look random in each."""
    calibration: dict[str, Any] = {"true_calibration": "white"} if name == "matched" else {}
    chosen = scenario(name, steps=3, **calibration)
    _, keys = keys_used(
        monkeypatch, lambda: quick_jit(lambda key: simulate(chosen, key))(jax.random.key(0))
    )
    assert len(keys) == count
    assert len(set(keys)) == len(keys)


def pixels_without_noise(runs, chosen):
    camera = Camera(jnp.asarray(chosen.focal), jnp.asarray(chosen.centre))

    def one(pose, points):
        seen = jax.vmap(pose.inverse().apply)(points)
        return jax.vmap(project, in_axes=(None, 0))(camera, seen), seen

    return quick_jit(jax.vmap(jax.vmap(one, (0, None))))(runs.poses, runs.points)


def two_sided(sum_of_squares, count):
    """Is a sum of squared standard normal numbers one, but for FALSE_ALARM?"""
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], count)
    assert low < sum_of_squares < high


def centred(numbers):
    """Have independent standard normal numbers a mean of zero, but for FALSE_ALARM?"""
    assert abs(numbers.mean()) * np.sqrt(numbers.size) < stats.norm.isf(FALSE_ALARM / 2)


def test_pixel_noise_has_the_stated_sigma():
    chosen = scenario("matched-6dof", pixel_sigma=0.7)
    runs = batch(chosen, 10)
    ideal, _ = pixels_without_noise(runs, chosen)
    noise = np.asarray(runs.measured - ideal)[np.asarray(runs.visible)] / 0.7
    assert noise.size > 10_000
    two_sided(np.sum(noise**2), noise.size)
    centred(noise)


@pytest.mark.slow
def test_errors_of_patches_stay_as_long_as_they_should():
    chosen = scenario("matched-6dof", pixel_sigma=1e-9, drift_sigma=0.2, drift_frames=5.0)
    runs = batch(chosen, 10)
    ideal, _ = pixels_without_noise(runs, chosen)
    seen = np.all(runs.visible, axis=1)[:, None, :, None]
    errors = np.asarray(runs.measured - ideal) / 0.2
    pairs = np.broadcast_to(seen, errors[:, 1:].shape)
    white = (errors[:, 1:] - np.exp(-1 / 5) * errors[:, :-1]) / np.sqrt(1 - np.exp(-2 / 5))
    two_sided(np.sum(white[pairs] ** 2), pairs.sum())
    first = np.broadcast_to(seen[:, 0], errors[:, 0].shape)
    two_sided(np.sum(errors[:, 0][first] ** 2), first.sum())
    worse = batch(scenario(chosen, drift_wrong=1.0), 10)
    tenfold = np.asarray(worse.measured - ideal) / 0.2
    np.testing.assert_allclose(tenfold, 10 * errors, atol=1e-5)


def test_accelerations_and_the_first_velocity_have_the_stated_sigmas():
    chosen = scenario("matched-6dof-loose", landmarks=1)
    poses = batch(chosen, 100).poses
    before, after = (
        jax.tree.map(lambda x, part=part: x[:, part], poses)
        for part in (slice(None, -1), slice(1, None))
    )
    velocity = quick_jit(lambda a, b: (a.inverse() @ b).log())(before, after) * chosen.rate
    acceleration = np.diff(velocity, axis=1) * chosen.rate / np.array(chosen.acceleration_sigma)
    # The first step has its acceleration already.
    sigma = np.hypot(chosen.velocity_sigma, np.array(chosen.acceleration_sigma) / chosen.rate)
    first = (velocity[:, 0] - np.array(chosen.velocity)) / sigma
    for numbers in (acceleration, np.asarray(first)):
        for axis in range(6):
            two_sided(np.sum(numbers[..., axis] ** 2), numbers[..., axis].size)
            centred(numbers[..., axis])
    # White: neighbours in time are not correlated.
    neighbours = acceleration[:, 1:] * acceleration[:, :-1]
    centred(neighbours / neighbours.std())


@pytest.mark.parametrize("name", ["matched", "matched-6dof"])
def test_matched_truth_is_drawn_from_the_filters_prior(name):
    chosen = scenario(name, steps=1)
    runs = batch(chosen, 200)
    ideal, seen = (np.asarray(x)[:, 0] for x in pixels_without_noise(runs, chosen))
    low, high = np.array(chosen.first_pixels).T
    assert (ideal >= low - 1e-9).all()
    assert (ideal <= high + 1e-9).all()
    assert np.asarray(runs.visible)[:, 0].all()
    w = 1 / seen[..., -1].ravel()
    assert w.min() > chosen.least_inverse_depth
    mean, sigma = 1 / 6, 1 / 12
    prior = stats.truncnorm((chosen.least_inverse_depth - mean) / sigma, np.inf, mean, sigma)
    assert stats.kstest(w, prior.cdf).pvalue > FALSE_ALARM
    for axis in range(low.size):
        uniform = stats.uniform(low[axis], high[axis] - low[axis])
        assert stats.kstest(ideal[..., axis].ravel(), uniform.cdf).pvalue > FALSE_ALARM


def test_the_camera_circles_around_the_centre_of_the_ring():
    tiny = dict(velocity_sigma=[1e-9] * 3, acceleration_sigma=[1e-9] * 3)
    runs = batch(scenario("circle", tiny), 1)
    points, T = np.asarray(runs.points)[0], np.asarray(runs.poses.as_matrix())[0]
    centre = points.mean(axis=0)
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), 8.0, rtol=1e-12)
    positions, ahead = T[:, :2, 2], T[:, :2, 1]
    # 1e-6: noise of 1e-9 over 7 s, and the rounding of jaxlie's exp.
    np.testing.assert_allclose(np.linalg.norm(positions - centre, axis=1), 4.0, rtol=1e-6)
    # Looking along the path, at 1.2 m/s and 0.3 rad/s: the next centimetres are ahead.
    steps = np.diff(positions, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1) * 30, 1.2, rtol=1e-4)
    along = steps / np.linalg.norm(steps, axis=1)[:, None]
    # The chord is half the step's angle of 0.01 rad off the tangent.
    np.testing.assert_allclose(np.sum(along * ahead[:-1], axis=1), np.cos(0.005), rtol=1e-6)
    # It turns towards the centre, that is x → z turns z towards −x.
    left = np.asarray(T)[:, :2, 0] * -1
    to_centre = (centre - positions) / 4.0
    np.testing.assert_allclose(np.sum(left * to_centre, axis=1), 1.0, rtol=1e-5)
    angles = np.unwrap(np.sort(np.arctan2(*(points - centre).T)))
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / 36, rtol=1e-9)


def test_true_intrinsics_are_drawn_as_stated():
    """A pixel's deviation from the nominal camera is bearing · δf + δc."""
    for drawing in ("nominal", "constant", "white"):
        chosen = scenario(
            "matched",
            true_calibration=drawing,
            pixel_sigma=1e-9,
            velocity_sigma=[0] * 3,
            steps=20,
        )
        runs = batch(chosen, 40)
        ideal, seen = pixels_without_noise(runs, chosen)
        bearings = np.asarray(seen[..., 0] / seen[..., 1])
        deviation = np.asarray(runs.measured - ideal)[..., 0]
        ones = np.ones_like(bearings)
        A = np.stack([bearings, ones], axis=-1)
        deltas = np.einsum("rfip,rfp->rfi", np.linalg.pinv(A), deviation) / np.array([3.0, 2.0])
        if drawing == "nominal":
            assert np.abs(deltas).max() < 1e-6
        elif drawing == "constant":
            assert np.ptp(deltas, axis=1).max() < 1e-6
            two_sided(np.sum(deltas[:, 0] ** 2), deltas[:, 0].size)
        else:
            two_sided(np.sum(deltas**2), deltas.size)
            centred(deltas[:, 1:] * deltas[:, :-1])


def nominal_steps(poses):
    """The rotation matrix and the translation of every step of many runs."""
    T = np.asarray(poses.as_matrix())
    step = np.linalg.inv(T[:, :-1]) @ T[:, 1:]
    n = T.shape[-1] - 1
    return step[..., :n, :n], step[..., :n, n]


@pytest.mark.parametrize("name", ["room", "positions"])
def test_odometry_is_read_with_the_stated_errors_of_a_nominal_motion(name):
    chosen = scenario(name, steps=30)
    runs = batch(chosen, 60)
    nominal = np.array(chosen.velocity) / chosen.rate
    # The truth goes straight, and then turns, by the nominal motion, in every step of every run.
    rotations, translations = nominal_steps(runs.poses)
    n = translations.shape[-1]
    np.testing.assert_allclose(translations - nominal[:n], 0, atol=1e-12)
    angles = np.arccos((np.trace(rotations, axis1=-2, axis2=-1) - n + 2) / 2)
    np.testing.assert_allclose(angles, np.abs(nominal[n:]).max(), rtol=1e-9)
    assert runs.controls.shape == (60, 30, nominal.size)
    errors = (np.asarray(runs.controls) - nominal) / np.array(chosen.odometry_sigma)
    for axis in range(nominal.size):
        two_sided(np.sum(errors[..., axis] ** 2), errors[..., axis].size)
        centred(errors[..., axis])
    # White, and independent between axes.
    for product in (errors[:, 1:] * errors[:, :-1], errors * np.roll(errors, 1, axis=-1)):
        centred(product / product.std())


def test_a_camera_stands_exactly_still_and_then_moves_off_with_the_velocity_drawn():
    chosen = scenario("standstill", steps=7, still_frames=3)
    runs, free = batch(chosen, 30), batch(scenario(chosen, still_frames=0, steps=4), 30)
    T, moving = np.asarray(runs.poses.as_matrix()), np.asarray(free.poses.as_matrix())
    np.testing.assert_array_equal(T[:, :4], np.broadcast_to(np.eye(3), (30, 4, 3, 3)))
    np.testing.assert_allclose(T[:, 3:], moving, rtol=0, atol=1e-12)  # the same draws, later
    assert (np.abs(T[:, 4, :2, 2]).max(axis=1) > 1e-4).all()
    # The measurements of a camera that stands still differ by their noise alone.
    change = np.diff(np.asarray(runs.measured)[:, :4], axis=1) / chosen.pixel_sigma / np.sqrt(2)
    two_sided(np.sum(change[:, ::2] ** 2), change[:, ::2].size)
    # It may stand still to the end.
    to_the_end = batch(scenario("standstill-6dof", steps=2, still_frames=60), 1)
    assert not np.asarray(to_the_end.poses.translation()).any()


def test_seconds_are_the_control_of_a_constant_velocity():
    chosen = scenario("matched", steps=4, rate=20)
    np.testing.assert_allclose(batch(chosen, 2).controls, np.full((2, 4), 0.05), rtol=1e-15)


def test_positions_are_measured_in_range_and_with_the_stated_sigma():
    chosen = scenario("positions", steps=100, first_frame=4)
    runs = batch(chosen, 10)
    T, points = np.asarray(runs.poses.as_matrix()), np.asarray(runs.points)
    away = points[:, None] - T[:, :, None, :2, 2]
    seen_from = np.einsum("rfji,rflj->rfli", T[..., :2, :2], away)
    distance = np.linalg.norm(seen_from, axis=-1)
    in_range = (distance >= 0.5) & (distance <= 5.0)
    assert in_range[:, :4].any()
    in_range[:, :4] = False  # before the first frame
    np.testing.assert_array_equal(runs.visible, in_range)
    assert in_range.any()
    assert (seen_from[in_range][:, 1] < 0).any()  # behind, too
    noise = (np.asarray(runs.measured) - seen_from)[in_range] / 0.1
    two_sided(np.sum(noise**2), noise.size)
    centred(noise)


# --- the room -----------------------------------------------------------------------------------


@cache
def rooms():
    """The room with limits on what is measured, and the same runs without."""
    chosen = scenario("room", steps=60, known_landmarks=14)
    free = scenario(chosen, first_landmarks=0, new_landmarks=0, known_landmarks=0)
    return chosen, batch(chosen, 3), batch(free, 3)


def test_the_room_is_a_cloister_of_72_points_on_two_levels():
    """Centre 5 m to the left of the start; y down, the camera 0.6 m above the lower level."""
    _, runs, _ = rooms()
    points = np.asarray(runs.points)[0] - np.array([-5.0, 0.0, 0.0])
    assert len(np.unique(points.round(9), axis=0)) == 72
    heights, count = np.unique(points[:, 1].round(9), return_counts=True)
    np.testing.assert_allclose(heights, [-0.4, 0.6], atol=1e-9)
    np.testing.assert_array_equal(count, [36, 36])
    plane = points[:, [0, 2]]
    assert np.abs(plane).max() == pytest.approx(6)
    # Every point is on one of the two squares, and each wall is like the next.
    assert np.isin(np.abs(plane).max(axis=1).round(9), [4, 6]).all()
    lower = {tuple(p) for p in plane[points[:, 1] > 0].round(6)}
    assert lower == {tuple(p) for p in plane[points[:, 1] < 0].round(6)}
    assert {(-z, x) for x, z in lower} == lower
    # The camera walks between the squares, around the centre.
    path = np.asarray(runs.poses.translation())[0] - np.array([-5.0, 0.0, 0.0])
    np.testing.assert_allclose(path[:, 1], 0, atol=1e-12)
    assert np.abs(np.linalg.norm(path, axis=1) - 5).max() < 0.2
    assert np.abs(np.asarray(runs.poses.as_matrix())[0, 0, :3, 2] - [0, 0, 1]).max() == 0


def same_landmarks(limited, free):
    """The limited run's visibility, in the order of the landmarks of the free one."""
    distance = np.linalg.norm(free.points[:, None] - limited.points[None], axis=-1)
    order = distance.argmin(axis=1)
    assert sorted(order) == list(range(len(order)))
    assert distance.min(axis=1).max() < 1e-9  # rounding of metres, in two programs
    return limited.visible[:, order]


@pytest.mark.parametrize("i", range(3))
def test_no_frame_measures_more_than_its_limits_nor_less_than_it_can(i):
    chosen, limited, free = rooms()
    limited, free = (jax.tree.map(lambda x: np.asarray(x[i]), run) for run in (limited, free))
    for a, b in zip(jax.tree.leaves(limited.poses), jax.tree.leaves(free.poses), strict=True):
        # A limit changes nothing else of a run, in whose program it is: rounding of metres.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    used, before = same_landmarks(limited, free), np.zeros(72, bool)
    counts = []
    for k, (visible, chosen_now) in enumerate(zip(free.visible, used, strict=True)):
        assert not (chosen_now & ~visible).any()
        known, new = chosen_now & before, chosen_now & ~before
        most_new = chosen.new_landmarks if k else chosen.first_landmarks
        assert known.sum() == min(chosen.known_landmarks, (visible & before).sum())
        assert new.sum() == min(most_new, (visible & ~before).sum())
        counts.append((known.sum(), (visible & before).sum()))
        before |= new
    known, could = np.array(counts).T
    assert (could > known).any()  # the limit was met
    assert (could[1:] < chosen.known_landmarks).any()  # and fewer were there to be seen


def test_the_landmarks_of_a_limited_frame_are_drawn_at_random_and_evenly():
    """12 that are all visible: 6 are new in frame 0, of which 2 are measured in every later one."""
    chosen = scenario("matched", steps=3, first_landmarks=6, known_landmarks=2, new_landmarks=1)
    free = scenario(chosen, first_landmarks=0, known_landmarks=0, new_landmarks=0)
    # Far and nearly still, so that nothing leaves the picture.
    still: dict[str, Any] = dict(
        velocity=(0.0,) * 3, velocity_sigma=(0.0,) * 3, acceleration_sigma=(1e-9,) * 3
    )
    runs, everything = (batch(scenario(s, **still), 400) for s in (chosen, free))
    runs, everything = (jax.tree.map(np.asarray, r) for r in (runs, everything))
    assert everything.visible.all()
    used = np.stack(
        [
            same_landmarks(*(jax.tree.map(lambda x, i=i: x[i], r) for r in (runs, everything)))
            for i in range(400)
        ]
    )
    assert (used[:, 0].sum(axis=1) == 6).all()
    assert (used[:, 1:].sum(axis=2) == 3).all()

    def evenly(chosen, share):
        """Is every one of `lookup`, [runs, …], chosen with this probability?"""
        sigma = np.sqrt(share * (1 - share) / len(chosen))
        bound = stats.norm.isf(FALSE_ALARM / 2 / chosen[0].size) * sigma
        assert np.abs(chosen.mean(axis=0) - share).max() < bound

    evenly(used[:, 0], 1 / 2)
    # Neighbours in the table are not drawn together: 6 of 12 leave 5/11 for the next one.
    evenly((used[:, 0] & np.roll(used[:, 0], 1, axis=1)), 1 / 2 * 5 / 11)
    # In frame 1 those of frame 0 are known, and 1 of the 6 others is new.
    evenly(used[:, 1] & used[:, 0], 1 / 2 * 2 / 6)
    evenly(used[:, 1] & ~used[:, 0], 1 / 2 * 1 / 6)
    # Frames draw independently: 2 of 6 in frame 1, and 2 of 7, that one among them, in frame 2.
    evenly(used[:, 0] & used[:, 1] & used[:, 2], 1 / 2 * 2 / 6 * 2 / 7)


# --- landmarks that come and go ------------------------------------------------------------------


@cache
def coming_and_going():
    """Runs that turn much, with a landmark for every one that leaves the picture."""
    fast = dict(landmarks=8, steps=40, velocity_sigma=[1.0] * 6, pixel_sigma=1e-6)
    chosen = scenario("handheld", fast)
    return chosen, batch(chosen, 60)


def test_there_are_always_as_many_landmarks_in_view():
    chosen, runs = coming_and_going()
    assert runs.visible.shape == runs.new.shape == (60, 41, 8)
    assert runs.points.shape == (60, 41, 8, 3)
    assert np.asarray(runs.visible).all()
    assert ((runs.measured > -1e-3) & (runs.measured < np.array(chosen.image) + 1e-3)).all()
    seen_from = seen_by_frame(runs, np.asarray(runs.points))
    pixels = seen_from[..., :2] / seen_from[..., 2:] * 650 + np.array([320, 240])
    np.testing.assert_allclose(runs.measured, pixels, rtol=0, atol=1e-4)


def seen_by_frame(runs, points):
    """Points in the camera, frame by frame."""
    T = np.linalg.inv(np.asarray(runs.poses.as_matrix()))
    return np.einsum("rfij,rflj->rfli", T[..., :3, :3], points) + T[:, :, None, :3, 3]


def test_a_landmark_is_replaced_when_and_only_when_it_leaves_the_picture():
    chosen, runs = coming_and_going()
    new, points = np.asarray(runs.new), np.asarray(runs.points)
    assert new[:, 0].all()
    assert 0.02 < new[:, 1:].mean() < 0.5
    stays = (points[:, 1:] == points[:, :-1]).all(axis=-1)
    np.testing.assert_array_equal(stays, ~new[:, 1:])
    # Where the one of the frame before would be now.
    before = np.concatenate([points[:, :1], points[:, :-1]], axis=1)
    x, y, z = np.moveaxis(seen_by_frame(runs, before), -1, 0)
    u, v = 650 * x / z + 320, 650 * y / z + 240
    inside = (z > chosen.visible_depth) & (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
    np.testing.assert_array_equal(inside[:, 1:], ~new[:, 1:])


def test_it_is_thrown_along_a_random_ray_at_a_random_depth():
    chosen, runs = coming_and_going()
    new = np.asarray(runs.new)
    depth = seen_by_frame(runs, np.asarray(runs.points))[..., 2]
    later = new.copy()
    later[:, 0] = False
    for chosen_now in (new, later):
        least, greatest = chosen.depth_range
        uniform = stats.uniform(least, greatest - least)
        assert stats.kstest(depth[chosen_now], uniform.cdf).pvalue > FALSE_ALARM
        for axis, (low, high) in enumerate(chosen.first_pixels):
            pixels = np.asarray(runs.measured)[chosen_now][:, axis]
            uniform = stats.uniform(low, high - low)
            assert stats.kstest(pixels, uniform.cdf).pvalue > FALSE_ALARM
    # Neither slots nor frames repeat one another.
    assert len(np.unique(depth[new])) == new.sum()


def test_depths_change_in_the_middle_of_a_run():
    chosen = scenario("laps-change", steps=40)
    run = quick_jit(lambda key: simulate(chosen, key))(jax.random.key(0))
    seen = jax.vmap(lambda pose, points: jax.vmap(pose.inverse().apply)(points))
    depth = np.asarray(seen(run.poses, run.points))[..., 1]
    new = np.asarray(run.new)
    early, late = depth[:20][new[:20]], depth[21:][new[21:]]
    assert min(early.size, late.size) > 5
    assert (early > 1).all()
    assert (early < 6).all()
    assert (late > 5).all()
    assert (late < 50).all()
    assert late.max() > 10


def test_features_and_slots_of_landmarks_that_come_and_go():
    _, runs = coming_and_going()
    run = jax.tree.map(lambda x: x[0], runs)
    most = jax.tree.map(int, sightings(run))
    new = np.asarray(run.new)
    assert (most.landmarks, most.first) == (8, 8)
    assert most.new == new[1:].sum(axis=1).max()
    assert most.known == (~new).sum(axis=1).max()
    room = Room(10, 8, 8, 8)  # with room for two more
    (first, known, fresh), left = quick_jit(lambda run: (features(run, room), gone(run, room)))(run)
    left = np.asarray(left)
    assert left.shape == (40, 10)
    assert first.valid.all()
    for k in range(40):
        assert set(np.flatnonzero(left[k])) == set(np.flatnonzero(new[k + 1]))
        assert set(np.asarray(fresh.slots)[k][fresh.valid[k]]) == set(np.flatnonzero(new[k + 1]))
        assert set(np.asarray(known.slots)[k][known.valid[k]]) == set(np.flatnonzero(~new[k + 1]))
    # One that ends without a successor is gone in the frame in which it is not seen, and only then.
    ended = dataclasses.replace(run, visible=run.visible.at[7:, 3].set(False))
    left = np.asarray(gone(ended, Room(8, 8, 8, 8)))
    assert left[6, 3]
    assert not left[7:, 3].any()
    assert gone(circling()[1], Room(36, 1, 1, 1)) is None


def test_a_sensor_without_rays_cannot_throw_landmarks():
    with pytest.raises(ValueError, match="placement rays is for a camera, not for a Position"):
        simulate(scenario("handheld"), jax.random.key(0), sensor=Position(0.1, point_dim=3))


# --- features -----------------------------------------------------------------------------------


@cache
def circling():
    """A run in which landmarks enter and leave, and come back."""
    chosen = scenario("circle", steps=600)
    run = quick_jit(lambda key: simulate(chosen, key))(jax.random.key(1))
    most = jax.tree.map(int, quick_jit(sightings)(run))
    room = Room(most.landmarks, most.first, most.known, most.new)
    return chosen, run, most, quick_jit(lambda run: features(run, room))(run)


def test_every_visible_landmark_is_a_feature_exactly_once():
    _, run, most, (first, known, new) = circling()
    visible, pixels = np.asarray(run.visible), np.asarray(run.measured)
    frames = [[first]] + [
        [jax.tree.map(lambda x, k=k: x[k], part) for part in (known, new)]
        for k in range(len(visible) - 1)
    ]
    in_map, found = set(), np.zeros_like(visible, dtype=int)
    for k, parts in enumerate(frames):
        inserted = set()
        for part, is_new in zip(parts, [True] if k == 0 else [False, True], strict=True):
            for slot, pixel in zip(
                np.asarray(part.slots)[part.valid],
                np.asarray(part.measured)[part.valid],
                strict=True,
            ):
                assert (slot in in_map) != is_new
                found[k, slot] += 1
                np.testing.assert_array_equal(pixel, pixels[k, slot])
                if is_new:
                    inserted.add(slot)
        in_map |= inserted
    np.testing.assert_array_equal(found, visible)
    assert len(in_map) == most.landmarks
    # The run is worth its name: some come later, some go and come back.
    assert new.valid.any()
    changes = np.diff(visible.astype(int), axis=0)
    assert ((changes == 1).sum(axis=0) >= 2).any()


def test_sightings_are_the_smallest_capacities_that_hold_a_run():
    _, run, most, (first, known, new) = circling()
    assert most.landmarks == np.asarray(run.visible).any(axis=0).sum()
    assert most.first == first.valid.sum() == first.valid.size
    for part, capacity in ((known, most.known), (new, most.new)):
        assert part.valid.sum(axis=1).max() == capacity == part.valid.shape[1]


def test_landmarks_are_in_the_order_of_their_first_appearance():
    _, run, most, _ = circling()
    visible = np.asarray(run.visible)
    appearance = np.where(visible.any(axis=0), visible.argmax(axis=0), len(visible))
    assert (np.diff(appearance) >= 0).all()
    assert (appearance[: most.landmarks] < len(visible)).all()


def test_visible_means_inside_the_picture_and_in_front():
    chosen, run, *_ = circling()
    nominal = scenario(chosen, true_calibration="nominal")
    runs = jax.tree.map(lambda x: x[None], run)
    ideal, seen = (np.asarray(x)[0] for x in pixels_without_noise(runs, nominal))
    in_front = seen[..., -1] > chosen.visible_depth
    # The true camera of a frame differs from the nominal one by some pixels: keep 30 clear, which
    # is more than 5 σ of focal length and centre together.
    inside = ((ideal > 30) & (ideal < 610)).all(axis=-1) & in_front
    outside = ((ideal < -30) | (ideal > 670)).any(axis=-1) | ~in_front
    visible = np.asarray(run.visible)
    assert visible[inside].all()
    assert not visible[outside].any()
    assert inside.any()
    assert (seen[..., -1] < 0).any()


def test_landmarks_that_share_slots_are_new_when_they_come_back():
    """A slot is one point's for as long as that is seen, and what it measures is that point's."""
    run = simulated(scenario("laps", steps=900, in_view=6))
    who, new = np.asarray(run.identity), np.asarray(run.new)
    seen = np.asarray(run.visible)
    np.testing.assert_array_equal(seen, who >= 0)
    stays = seen[1:] & ~new[1:]
    np.testing.assert_array_equal(who[1:][stays], who[:-1][stays])
    for row in who[::50]:
        held = row[row >= 0].tolist()
        assert len(set(held)) == len(held)
    again = [point for point in set(who[new].tolist()) if np.sum(who[new] == point) > 1]
    assert len(again) > 20
    frame, slot = 450, int(np.flatnonzero(seen[450])[0])
    pose = jax.tree.map(lambda x: x[frame], run.poses)
    x, z = pose.inverse() @ run.points[frame, slot]
    assert abs(float(run.measured[frame, slot, 0]) - (650 * x / z + 320)) < 3


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"placement": "rays", "in_view": 5}, "in_view: not with placement rays"),
        ({"known_landmarks": 3, "in_view": 5}, "in_view: not with known_landmarks"),
        ({"in_view": -1}, "in_view must not be negative"),
    ],
)
def test_worlds_that_are_seen_again_are_checked(fields, message):
    with pytest.raises(ValueError, match=message):
        scenario("matched", fields)


def test_what_no_field_says_of_an_inertial_unit_stays_when_others_change():
    plain = scenario("imu", steps=7)
    assert (plain.fields["motion"], plain.motion.readings) == ("imu", 40)
    mounted = np.diag([1.0, -1.0, -1.0, 1.0])
    world = scenario("imu", motion=dataclasses.replace(plain.motion, camera_from_imu=mounted))
    changed = scenario(world, steps=5)
    assert changed.steps == 5
    assert isinstance(changed.motion, Imu)
    assert isinstance(plain.motion, Imu)
    np.testing.assert_array_equal(changed.motion.camera_from_imu, mounted)
    np.testing.assert_array_equal(changed.motion.density, plain.motion.density)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"sway": [0.1] * 3}, r"the sway of a world has shape \(3,\); it needs \(6,\)"),
        ({"motion": "velocity"}, "sway: not of a ConstantVelocity; use 0"),
        ({"trajectory": "x.txt", "still_frames": 3}, "still_frames: not with an Imu along a"),
    ],
)
def test_worlds_that_no_inertial_unit_has_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        scenario("imu", **fields)


def test_a_unit_that_first_stands_still_reads_no_motion():
    run = quick_jit(partial(simulate, scenario("imu", steps=6, still_frames=4, landmarks=2)))(
        jax.random.key(1)
    )
    away = np.linalg.norm(run.poses.translation(), axis=1)
    assert away[:5].max() < 1e-7
    assert away[6] > 1e-5
