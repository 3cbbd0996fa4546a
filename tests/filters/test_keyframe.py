"""Tests of the keyframe's frame: when one is due, and what it changes."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import close, each_geometry, named, quick_jit

from jaxslam.filters.gaussian import reanchored
from jaxslam.filters.linear.state import State
from jaxslam.filters.readouts import camera_pose, landmarks_in_camera, landmarks_in_world
from jaxslam.filters.words import FILTERS
from jaxslam.geometry import PLANAR, exp, identity, joined
from jaxslam.landmarks import ImagePlane, InverseScaling
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import Keyframe, KeyframePose
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.sensors import Pinhole

IMAGE_PLANE = ImagePlane()
CAPACITY = 5


def make(geometry, landmark=IMAGE_PLANE):
    p, t = geometry.pixel_dim, geometry.tangent_dim
    return FILTERS["keyframe"](
        motion=ConstantVelocity(np.full(t, 0.3), np.full(t, 0.1), np.full(t, 0.02)),
        sensor=Pinhole(Camera(np.full(p, 400.0), np.full(p, 300.0)), 1.0),
        landmark=landmark,
        depth=InverseDepth(0.25, 0.05),
    )


def correlated(geometry):
    """A keyframe filter and its state, all of it correlated; slots 1 and 4 are empty."""
    slam = make(geometry)
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


@pytest.mark.parametrize(("turn", "left"), [(0.19, False), (0.21, True)])
def test_a_keyframe_is_due_after_a_turn(turn, left):
    held = KeyframePose.at(identity(PLANAR, jnp.float64))
    held = held.moved(PLANAR.group.exp(jnp.array([0.0, 0.0, turn])))
    assert Keyframe(turn=0.2, parallax=0.1).left(held, jnp.zeros(3)) == left


@pytest.mark.parametrize("landmark", [InverseScaling(), ImagePlane()], ids=named)
def test_a_parallax_is_the_way_from_the_keyframe_by_the_distance_of_the_map(landmark):
    """Whatever length a parametrization gives to a ray, and of landmarks in the map alone."""
    slam = make(PLANAR, landmark)
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
