"""Tests of what a filter is told of its landmarks: a map from before, and each one's own noise."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import a_filter, close, named, quick_jit

from jaxslam.filters.gate import Gate
from jaxslam.filters.readouts import landmarks_in_world
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import PLANAR, SPATIAL
from jaxslam.landmarks import LANDMARKS, Cartesian, InverseScaling
from jaxslam.models.frame import Keyframe, Robocentric, WorldCentric
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features, PriorMap
from jaxslam.models.sensors import Position, RangeBearing
from jaxslam.simulation import scenario

SLOTS = jnp.array([3, 0, 2])


def a_map(geometry, seed=0, sigma=0.1):
    """Three points ahead, in slots out of order, that are uncertain together."""
    rng, n = np.random.default_rng(seed), geometry.point_dim
    points = rng.uniform(-1, 1, (3, n)) + 4.0 * np.eye(n)[-1]
    root = sigma * rng.normal(size=(3 * n, 3 * n))
    return PriorMap(SLOTS, points, root @ root.T)


@pytest.mark.parametrize(
    ("geometry", "landmark", "frame"),
    [
        (PLANAR, InverseScaling(), Robocentric()),
        (SPATIAL, InverseScaling(), Keyframe()),
        (SPATIAL, Cartesian(), WorldCentric()),
    ],
    ids=named,
)
def test_a_filter_starts_with_a_prior_map(geometry, landmark, frame):
    """Its points in the map, and `J C Jᵀ` of them jointly; the camera is still known."""
    slam, known = a_filter(geometry, landmark, frame), a_map(geometry)
    focal, n = jnp.asarray(slam.sensor.focal), geometry.point_dim

    @quick_jit
    def begun(known):
        def parameters(points):
            one = jax.vmap(lambda point: landmark.initialise(point, jnp.ones(()), focal))
            return one(points.reshape(-1, n))

        state = slam.init(5, known=known)
        J = jax.jacfwd(parameters)(known.points.ravel())
        return state, landmarks_in_world(slam, state, known.slots), parameters(known.points), J

    state, (points, covariances), parameters, J = begun(known)
    assert np.flatnonzero(state.active).tolist() == sorted(SLOTS)
    np.testing.assert_allclose(points, known.points, rtol=1e-14)
    np.testing.assert_array_equal(state.landmarks[SLOTS], parameters)
    blocks = known.covariance.reshape(3, n, 3, n)[np.arange(3), :, np.arange(3)]
    close(covariances, blocks, 1e-13)
    c, d = state.core_dim, landmark.size(n)
    rows = (c + d * SLOTS[:, None] + np.arange(d)).ravel()
    J = np.asarray(J).reshape(3 * d, 3 * n)
    expected = np.zeros_like(state.covariance)
    expected[np.ix_(rows, rows)] = J @ known.covariance @ J.T
    close(state.covariance, expected, 1e-13)


def test_in_a_gauge_a_prior_map_is_in_metres_whatever_the_unit():
    """Points are known exactly, unit and metre are not: in metres nothing is left of that."""
    slam: Any = make_filter("scale_gauge", **scenario_pieces(scenario("matched")))
    slam, known = replace(slam, depth=replace(slam.depth, unit=0.4)), a_map(PLANAR, sigma=0.0)
    told = quick_jit(lambda: landmarks_in_world(slam, slam.init(4, known=known), SLOTS))
    points, covariances = told()
    np.testing.assert_allclose(points, known.points, rtol=1e-13)
    np.testing.assert_allclose(covariances, 0, atol=1e-13)


@pytest.mark.usefixtures("unchecked")
def test_a_prior_map_of_another_shape_or_of_no_use_is_refused():
    pieces, known = scenario_pieces(scenario("matched")), a_map(PLANAR)
    for name, landmark, message in (
        ("world+particles", "cartesian", "a delayed initialisation takes no prior map"),
        ("robocentric+mixture3+rest", "cartesian", "start from a window takes no prior map"),
    ):
        slam = make_filter(name, landmark=LANDMARKS[landmark], **pieces)
        with pytest.raises(ValueError, match=message):
            slam.init(4, known=known)
    slam = make_filter("world", **pieces)
    again = Features(jnp.array([1, 1]), jnp.ones((2, 1)), jnp.ones(2, bool))
    P, points = np.eye(6), np.ones((3, 2))
    for given, message in (
        ((SLOTS, points, P[:4, :4]), r"covariance has shape \(4, 4\); it needs \(6, 6\)"),
        (([3, 0, 2], points.tolist(), 0.1), r"covariance has shape \(\); it needs \(6, 6\)"),
        (([1, 1, 2], points, P), r"slots of a prior map .* 0 to 3, each .*, not \[1, 1, 2\]"),
        (([0, 1, 4], points, P), "slots of a prior map are whole"),
        (([0, -1, 2], points, P), "slots of a prior map are whole"),
        ((SLOTS, points * np.nan, P), "map's points holds nan"),
        ((SLOTS, points, P + np.eye(6, k=1)), "covariance is symmetric"),
        ((SLOTS, points, -P), "with no variance below 0"),
    ):
        with pytest.raises(ValueError, match=message):
            slam.init(4, known=PriorMap(*given))
    for slots in ([1, 1], [-1, 1], [1, 4]):
        with pytest.raises(ValueError, match="slots of features are whole numbers from 0 to 3"):
            slam.init(4, replace(again, slots=jnp.array(slots)))


class FarIsWorse(Position):
    """A position whose σ is a share of its distance."""

    def noise_at(self, measured):
        return self.sigma**2 * (measured @ measured) * jnp.eye(measured.size)


class FarRangesAreWorse(RangeBearing):
    """A range whose σ is a share of itself."""

    def noise_at(self, measured):
        return jnp.diag(self.sigma**2 * jnp.array([measured[0] ** 2, 1.0]))


def test_a_tolerance_is_a_share_of_the_noise_of_each_number_of_each_measurement():
    """A bearing that is 20 of its σ off is no right match; a far range, off by more metres, is."""
    sensor, gate = FarRangesAreWorse((0.1, 0.01)), Gate("individual", tolerance=5.0)
    slam = a_filter(PLANAR, Cartesian(), sensor=sensor, gate=gate)
    at = jnp.array([[4.0, 0.3], [5.0, -0.2], [6.0, 0.1], [10.0, 0.6]])
    off = jnp.array([[0.0, 0.2], [0.0, 0.0], [5.4, 0.0], [-8.0, 0.0]])
    first = Features(jnp.arange(4), at, jnp.ones(4, bool))

    def used(first, seen):
        state = slam.init(4, first)
        control = jnp.asarray(1.0)
        return slam.update(slam.predict(state, control), control, seen)[1].used

    assert quick_jit(used)(first, first).all()
    seen = replace(first, measured=at + off)
    assert quick_jit(used)(first, seen).tolist() == [False, True, True, False]


def test_every_measurement_has_its_own_noise():
    """In insertion, in what is expected, and in the update: of its factor, and of the sensor."""
    factor = np.array([4.0, 0.25])
    measured = np.array([[0.5, 2.0], [1.0, 6.0]])
    slots, valid = jnp.arange(2), jnp.ones(2, bool)
    still = {"motion": ConstantVelocity(*np.zeros((3, 3))), "landmark": Cartesian()}

    def run(sensor, factor):
        slam = a_filter(PLANAR, sensor=sensor, **still)
        seen = Features(slots, jnp.asarray(measured), valid, factor)
        state = slam.predict(slam.init(2, seen), jnp.asarray(0.2))
        expected = slam.predict_features(state, jnp.asarray(0.2), slots).covariance
        after, innovation = slam.update(state, jnp.asarray(0.2), seen)
        told = partial(landmarks_in_world, slam)
        S = innovation.covariance.reshape(2, 2, 2, 2)[slots, :, slots]
        return told(state, slots)[1], expected, S, told(after, slots)[1]

    eye = np.eye(2)
    for sensor, factors, R, of_sensor in (
        (Position(0.1), factor, 0.01 * factor, [0.01, 0.01]),
        (FarIsWorse(0.1), None, 0.01 * np.sum(measured**2, axis=1), None),
        (FarIsWorse(0.1), factor, 0.01 * np.sum(measured**2, axis=1) * factor, None),
    ):
        of_sensor = 0.01 * np.sum(measured**2, axis=1) if of_sensor is None else of_sensor
        inserted, expected, S, after = quick_jit(partial(run, sensor))(factors)
        close(inserted, R[:, None, None] * eye, 1e-12)
        close(expected, (R + of_sensor)[:, None, None] * eye, 1e-12)
        close(S, 2 * R[:, None, None] * eye, 1e-12)
        close(after, R[:, None, None] / 2 * eye, 1e-12)
