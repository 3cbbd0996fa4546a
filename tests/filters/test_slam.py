"""Tests of jaxslam.filters.slam: composition, robocentric against world, and whole runs in JAX."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, a_filter, close, each_geometry, named, pose, quick_jit

from jaxslam.filters.gaussian import compose_first, insert
from jaxslam.filters.linear import covariance as linear
from jaxslam.filters.model import Context, Core
from jaxslam.filters.readouts import (
    camera_pose,
    landmarks_from_above,
    landmarks_in_camera,
    landmarks_in_world,
)
from jaxslam.filters.slam import Slam
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import PLANAR, SPATIAL, joined
from jaxslam.landmarks import InverseScaling
from jaxslam.models.frame import Keyframe, Robocentric, Submaps, WorldCentric
from jaxslam.models.observations import Features
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import scenario

DT = 0.1
HERE = Context(DT)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_all_frames_speak_of_the_same_camera_and_the_same_point(geometry):
    """`T_CB ← T_{k-1,k}⁻¹ T_CB`, landmarks moved, against `T_BC ← T_BC T_{k-1,k}` and no more; in
    those by way of a keyframe T_KC."""
    T_BC, landmark, rng = pose(geometry, 2), InverseScaling(), np.random.default_rng(2)
    velocity, acceleration = jnp.asarray(rng.normal(size=(2, geometry.tangent_dim)))
    X_B = jnp.array([0.3, -0.2, 1.0, 0.2])[-geometry.point_dim - 1 :]

    def moved(frame, parameters):
        model = a_filter(geometry, landmark, frame).model
        core = Core(frame.from_base_pose(T_BC), velocity, None, acceleration, jnp.zeros(0))
        for _ in range(2):
            if model.moves_landmarks:
                parameters = model.compose_landmark(model.view(core, HERE), parameters, HERE)
            core = replace(model.compose_core(core, HERE), noise=acceleration)
        point, omega = landmark.homogeneous(parameters)
        return frame.camera_pose(core.pose), core.motion, point / omega

    @quick_jit
    def after():
        X_C = landmark.transform(T_BC.inverse(), X_B)
        in_camera = [moved(frame, X_C) for frame in (Robocentric(), Submaps(), Keyframe())]
        return moved(WorldCentric(), X_B), *in_camera

    (T, v, in_base), *others, by_keyframe = after()
    assert np.abs(T.translation() - T_BC.translation()).max() > 0.01
    np.testing.assert_allclose(v, velocity + 2 * acceleration * DT, rtol=0, atol=1e-14)
    for (pose_there, w, point), base_from in (*((x, T) for x in others), (by_keyframe, T_BC)):
        np.testing.assert_allclose(w, v, rtol=0, atol=1e-14)
        np.testing.assert_allclose(pose_there.as_matrix(), T.as_matrix(), atol=1e-14)
        np.testing.assert_allclose(base_from @ point, in_base, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_in_a_gauge_the_noise_is_scaled_but_says_nothing_of_the_scale(geometry):
    """`a e^−λ` moves the camera, its turn as it is; but the derivative by λ is none."""
    model = a_filter(geometry, scale=ScaleGauge()).model
    rng, n = np.random.default_rng(3), geometry.point_dim
    velocity, noise = jnp.asarray(rng.normal(size=(2, geometry.tangent_dim)))

    def core_of(log_scale, noise):
        held = Robocentric().from_base_pose(pose(geometry, 2))
        return Core(held, velocity, log_scale, noise, jnp.zeros(0))

    def moved(log_scale, noise, context=HERE):
        core = core_of(log_scale, noise)
        after = model.compose_core(core, context)
        return model.displacement(core, context).as_matrix(), after.motion

    log_scale = jnp.array([0.7])
    given = model.given(core_of(log_scale, noise), HERE)
    assert not any(np.any(part) for part in quick_jit(jax.jacfwd(moved))(log_scale, noise, given))
    # Only where it is given: a derivative of a whole run is the exact one, by e^−λ a.
    less = noise.at[n:].set(0.0)
    for by_scale, by_noise in quick_jit(jax.jacfwd(moved, argnums=(0, 1)))(log_scale, noise):
        close(by_scale[..., 0], -by_noise @ less, 1e-12)
    smaller = noise.at[:n].multiply(np.exp(-0.7))
    scaled, plain = (quick_jit(moved)(*x) for x in ((log_scale, noise), (0 * log_scale, smaller)))
    for found, expected in zip(scaled, plain, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_in_a_gauge_lengths_are_told_in_metres():
    slam, slots = tight().filter("scale_gauge"), jnp.arange(3)
    state = quick_jit(partial(slam.init, tight().capacity))(tight().frames(0)[0])

    @quick_jit
    def told(log_scale):
        held = slam.frame.from_base_pose(pose(PLANAR, 3))
        core = replace(state.core, pose=held, log_scale=log_scale[None])
        here = replace(state, core=core)
        return (
            camera_pose(slam, here)[0].translation(),
            landmarks_in_world(slam, here, slots)[0],
            landmarks_in_camera(slam, here, slots, slam.sensor)[0],
            landmarks_from_above(slam, here, slots)[0],
        )

    one, larger = told(jnp.asarray(0.0)), told(jnp.asarray(0.5))
    factor = np.exp(0.5)
    for found, before, by in zip(
        larger, one, (factor, factor, [1, 1 / factor], [1, 1 / factor]), strict=True
    ):
        np.testing.assert_allclose(found, before * np.asarray(by), rtol=0, atol=1e-12)


@cache
def tight():
    """A run of `matched-tight`, where an EKF is nearly exact."""
    return Case("matched-tight", seed=3)


@pytest.mark.parametrize("kind", ["robocentric", "world"])
def test_a_step_leaves_no_acceleration_and_no_white_calibration_behind(kind):
    case = tight()
    slam = case.filter(kind, "inverse_scaling", "white")
    first, known, new = case.frames(0)

    def two(first):
        state = slam.init(case.capacity, first)
        predicted = slam.predict(state, jnp.asarray(DT))
        seen, fresh = (jax.tree.map(lambda x: x[0], part) for part in (known, new))
        return predicted, slam.step(state, jnp.asarray(DT), seen, fresh)[0]

    predicted, state = quick_jit(two)(first)
    appended = np.diag(predicted.covariance)[6:11]
    used = np.zeros(3) if compose_first(slam) else np.full(3, 0.02**2)
    np.testing.assert_allclose(appended, [*used, 9.0, 4.0], rtol=1e-14)
    assert not np.any(state.covariance[6:11])
    assert not np.any(state.covariance[:, 6:11])
    assert not np.any([*state.core.noise, *state.core.calibration])


def test_a_map_from_above_is_azimuth_and_inverse_distance_along_the_axes_of_the_world():
    """Of a camera that is turned in every direction; azimuth from z towards x."""
    slam = make_filter("robocentric", **scenario_pieces(scenario("matched-6dof")))
    assert isinstance(slam, Slam)
    seen = Features(jnp.arange(2), jnp.array([[100.0, 90.0], [500.0, 300.0]]), jnp.ones(2, bool))
    T_BC = pose(SPATIAL, 5, scale=1.0)

    @quick_jit
    def told():
        state = slam.init(2)
        state = replace(state, core=replace(state.core, pose=slam.frame.from_base_pose(T_BC)))
        ask = (slam, insert(slam, state, seen), jnp.arange(2))
        return landmarks_from_above(*ask)[0], landmarks_in_world(*ask)[0]

    above, points = told()
    x, _, z = (points - T_BC.translation()).T
    np.testing.assert_allclose(above[:, 0], np.arctan2(x, z), rtol=0, atol=1e-12)
    np.testing.assert_allclose(above[:, 1], 1 / np.hypot(x, z), rtol=1e-12)


def test_a_frame_with_new_landmarks_becomes_an_anchor_that_no_other_landmark_has():
    slam = tight().filter("robocentric", "framed_homogeneous")

    @quick_jit
    def inserted(state, slot):
        return insert(slam, state, Features(slot, jnp.array([[300.0]]), jnp.array([True])))

    state = slam.init(3)
    for slot in ([0], [1], [2]):
        state = inserted(state, jnp.array(slot))
    before = state.landmarks[:, -1].tolist()
    assert sorted(before) == [0, 1, 2]
    state = slam.remove(state, jnp.arange(3) == 1)
    assert inserted(state, jnp.array([1])).landmarks[:, -1].tolist() == before


@pytest.mark.parametrize("kind", ["robocentric", "world"])
def test_pose_error_is_zero_at_the_truth_and_refers_to_the_covariance(kind):
    case = tight()
    T_BC, delta = pose(PLANAR, 4), np.array([0.01, -0.02, 0.03])
    slam = case.filter(kind)
    state = slam.init(1)
    held = slam.frame.from_base_pose(T_BC)
    state = replace(state, core=replace(state.core, pose=held))
    state = linear.augmented(state, 0, jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    error, covariance = slam.pose_error(state, T_BC)
    np.testing.assert_allclose(error, np.zeros(3), rtol=0, atol=1e-14)
    # By the derivative of a pose by itself: a turn there and back, which is the identity but for
    # rounding.
    np.testing.assert_allclose(covariance, np.diag([1.0, 2.0, 3.0]), rtol=0, atol=1e-14)
    # The truth is the estimate perturbed by δ: as a whole and on the right where the camera is
    # the base; along the axes of B, and turned, where B is.
    if kind == "robocentric":
        truth = (held @ PLANAR.group.exp(jnp.asarray(delta))).inverse()
    else:
        turn = type(held.rotation).from_radians(delta[2])
        truth = joined(held.rotation @ turn, held.translation + delta[:2])
    error, _ = slam.pose_error(state, truth)
    np.testing.assert_allclose(error, delta, rtol=1e-10)
