"""Tests of worlds of pieces: put together, named in files, drawn, surveyed and shown."""

import dataclasses
import json
import math
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit, simulated, standard_normal

import jaxslam
from jaxslam.models import AnyArray, number_field
from jaxslam.models.sensors import FieldOfView
from jaxslam.simulation import BUILT_IN, Limits, Room, as_data, features, scenario, sightings
from jaxslam.simulation.fields import FIELDS
from jaxslam.simulation.scenario import parse_override

MINE = """
import jax.numpy as jnp
import jaxslam
from jaxslam.models import AnyArray, number_field

class Sonar(jaxslam.AbstractSensor):
    sigma: AnyArray = number_field(default=0.1)
    size = 2
    point_dim = 2

    def measure(self, point, omega):
        return point / omega

    def locate(self, measured, hidden):
        return measured, jnp.ones(())

class Walk(jaxslam.AbstractMotion):
    noise_sigma: AnyArray = number_field(default=(0.1, 0.1, 0.1))
    geometry = jaxslam.PLANAR

    def displacement(self, variables, noise, control):
        return self.geometry.group.exp(control + noise)

    def still(self, dtype=None):
        return jnp.zeros(3, dtype)

    def nominal_control(self, velocity, seconds):
        return velocity * seconds

class Row(jaxslam.AbstractPlacement):
    apart: float = 1.0
    landmarks = 3

    def points(self, world, key):
        along = self.apart * jnp.arange(3.0)
        return jnp.stack([along, jnp.full(3, 2.0)], axis=1)
"""


def a_world(**pieces):
    usual: dict[str, Any] = {
        "motion": jaxslam.Odometry([0.02, 0.02, 0.01]),
        "sensor": jaxslam.RangeBearing([0.1, 0.02]),
        "placement": jaxslam.Ring(landmarks=6, radius=6.0),
        "steps": 5,
    }
    return jaxslam.World(**{**usual, **pieces})


def test_a_world_of_pieces_is_a_scenario():
    world = a_world(rate=20.0, limits=Limits(first_landmarks=4), name="mine")
    told = json.loads(json.dumps(world.to_dict()))
    assert list(told) == list(FIELDS)
    assert (told["sensor"], told["motion"], told["placement"]) == (
        "range_bearing", "odometry", "ring",
    )  # fmt: skip
    assert (told["ring_radius"], told["range_bearing_sigma"]) == (6.0, [0.1, 0.02])
    assert told["velocity"] == [0.0, 1.2, 0.3]  # in a circle of 4 m, which a ring is around
    longer = scenario(world, steps=7)
    assert (longer.steps, longer.first_landmarks, longer.sensor) == (7, 4, world.sensor)
    run = simulated(world)
    assert run.measured.shape == (6, 6, 2)
    assert run.visible.sum(axis=1).tolist()[0] == 4
    assert set(jaxslam.make_filters(world, "world", "cartesian")) == {"world/cartesian"}


def test_a_motion_and_a_sensor_take_the_place_of_the_worlds():
    sensor, motion = jaxslam.Position(0.2), jaxslam.Odometry([0.5, 0.5, 0.1])
    own = quick_jit(lambda key: jaxslam.simulate("circle", key, motion=motion, sensor=sensor))
    world = dataclasses.replace(
        scenario("circle", true_calibration="nominal", calibration="known"),
        motion=motion,
        sensor=sensor,
    )
    key = jax.random.key(1)
    for a, b in zip(jax.tree.leaves(own(key)), jax.tree.leaves(simulated(world, 1)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.fixture
def mine(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    return tmp_path


def test_pieces_of_ones_own_are_named_in_files(mine):
    (mine / "own.toml").write_text(
        'base = "positions"\nsteps = 4\nlandmarks = 3\nsensor = "mine:Sonar"\n'
        'motion = "mine.py:Walk"\nplacement = {type = "mine:Row", apart = 0.5}\n'
    )
    world = scenario(mine / "own.toml")
    kinds = [type(x).__name__ for x in (world.motion, world.sensor, world.placement)]
    assert kinds == ["Walk", "Sonar", "Row"]
    told = json.loads(json.dumps(world.to_dict()))
    assert told["sensor"] == {"type": "mine:Sonar", "sigma": 0.1}
    assert told["placement"] == {"type": "mine:Row", "apart": 0.5}
    again = scenario("positions", told)  # as a suite reads it
    assert np.array_equal(again.motion.noise_sigma, world.motion.noise_sigma)
    run = simulated(world)
    np.testing.assert_array_equal(run.points, [[0.0, 2.0], [0.5, 2.0], [1.0, 2.0]])
    name, value = parse_override("sensor={type='mine:Sonar', sigma=0.3}")
    given = scenario("positions", {name: value}, placement=jaxslam.GivenPoints([[1.0, 2.0]]))
    assert (given.sensor.sigma, given.landmarks) == (0.3, 1)
    by_field = scenario("positions", placement="points", points=[[1, 2], [3, 4]])
    np.testing.assert_array_equal(simulated(by_field).points, [[1, 2], [3, 4]])


@pytest.mark.usefixtures("mine", "unchecked")
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"sensor": "mine:Radar"}, "scenario field sensor: mine:Radar: module 'mine' has no"),
        ({"sensor": "thine:Sonar"}, "scenario field sensor: thine:Sonar: No module named 'thine'"),
        ({"sensor": "none.py:Sonar"}, "scenario field sensor: none.py:Sonar: .*No such file"),
        ({"sensor": "sonar"}, "sensor is 'sonar'; known: camera, .*, or module:Class"),
        (
            {"sensor": {"type": "range_bearing", "sigm": 0.1}},
            "range_bearing takes no sigm; its fields of a scenario are range_bearing_sigma",
        ),
        ({"sensor": {"sigma": 1}}, "scenario field sensor is a word, module:Class, a table"),
        ({"sensor": {"type": "mine:Sonar", "sigm": 1}}, "sensor: mine:Sonar: .*sigm"),
        ({"sensor": "mine:Walk"}, "sensor is an instance of AbstractSensor, not Walk"),
        ({"placement": "points"}, "points need 2 numbers each in a planar world"),
        ({"placement": "points", "points": [1, 2]}, "points must be a list of points"),
        ({"beacons": 16}, "beacons: at most the 15 landmarks are accepted"),
        ({"beacons": 3, "in_view": 5}, "beacons: .*none with in_view"),
        ({"motion": jaxslam.Odometry([0.1] * 6)}, "the velocity of a world has shape"),
        ({"sensor": jaxslam.Position(0.1, point_dim=3)}, "Position is not for a planar world"),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_pieces_that_make_no_world_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        scenario("positions", fields)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"motion": jaxslam.Odometry([0.1, math.nan, 0.1])}, "motion.noise_sigma holds nan"),
        ({"sensor": jaxslam.Position(-0.1)}, "sensor.sigma must not be negative, not -0.1"),
        ({"sensor": jaxslam.Position}, "sensor is an instance of AbstractSensor, not <class"),
        ({"view": 3}, "view is an instance of FieldOfView, not 3"),
        ({"view": FieldOfView([0, math.inf])}, "view.range holds inf; it must be finite"),
        ({"depth": "near"}, "depth is an instance of InverseDepth, not 'near'"),
        ({"treatment": "maybe"}, "calibration is 'maybe'; known: white"),
        ({"steps": 2.5}, "steps of World must be a whole number, not 2.5"),
        ({"beacons": "3"}, "beacons of World must be a whole number, not '3'"),
        ({"rate": [10.0]}, r"rate of World must be a number, not \[10.0\]"),
        ({"placement": jaxslam.GivenPoints(np.zeros((0, 2)))}, r"one point at least; .* \(0, 2\)"),
    ],
)
def test_numbers_that_make_no_world_are_refused(given, message):
    pieces = {"motion": jaxslam.Odometry([0.1] * 3), "sensor": jaxslam.Position(0.1)}
    with pytest.raises(ValueError, match=message):
        jaxslam.World(**pieces | {"placement": jaxslam.Ring()} | given)


def test_whole_numbers_may_be_those_of_arrays_and_a_world_of_pieces_is_json():
    motion, sensor = jaxslam.Odometry([0.1] * 3), jaxslam.Position(0.1)
    four: Any = np.int64(4)
    world = jaxslam.World(motion, sensor, jaxslam.Ring(four), steps=four)
    told = json.loads(json.dumps(world.to_dict(), allow_nan=False))
    assert scenario("positions", told) == world == scenario(world, steps=4)
    with pytest.raises(ValueError, match=r"noise_sigma holds nan"):
        jaxslam.Slam(jaxslam.Odometry([math.nan] * 3), sensor, jaxslam.Cartesian())


class Sonar(jaxslam.AbstractSensor):
    """A position whose σ grows with the distance, and whose coordinates are correlated."""

    share: AnyArray = number_field(default=0.05)
    sigma = 1.0
    size = 2
    point_dim = 2

    def measure(self, point, omega):
        return point / omega

    def locate(self, measured, hidden):
        del hidden
        return measured, jnp.ones(())

    def noise_at(self, measured):
        return (self.share**2 * measured @ measured) * jnp.array([[1.0, 0.6], [0.6, 1.0]])


def test_noise_is_that_of_the_measurement():
    world = a_world(sensor=Sonar(), steps=400, placement=jaxslam.Ring(landmarks=12, radius=8.0))
    run = simulated(world)
    away = run.points[None] - run.poses.translation()[:, None]
    exact = jax.vmap(lambda R, x: x @ R)(run.poses.rotation().as_matrix(), away)
    error, distance = run.measured - exact, jnp.linalg.norm(exact, axis=-1)
    assert distance.max() > 2 * distance.min()
    root = np.linalg.cholesky([[1.0, 0.6], [0.6, 1.0]])
    white = np.linalg.solve(root, (error / (0.05 * distance)[..., None]).reshape(-1, 2).T)
    for numbers in white:
        standard_normal(numbers)
    for half in np.array_split(np.argsort(distance.ravel()), 2):  # near and far alike
        assert np.std(white[:, half]) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(white[0] * white[1])) * np.sqrt(white[0].size) < 5


def test_beacons_are_known_before_the_first_frame():
    world = scenario("circle", steps=30, beacons=9, beacon_sigma=0.2)
    drawn = quick_jit(jax.vmap(lambda key: jaxslam.simulate(world, key)))
    runs = drawn(jax.vmap(jax.random.key)(jnp.arange(50)))
    run, plain = jax.tree.map(lambda x: x[0], runs), simulated(scenario(world, beacons=0))
    assert run.known is not None
    np.testing.assert_array_equal(run.known.slots, np.arange(9))
    every = np.asarray(plain.points)[:, None] - np.asarray(run.points[:9])
    assert np.abs(every).sum(axis=-1).min(axis=0).max() == 0  # the same world
    spread = np.sort(np.arctan2(*(np.asarray(run.points[:9]) - [-4.0, 0.0]).T))
    np.testing.assert_allclose(np.diff(spread), 2 * np.pi / 9, atol=1e-9)
    np.testing.assert_allclose(run.known.covariance, 0.04 * np.eye(18))
    room = Room(36, 36, 36, 36)
    seen, (first, known, new) = quick_jit(lambda run: (sightings(run), features(run, room)))(run)
    assert run.visible[:, :9].any()
    for part, beacons in ((first, False), (known, True), (new, False)):
        assert bool(np.any(part.valid & (part.slots < 9))) == beacons
    assert seen.landmarks == np.sum(run.visible.any(axis=0)[9:]) + 9
    standard_normal((runs.known.points - runs.points[:, :9]) / 0.2)


def test_a_seed_is_a_key():
    by_seed = quick_jit(lambda: jaxslam.simulate(a_world(), 3))()
    np.testing.assert_allclose(by_seed.measured, simulated(a_world(), 3).measured, rtol=1e-12)
    for wrong in (-1, True, jnp.zeros(3)):
        with pytest.raises(ValueError, match=r"a key is jax.random.key\(seed\), or a seed of 0"):
            jaxslam.simulate("matched", wrong)


def test_worlds_that_differ_in_numbers_share_their_programs():
    for name, fields in (("circle", {"focal": 400.0}), ("positions", {"ring_radius": 4.0})):
        one, other = as_data(BUILT_IN[name]), as_data(scenario(name, fields, name="other"))
        assert jax.tree.structure(one) == jax.tree.structure(other)
        assert [x.dtype for x in jax.tree.leaves(one)] == [x.dtype for x in jax.tree.leaves(other)]
    assert jax.tree.structure(as_data(BUILT_IN["laps"])) != jax.tree.structure(one)
    kept = {scenario("circle"): 1, scenario("circle", focal=400.0): 2}
    assert (kept[BUILT_IN["circle"]], len(kept)) == (1, 2)


def test_a_world_is_shown(tmp_path):
    world = scenario("circle", steps=3, beacons=3, landmarks=6, ring_radius=6.0)
    figure = world.plot(path=tmp_path / "of" / "world.png")
    assert (tmp_path / "of" / "world.png").stat().st_size > 10_000
    (ax,) = figure.axes
    around = ax.get_tightbbox()
    assert around is not None
    assert around.y1 <= figure.bbox.y1  # with its title
    lines = {line.get_label(): np.asarray(line.get_xydata()) for line in ax.get_lines()}
    assert len(lines["beacon, as surveyed"]) == 3
    assert len(lines["measured"]) + len(lines["never measured"]) == 6
    world = scenario("handheld", steps=2, landmarks=5)
    run = simulated(world)
    (path,) = (x for x in world.plot(run).axes[0].get_lines() if x.get_label() == "true path")
    np.testing.assert_array_equal(path.get_xydata(), run.poses.translation()[:, [0, 2]])
