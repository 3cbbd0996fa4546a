"""Tests of a rolling shutter: every row is seen from where the camera is then."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import a_filter, each_geometry, named, quick_jit

import jaxslam
from jaxslam.cli.track import TrackOptions
from jaxslam.consistency import draw, run_through
from jaxslam.geometry import exp, homogeneous_apply
from jaxslam.models.camera import Camera, project
from jaxslam.models.motion import Odometry
from jaxslam.models.sensors import Pinhole
from jaxslam.tracking.settings import TrackerSettings

LINE = 1e-4
VELOCITY = np.array([0.6, -0.2, 0.4, 0.3, 0.8, -0.2])


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_pixel_is_that_of_a_camera_at_the_time_of_its_row(geometry):
    p, n = geometry.pixel_dim, geometry.point_dim
    camera = Camera([500.0] * p, [320.0, 240.0][:p])
    velocity = jnp.asarray(VELOCITY if n == 3 else VELOCITY[[0, 2, 4]])
    sensor = Pinhole(camera, 0.3, LINE).moving(velocity)
    point, omega = jnp.asarray([0.7, 0.9, 2.0])[-n:], jnp.asarray(0.5)

    @quick_jit
    def both(point):
        pixel = sensor.measure(point, omega)
        time = LINE * (pixel[-1] - camera.centre[-1])
        there = homogeneous_apply(exp(geometry.group, -time * velocity), point, omega)
        return pixel, project(camera, there), sensor.locate(pixel, omega[None] / point[-1])

    pixel, seen, (ray, _) = both(point)
    still = project(camera, point)
    assert np.linalg.norm(pixel - still) > 4
    np.testing.assert_allclose(pixel, seen, atol=0.02)
    # The depth of the row's camera is not that of the frame's, but nearly.
    np.testing.assert_allclose(project(camera, ray), still, atol=0.3)
    np.testing.assert_array_equal(Pinhole(camera, 0.3).measure(point, omega), still)


def test_a_filter_that_knows_the_readout_is_consistent_and_one_that_does_not_is_not():
    world = jaxslam.scenario("matched-turn", {"steps": 20})
    assert isinstance(world.sensor, Pinhole)
    rolling = replace(world, sensor=replace(world.sensor, line=1e-4))
    # In a unit of its own, in which the velocity counts too.
    (knows,) = jaxslam.make_filters(rolling, ["scale_gauge+oc"]).values()
    (does_not,) = jaxslam.make_filters(world, ["robocentric"]).values()
    room, runs = draw(rolling, 40, seed=5)

    def nees(slam):
        def of(state, _, frame):
            error, P = slam.pose_error(state, frame.pose)
            return error @ jnp.linalg.solve(P, error)

        one = quick_jit(jax.vmap(lambda run: run_through(slam, room, run, of)[1]))
        return np.mean(one(runs)[:, -5:])

    assert nees(knows) < 4.2
    assert nees(does_not) > 30


@pytest.mark.parametrize("time", ["20ms", " 0.02 s", ".02", "20000us", "20000 µs"])
def test_a_readout_is_a_time_with_a_unit(time):
    assert TrackOptions(readout=time)._settings().readout == pytest.approx(0.02)


def test_it_needs_a_velocity():
    slam = a_filter(each_geometry[1])
    with pytest.raises(ValueError, match="a rolling shutter is for a motion whose variables are"):
        replace(slam, motion=Odometry(np.ones(6)), sensor=replace(slam.sensor, line=LINE))
    for time in (-1, 20):
        with pytest.raises(ValueError, match=f"from 0 to 1 s, such as 20ms, not {time} s"):
            TrackerSettings(readout=time)
