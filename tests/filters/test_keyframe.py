"""Tests of the keyframe's frame: when one is due, and what it changes."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, each_geometry, named, quick_jit

from jaxslam.filters.gaussian import reanchored
from jaxslam.filters.linear.covariance import augmented
from jaxslam.filters.linear.state import State
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera, landmarks_in_world
from jaxslam.filters.words import FILTERS
from jaxslam.geometry import PLANAR, SPATIAL, difference, exp, identity, joined, tangent_dim
from jaxslam.landmarks import ImagePlane, InverseScaling
from jaxslam.models.calibration import TREATMENTS
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import Keyframe, KeyframePose
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features
from jaxslam.models.sensors import Pinhole

IMAGE_PLANE = ImagePlane()
CAPACITY, STEPS, DT = 5, 10, 0.1
# Landmark of each slot: the frame in which it is new, and that after which it is removed.
LIVES = ((0, None), (0, None), (3, None), (0, 5), (6, None))


def axes(geometry, planar, spatial):
    return jnp.array(planar if geometry is PLANAR else spatial)


def velocity(geometry):
    """Sideways, turning: 0.014 rad a step, so that the fourth and the eighth make keyframes."""
    return axes(geometry, [0.3, 0.1, 0.14], [0.3, 0.0, 0.1, 0.0, -0.14, 0.02])


def make(kind, geometry, calibration="white", scale=1.0, landmark=IMAGE_PLANE):
    """A filter, every σ of which is times a scale."""
    p, t = geometry.pixel_dim, geometry.tangent_dim
    return FILTERS[kind](
        motion=ConstantVelocity(
            scale * np.full(t, 0.3), velocity(geometry), scale * np.full(t, 0.02)
        ),
        sensor=Pinhole(Camera(np.full(p, 400.0), np.full(p, 300.0)), scale * 1.0),
        landmark=landmark,
        calibration=TREATMENTS[calibration](scale * np.full(2 * p, 2.0)),
        depth=InverseDepth(0.25, scale * 0.05),
    )


@cache
def world(geometry, scale=1.0):
    """New and known features, and removed landmarks, of every frame; all errors times a scale."""
    rng = np.random.default_rng(3)
    slam, p = make("keyframe", geometry, scale=scale), geometry.pixel_dim
    still, poses = jnp.zeros(geometry.tangent_dim), [identity(geometry, jnp.float64)]
    started = velocity(geometry) + scale * 0.02 * rng.normal(size=geometry.tangent_dim)
    step = slam.motion.displacement(started, still, DT)
    for _ in range(STEPS):
        poses.append(poses[-1] @ step)
    # The depths that the prior speaks of are those in the camera that sees a landmark first.
    depths = 1 / (0.25 + scale * 0.05 * rng.normal(size=CAPACITY))
    bearings = np.column_stack([rng.uniform(-0.3, 0.3, (CAPACITY, p)), np.ones(CAPACITY)])
    seen_first = zip(LIVES, depths, bearings, strict=True)
    points = jnp.stack([poses[born] @ (depth * ray) for (born, _), depth, ray in seen_first])

    new, seen, gone = [], [], []
    for k, pose in enumerate(poses):
        inside = jax.vmap(pose.inverse().apply)(points)
        pixels = jax.vmap(slam.sensor.measure, in_axes=(0, None))(inside, 1.0)
        pixels += scale * rng.normal(size=pixels.shape)
        slots = jnp.arange(CAPACITY)
        unseen = k % 3 == np.arange(CAPACITY) % 3  # every landmark is missed now and then
        known = np.array([born < k and (end is None or k <= end) for born, end in LIVES])
        new.append(Features(slots, pixels, jnp.array([born == k for born, _ in LIVES])))
        seen.append(Features(slots, pixels, jnp.asarray(known & np.logical_not(unseen))))
        gone.append(jnp.array([end == k for _, end in LIVES]))
    return tuple(jax.tree.map(lambda *x: jnp.stack(x), *part) for part in (new, seen, gone))


def run(slam, pose_sigma, new, seen, gone):
    """States, covariances, NIS and camera poses of every step, from an uncertain pose."""
    state = slam.init(CAPACITY)
    size = tangent_dim(state.core.pose)
    state = augmented(state, 0, pose_sigma**2 * jnp.eye(size))
    if slam.calibration.each_frame:
        drawn = jnp.diag(slam.calibration.sigma**2)
        state = augmented(state, state.core.part("calibration").start, drawn)
    state = slam.close(state, jax.tree.map(lambda x: x[0], new))

    def step(state, frame):
        new, seen, gone = frame
        state, innovation = slam.step(state, jnp.array(DT), seen, new)
        state = slam.remove(state, gone)
        return state, (state, state.covariance, innovation.nis, camera_pose(slam, state))

    later = jax.tree.map(lambda x: x[1:], (new, seen, gone))
    return jax.lax.scan(step, state, later)[1]


def compiled(kind, geometry, calibration="white", scale=1.0):
    return quick_jit(partial(run, make(kind, geometry, calibration, scale)))


in_the_plane_quickly = pytest.mark.parametrize(
    "geometry", [PLANAR, pytest.param(SPATIAL, marks=pytest.mark.slow)], ids=named
)
"""Where the run is the subject: in space it takes as long again, by the same functions."""


@in_the_plane_quickly
def test_the_run_has_keyframes_new_landmarks_and_removed_ones(geometry):
    states = compiled("keyframe", geometry)(jnp.array(1e-2), *world(geometry))[0]
    keyframes = np.asarray(states.core.pose.base_from_keyframe.translation())
    assert np.sum(np.abs(np.diff(keyframes[:, 0])) > 0.05) == 2
    assert np.asarray(states.active).sum(axis=1).tolist() == [3, 3, 4, 4, 3, 4, 4, 4, 4, 4]


def correlated(geometry):
    """A keyframe filter and its state, all of it correlated; slots 1 and 4 are empty."""
    slam = make("keyframe", geometry, "known")
    state = slam.init(CAPACITY)
    rng = np.random.default_rng(1)
    active = np.array([True, False, True, True, False])
    d, c = geometry.point_dim, state.core_dim
    present = np.concatenate([np.ones(c, bool), np.repeat(active, d)])
    root = 0.01 * rng.normal(size=(present.sum(), 2 * present.sum()))
    P = np.zeros((len(present), len(present)))
    P[np.ix_(present, present)] = root @ root.T
    T_KC = exp(geometry.group, jnp.asarray(rng.uniform(-0.2, 0.2, geometry.tangent_dim)))
    held = replace(state.core.pose, keyframe_from_camera=T_KC)
    landmarks = np.column_stack([rng.uniform(-0.3, 0.3, (CAPACITY, d - 1)), np.full(CAPACITY, 0.3)])
    landmarks = jnp.asarray(landmarks)
    mean = replace(state.core, pose=held), landmarks, jnp.asarray(active)
    return slam, State(*mean, jnp.asarray(P))


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_reanchoring_changes_neither_the_camera_nor_the_points(geometry):
    slam, state = correlated(geometry)
    slots = jnp.array([0, 2, 3])

    def told(state):
        points = landmarks_in_world(slam, state, slots)
        return (
            camera_pose(slam, state),
            points,
            landmarks_in_camera(slam, state, slots, slam.sensor),
        )

    after = quick_jit(partial(reanchored, slam))(state)
    told = quick_jit(told)
    for a, b in zip(jax.tree.leaves(told(after)), jax.tree.leaves(told(state)), strict=True):
        close(a, b, 1e-12)
    t = geometry.tangent_dim
    np.testing.assert_array_equal(after.covariance[t : 2 * t], np.zeros_like(after.covariance[:t]))
    held = after.core.pose.keyframe_from_camera
    np.testing.assert_array_equal(held.as_matrix(), np.eye(geometry.point_dim + 1))
    assert np.abs(after.landmarks - state.landmarks)[slots].min(axis=1).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["keyframe", "robocentric"])
def test_filters_of_two_frames_differ_to_second_order(kind):
    apart = []
    for scale in (0.1, 0.01):
        data = (jnp.array(0.0), *world(PLANAR, scale))
        runs = [compiled(name, PLANAR, "known", scale)(*data) for name in (kind, "world")]
        (ours, P), (theirs, _) = (run[3] for run in runs)
        shift = jax.vmap(difference)(ours, theirs)
        apart.append(np.abs(shift / np.sqrt(np.diagonal(P, axis1=1, axis2=2)))[-1].max())
    # Errors of second order, by a σ that is of first.
    assert 0 < apart[1] < apart[0] / 5
    assert apart[1] < 1e-2


def test_a_keyframe_is_due_after_a_turn_or_a_baseline():
    near, far = jnp.array([0.5, 0.0, 0.5]), jnp.array([0.01, 0.0, 0.0])
    frame, origin = Keyframe(turn=0.2, parallax=0.1), identity(PLANAR, jnp.float64)
    moved, turned = jnp.array([0.3, 0.4, 0.0]), jnp.array([0.0, 0.0, 0.22])

    def left(displacement, inverse_distances):
        held = KeyframePose.at(origin).moved(PLANAR.group.exp(displacement))
        return frame.left(held, inverse_distances)

    assert left(moved, near)
    assert not left(moved, far)
    assert not left(moved, jnp.zeros(3))
    assert left(turned, far)
    assert not left(0.8 * turned, near)


@pytest.mark.parametrize("landmark", [InverseScaling(), ImagePlane()], ids=named)
def test_a_parallax_is_the_way_from_the_keyframe_by_the_distance_of_the_map(landmark):
    """Whatever length a parametrization gives to a ray, and of landmarks in the map alone."""
    slam = make("keyframe", PLANAR, "known", landmark=landmark)
    distance = 5.0
    ray = jnp.array([0.75, 1.0])
    seen = landmark.initialise(ray, jnp.asarray(1.25 / distance), jnp.asarray(650.0))

    def due(way, inverse_depth):
        state = slam.init(3)
        empty = landmark.initialise(ray, jnp.asarray(inverse_depth), jnp.asarray(650.0))
        there = joined(state.core.pose.keyframe_from_camera.rotation(), jnp.array([0.0, way]))
        pose = replace(state.core.pose, keyframe_from_camera=there)
        state = replace(
            state,
            core=replace(state.core, pose=pose),
            landmarks=jnp.stack([seen, seen, empty]),
            active=jnp.array([True, True, False]),
        )
        return bool(slam.model.keyframe_left(state))

    least = slam.frame.parallax * distance
    assert not due(0.99 * least, 100.0)
    assert due(1.01 * least, 100.0)
