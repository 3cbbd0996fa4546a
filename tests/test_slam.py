"""Tests of jaxslam.filters.slam: composition, robocentric against world, and whole runs in JAX."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, close, each_geometry, few_landmarks, named, pose, quick_jit

from jaxslam.filters import CALIBRATIONS, FILTERS, Features, SlamFilter, SlamModel, State, ekf
from jaxslam.filters.slam import ROBOCENTRIC, WORLD, Context, Core
from jaxslam.geometry import PLANAR, joined
from jaxslam.landmarks import INVERSE_SCALING
from jaxslam.rig import Rig

DT = 0.1


@cache
def composer(geometry, landmark, frame):
    """`(pose, velocity, acceleration, landmark) → the same after the motion`, no covariance."""
    model = SlamModel(Rig(geometry), landmark, frame)
    context = Context(None, jnp.asarray(DT))

    def compose(pose, velocity, acceleration, parameters):
        core = Core(frame.hold(pose), velocity, acceleration, jnp.zeros(0))
        moved = model.compose_core(core, context)
        if frame.moves_landmarks:
            view = model.view(core, context)
            parameters = model.compose_landmark(view, parameters, context)
        return frame.pose(moved.pose), moved.velocity, parameters

    return quick_jit(compose)


@cache
def a_landmark(geometry, landmark):
    def make():
        bearing = jnp.array([0.3, -0.2])[: geometry.pixel_dim]
        seen = landmark.initialise(jnp.append(bearing, 1.0), jnp.asarray(0.2), jnp.asarray(650.0))
        return landmark.transform(pose(geometry, 1), seen)

    return quick_jit(make)()


def euclidean(landmark, parameters):
    point, omega = landmark.homogeneous(parameters)
    return np.asarray(point / omega)


@pytest.mark.parametrize("frame", [ROBOCENTRIC, WORLD], ids=named)
@pytest.mark.parametrize("landmark", few_landmarks, ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_composition_with_no_motion_is_the_identity(geometry, landmark, frame):
    T, X = pose(geometry, 2), a_landmark(geometry, landmark)
    zero = jnp.zeros(geometry.tangent_dim)
    moved, velocity, parameters = composer(geometry, landmark, frame)(T, zero, zero, X)
    np.testing.assert_allclose(moved.parameters(), T.parameters(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(parameters, X, rtol=1e-14, atol=1e-15)
    np.testing.assert_array_equal(velocity, zero)


@pytest.mark.parametrize("frame", [ROBOCENTRIC, WORLD], ids=named)
@pytest.mark.parametrize("landmark", few_landmarks, ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_composition_with_a_motion_and_its_inverse_is_the_identity(geometry, landmark, frame):
    T, X = pose(geometry, 2), a_landmark(geometry, landmark)
    rng = np.random.default_rng(1)
    velocity, zero = rng.normal(size=geometry.tangent_dim), jnp.zeros(geometry.tangent_dim)
    compose = composer(geometry, landmark, frame)
    there, _, X_there = compose(T, velocity, zero, X)
    assert np.abs(there.parameters() - T.parameters()).max() > 0.01
    back, _, X_back = compose(there, -velocity, zero, X_there)
    np.testing.assert_allclose(back.as_matrix(), T.as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(X_back, X, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("landmark", few_landmarks, ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_both_frames_speak_of_the_same_camera_and_the_same_point(geometry, landmark):
    """`T_CB ← T_{k-1,k}⁻¹ T_CB` and P20 against `T_BC ← T_BC T_{k-1,k}` and nothing at all."""
    T_BC, X_B = pose(geometry, 2), a_landmark(geometry, landmark)
    rng = np.random.default_rng(2)
    velocity, acceleration = rng.normal(size=(2, geometry.tangent_dim))
    X_C = landmark.transform(T_BC.inverse(), X_B)
    robocentric, world = (composer(geometry, landmark, f) for f in (ROBOCENTRIC, WORLD))
    T_CB, v, X_C = robocentric(T_BC.inverse(), velocity, acceleration, X_C)
    T_BC, w, X_B = world(T_BC, velocity, acceleration, X_B)
    np.testing.assert_allclose(v, velocity + acceleration * DT, rtol=1e-15)
    np.testing.assert_array_equal(v, w)
    np.testing.assert_allclose(T_CB.inverse().as_matrix(), T_BC.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(
        T_BC @ euclidean(landmark, X_C), euclidean(landmark, X_B), rtol=1e-12, atol=1e-12
    )


# --- whole runs ---------------------------------------------------------------------------------


@cache
def tight():
    """Five runs of `matched-tight`, where an EKF is nearly exact."""
    return Case("matched-tight", runs=5, seed=3)


def test_robocentric_and_world_agree_where_the_problem_is_linear():
    """What differs is of second order in the noise, hence of first order in units of σ."""
    case = tight()
    first, known, new = case.frames(0)
    differences = {}
    # The noise is scaled in everything: pixels, motion, and the prior on depth, whose mean is
    # true. (Below a hundredth, jaxlie's derivatives near zero rotation are what is compared.)
    for scale in (1.0, 0.1):
        parameters = case.parameters()
        parameters = replace(
            parameters,
            motion_sigma=parameters.motion_sigma * scale,
            measurement_sigma=parameters.measurement_sigma * scale,
            inverse_depth_sigma=parameters.inverse_depth_sigma * scale,
        )
        slots, valid = known.slots, known.valid
        pixels = perfect_pixels(case, parameters, scale)
        frames = (
            replace(first, measured=pixels[0][first.slots]),
            Features(slots, jnp.take_along_axis(pixels[1:], slots[..., None], 1), valid),
            new,
        )
        velocity, velocity_sigma, controls = case.motion()
        motion = (velocity, velocity_sigma * scale, controls)
        (T, P), (U, Q) = (
            case.compiled(kind, "inverse_scaling")(parameters, motion, *frames)[1][:2]
            for kind in ("robocentric", "world")
        )
        sigma = np.sqrt(np.einsum("kii->ki", np.asarray(P)))
        apart = np.asarray((T.inverse() @ U).log()) / sigma
        differences[scale] = np.abs(apart).max()
        np.testing.assert_allclose(
            np.sqrt(np.einsum("kii->ki", np.asarray(Q))), sigma, rtol=0.1 * scale
        )
    # In units of σ the difference is O(scale): measured 0.0286 and 0.0029.
    assert differences[1.0] < 0.06
    assert differences[0.1] < 0.2 * differences[1.0]


def perfect_pixels(case, parameters, scale):
    """Pixels of points at the mean of the prior, in the nominal motion, with scaled noise."""
    frames, landmarks = case.runs.visible.shape[1:]
    f, c = 650.0, 320.0
    bearings = (np.linspace(60, 580, landmarks) - c) / f
    depth = 1 / float(parameters.inverse_depth)
    x = bearings * depth - 1.2 / 30 * np.arange(frames)[:, None]
    noise = np.random.default_rng(0).normal(size=x.shape) * 0.3 * scale
    return jnp.asarray(f * x / depth + c + noise)[..., None]


def test_one_trace_serves_every_call_of_a_step():
    case = tight()
    slam = case.filter("robocentric", "inverse_scaling")
    traces = []

    def step(state, parameters, dt, known, new):
        traces.append(None)
        return slam.step(state, parameters, dt, known, new)

    first, known, new = case.frames(0)
    start = quick_jit(
        lambda parameters, first: slam.first(
            slam.start(parameters, case.capacity, jnp.zeros(3), jnp.full(3, 0.1)),
            parameters,
            first,
        )
    )
    state, compiled = start(case.parameters(), first), quick_jit(step)
    for k, measurement_sigma in enumerate((0.3, 0.5, 1.0)):
        parameters = replace(case.parameters(), measurement_sigma=jnp.asarray(measurement_sigma))
        seen = jax.tree.map(lambda x, k=k: x[k], known)
        # What is seen, the noise, and the time all change.
        seen = replace(seen, valid=seen.valid & (jnp.arange(seen.valid.size) >= k))
        fresh = jax.tree.map(lambda x, k=k: x[k], new)
        state, innovation = compiled(state, parameters, jnp.asarray(0.03 + 0.01 * k), seen, fresh)
        assert innovation.nis_dof == seen.valid.sum()
    assert len(traces) == 1


def leaves_close(actual, expected, relative):
    """Every array within `relative` of its largest entry."""
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=relative * max(1e-3, np.abs(b).max()))


def test_a_batch_of_runs_is_the_runs_one_by_one():
    case = tight()
    parameters = case.parameters()
    slam = case.filter("robocentric", "inverse_scaling")
    mapped = jax.vmap(case.function(slam), in_axes=(None, None, 0, 0, 0))
    _, (poses, pose_covariances, _, nis) = quick_jit(mapped)(
        parameters, case.motion(), *case.features
    )
    for i in range(5):
        _, (one, covariance, _, one_nis) = case.compiled("robocentric", "inverse_scaling")(
            parameters, case.motion(), *case.frames(i)
        )
        # The same sums in another order, over 60 steps.
        batch = jax.tree.map(lambda x, i=i: x[i], (poses, pose_covariances, nis))
        leaves_close(batch, (one, covariance, one_nis), 1e-8)


def test_single_precision_is_near_double():
    case = tight()

    def result(dtype):
        data = (case.parameters(), case.motion(), *case.frames(0))
        data = jax.tree.map(np.asarray, data)
        with jax.enable_x64(dtype == "float64"):
            _, (T, P, _, nis) = case.compiled("robocentric", "inverse_scaling")(*data)
        assert nis.dtype == dtype
        sigma = np.sqrt(np.einsum("kii->ki", np.asarray(P, float)))
        return np.asarray(T.parameters(), float), sigma, np.asarray(nis, float)

    (T, sigma, nis), (U, single_sigma, single_nis) = result("float64"), result("float32")
    # Measured 0.014 σ, 0.4 % of σ, and 0.017 of a NIS of about 12.
    assert np.abs((U - T)[:, 2:] / sigma[:, :2]).max() < 0.05
    assert np.abs(single_sigma / sigma - 1).max() < 0.015
    assert np.abs(single_nis - nis).max() < 0.06


def test_a_run_can_be_differentiated_by_its_noise():
    """d(position, σ and NIS)/d(acceleration σ), backwards through every step."""
    case = Case("matched-tight", steps=4, landmarks=4)
    first, *later = case.frames(0)
    slam = case.filter("robocentric", "inverse_scaling")
    parameters, (velocity, velocity_sigma, controls) = case.parameters(), case.motion()
    start = slam.start(parameters, case.capacity, velocity, velocity_sigma)
    start = quick_jit(slam.first)(start, parameters, first)

    def score(sigma):
        noisy = replace(parameters, motion_sigma=sigma)

        def step(state, frame):
            state, innovation = slam.step(state, noisy, *frame)
            return state, innovation.nis

        state, nis = jax.lax.scan(step, start, (controls, *later))
        pose_variance = jnp.trace(state.covariance[:3, :3])
        # Scaled so that each part matters: metres, log σ², and numbers compared.
        return 1e3 * state.core.pose.translation()[0] + jnp.log(pose_variance) + nis.mean()

    sigma = parameters.motion_sigma
    gradient = np.asarray(quick_jit(jax.grad(score))(sigma))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 1e-3
    # Steps of 1e-3: curvature leaves 1e-6 of the largest, rounding of the NIS about as much.
    value, h = quick_jit(score), 1e-3 * np.asarray(sigma)
    differences = [(value(sigma + d) - value(sigma - d)) / (2 * d.max()) for d in np.diag(h)]
    close(differences, gradient, 1e-4)


# --- the pieces of a frame ----------------------------------------------------------------------


def test_the_start_is_exact_in_the_pose_and_empty_in_the_map():
    case = tight()
    slam = case.filter("robocentric", "inverse_scaling", "white")
    state = slam.start(case.parameters(), 3, jnp.array([1.2, 0.0, 0.1]), jnp.array([0.1, 0.2, 0.3]))
    assert isinstance(state, State)
    assert not state.active.any()
    sigma = np.zeros(len(state.covariance))
    sigma[3:6] = 0.1, 0.2, 0.3
    np.testing.assert_allclose(state.covariance, np.diag(sigma**2), rtol=1e-15)
    np.testing.assert_array_equal(state.core.pose.as_matrix(), np.eye(3))
    assert state.core_dim == 3 + 3 + 3 + 2


@pytest.mark.parametrize("kind", list(FILTERS))
def test_a_step_leaves_no_acceleration_and_no_white_calibration_behind(kind):
    case = tight()
    slam = case.filter(kind, "inverse_scaling", "white")
    first, known, new = case.frames(0)

    def two(parameters):
        state = slam.start(parameters, case.capacity, jnp.zeros(3), jnp.full(3, 0.1))
        state = slam.first(state, parameters, first)
        predicted = slam.predict(state, parameters, jnp.asarray(DT))
        seen = jax.tree.map(lambda x: x[0], known)
        fresh = jax.tree.map(lambda x: x[0], new)
        return predicted, slam.step(state, parameters, jnp.asarray(DT), seen, fresh)[0]

    predicted, state = quick_jit(two)(case.parameters())
    appended = np.diag(predicted.covariance)[6:11]
    used = np.zeros(3) if slam.compose_first else np.full(3, 0.02**2)
    np.testing.assert_allclose(appended, [*used, 9.0, 4.0], rtol=1e-14)
    assert not np.any(state.covariance[6:11])
    assert not np.any(state.covariance[:, 6:11])
    np.testing.assert_array_equal(state.core.noise, np.zeros(3))
    np.testing.assert_array_equal(state.core.calibration, np.zeros(2))


def test_an_unknown_calibration_is_refused_by_name():
    model = SlamModel(Rig(PLANAR), INVERSE_SCALING, ROBOCENTRIC)
    with pytest.raises(ValueError, match="'black'") as error:
        SlamFilter(model, "black")
    assert all(name in str(error.value) for name in CALIBRATIONS)


@pytest.mark.parametrize("frame", [ROBOCENTRIC, WORLD], ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_frame_holds_every_pose_and_gives_it_back(geometry, frame):
    T = pose(geometry, 3, scale=1.0)
    again = frame.pose(frame.hold(frame.pose_from_camera(T)))
    np.testing.assert_allclose(
        frame.pose_from_camera(again).as_matrix(), T.as_matrix(), rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("kind", list(FILTERS))
def test_pose_error_is_zero_at_the_truth_and_refers_to_the_covariance(kind):
    case = tight()
    T_BC, delta = pose(PLANAR, 4), np.array([0.01, -0.02, 0.03])
    slam = case.filter(kind, "inverse_scaling")
    frame = slam.model.frame
    state = slam.start(case.parameters(), 1, jnp.zeros(3), jnp.full(3, 0.1))
    held = frame.pose_from_camera(T_BC)
    state = replace(state, core=replace(state.core, pose=frame.hold(held)))
    state = ekf.augment(state, 0, jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    error, covariance = slam.pose_error(state, T_BC)
    np.testing.assert_allclose(error, np.zeros(3), atol=1e-15)
    np.testing.assert_array_equal(covariance, np.diag([1.0, 2.0, 3.0]))
    # The truth is the estimate perturbed by δ: as a whole and on the right where the camera is
    # the base; along the axes of B, and turned, where B is.
    if kind == "robocentric":
        truth = held @ PLANAR.group.exp(jnp.asarray(delta))
    else:
        turn = type(held.rotation()).from_radians(delta[2])
        truth = joined(held.rotation() @ turn, held.translation() + delta[:2])
    error, _ = slam.pose_error(state, frame.pose_from_camera(truth))
    np.testing.assert_allclose(error, delta, rtol=1e-10)
