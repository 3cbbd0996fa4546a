"""Tests of jaxslam.simulation: the built-in scenarios, their overrides, and what is drawn."""

import dataclasses
import json
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FALSE_ALARM, centred, keys_used, quick_jit, simulated, standard_normal
from scipy import stats

from jaxslam._numerics.arrays import cast
from jaxslam.models.camera import Camera, project
from jaxslam.models.imu import Imu
from jaxslam.models.motion import ConstantVelocity, Odometry
from jaxslam.models.sensors import Pinhole, Position
from jaxslam.simulation import BUILT_IN, Room, features, gone, scenario, sightings, simulate
from jaxslam.simulation.scenario import parse_override


def batch(chosen, count):
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(0), i))(jnp.arange(count))
    return quick_jit(jax.vmap(partial(simulate, chosen)))(keys)


# --- the built-in scenarios, as they were published ---------------------------------------------

PUBLISHED = """
matched-tight            30   60  12  prior  1.2,0,0             0.02  0.02  0.002  0.002
matched                  30   60  12  prior  1.2,0,0             0.1   0.1   0.01   0.01
matched-loose            30   60  12  prior  1.2,0,0             0.5   0.3   0.1    0.05
matched-very-loose       30   60  12  prior  1.2,0,0             3     1     0.1    0.05
matched-forward          30   60  12  prior  0,1.2,0             0.1   0.1   0.01   0.01
matched-forward-loose    30   60  12  prior  0,1.2,0             0.5   0.3   0.1    0.05
matched-turn             30   60  12  prior  0,1.2,0.3           0.1   0.1   0.01   0.01
matched-turn-loose       30   60  12  prior  0,1.2,0.3           0.5   0.3   0.1    0.05
matched-6dof-tight       30   60  30  prior  1.2,0,0,0,0,0       0.02  0.02  0.002  0.002
matched-6dof             30   60  30  prior  1.2,0,0,0,0,0       0.1   0.1   0.01   0.01
matched-6dof-loose       30   60  30  prior  1.2,0,0,0,0,0       0.5   0.3   0.1    0.05
matched-6dof-very-loose  30   60  30  prior  1.2,0,0,0,0,0       3     1     0.1    0.05
standstill               30   60  12  prior  0,0,0               0.5   0.3   0.5    0.2
standstill-6dof          30   60  30  prior  0,0,0,0,0,0         0.5   0.3   0.5    0.2
handheld                 30  150  30  rays   0,0,0,0,0,0         4     6     1      1
drifting-patches         30  150  30  rays   1.2,0,0,0,0,0       0.5   0.3   0.1    0.05
circle-tight             30  200  36  ring   0,1.2,0.3           0.02  0.02  0.002  0.002
circle                   30  200  36  ring   0,1.2,0.3           0.1   0.1   0.01   0.01
circle-loose             30  200  36  ring   0,1.2,0.3           0.3   0.5   0.05   0.1
laps                     30 3150 144  ring   0,1.2,0.3           0.02  0.02
laps-thrown              30 3000  12  rays   0,1.2,0.3           0.02  0.02
laps-prior               30 3000  12  rays   0,1.2,0.3           0.02  0.02
laps-change              30 3000  12  rays   0,1.2,0.3           0.02  0.02
laps-thrown-6dof         30 3000  20  rays   0,0,1.2,0,-0.3,0    0.02  0.02
laps-prior-6dof          30 3000  20  rays   0,0,1.2,0,-0.3,0    0.02  0.02
laps-change-6dof         30 3000  20  rays   0,0,1.2,0,-0.3,0    0.02  0.02
laps-6dof                10 1050 144  ring   0,0,1.2,0,-0.3,0
room                     10  200  72  room   0,0,0.8,0,-0.15707963267948966,0
positions                 1  400  15  ring   0,0.25,0.075
positions-loose           1  400  15  ring   0,0.25,0.075
imu                      10  300  20  rays   0,0,1.2,0,-0.3,0
imu-loose                10  300  20  rays   0,0,1.2,0,-0.3,0
"""
"""Name, rate, steps, landmarks and their placement, nominal velocity, and the σ of its linear and
angular accelerations and of the first velocity, for those of constant velocity."""
PLANAR: dict[str, Any] = {
    "geometry": "planar", "first_pixels": ((20.0, 620.0),), "nearest_depth": 3.0,
    "least_inverse_depth": 0.001, "calibration": "known", "true_calibration": "nominal",
    "image": (640.0,), "focal": (650.0,), "centre": (320.0,), "focal_sigma": 3.0,
    "centre_sigma": 2.0, "pixel_sigma": 0.3,
}  # fmt: skip
SPATIAL = PLANAR | {
    "geometry": "spatial", "first_pixels": ((20.0, 620.0), (20.0, 460.0)),
    "image": (640.0, 480.0), "focal": (650.0, 650.0), "centre": (320.0, 240.0),
}  # fmt: skip


def moments(least, greatest):
    """Mean and σ of 1/z, of depths that are uniform."""
    mean = np.log(greatest / least) / (greatest - least)
    return pytest.approx((mean, np.sqrt(1 / (least * greatest) - mean**2)), rel=1e-3)


def odometry(*sigma):
    return {"motion": "odometry", "odometry_sigma": pytest.approx(sigma)}


DEGREE, WHITE = np.pi / 180, {"calibration": "white", "true_calibration": "white"}
IN_METRES = odometry(*(0.005,) * 3, *(0.05 * DEGREE,) * 3)
OF_IMU = {"inertial_density": (1.7e-4, 2e-3), "inertial_walk": (2e-5, 3e-3)}
OTHERS: dict[str, dict[str, Any]] = {
    "matched": PLANAR, "matched-turn": PLANAR, "standstill": PLANAR, "matched-6dof": SPATIAL,
    "handheld": SPATIAL | {"nearest_depth": 1.0, "depth_range": (1.0, 6.0)},
    "drifting-patches": {"drift_sigma": 0.2, "drift_frames": 20.0, "drift_wrong": 0.05},
    "circle": WHITE | {"ring_radius": 8.0, "nearest_depth": 3.0, "focal_sigma": 3.0},
    "laps": {"in_view": 24}, "laps-6dof": IN_METRES | {"in_view": 20},
    "laps-thrown": {"in_view": 0, "inverse_depth": (), "depth_range": (1.0, 6.0)},
    "laps-prior": {"inverse_depth": moments(1, 6)},
    "laps-change-6dof": {"inverse_depth": moments(1, 6), "depth_range": (1.0, 6.0, 5.0, 50.0)},
    "room": IN_METRES | {
        "focal": (320.0, 320.0), "pixel_sigma": 1.0, "inverse_depth": (0.01, 0.5),
        "first_landmarks": 10, "new_landmarks": 1, "known_landmarks": 10,
    },
    "positions": odometry(0.001, 0.02 / np.sqrt(2), 2 * np.sqrt(2) * 0.02) | {
        "ring_radius": pytest.approx(0.25 / 0.075 + 2.5), "sensor": "position",
        "range": (0.5, 5.0), "position_sigma": 0.1, "first_frame": 1,
    },
    "positions-loose": odometry(0.001, 0.04 / np.sqrt(2), 2 * np.sqrt(2) * 0.04),
    "imu": OF_IMU | {
        "motion": "imu", "readings": 40, "sway": (0.5, 0.3, 0.5, 0.2, 0.2, 0.2),
        "depth_range": (2.0, 10.0), "pixel_sigma": 1.0, "inverse_depth": moments(2, 10),
        "inertial_start_sigma": (0.01, 0.017), "inertial_bias_sigma": (0.01, 0.01),
    },
    "imu-loose": {
        "inertial_density": (1.7e-3, 2e-2), "inertial_walk": (2e-4, 3e-3),
        "inertial_start_sigma": (0.1, 0.05), "inertial_bias_sigma": (0.05, 0.2),
    },
}  # fmt: skip


def published(row):
    """A row's name and fields."""
    name, rate, steps, landmarks, placement, velocity, *sigmas = row.split()
    velocity = tuple(map(float, velocity.split(",")))
    linear, angular = (2, 1) if len(velocity) == 3 else (3, 3)
    given: dict[str, Any] = {"rate": float(rate), "steps": int(steps), "landmarks": int(landmarks)}
    given |= {"name": name, "placement": placement, "velocity": velocity}
    pairs = zip(sigmas[::2], sigmas[1::2], strict=True)
    fields = "acceleration_sigma", "velocity_sigma"
    for field, (first, second) in zip(fields, pairs, strict=False):
        given[field] = (float(first),) * linear + (float(second),) * angular
    return name, given | OTHERS.get(name, {})


def test_built_in_scenarios_hold_the_published_numbers_and_survive_a_toml_file(tmp_path):
    expected = dict(map(published, PUBLISHED.split("\n")[1:-1]))
    assert set(BUILT_IN) == set(expected) >= set(OTHERS)
    for name, fields in expected.items():
        found = BUILT_IN[name].fields
        assert {field: found[field] for field in fields} == fields, name
        path = tmp_path / "mine.toml"
        whole = BUILT_IN[name].to_dict().items()
        path.write_text("\n".join(f"{field} = {json.dumps(value)}" for field, value in whole))
        assert scenario(path) == scenario(str(path)) == BUILT_IN[name]


def test_the_filter_starts_from_the_true_priors_and_has_the_motion_and_the_sensor():
    chosen = scenario("matched-6dof-loose", nearest_depth=2.0)
    sensor, motion = chosen.sensor, chosen.motion
    assert isinstance(sensor, Pinhole)
    assert isinstance(motion, ConstantVelocity)
    assert (chosen.depth.mean, chosen.depth.sigma, sensor.sigma) == (1 / 4, 1 / 8, 0.3)
    np.testing.assert_array_equal(chosen.calibration.sigma, [3, 3, 2, 2])
    np.testing.assert_array_equal(sensor.camera.intrinsics, [650, 650, 320, 240])
    np.testing.assert_array_equal(motion.noise_sigma, chosen.acceleration_sigma)
    np.testing.assert_array_equal(motion.velocity, chosen.velocity)
    np.testing.assert_array_equal(motion.velocity_sigma, chosen.velocity_sigma)
    assert cast(sensor, jnp.float32).sigma.dtype == jnp.float32
    chosen = scenario("positions", inverse_depth=[0.3, 0.1])
    motion, sensor, depth = chosen.motion, chosen.sensor, chosen.depth
    np.testing.assert_array_equal(motion.noise_sigma, chosen.odometry_sigma)
    assert (sensor.sigma, depth.mean, depth.sigma) == (chosen.position_sigma, 0.3, 0.1)
    assert (type(motion), type(sensor)) == (Odometry, Position)
    assert (motion.geometry.name, sensor.point_dim) == ("planar", 2)


# --- overrides and files ------------------------------------------------------------------------


def test_overrides_replace_fields_and_take_the_type_of_the_field(tmp_path):
    chosen = scenario("matched", {"steps": 5.0, "focal": 500}, pixel_sigma=1)
    assert (chosen.steps, chosen.focal, chosen.pixel_sigma) == (5, (500.0,), 1.0)
    assert isinstance(chosen.steps, int)
    before = BUILT_IN["matched"].fields
    changed = {field for field, value in chosen.fields.items() if value != before[field]}
    assert changed == {"steps", "focal", "pixel_sigma"}
    path = tmp_path / "wide.toml"
    path.write_text('base = "circle"\nfocal = 400\n')
    assert scenario(path) == scenario("circle", name="wide", focal=(400.0,))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("steps=5", ("steps", 5)),
        (" velocity = [1, 0.5, 0] ", ("velocity", [1, 0.5, 0])),
        ("calibration=white", ("calibration", "white")),
        ('name="a = b"', ("name", "a = b")),
        ("steps", None),
        ("=5", None),
    ],
)
def test_an_override_is_read_as_toml(text, expected):
    if expected:
        assert parse_override(text) == expected
    else:
        with pytest.raises(ValueError, match="field=value"):
            parse_override(text)


REFUSED = [
    ({"pixl_sigma": 1}, r"pixl_sigma.*did you mean pixel_sigma\?"),
    ({"xyzzy": 1}, r"unknown scenario field 'xyzzy'; known: name, geometry"),
    ({"velocity": [1.2, float("inf"), 0.0]}, "velocity holds inf"),
    ({"first_pixels": [[20.0, float("nan")]]}, "first_pixels"),
    ({"steps": float("nan")}, "steps must be a whole number"),
    ({"steps": 2.5}, "steps must be a whole number"),
    ({"steps": 2**40}, "steps must be a number up to"),
    ({"steps": 0}, "steps must be positive"),
    ({"rate": 0}, "rate must be positive"),
    ({"acceleration_sigma": [0.1, -0.1, 0.1]}, "acceleration_sigma must be positive"),
    ({"velocity_sigma": [0.1, 0.1, -0.1]}, "velocity_sigma must not be negative"),
    ({"velocity": [1.2, 0.0]}, "velocity needs 3 values in a planar world, not 2"),
    ({"geometry": "spatial"}, "needs 6 values in a spatial world, not 3"),
    ({"first_pixels": [[20, 620], [20, 460]]}, "first_pixels needs 1 values"),
    ({"first_pixels": [[620, 20]]}, r"first_pixels needs \[low, high\] pairs"),
    ({"first_pixels": 20}, r"first_pixels must be a list of \[low, high\] pairs, not 20"),
    ({"steps": True}, "steps must be a number, not True"),
    ({"velocity": ["fast", 0, 0]}, "velocity must be a number, not 'fast'"),
    ({"geometry": 2}, "geometry must be a word, not 2"),
    ({"placement": "grid"}, "placement is 'grid'; known: prior, ring"),
    ({"calibration": "black"}, "calibration is 'black'; known: .*white"),
    ({"true_calibration": "known"}, "true_calibration is 'known'; known: nominal"),
    ({"placement": "ring"}, "ring needs a nominal path that turns"),
    ({"placement": "room"}, "room is for a spatial geometry and 72 landmarks"),
    ({"motion": "wheels"}, "motion is 'wheels'; known: velocity, odometry"),
    ({"motion": "odometry", "odometry_sigma": [0.1]}, "odometry_sigma needs 3 values"),
    ({"inverse_depth": [0.1]}, "inverse_depth needs a mean and a σ"),
    ({"inverse_depth": [0.1, 0.0]}, "inverse_depth needs a mean and a σ"),
    ({"still_frames": 2, "motion": "odometry"}, "still_frames: odometry has the nominal"),
    ({"depth_range": [1.0, 6.0, 5.0]}, "depth_range needs a least and a greatest depth, or sev"),
    ({"depth_range": [1.0, 6.0, 5.0, 4.0]}, "depth_range needs a least and a greatest depth"),
    ({"placement": "rays", "known_landmarks": 3}, "known_landmarks: placement rays has no"),
    ({"placement": "rays", "sensor": "position"}, "placement rays is for a camera"),
    ({"placement": "rays", "in_view": 5}, "in_view: not with placement rays"),
    ({"placement": "rays", "beacons": 3}, "beacons: not with placement rays"),
    ({"known_landmarks": 3, "in_view": 5}, "in_view: not with known_landmarks"),
    ({"range": [5.0, 0.5]}, "range needs a least and a greatest one"),
    ({"range": 5.0}, "range needs 2 values"),
    ({"sensor": "position", "calibration": "white"}, "calibration: a Position sensor has none"),
]
OF_UNITS = [
    ({"sway": [0.1] * 3}, r"the sway of a world has shape \(3,\); it needs \(6,\)"),
    ({"motion": "velocity"}, "sway: not of a ConstantVelocity; use 0"),
    ({"trajectory": "x.txt", "still_frames": 3}, "still_frames: not with an Imu along a"),
]


@pytest.mark.parametrize(
    ("base", "fields", "message"),
    [
        *(("matched", *row) for row in REFUSED),
        *(("imu", *row) for row in OF_UNITS),
        ("matched-6dof", {"placement": "ring", "velocity": [1.2, *[0.0] * 4, 0.3]}, "path that tu"),
        ("cirle", {}, r"'cirle' \(did you mean circle\?\); known: matched-tight"),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_a_scenario_that_makes_no_sense_is_refused_by_field(base, fields, message):
    with pytest.raises(ValueError, match=message):
        scenario(base, fields)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("steps = ", "wrong.toml: "),
        ('base = "cirle"', "unknown base 'cirle'; known: .*circle"),
        ("stepz = 5", r"did you mean steps\?"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "wrong.toml").write_text(text)
    with pytest.raises(ValueError, match=message):
        scenario(tmp_path / "wrong.toml")


# --- what is drawn ------------------------------------------------------------------------------


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
    _, keys = keys_used(monkeypatch, lambda: simulated(chosen))
    assert len(keys) == len(set(keys)) == count


def pixels_without_noise(runs, chosen):
    camera = Camera(jnp.asarray(chosen.focal), jnp.asarray(chosen.centre))

    def one(pose, points):
        seen = jax.vmap(pose.inverse().apply)(points)
        return jax.vmap(project, in_axes=(None, 0))(camera, seen), seen

    ideal, seen = quick_jit(jax.vmap(jax.vmap(one, (0, None))))(runs.poses, runs.points)
    return np.asarray(ideal), np.asarray(seen)


def uniform(numbers, low, high):
    distribution = stats.uniform(low, high - low)
    assert stats.kstest(np.ravel(numbers), distribution.cdf).pvalue > FALSE_ALARM


def in_cameras(runs, points):
    """Points of every frame, in its camera, of many runs."""
    T, n = np.linalg.inv(np.asarray(runs.poses.as_matrix())), points.shape[-1]
    return np.einsum("rfij,rflj->rfli", T[..., :n, :n], points) + T[:, :, None, :n, n]


@pytest.mark.parametrize("name", ["matched", "matched-6dof"])
def test_matched_truth_is_drawn_from_the_filters_prior_and_seen_with_the_stated_noise(name):
    chosen = scenario(name, steps=1, pixel_sigma=0.7)
    runs = batch(chosen, 200)
    ideal, seen = pixels_without_noise(runs, chosen)
    noise = (np.asarray(runs.measured) - ideal)[np.asarray(runs.visible)] / 0.7
    assert noise.size > 4000
    standard_normal(noise)
    ideal, w = ideal[:, 0], 1 / seen[:, 0, ..., -1].ravel()
    low, high = np.array(chosen.first_pixels).T
    assert (ideal >= low - 1e-9).all()
    assert (ideal <= high + 1e-9).all()
    for axis in range(low.size):
        uniform(ideal[..., axis], low[axis], high[axis])
    assert np.asarray(runs.visible)[:, 0].all()
    least, mean, sigma = chosen.least_inverse_depth, 1 / 6, 1 / 12
    assert least < w.min() < 10 * least
    prior = stats.truncnorm((least - mean) / sigma, np.inf, mean, sigma)
    assert stats.kstest(w, prior.cdf).pvalue > FALSE_ALARM


def test_errors_of_patches_stay_as_long_as_they_should():
    """Those of another share of the landmarks are ten times as large."""
    chosen = scenario("matched", pixel_sigma=1e-9, drift_sigma=0.2, drift_frames=5.0, steps=20)
    runs = batch(chosen, 30)
    ideal, _ = pixels_without_noise(runs, chosen)
    seen = np.all(runs.visible, axis=1)
    errors = np.moveaxis(np.asarray(runs.measured) - ideal, 1, 2)[seen][..., 0] / 0.2
    standard_normal((errors[:, 1:] - np.exp(-1 / 5) * errors[:, :-1]) / np.sqrt(1 - np.exp(-2 / 5)))
    standard_normal(errors[:, 0])
    worse = batch(scenario(chosen, drift_wrong=1.0), 30)
    tenfold = np.moveaxis(np.asarray(worse.measured) - ideal, 1, 2)[seen][..., 0] / 0.2
    np.testing.assert_allclose(tenfold, 10 * errors, atol=1e-5)


def test_accelerations_and_the_first_velocity_have_the_stated_sigmas():
    chosen = scenario("matched-6dof-loose", landmarks=1)
    poses = batch(chosen, 100).poses
    before, after = (jax.tree.map(lambda x, p=p: x[:, p], poses) for p in (np.s_[:-1], np.s_[1:]))
    velocity = quick_jit(lambda a, b: (a.inverse() @ b).log())(before, after) * chosen.rate
    acceleration = np.diff(velocity, axis=1) * chosen.rate / np.array(chosen.acceleration_sigma)
    # The first step has its acceleration already.
    sigma = np.hypot(chosen.velocity_sigma, np.array(chosen.acceleration_sigma) / chosen.rate)
    first = (velocity[:, 0] - np.array(chosen.velocity)) / sigma
    for numbers in (acceleration, np.asarray(first)):
        for axis in range(6):
            standard_normal(numbers[..., axis])
    # White: neighbours in time are not correlated.
    neighbours = acceleration[:, 1:] * acceleration[:, :-1]
    centred(neighbours / neighbours.std())


def test_the_camera_circles_around_the_centre_of_the_ring():
    tiny = dict(velocity_sigma=[1e-9] * 3, acceleration_sigma=[1e-9] * 3)
    run = simulated(scenario("circle", tiny))
    points, T = np.asarray(run.points), np.asarray(run.poses.as_matrix())
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
    to_centre = (centre - positions) / 4.0
    np.testing.assert_allclose(np.sum(-T[:, :2, 0] * to_centre, axis=1), 1.0, rtol=1e-5)
    angles = np.unwrap(np.sort(np.arctan2(*(points - centre).T)))
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / 36, rtol=1e-9)
    # In space it is on the left too, and on three levels.
    world = scenario("laps-6dof")
    points = np.asarray(world.placement.points(world, jax.random.key(0)))
    np.testing.assert_allclose(points.mean(axis=0), [-4, 0, 0], atol=1e-9)
    assert set(points[:, 1].tolist()) == {-1.0, 0.0, 1.0}


@pytest.mark.parametrize("drawing", ["constant", "white"])
def test_true_intrinsics_are_drawn_as_stated(drawing):
    """A pixel's deviation from the nominal camera is bearing · δf + δc."""
    given = {"true_calibration": drawing, "pixel_sigma": 1e-9, "velocity_sigma": [0] * 3}
    chosen = scenario("matched", given, steps=20)
    runs = batch(chosen, 40)
    ideal, seen = pixels_without_noise(runs, chosen)
    bearings = seen[..., 0] / seen[..., 1]
    deviation = (np.asarray(runs.measured) - ideal)[..., 0]
    A = np.stack([bearings, np.ones_like(bearings)], axis=-1)
    deltas = np.einsum("rfip,rfp->rfi", np.linalg.pinv(A), deviation) / np.array([3.0, 2.0])
    if drawing == "constant":
        assert np.ptp(deltas, axis=1).max() < 1e-6
        standard_normal(deltas[:, 0])
    else:
        standard_normal(deltas)
        centred(deltas[:, 1:] * deltas[:, :-1])


@cache
def rooms():
    """The room with limits on what is measured, and the same runs without."""
    chosen = scenario("room", steps=60, known_landmarks=14)
    free = scenario(chosen, first_landmarks=0, new_landmarks=0, known_landmarks=0)
    return chosen, batch(chosen, 3), batch(free, 3)


@cache
def among_positions():
    chosen = scenario("positions", steps=100, first_frame=4)
    return chosen, batch(chosen, 10)


@pytest.mark.parametrize("drawn", [rooms, among_positions])
def test_odometry_is_read_with_the_stated_errors_of_a_nominal_motion(drawn):
    chosen, runs, *_ = drawn()
    nominal = np.array(chosen.velocity) / chosen.rate
    # The truth goes straight, and then turns, by the nominal motion, in every step of every run.
    T = np.asarray(runs.poses.as_matrix())
    steps, n = np.linalg.inv(T[:, :-1]) @ T[:, 1:], T.shape[-1] - 1
    np.testing.assert_allclose(steps[..., :n, n] - nominal[:n], 0, atol=1e-12)
    angles = np.arccos((np.trace(steps[..., :n, :n], axis1=-2, axis2=-1) - n + 2) / 2)
    np.testing.assert_allclose(angles, np.abs(nominal[n:]).max(), rtol=1e-9)
    errors = (np.asarray(runs.controls) - nominal) / np.array(chosen.odometry_sigma)
    for axis in range(nominal.size):
        standard_normal(errors[..., axis])
    # White, and independent between axes.
    for product in (errors[:, 1:] * errors[:, :-1], errors * np.roll(errors, 1, axis=-1)):
        centred(product / product.std())


def test_positions_are_measured_in_range_and_with_the_stated_sigma():
    _, runs = among_positions()
    points = np.asarray(runs.points)
    seen_from = in_cameras(runs, np.repeat(points[:, None], 101, axis=1))
    distance = np.linalg.norm(seen_from, axis=-1)
    in_range = (distance >= 0.5) & (distance <= 5.0)
    assert in_range[:, :4].any()
    in_range[:, :4] = False  # before the first frame
    np.testing.assert_array_equal(runs.visible, in_range)
    assert in_range.any()
    assert (seen_from[in_range][:, 1] < 0).any()  # behind, too
    standard_normal((np.asarray(runs.measured) - seen_from)[in_range] / 0.1)


def test_a_camera_stands_exactly_still_and_then_moves_off_with_the_velocity_drawn():
    chosen = scenario("standstill", steps=7, still_frames=3)
    runs, free = batch(chosen, 30), batch(scenario(chosen, still_frames=0, steps=4), 30)
    T, moving = np.asarray(runs.poses.as_matrix()), np.asarray(free.poses.as_matrix())
    np.testing.assert_array_equal(T[:, :4], np.broadcast_to(np.eye(3), (30, 4, 3, 3)))
    np.testing.assert_allclose(T[:, 3:], moving, rtol=0, atol=1e-12)  # the same draws, later
    assert (np.abs(T[:, 4, :2, 2]).max(axis=1) > 1e-4).all()
    # The measurements of a camera that stands still differ by their noise alone.
    change = np.diff(np.asarray(runs.measured)[:, :4], axis=1) / chosen.pixel_sigma / np.sqrt(2)
    standard_normal(change[:, ::2])
    np.testing.assert_allclose(runs.controls, np.full((30, 7), 1 / 30), rtol=1e-15)
    # It may stand still to the end.
    to_the_end = simulated(scenario("standstill", steps=2, still_frames=60))
    assert not np.asarray(to_the_end.poses.translation()).any()


# --- the room -----------------------------------------------------------------------------------


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
    """The limited runs' visibility, in the order of the landmarks of the free ones."""
    distance = np.linalg.norm(free.points[:, :, None] - limited.points[:, None], axis=-1)
    order = distance.argmin(axis=2)
    np.testing.assert_array_equal(
        np.sort(order), np.broadcast_to(np.arange(order.shape[1]), order.shape)
    )
    assert distance.min(axis=2).max() < 1e-9  # rounding of metres, in two programs
    return np.take_along_axis(limited.visible, order[:, None], axis=2)


def test_no_frame_measures_more_than_its_limits_nor_less_than_it_can():
    chosen, *runs = rooms()
    limited, free = (jax.tree.map(np.asarray, run) for run in runs)
    # A limit changes nothing else of a run, in whose program it is: rounding of metres.
    T = limited.poses.as_matrix()
    np.testing.assert_allclose(T, free.poses.as_matrix(), rtol=0, atol=1e-12)
    before, counts = np.zeros((3, 72), bool), []
    for k, used in enumerate(np.moveaxis(same_landmarks(limited, free), 1, 0)):
        visible = free.visible[:, k]
        assert not (used & ~visible).any()
        known, could = (used & before).sum(axis=1), (visible & before).sum(axis=1)
        most_new = chosen.new_landmarks if k else chosen.first_landmarks
        np.testing.assert_array_equal(known, np.minimum(chosen.known_landmarks, could))
        new = np.minimum(most_new, (visible & ~before).sum(axis=1))
        np.testing.assert_array_equal((used & ~before).sum(axis=1), new)
        counts.append((known, could))
        before |= used
    known, could = np.moveaxis(np.array(counts), 1, 0)
    assert (could > known).any(axis=0).all()  # the limit was met
    assert (could[1:] < chosen.known_landmarks).any(axis=0).all()  # and fewer were there to be seen


def test_the_landmarks_of_a_limited_frame_are_drawn_at_random_and_evenly():
    """12 that are all visible: 6 are new in frame 0, of which 2 are measured in every later one."""
    # Far and nearly still, so that nothing leaves the picture.
    still = dict(velocity=(0.0,) * 3, velocity_sigma=(0.0,) * 3, acceleration_sigma=(1e-9,) * 3)
    free = scenario("matched", still, steps=3)
    chosen = scenario(free, first_landmarks=6, known_landmarks=2, new_landmarks=1)
    runs, everything = (jax.tree.map(np.asarray, batch(s, 400)) for s in (chosen, free))
    assert everything.visible.all()
    used = same_landmarks(runs, everything)
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


def test_a_landmark_is_replaced_when_and_only_when_it_leaves_the_picture():
    chosen, runs = coming_and_going()
    new, points = np.asarray(runs.new), np.asarray(runs.points)
    assert runs.visible.shape == (60, 41, 8)
    assert np.asarray(runs.visible).all()  # always as many are in view
    assert ((runs.measured > -1e-3) & (runs.measured < np.array(chosen.image) + 1e-3)).all()
    seen_from = in_cameras(runs, points)
    pixels = seen_from[..., :2] / seen_from[..., 2:] * 650 + np.array([320, 240])
    np.testing.assert_allclose(runs.measured, pixels, rtol=0, atol=1e-4)
    assert new[:, 0].all()
    assert 0.02 < new[:, 1:].mean() < 0.5
    stays = (points[:, 1:] == points[:, :-1]).all(axis=-1)
    np.testing.assert_array_equal(stays, ~new[:, 1:])
    # Where the one of the frame before would be now.
    before = np.concatenate([points[:, :1], points[:, :-1]], axis=1)
    x, y, z = np.moveaxis(in_cameras(runs, before), -1, 0)
    u, v = 650 * x / z + 320, 650 * y / z + 240
    inside = (z > chosen.visible_depth) & (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
    np.testing.assert_array_equal(inside[:, 1:], ~new[:, 1:])


def test_it_is_thrown_along_a_random_ray_at_a_random_depth():
    chosen, runs = coming_and_going()
    new = np.asarray(runs.new)
    depth = in_cameras(runs, np.asarray(runs.points))[..., 2]
    later = new & (np.arange(41) > 0)[:, None]
    for some in (new, later):
        uniform(depth[some], *chosen.depth_range)
        for axis, interval in enumerate(chosen.first_pixels):
            uniform(np.asarray(runs.measured)[some][:, axis], *interval)
    # Neither slots nor frames repeat one another.
    assert len(np.unique(depth[new])) == new.sum()


def test_depths_change_in_the_middle_of_a_run():
    run = jax.tree.map(lambda x: x[None], simulated(scenario("laps-change", steps=40)))
    depth = in_cameras(run, np.asarray(run.points))[0, ..., 1]
    new = np.asarray(run.new)[0]
    early, late = depth[:20][new[:20]], depth[21:][new[21:]]
    assert min(early.size, late.size) > 5
    assert 1 < early.min() < early.max() < 6
    assert 5 < late.min() < 10 < late.max() < 50


def test_features_and_slots_of_landmarks_that_come_and_go():
    run = jax.tree.map(lambda x: x[0], coming_and_going()[1])
    room = Room(10, 8, 8, 8)  # with room for two more
    of_run = quick_jit(lambda run: (sightings(run), features(run, room), gone(run, room)))
    most, (first, known, fresh), left = jax.tree.map(np.asarray, of_run(run))
    new = np.asarray(run.new)
    assert (most.landmarks, most.first) == (8, 8)
    assert most.new == new[1:].sum(axis=1).max()
    assert most.known == (~new).sum(axis=1).max()
    assert left.shape == (40, 10)
    assert first.valid.all()
    for k in range(40):
        assert set(np.flatnonzero(left[k])) == set(np.flatnonzero(new[k + 1]))
        assert set(fresh.slots[k][fresh.valid[k]]) == set(np.flatnonzero(new[k + 1]))
        assert set(known.slots[k][known.valid[k]]) == set(np.flatnonzero(~new[k + 1]))
    # One that ends without a successor is gone in the frame in which it is not seen, and only then.
    ended = dataclasses.replace(run, visible=run.visible.at[7:, 3].set(False))
    *_, left = of_run(ended)
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
    chosen = scenario("circle", steps=260, rate=10.0)
    run = quick_jit(partial(simulate, chosen))(jax.random.key(1))
    most = jax.tree.map(int, quick_jit(sightings)(run))
    room = Room(most.landmarks, most.first, most.known, most.new)
    return chosen, run, most, quick_jit(lambda run: features(run, room))(run)


def test_every_visible_landmark_is_a_feature_exactly_once():
    _, run, most, (first, *later) = circling()
    visible, pixels = np.asarray(run.visible), np.asarray(run.measured)
    frames = [[first]] + [
        [jax.tree.map(lambda x, k=k: x[k], part) for part in later] for k in range(len(visible) - 1)
    ]
    in_map, found = set(), np.zeros_like(visible, dtype=int)
    for k, parts in enumerate(frames):
        *known, new = (
            (np.asarray(part.slots)[part.valid], np.asarray(part.measured)[part.valid])
            for part in parts
        )
        for slots, measured in (*known, new):
            found[k, slots] += 1
            np.testing.assert_array_equal(measured, pixels[k, slots])
        assert all(in_map.issuperset(slots.tolist()) for slots, _ in known)
        assert in_map.isdisjoint(new[0].tolist())
        in_map.update(new[0].tolist())
    np.testing.assert_array_equal(found, visible)
    # The run is worth its name: some come later, some go and come back.
    assert later[1].valid.any()
    changes = np.diff(visible.astype(int), axis=0)
    assert (visible[0] & (changes == 1).any(axis=0)).any()
    # Sightings are the smallest capacities that hold it.
    assert len(in_map) == most.landmarks == visible.any(axis=0).sum()
    assert most.first == first.valid.sum() == first.valid.size
    for part, capacity in zip(later, (most.known, most.new), strict=True):
        assert part.valid.sum(axis=1).max() == capacity == part.valid.shape[1]
    # Landmarks are in the order of their first appearance.
    appearance = np.where(visible.any(axis=0), visible.argmax(axis=0), len(visible))
    assert (np.diff(appearance) >= 0).all()


def test_visible_means_inside_the_picture_and_in_front():
    chosen, run, *_ = circling()
    ideal, seen = (x[0] for x in pixels_without_noise(jax.tree.map(lambda x: x[None], run), chosen))
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
    run = simulated(scenario("laps", steps=300, in_view=6, rate=10.0))
    who, new, seen = (np.asarray(x) for x in (run.identity, run.new, run.visible))
    np.testing.assert_array_equal(seen, who >= 0)
    stays = seen[1:] & ~new[1:]
    np.testing.assert_array_equal(who[1:][stays], who[:-1][stays])
    for row in who[::50]:
        held = row[row >= 0].tolist()
        assert len(set(held)) == len(held)
    _, times = np.unique(who[new], return_counts=True)
    assert np.sum(times > 1) > 20
    frame, slot = 150, int(np.flatnonzero(seen[150])[0])
    pose = jax.tree.map(lambda x: x[frame], run.poses)
    x, z = pose.inverse() @ run.points[frame, slot]
    assert abs(float(run.measured[frame, slot, 0]) - (650 * x / z + 320)) < 3


# --- inertial units -------------------------------------------------------------------------------


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


def test_a_unit_that_first_stands_still_reads_no_motion():
    run = simulated(scenario("imu", steps=6, still_frames=4, landmarks=2), 1)
    away = np.linalg.norm(run.poses.translation(), axis=1)
    assert away[:5].max() < 1e-7
    assert away[6] > 1e-5
