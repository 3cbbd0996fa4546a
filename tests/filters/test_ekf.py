"""Tests of jaxslam.filters.linear.covariance: dense filters, Jacobians, and invariances."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, close, named, pose, quick_jit, run_filter

from jaxslam._numerics.arrays import cast
from jaxslam.filters.linear import blocks
from jaxslam.filters.linear import covariance as linear
from jaxslam.filters.linear.blocks import Blocks, observed, placed
from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.linear.state import State
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.filters.slam import Slam
from jaxslam.filters.words import make_filter
from jaxslam.geometry import PLANAR, SPATIAL, difference, retract
from jaxslam.landmarks import LANDMARKS, ImagePlane, InverseScaling, SotNormal
from jaxslam.models.calibration import White
from jaxslam.models.camera import Camera
from jaxslam.models.depth import InverseDepth
from jaxslam.models.frame import Robocentric, WorldCentric
from jaxslam.models.motion import ConstantVelocity
from jaxslam.models.observations import Features, Status
from jaxslam.models.sensors import Pinhole

update = Kalman().update


def pieces(geometry) -> dict[str, Any]:
    p, t = geometry.pixel_dim, geometry.tangent_dim
    return {
        "motion": ConstantVelocity(np.full(t, 0.1), np.zeros(t), np.full(t, 0.1)),
        "sensor": Pinhole(Camera([650.0, 640.0][:p], [320.0, 240.0][:p]), 0.3),
        "calibration": White([3.0, 3.0, 2.0, 2.0][: 2 * p]),
        "depth": InverseDepth(1 / 6, 1 / 12),
    }


def slam_model(geometry, landmark, frame):
    return Slam(landmark=landmark, frame=frame, **pieces(geometry)).model


def noise_of(geometry):
    """R of one measurement, of σ = 0.3 pixels."""
    return 0.09 * jnp.eye(geometry.pixel_dim)


BEARINGS = np.array([[0.3, -0.2], [-0.25, 0.1], [0.1, 0.25]])
DEPTHS = np.array([4.0, 7.0, 2.5])
STEP = 0.2


def generic_state(model):
    """Three landmarks ahead, first seen from elsewhere, everything correlated and nothing zero."""
    geometry, rng = model.geometry, np.random.default_rng(8)
    t, p = geometry.tangent_dim, geometry.pixel_dim
    core = Core(
        pose=model.frame.from_base_pose(pose(geometry, 11)),
        motion=jnp.asarray(rng.normal(0, 0.5, t)),
        log_scale=None,
        noise=jnp.asarray(rng.normal(0, 0.5, t)),
        calibration=jnp.asarray(rng.normal(0, 2, 2 * p)),
    )
    T_AC = model.view(core, Context(jnp.asarray(STEP))).map_from_camera
    elsewhere = pose(geometry, 12, scale=0.1)

    def landmark(bearing, depth):
        seen = model.landmark.initialise(jnp.append(bearing, 1.0), 1 / depth, jnp.asarray(650.0))
        return model.landmark.transform(T_AC @ elsewhere, seen)

    landmarks = jax.vmap(landmark)(BEARINGS[:, :p], DEPTHS)
    n = 3 * t + 2 * p + landmarks.size
    factor = rng.normal(0, 0.05, (n, n))
    return State(core, landmarks, jnp.ones(3, bool), jnp.asarray(factor @ factor.T))


def whole_state_function(model, state, context):
    """δ ↦ stacked measurements of every landmark, then the composed state ⊟ its mean."""
    c, shape = state.core_dim, state.landmarks.shape
    mean = model.compose_core(state.core, context)

    def function(delta):
        core = retract(state.core, delta[:c])
        landmarks = state.landmarks + delta[c:].reshape(shape)
        view = model.view(core, context)
        pixels = jax.vmap(lambda x: model.observe(view, x, context)[0])(landmarks)
        if model.moves_landmarks:
            landmarks = jax.vmap(lambda x: model.compose_landmark(view, x, context))(landmarks)
        composed = difference(model.compose_core(core, context), mean)
        return jnp.concatenate([pixels.ravel(), composed, landmarks.ravel()])

    return function


@cache
def slam_case(geometry, landmark, frame):
    """A generic state; compiled: all that is done by blocks, the dense function, its Jacobian."""
    model = slam_model(geometry, landmark, frame)
    context = Context(jnp.asarray(STEP))
    state = quick_jit(lambda: generic_state(model))()

    def block_wise(state, features):
        updated, innovation = update(model, state, features, noise_of(geometry), context)
        expected = linear.expected(model, state, jnp.array([2, 0]), context)
        return updated, innovation, linear.composed(model, state, context), expected

    def dense(state, delta):
        return whole_state_function(model, state, context)(delta)

    jacobian = jax.jacfwd(dense, argnums=1)
    return state, quick_jit(block_wise), quick_jit(dense), quick_jit(jacobian)


@cache
def compiled_retract():
    return quick_jit(retract)


def assert_updated(after, innovation, state, H, residual, bound):
    """Joseph's form, with the optimal gain."""
    P, R, c = np.asarray(state.covariance), 0.09 * np.eye(len(H)), state.core_dim
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    left = np.eye(len(P)) - K @ H
    close(after.covariance, left @ P @ left.T + K @ R @ K.T, bound)
    np.testing.assert_array_equal(after.covariance, after.covariance.T)
    delta = K @ residual
    close(after.landmarks.ravel(), state.landmarks.ravel() + delta[c:], bound / 10)
    moved = compiled_retract()(state.core, delta[:c])
    for a, b in zip(jax.tree.leaves(after.core), jax.tree.leaves(moved), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=bound)
    nis = residual @ np.linalg.solve(S, residual)
    np.testing.assert_allclose(innovation.nis, nis, rtol=1e-9)
    assert innovation.nis_dof == len(H)
    np.testing.assert_allclose(innovation.log_det, np.linalg.slogdet(S)[1], rtol=1e-12)
    assert innovation.status == Status.OK


@pytest.mark.parametrize(
    ("geometry", "frame", "landmark"),
    [
        (SPATIAL, Robocentric(), LANDMARKS["inverse_scaling"]),
        (PLANAR, WorldCentric(), LANDMARKS["inverse_depth"]),
        (PLANAR, Robocentric(), LANDMARKS["cartesian"]),
    ],
    ids=named,
)
def test_blocks_are_the_dense_jacobians_with_only_the_middle_landmark_seen(
    geometry, frame, landmark
):
    state, block_wise, dense, jacobian = slam_case(geometry, landmark, frame)
    p, c, zero = geometry.pixel_dim, state.core_dim, np.zeros(len(state.covariance))
    pixels, composed = np.split(dense(state, zero), [3 * p])
    H, J = np.split(np.asarray(jacobian(state, zero)), [3 * p])
    off = np.array([0.7, -0.4])[:p]
    middle = np.full((3, p), np.nan)  # features of all landmarks, of which only this one counts
    middle[1] = pixels.reshape(3, p)[1] + off
    seen = Features(jnp.arange(3), jnp.asarray(middle), jnp.array([False, True, False]))
    updated, innovation, moved, expected = block_wise(state, seen)
    P = np.asarray(state.covariance)
    # Search ellipses, of slots 2 and 0.
    assert expected[2].all()
    close(expected[0], pixels.reshape(3, p)[np.array([2, 0])], 1e-14)
    ellipses = (H @ P @ H.T).reshape(3, p, 3, p)
    close(expected[1], np.stack([ellipses[i, :, i] for i in (2, 0)]), 1e-11)
    own = slice(p, 2 * p)
    # 1e-11: rounding, times the condition of S.
    close(innovation.covariance[own, own], H[own] @ P @ H[own].T + 0.09 * np.eye(p), 1e-11)
    assert_updated(updated, innovation, state, H[own], off, 1e-11)
    close(moved.covariance, J @ P @ J.T, 1e-12)
    close(moved.landmarks.ravel(), composed[c:], 1e-14)


def planar_case():
    return slam_case(PLANAR, InverseScaling(), Robocentric())


def planar_pixels(state):
    """A pixel for every landmark, half a pixel from where it is expected."""
    pixels = planar_case()[2](state, jnp.zeros(len(state.covariance)))[:3]
    return pixels.reshape(3, 1) + jnp.array([[0.5], [-0.3], [0.8]])


def behind(state):
    """The state with landmark 0 behind the camera, by reflecting its homogeneous point."""
    return replace(state, landmarks=state.landmarks.at[0].multiply(jnp.array([-1, -1, 1])))


def removed(state):
    """The state without landmark 0."""
    return linear.removed(state, np.arange(3) == 0)


@pytest.mark.parametrize("change", [behind, removed])
def test_a_feature_that_cannot_be_used_changes_nothing(change):
    """Beside one that is used, whatever its pixel says."""
    state, block_wise, *_ = planar_case()
    pixels = planar_pixels(state)
    state = change(state)
    beside = Features(jnp.arange(3), pixels.at[0].set(1e9), jnp.array([True, True, False]))
    without = Features(jnp.arange(3), pixels, jnp.array([False, True, False]))
    (a, one, *_), (b, other, *_) = (block_wise(state, f) for f in (beside, without))
    np.testing.assert_array_equal(a.covariance, b.covariance)
    np.testing.assert_array_equal(a.landmarks, b.landmarks)
    assert one.nis == other.nis > 0
    assert one.nis_dof == other.nis_dof == 1
    np.testing.assert_array_equal(one.used, [False, True, False])


def test_an_iterated_update_is_so_many_steps_of_gauss_newton():
    """`x ← x₀ + K (z − h(x) − H (x₀ − x))`, of a camera whose pose is known: the rest is linear."""
    state, _, dense, jacobian = planar_case()
    steps, x, known = 2, np.zeros(len(state.covariance)), np.arange(len(state.covariance)) < 3
    P = np.where(known | known[:, None], 0.0, state.covariance)
    pixels = dense(state, x)[:3] + np.array([50.0, -30.0, 80.0])
    model, context = slam_model(PLANAR, InverseScaling(), Robocentric()), Context(jnp.asarray(STEP))
    seen = Features(jnp.arange(3), pixels[:, None], jnp.ones(3, bool))
    given = replace(state, covariance=jnp.asarray(P)), seen, noise_of(PLANAR), context
    after, _ = quick_jit(partial(Kalman(steps).update, model))(*given)
    for _ in range(steps):
        H = np.asarray(jacobian(state, x))[:3]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.09 * np.eye(3))
        before, x = x, K @ (pixels - dense(state, x)[:3] + H @ x)
    assert np.abs(x - before).max() > 1e-4  # one step fewer, or more, is another state
    c, left = state.core_dim, np.eye(len(P)) - K @ H
    close(after.landmarks.ravel(), state.landmarks.ravel() + x[c:], 1e-9)
    close(after.covariance, left @ P @ left.T + 0.09 * K @ K.T, 1e-9)


@pytest.mark.parametrize("frame", [Robocentric(), WorldCentric()], ids=named)
def test_landmarks_of_one_frame_share_its_pose_and_its_calibration(frame):
    """P ← J diag(P, R, σ², R, σ²) Jᵀ for two landmarks at once, the paper's P22–P26."""
    model = slam_model(PLANAR, InverseScaling(), frame)
    depth = cast(model.depth, float)
    everyone = slam_case(PLANAR, InverseScaling(), frame)[0]
    state = linear.removed(everyone, jnp.array([True, False, True]))
    c, d = state.core_dim, state.landmarks.shape[1]
    pixels, w = jnp.array([[100.0], [500.0]]), depth.mean
    prior = (w[None], depth.sigma[None])
    new = Features(jnp.array([2, 0]), pixels, jnp.ones(2, bool))

    def block_wise(state):
        return linear.initialised(model, state, new, noise_of(PLANAR), prior, COMPOSED)

    def both(x):
        view = model.view(retract(state.core, x[:c]), COMPOSED)
        return jnp.concatenate(
            [
                model.initialise(view, pixels[0] + x[c], w[None] + x[c + 1], COMPOSED),
                model.initialise(view, pixels[1] + x[c + 2], w[None] + x[c + 3], COMPOSED),
            ]
        )

    after = quick_jit(block_wise)(state)
    J = np.asarray(quick_jit(jax.jacfwd(both))(jnp.zeros(c + 4)))
    P = np.asarray(state.covariance)
    full = np.zeros((c + 4, c + 4))
    full[:c, :c] = P[:c, :c]
    full[c:, c:] = np.diag([0.09, float(depth.sigma) ** 2] * 2)
    new_rows = np.r_[c + 2 * d : c + 3 * d, c : c + d]
    expected = J @ full @ J.T
    actual = np.asarray(after.covariance)[np.ix_(new_rows, new_rows)]
    close(actual, expected, 1e-13)
    # What would be missing if each landmark were initialised alone: z = f is one and the same.
    sigma = np.sqrt(np.diag(expected))
    assert np.abs(expected[:d, d:] / np.outer(sigma[:d], sigma[d:])).max() > 0.5
    # With the old state: J_core P.
    old = np.r_[0:c, c + d : c + 2 * d]
    close(after.covariance[np.ix_(new_rows, old)], J[:, :c] @ P[:c][:, old], 1e-13)
    np.testing.assert_array_equal(after.covariance[np.ix_(old, old)], P[np.ix_(old, old)])
    np.testing.assert_array_equal(after.active, [True, True, True])


def test_a_conversion_is_carried_into_what_is_known_of_landmarks():
    """Of the first and the last, whose inverse distances are well known; the middle one waits."""
    model = slam_model(PLANAR, LANDMARKS["inverse_depth_to_cartesian"], Robocentric())
    state = generic_state(model)
    c, (_, d) = state.core_dim, state.landmarks.shape
    known = np.ones(len(state.covariance))
    known[[c + d - 2, c + 3 * d - 2]], known[c + d - 1 :: d] = 1e-5, 0
    state = replace(state, covariance=state.covariance * np.outer(known, known))

    def function(delta):
        view = model.view(retract(state.core, delta[:c]), COMPOSED)
        landmarks = state.landmarks + delta[c:].reshape(3, d)
        own = [state.covariance[k : k + d, k : k + d] for k in range(c, c + 3 * d, d)]
        of = [model.convert(view, *given, COMPOSED) for given in zip(landmarks, own, strict=True)]
        return jnp.append(delta[:c], jnp.concatenate(of))

    zero = jnp.zeros(len(known))
    both = quick_jit(lambda: (function(zero), jax.jacfwd(function)(zero)))
    converted, (expected, J) = quick_jit(partial(linear.converted, model))(state, COMPOSED), both()
    np.testing.assert_array_equal(converted.landmarks[:, -1], [1, 0, 1])
    close(converted.landmarks.ravel(), expected[c:], 1e-13)
    close(converted.covariance, J @ state.covariance @ J.T, 1e-12)


def test_covariance_stays_symmetric_and_positive_over_a_long_run():
    """In single precision, with landmarks whose covariance is singular: see `ROUNDING`."""
    case, dtype = Case("matched-very-loose", steps=300), jnp.float32
    slam = cast(case.filter("robocentric"), dtype)
    data = cast((case.controls(), *case.frames(0)), dtype)
    _, (_, _, covariances, nis) = quick_jit(partial(run_filter, case.capacity, slam))(*data)
    assert nis.dtype == dtype
    assert np.isfinite(nis).all()
    P = np.asarray(covariances, float)
    unit = np.finfo(dtype).eps
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    sigma = np.where(sigma > 0, sigma, 1.0)
    correlations = P / sigma[:, :, None] / sigma[:, None, :]
    # Composition and initialisation round the two halves differently; the update mends it.
    assert np.abs(correlations - correlations.transpose(0, 2, 1)).max() <= 100 * unit
    least = np.linalg.eigvalsh((correlations + correlations.transpose(0, 2, 1)) / 2)[:, 0]
    assert least.min() >= -P.shape[1] * unit


@pytest.mark.parametrize("dense", [0, 1000])
def test_products_with_blocks_leave_out_only_zeros(dense, monkeypatch):
    monkeypatch.setattr(blocks, "DENSE", dense)
    rng = np.random.default_rng(0)
    m, k, v, c, d, capacity = 3, 2, 4, 5, 3, 6
    J = Blocks(*(jnp.asarray(rng.normal(size=s)) for s in ((v, c), (m, k, v), (m, k, d))))
    slots, B = jnp.array([4, 0, 4]), jnp.asarray(rng.normal(size=(c + capacity * d, 7)))
    close(observed(J, slots, B), placed(J, slots, capacity) @ B, 1e-14)


class Charted(SotNormal):
    """A ray of unit length and one over the range: the equivariant filter's other chart."""

    name = "sot_inverse_depth"

    def initialise(self, point, omega, focal):
        return jnp.append(point, omega) / jnp.linalg.norm(point)

    def homogeneous(self, landmark):
        return landmark[:-1] / jnp.linalg.norm(landmark[:-1]), landmark[-1]


def test_the_equivariant_filter_in_inverse_depth_is_that_of_the_image_plane():
    """1/range and 1/z differ by a factor of the bearing: the filters do by products with a
    bearing's error alone, where that in normal coordinates goes another way."""
    case = Case("matched", steps=8, landmarks=5, placement="prior")
    landmarks = ImagePlane(), Charted(), SotNormal()
    filters = (make_filter("robocentric", landmark=x, **case.pieces()) for x in landmarks)
    found = [
        quick_jit(partial(run_filter, case.capacity, slam))(case.controls(), *case.frames(0))[1]
        for slam in filters
    ]
    sigma = np.sqrt(np.diagonal(found[0][1], axis1=1, axis2=2))
    off = [jax.vmap(difference)(poses, found[0][0]) / sigma for poses, *_ in found[1:]]
    assert np.abs(off[0]).max() < 1e-3
    assert np.abs(off[1]).max() > 0.1
