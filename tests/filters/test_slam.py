"""Tests of jaxslam.filters.slam: composition, robocentric against world, and whole runs in JAX."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import (
    Case,
    a_filter,
    central,
    close,
    each_geometry,
    few_landmarks,
    named,
    pose,
    quick_jit,
    quick_rows,
    run_filter,
)

from jaxslam._numerics.arrays import cast
from jaxslam.consistency.likelihood import log_likelihood
from jaxslam.filters.gaussian import compose_first, insert
from jaxslam.filters.linear import covariance as linear
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.filters.readouts import (
    camera_pose,
    landmarks_from_above,
    landmarks_in_camera,
    landmarks_in_world,
)
from jaxslam.filters.slam import Slam
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import PLANAR, SPATIAL, joined, retract
from jaxslam.landmarks import (
    LANDMARKS,
    InverseDepthToCartesian,
    ParallaxAngle,
)
from jaxslam.models.calibration import TREATMENTS, Estimated
from jaxslam.models.frame import Keyframe, Robocentric, WorldCentric
from jaxslam.models.observations import Features
from jaxslam.models.scale import ScaleGauge
from jaxslam.simulation import scenario

DT = 0.1
HERE = Context(DT)


@cache
def composer(geometry, landmark, frame):
    """`(T_BC, velocity, acceleration, landmark) → the same after the motion`, no covariance."""
    model = a_filter(geometry, landmark, frame).model
    context = Context(jnp.asarray(DT))

    def compose(pose, velocity, acceleration, parameters):
        core = Core(frame.from_base_pose(pose), velocity, None, acceleration, jnp.zeros(0))
        moved = model.compose_core(core, context)
        if frame.moves_landmarks:
            view = model.view(core, context)
            parameters = model.compose_landmark(view, parameters, context)
        return frame.camera_pose(moved.pose), moved.motion, parameters

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


@pytest.mark.parametrize("frame", [Robocentric(), WorldCentric()], ids=named)
@pytest.mark.parametrize("landmark", few_landmarks, ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_composition_with_no_motion_or_one_and_its_inverse_is_the_identity(
    geometry, landmark, frame
):
    T, X = pose(geometry, 2), a_landmark(geometry, landmark)
    zero, compose = jnp.zeros(geometry.tangent_dim), composer(geometry, landmark, frame)
    for velocity in (zero, np.random.default_rng(1).normal(size=zero.size)):
        there, kept, X_there = compose(T, velocity, zero, X)
        np.testing.assert_array_equal(kept, velocity)
        assert (np.abs(there.parameters() - T.parameters()).max() > 0.01) == np.any(velocity)
        back, _, X_back = compose(there, -velocity, zero, X_there)
        np.testing.assert_allclose(back.as_matrix(), T.as_matrix(), rtol=0, atol=1e-14)
        np.testing.assert_allclose(X_back, X, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("landmark", few_landmarks, ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_both_frames_speak_of_the_same_camera_and_the_same_point(geometry, landmark):
    """`T_CB ← T_{k-1,k}⁻¹ T_CB`, landmarks moved, against `T_BC ← T_BC T_{k-1,k}` and no more."""
    T_BC, X_B = pose(geometry, 2), a_landmark(geometry, landmark)
    rng = np.random.default_rng(2)
    velocity, acceleration = rng.normal(size=(2, geometry.tangent_dim))
    X_C = landmark.transform(T_BC.inverse(), X_B)
    robocentric, world = (composer(geometry, landmark, f) for f in (Robocentric(), WorldCentric()))
    by_camera, v, X_C = robocentric(T_BC, velocity, acceleration, X_C)
    T_BC, w, X_B = world(T_BC, velocity, acceleration, X_B)
    for found in (v, w):
        np.testing.assert_allclose(found, velocity + acceleration * DT, rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_camera.as_matrix(), T_BC.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(
        T_BC @ euclidean(landmark, X_C), euclidean(landmark, X_B), rtol=1e-12, atol=1e-12
    )


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


@cache
def in_gauge():
    """A filter whose scale is known to a third, in frame 0."""
    case = tight()
    slam = case.filter("scale_gauge")
    slam = begun_with(slam, [1.2, 0.0, 0.0], [0.4, 0.1, 0.1])
    return slam, quick_jit(partial(slam.init, case.capacity))(case.frames(0)[0])


def begun_with(slam, velocity, sigma):
    """The filter with another prior on the velocity before the first step."""
    return replace(slam, motion=replace(slam.motion, velocity=velocity, velocity_sigma=sigma))


def test_in_a_gauge_inverse_depths_have_the_moments_of_a_product_with_a_log_normal():
    """`E e^λ ρ = e^(λ + P/2) ρ0` and `E (e^λ ρ)² = e^(2λ + 2P) (ρ0² + σ²)`, exactly."""
    slam, state = in_gauge()
    log_scale, P = slam.marginal(state, lambda view: view.core.log_scale)
    log_scale, P = float(log_scale[0]), float(P[0, 0])
    assert P > 0.1
    mean, sigma = float(slam.depth.mean), float(slam.depth.sigma)
    own = state.core_dim + 2  # of (x, z, ω) of landmark 0, in pixels
    first = mean * np.exp(log_scale + P / 2)
    second = (mean**2 + sigma**2) * np.exp(2 * log_scale + 2 * P)
    np.testing.assert_allclose(state.landmarks[0, 2] / 650, first, rtol=1e-12)
    variance = state.covariance[own, own] / 650**2
    np.testing.assert_allclose(variance, second - first**2, rtol=1e-12)


def test_in_a_gauge_lengths_are_told_in_metres():
    slam, state = in_gauge()
    slots = jnp.arange(3)

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


# --- whole runs ---------------------------------------------------------------------------------


@cache
def tight():
    """Five runs of `matched-tight`, where an EKF is nearly exact."""
    return Case("matched-tight", runs=5, seed=3)


def exact_run(chosen, points):
    """True poses, and controls and features of the nominal motion: all seen, nothing noisy."""
    nominal = np.array(chosen.velocity) / chosen.rate
    c, s = np.cos(nominal[2]), np.sin(nominal[2])
    step = np.array([[c, -s, nominal[0]], [s, c, nominal[1]], [0, 0, 1]])
    T = np.array([np.linalg.matrix_power(step, k) for k in range(chosen.steps + 1)])
    seen = np.einsum("kji,klj->kli", T[:, :2, :2], points - T[:, None, :2, 2])
    measured = seen if chosen.sensor.hidden == 0 else 650 * seen[..., :1] / seen[..., 1:] + 320
    slots = np.tile(np.arange(len(points)), (len(T), 1))
    everything = Features(slots, measured, np.ones(slots.shape, bool))
    first, later = (jax.tree.map(lambda x, at=at: x[at], everything) for at in (0, slice(1, None)))
    nothing = jax.tree.map(lambda x: x[:, :0], later)
    return T, np.tile(nominal, (chosen.steps, 1)), (first, later, nothing)


@pytest.mark.parametrize(
    ("landmark", "fields"),
    [
        ("cartesian", {"sensor": "position", "position_sigma": 0.1}),
        ("inverse_scaling", {"sensor": "camera", "inverse_depth": [0.2, 0.1]}),
    ],
    ids=["positions", "pixels"],
)
def test_robocentric_and_world_agree_to_rounding_where_nothing_is_noisy(landmark, fields):
    """With odometry, all residuals zero: one linear problem, in two sets of coordinates."""
    velocity: dict[str, Any] = dict(velocity=[0.3, 1.2, 0.4], velocity_sigma=[0.0] * 3)
    sigma: dict[str, Any] = dict(odometry_sigma=[0.01, 0.02, 0.03])
    chosen = scenario("matched", steps=15, motion="odometry", **velocity, **sigma, **fields)
    # At the mean of the prior on 1/z.
    points = np.stack([np.linspace(-2, 2, 5), np.full(5, 5.0)], axis=1)
    truth, controls, features = exact_run(chosen, points)
    pieces = scenario_pieces(chosen)

    def run(kind):
        slam = make_filter(kind, landmark=LANDMARKS[landmark], **pieces)

        @quick_jit
        def whole(*features):
            state, records = run_filter(5, slam, controls, *features)
            return records, landmarks_in_world(slam, state, jnp.arange(5))

        return whole(*features)

    ((T, P, _, nis), (X, X_covariance)), ((U, Q, _, _), (Y, Y_covariance)) = (
        run(kind) for kind in ("robocentric", "world")
    )
    for poses in (T, U):
        np.testing.assert_allclose(poses.as_matrix(), truth[1:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(nis, 0, atol=1e-15)
    close(Q, P, 1e-11)
    np.testing.assert_allclose(X, points, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(Y, points, rtol=1e-11, atol=1e-11)
    close(Y_covariance, X_covariance, 1e-10)
    # It is not the odometry alone: its error in x is less for what is seen.
    assert P[-1][0, 0] < 15 * 0.01**2


@cache
def near():
    """A short run with depths known to a twentieth: every parametrization is nearly linear."""
    return Case("matched-tight", steps=10, landmarks=5, inverse_depth=[0.2, 0.01])


@pytest.mark.slow
@pytest.mark.parametrize("landmark", [name for name in LANDMARKS if name != "inverse_scaling"])
def test_every_parametrization_is_the_same_filter_where_the_problem_is_linear(landmark):
    case = near()
    data = case.controls(), *case.frames(0)
    _, (T, P, _, nis) = case.compiled("robocentric")(*data)
    last, (U, Q, _, other_nis) = case.compiled("robocentric", landmark)(*data)
    sigma, other_sigma = (np.sqrt(np.einsum("kii->ki", np.asarray(x))) for x in (P, Q))
    # Measured 0.10 σ and 6 % for Cartesian points, 0.026 σ and 4 % after a conversion to them, and
    # 0.003 σ and 3e-4 elsewhere.
    apart, nis_apart = {
        "cartesian": (0.2, 0.12),
        "inverse_depth_to_cartesian": (0.06, 0.1),
    }.get(landmark, (0.008, 0.001))
    assert np.abs(np.asarray((T.inverse() @ U).log()) / sigma).max() < apart
    np.testing.assert_allclose(other_sigma, sigma, rtol=0.005)
    np.testing.assert_allclose(other_nis, nis, rtol=nis_apart)
    if LANDMARKS[landmark].converts:
        assert (np.asarray(last.landmarks)[:, -1] == 1).all()


def test_one_trace_serves_every_call_of_a_step():
    """Also with other numbers of the filter, which are data."""
    case = tight()
    slam = begun_with(case.filter("robocentric"), np.zeros(3), np.full(3, 0.1))
    traces = []

    @eqx.filter_jit
    def step(slam, state, dt, known, new):
        traces.append(None)
        return slam.step(state, dt, known, new)

    first, known, new = case.frames(0)
    state = quick_jit(partial(slam.init, case.capacity))(first)
    for k, sigma in enumerate((0.3, 0.5, 1.0)):
        noisy = replace(slam, sensor=replace(slam.sensor, sigma=sigma))
        seen = jax.tree.map(lambda x, k=k: x[k], known)
        # What is seen, the noise, and the time all change.
        seen = replace(seen, valid=seen.valid & (jnp.arange(seen.valid.size) >= k))
        fresh = jax.tree.map(lambda x, k=k: x[k], new)
        state, innovation = step(noisy, state, jnp.asarray(0.03 + 0.01 * k), seen, fresh)
        assert innovation.nis_dof == seen.valid.sum()
    assert len(traces) == 1


def leaves_close(actual, expected, relative):
    """Every array within `relative` of its largest entry."""
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=relative * max(1e-3, np.abs(b).max()))


@pytest.mark.slow
def test_a_run_can_be_differentiated_by_its_noise():
    """d(position, σ and NIS)/d(acceleration σ), backwards through every step."""
    case = Case("matched-tight", steps=4, landmarks=4)
    first, *later = case.frames(0)
    slam = case.filter("robocentric")
    start = quick_jit(partial(slam.init, case.capacity))(first)

    def score(sigma):
        noisy = replace(slam, motion=replace(slam.motion, noise_sigma=sigma))

        def step(state, frame):
            state, innovation = noisy.step(state, *frame)
            return state, innovation.nis

        state, nis = jax.lax.scan(step, start, (case.controls(), *later))
        pose_variance = jnp.trace(state.covariance[:3, :3])
        # Scaled so that each part matters: metres, log σ², and numbers compared.
        return 1e3 * state.core.pose.translation()[0] + jnp.log(pose_variance) + nis.mean()

    sigma = jnp.asarray(slam.motion.noise_sigma)
    both = quick_jit(jax.value_and_grad(score))
    gradient = np.asarray(both(sigma)[1])
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 1e-3
    # Steps of 1e-3: curvature leaves 1e-6 of the largest, rounding of the NIS about as much.
    h = 1e-3 * np.asarray(sigma)
    differences = [(both(sigma + d)[0] - both(sigma - d)[0]) / (2 * d.max()) for d in np.diag(h)]
    close(differences, gradient, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scale_gauge", "scale_gauge+oc+scene50"])
def test_a_likelihood_in_a_gauge_has_the_exact_derivative(name):
    """Also of what a Jacobian of the filter takes as given, the scale that divides the noise."""
    case = Case("matched-very-loose", steps=5, landmarks=4)
    slam, run = cast(case.filter(name), jnp.float64), case.run(0)

    def of(factor):
        motion = replace(slam.motion, noise_sigma=factor * slam.motion.noise_sigma)
        return log_likelihood(replace(slam, motion=motion), case.room, run)

    one = jnp.ones(())
    _, derivative = quick_jit(lambda at: jax.jvp(of, (at,), (one,)))(one)
    difference = central(quick_jit(lambda x: of(x[0])), np.ones(1), 1e-5)[0]
    np.testing.assert_allclose(derivative, difference, rtol=1e-6)
    assert abs(derivative) > 0.1


# --- conversions of landmarks -------------------------------------------------------------------


def convertible_state(model):
    """Two landmarks that are ready, and between them one that is not; the last is not active."""
    geometry, rng = model.geometry, np.random.default_rng(6)
    t, p = geometry.tangent_dim, geometry.pixel_dim
    core = Core(
        pose=model.frame.from_base_pose(pose(geometry, 11)),
        motion=jnp.asarray(rng.normal(0, 0.5, t)),
        log_scale=None,
        noise=jnp.zeros(t),
        calibration=jnp.asarray(rng.normal(0, 2, 2 * p)),
    )
    T_AC = model.view(core, COMPOSED).map_from_camera

    def landmark(bearing, inverse_depth, anchor):
        seen = model.landmark.initialise(
            jnp.append(bearing, 1.0), inverse_depth, jnp.asarray(650.0)
        )
        return model.landmark.transform(T_AC @ geometry.group.exp(anchor), seen)

    landmarks = jax.vmap(landmark)(
        jnp.asarray(rng.uniform(-0.3, 0.3, (4, p))),
        jnp.array([0.2, 0.01, 0.25, 0.3]),
        jnp.asarray(0.4 * rng.choice([-1, 1], (4, t)) * rng.uniform(0.7, 1, (4, t))),
    )
    c, d = t * 3 + 2 * p, landmarks.shape[1]
    n = c + landmarks.size
    factor = rng.normal(0, 0.01, (n, n))
    factor[c + d - 1 :: d] = 0  # the constants
    factor[[c + d - 2, c + 3 * d - 2]] *= 0.01  # the inverse distances of those that are ready
    factor[2 * t : 3 * t] = 0  # the noise of a step
    factor[c + 3 * d :] = 0
    return State(core, landmarks, jnp.arange(4) < 3, jnp.asarray(factor @ factor.T))


@pytest.mark.parametrize(
    ("geometry", "frame", "landmark"),
    quick_rows(
        1,
        [
            (PLANAR, Robocentric(), InverseDepthToCartesian()),
            (SPATIAL, WorldCentric(), ParallaxAngle()),
        ],
    ),
    ids=named,
)
def test_a_conversion_changes_neither_points_nor_what_is_known_of_them(geometry, frame, landmark):
    calibration = Estimated(np.full(2 * geometry.pixel_dim, 2.0))
    model = a_filter(geometry, landmark, frame, calibration=calibration).model
    n, slots = geometry.point_dim, jnp.arange(3)

    def view(core):
        return model.view(core, COMPOSED)

    def chart(view, landmark):
        return model.sensor.chart(*model.metric_point(view, landmark))

    def charts(state, delta):
        """The error of the core, and the landmarks in the camera's chart."""
        c = state.core_dim
        here = view(retract(state.core, delta[:c]))
        landmarks = state.landmarks + delta[c:].reshape(state.landmarks.shape)
        seen = jax.vmap(chart, in_axes=(None, 0))(here, landmarks[:3])
        return jnp.concatenate([delta[:c], seen.ravel()])

    def known(state):
        zero = jnp.zeros(len(state.covariance))
        J = jax.jacfwd(charts, argnums=1)(state, zero)
        alone, own = linear.landmark_moments(view, chart, state, slots)
        return charts(state, zero), J @ state.covariance @ J.T, alone, own

    def both():
        state = convertible_state(model)
        converted = linear.converted(model, state, COMPOSED)
        again = linear.converted(model, converted, COMPOSED)
        return state, converted, again, known(state), known(converted)

    state, converted, again, before, after = quick_jit(both)()
    np.testing.assert_array_equal(state.landmarks[:, -1], [0, 0, 0, 0])
    np.testing.assert_array_equal(converted.landmarks[:, -1], [1, 0, 1, 0])
    for a, b in zip(after, before, strict=True):
        close(a, b, 1e-9)
    all_charts, covariance, alone, own = before
    c = state.core_dim
    for i in range(3):  # the charts alone are the diagonal blocks of everything
        block = slice(c + i * n, c + (i + 1) * n)
        close(alone[i], all_charts[block], 1e-12)
        close(own[i], covariance[block, block], 1e-9)
    assert np.abs(covariance[:c, c:]).max() > 1e-5  # there is something to keep
    # What is not ready, and what is not there, stays as it is, and so does the core.
    np.testing.assert_array_equal(converted.landmarks[1::2], state.landmarks[1::2])
    np.testing.assert_array_equal(converted.active, state.active)
    d = state.landmarks.shape[1]
    same = np.r_[:c, c + d : c + 2 * d, c + 3 * d : c + 4 * d]
    kept = np.ix_(same, same)
    close(converted.covariance[kept], state.covariance[kept], 1e-14)
    assert not np.any(converted.covariance[c + 3 * d :])
    # Once.
    np.testing.assert_array_equal(again.landmarks, converted.landmarks)
    close(again.covariance, converted.covariance, 1e-14)


# --- the pieces of a frame ----------------------------------------------------------------------


def test_the_start_is_exact_in_the_pose_and_empty_in_the_map():
    case = tight()
    slam = case.filter("robocentric", "inverse_scaling", "white")
    state = begun_with(slam, [1.2, 0.0, 0.1], [0.1, 0.2, 0.3]).init(3)
    assert isinstance(state, State)
    assert not state.active.any()
    sigma = np.zeros(len(state.covariance))
    sigma[3:6] = 0.1, 0.2, 0.3
    np.testing.assert_allclose(state.covariance, np.diag(sigma**2), rtol=0, atol=1e-16)
    np.testing.assert_array_equal(state.core.pose.as_matrix(), np.eye(3))
    assert state.core_dim == 3 + 3 + 3 + 2


@pytest.mark.parametrize("kind", ["robocentric", "world"])
def test_a_step_leaves_no_acceleration_and_no_white_calibration_behind(kind):
    case = tight()
    slam = case.filter(kind, "inverse_scaling", "white")
    slam = begun_with(slam, np.zeros(3), np.full(3, 0.1))
    first, known, new = case.frames(0)

    def two(first):
        state = slam.init(case.capacity, first)
        predicted = slam.predict(state, jnp.asarray(DT))
        seen = jax.tree.map(lambda x: x[0], known)
        fresh = jax.tree.map(lambda x: x[0], new)
        return predicted, slam.step(state, jnp.asarray(DT), seen, fresh)[0]

    predicted, state = quick_jit(two)(first)
    appended = np.diag(predicted.covariance)[6:11]
    used = np.zeros(3) if compose_first(slam) else np.full(3, 0.02**2)
    np.testing.assert_allclose(appended, [*used, 9.0, 4.0], rtol=1e-14)
    assert not np.any(state.covariance[6:11])
    assert not np.any(state.covariance[:, 6:11])
    np.testing.assert_array_equal(state.core.noise, np.zeros(3))
    np.testing.assert_array_equal(state.core.calibration, np.zeros(2))


@pytest.mark.parametrize("kind", ["robocentric", "world"])
def test_a_map_from_above_is_azimuth_and_inverse_distance_along_the_axes_of_the_world(kind):
    """Of a camera that is turned in every direction; azimuth from z towards x."""
    slam = make_filter(kind, **scenario_pieces(scenario("matched-6dof")))
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


@pytest.mark.usefixtures("unchecked")
def test_an_unknown_calibration_is_refused_by_name():
    with pytest.raises(ValueError, match="'black'") as error:
        scenario_pieces(scenario("matched"), "black")
    assert all(name in str(error.value) for name in TREATMENTS)
    for piece, wanted in (
        ("calibration", "AbstractCalibration"), ("scale", "AbstractScale"), ("gate", "Gate"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f"{piece} is an instance of {wanted}, not 'feet'"):
            a_filter(PLANAR, **{piece: "feet"})


@pytest.mark.parametrize("frame", [Robocentric(), WorldCentric(), Keyframe()], ids=named)
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_frame_holds_every_pose_and_gives_it_back(geometry, frame):
    T = pose(geometry, 3, scale=1.0)
    again = frame.camera_pose(frame.from_base_pose(T))
    np.testing.assert_allclose(again.as_matrix(), T.as_matrix(), rtol=0, atol=1e-14)


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
