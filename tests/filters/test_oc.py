"""Tests of the gauge and of the filters that respect it: observability-constrained, first-estimate.

What no measurement tells must stay unknown while estimates change: the stacked Jacobians keep
their null space, and uncertainty added along it at the start changes no estimate ever after.
"""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, a_filter, close, each_landmark, named, pose, quick_jit, quick_rows
from test_observability import GAUGE, nullity

from jaxslam.filters.linear.blocks import plus
from jaxslam.filters.linear.covariance import empty
from jaxslam.filters.model import COMPOSED, Context, Core
from jaxslam.filters.remedies.gauge import act, unobservable_directions
from jaxslam.filters.remedies.observability_constrained import transport
from jaxslam.filters.remedies.transport import read_from, read_scale_too
from jaxslam.geometry import PLANAR, SPATIAL, SplitPose, difference, tangent_dim
from jaxslam.landmarks import (
    Cartesian,
    FramedHomogeneous,
    ImagePlane,
    InverseScaling,
    UnifiedInverseDepth,
)
from jaxslam.models.frame import Robocentric, WorldCentric
from jaxslam.models.motion import Odometry

COUNT, STEPS, DT = 7, 8, 0.4


def context(model, composed):
    """Of a moving camera, or of one whose motion is composed."""
    if composed:
        return COMPOSED
    t, moving = model.geometry.tangent_dim, model.motion.has_velocity
    return Context(jnp.asarray(DT) if moving else jnp.linspace(0.3, 0.1, t))


def truth(model):
    """A state with velocity, motion noise, anchors and landmarks first seen from many places."""
    geometry, rng = model.geometry, np.random.default_rng(5)
    t, n = geometry.tangent_dim, geometry.point_dim
    velocity = np.concatenate([rng.uniform(0.3, 0.8, n), rng.uniform(0.1, 0.2, t - n)])
    anchors = None
    if model.landmark.anchored:
        drawn = jax.vmap(geometry.group.exp)(jnp.asarray(rng.uniform(-0.3, 0.3, (COUNT, t))))
        anchors = jax.vmap(SplitPose.of)(drawn)
    core = Core(
        model.frame.from_base_pose(pose(geometry, 1)),
        jnp.asarray(velocity) if model.motion.has_velocity else (),
        None,
        jnp.zeros(t),
        jnp.zeros(0),
        anchors,
    )
    T_AC = model.view(core, context(model, True)).map_from_camera

    def landmark(number, bearing, depth, seen_from):
        seen = model.landmark.initialise(jnp.append(bearing, 1.0), 1 / depth, jnp.asarray(1.0))
        if model.landmark.anchored:
            return seen.at[-1].set(number)
        return model.landmark.transform(T_AC @ geometry.group.exp(seen_from), seen)

    landmarks = jax.vmap(landmark)(
        jnp.arange(COUNT),
        rng.uniform(-0.4, 0.4, (COUNT, geometry.pixel_dim)),
        rng.uniform(8, 20, COUNT),
        rng.uniform(-0.3, 0.3, (COUNT, t)),
    )
    return replace(empty(core, landmarks), active=jnp.ones(COUNT, bool))


def observed(model, state, composed=True):
    """All predicted measurements."""
    here = context(model, composed)
    view = model.view(state.core, here)
    return jax.vmap(lambda x: model.observe(view, x, here)[0])(state.landmarks).ravel()


def moved(model, core, landmarks):
    """Core and landmarks after one step."""
    here = context(model, False)
    view = model.view(core, here)
    if model.moves_landmarks:
        landmarks = jax.vmap(lambda x: model.compose_landmark(view, x, here))(landmarks)
    return model.compose_core(core, here), landmarks


def test_the_scale_is_read_from_pose_velocity_and_landmarks_and_from_nothing_else():
    """Of any gauge of three directions and a scale, and any covariance."""
    draw = np.random.default_rng(0)
    N, half = draw.normal(size=(12, 4)), draw.normal(size=(12, 12))

    def read(N, P):
        return read_scale_too(N, read_from(N[:, :3], 3), P, slice(3, 5), slice(7, 11))

    L = quick_jit(read)(N, half @ half.T)
    np.testing.assert_allclose(L @ N, np.eye(4), atol=1e-10)
    np.testing.assert_array_equal(np.flatnonzero(~np.any(np.abs(L) > 1e-12, axis=0)), [5, 6, 11])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("geometry", "landmark", "frame"),
    [(PLANAR, landmark, WorldCentric()) for landmark in each_landmark]
    + [(PLANAR, InverseScaling(), Robocentric()), (PLANAR, FramedHomogeneous(), Robocentric())]
    + [(SPATIAL, UnifiedInverseDepth(), WorldCentric())],
    ids=named,
)
def test_the_gauge_changes_no_measurement_now_or_after_a_motion(geometry, landmark, frame):
    """Finite transformations: h(g x) = h(x), and the motion of g x is g of the motion of x."""
    model = a_filter(geometry, landmark, frame).model

    def compared():
        state = truth(model)
        noise = jnp.linspace(0.2, -0.3, geometry.tangent_dim)
        core, landmarks = replace(state.core, noise=noise), state.landmarks
        rigid, factor = pose(geometry, 7, 1.5), jnp.asarray(1.7)
        other_core, other_landmarks = act(model, rigid, factor, core, landmarks)
        other = replace(state, core=other_core, landmarks=other_landmarks)
        state = replace(state, core=core)
        seen = [observed(model, s, c) for s in (state, other) for c in (False, True)]
        after = moved(model, core, landmarks)
        return seen, act(model, rigid, factor, *after), moved(model, other.core, other.landmarks)

    (a, b, c, d), expected, actual = quick_jit(compared)()
    close(c, a, 1e-12)
    close(d, b, 1e-12)
    close(actual[1], expected[1], 1e-12)
    np.testing.assert_allclose(difference(actual[0], expected[0]), 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("frame", [Robocentric(), WorldCentric()], ids=named)
@pytest.mark.parametrize("landmark", [InverseScaling(), FramedHomogeneous()], ids=named)
def test_directions_are_the_derivative_of_the_action(landmark, frame):
    """H N = 0, by other Jacobians than N's; empty slots do not move."""
    model = a_filter(PLANAR, landmark, frame).model

    def products():
        state = truth(model)
        N = unobservable_directions(model, state)
        H = jax.jacfwd(lambda delta: observed(model, plus(state, delta)))(jnp.zeros(N.shape[0]))
        half = replace(state, active=state.active.at[3].set(False))
        return H, N, unobservable_directions(model, half)

    H, N, half = map(np.asarray, quick_jit(products)())
    d = jax.eval_shape(partial(truth, model)).landmarks.shape[1]
    start = len(N) - COUNT * d + 3 * d
    np.testing.assert_allclose(H @ N, 0, atol=1e-13 * np.abs(H).max() * np.abs(N).max())
    assert not half[start : start + d].any()
    others = np.delete(np.arange(len(N)), range(start, start + d))
    close(half[others, :3], N[others, :3], 1e-14)


def steps(model, constrained):
    """`(state, correction) → H, M, Φ, next state`: one step of a filter that is corrected."""

    def step(state, correction):
        H = jax.jacfwd(lambda delta: observed(model, plus(state, delta)))(correction * 0)
        after = plus(state, correction)
        M = jnp.eye(correction.size)
        if constrained:
            change, L = transport(model, state, after)
            M += change @ L
        after_motion = moved(model, after.core, after.landmarks)

        def motion(delta):
            x = plus(after, delta)
            core, landmarks = moved(model, x.core, x.landmarks)
            return jnp.append(difference(core, after_motion[0]), landmarks.ravel())

        F = jax.jacfwd(motion)(correction * 0)
        core, landmarks = after_motion
        return H, M, F, replace(state, core=core, landmarks=landmarks)

    return quick_jit(step)


def with_directions(model, state):
    return state, unobservable_directions(model, state)


def window(model, constrained):
    """∂(all measurements)/∂(start, noise of every step), corrections in between; and N at the
    start, which noise has no part in."""
    t = model.geometry.tangent_dim
    state, N = quick_jit(lambda: with_directions(model, truth(model)))()
    n = state.core_dim + state.landmarks.size
    first = tangent_dim((state.core.pose, state.core.motion))
    kept = np.delete(np.arange(n), range(first, first + t))
    N = np.asarray(N)[kept]
    G = np.eye(n, kept.size + STEPS * t) * 0.0
    G[kept, np.arange(kept.size)] = 1.0
    rng, rows, step = np.random.default_rng(11), [], steps(model, constrained)
    for k in range(STEPS + 1):
        correction = 0.02 * rng.standard_normal(n)
        correction[first : first + t] = 0.0
        H, M, F, state = step(state, jnp.asarray(correction))
        rows.append(np.asarray(H) @ G)
        G = np.asarray(M) @ G
        if k < STEPS:
            here = kept.size + k * t
            G[first : first + t] = 0.0
            G[first : first + t, here : here + t] = np.eye(t)
            G = np.asarray(F) @ G
    return np.vstack(rows), N


@pytest.mark.slow
@pytest.mark.parametrize(
    ("geometry", "landmark", "frame", "motion"),
    [
        (PLANAR, Cartesian(), Robocentric(), "velocity"),
        (PLANAR, Cartesian(), WorldCentric(), "odometry"),
        (SPATIAL, ImagePlane(), Robocentric(), "velocity"),
        (SPATIAL, Cartesian(), WorldCentric(), "odometry"),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_corrections_leave_the_null_space_as_it_is(geometry, landmark, frame, motion):
    """4 or 7 directions without odometry, 3 or 6 with it, at other estimates in every step."""
    odometry = {"motion": Odometry(np.zeros(geometry.tangent_dim))}
    pieces = odometry if motion == "odometry" else {}
    model = a_filter(geometry, landmark, frame, **pieces).model
    stacked, N = window(model, True)
    size = np.linalg.norm(stacked, 2) * np.linalg.norm(N, 2)
    count = N.shape[0]
    assert np.linalg.norm(stacked[:, :count] @ N, 2) < 1e-12 * size
    plain, _ = window(model, False)
    unaware = np.linalg.norm(plain[:, :count] @ N, 2)
    if frame == Robocentric() and motion == "odometry":
        # Its pose is perturbed on the side of B: N is constant.
        assert unaware < 1e-12 * size
    else:
        assert unaware > 1e-6 * size
    if landmark.size(geometry.point_dim) > geometry.point_dim:
        return  # its redundant numbers are another null space
    expected = GAUGE[geometry] + (motion == "velocity")
    # Where motion is noise, the first velocity and acceleration are seen only in their sum.
    known = range(count, count + geometry.tangent_dim if motion == "velocity" else stacked.shape[1])
    assert nullity(np.delete(stacked, known, axis=1)) == expected
    assert N.shape[1] == expected


@cache
def case(geometry):
    """The start of a run without odometry."""
    return Case({PLANAR: "matched", SPATIAL: "matched-6dof"}[geometry], steps=6, landmarks=5)


def run_with_gauge(slam, start, directions):
    """A filter's run of a case twice: as it is, and with the frame (and the scale) unknown by 0.1
    at the start; states after every step, their directions N, and NIS."""
    first, known, new = start.frames(0)

    def run(sigma):
        state = slam.init(start.capacity, first)
        N = unobservable_directions(slam.model, state)[:, :directions]
        state = replace(state, covariance=state.covariance + sigma**2 * N @ N.T)

        def step(state, frame):
            state, innovation = slam.step(state, *frame)
            # Where the filter's directions are those of landmarks' first estimates.
            at = state if state.first is None else replace(state, landmarks=state.first)
            N = unobservable_directions(slam.model, at)[:, :directions]
            kept = state.core, state.landmarks, state.covariance
            return state, (*kept, N, innovation.nis)

        return jax.lax.scan(step, state, (start.controls(), known, new))[1]

    return quick_jit(jax.vmap(run))(jnp.array([0.0, 0.1]))


def difference_of_runs(slam, start, directions):
    """How much the estimates differ between the two runs, and how much the covariances differ
    from what was added; both relative."""
    core, landmarks, covariance, N, nis = run_with_gauge(slam, start, directions)
    estimates = [x for x in jax.tree.leaves((core, landmarks, nis)) if np.any(x[0])]
    moved = max(float(np.abs(b - a).max() / np.abs(a).max()) for a, b in estimates)
    added = covariance[1] - covariance[0]
    expected = 0.01 * N[0] @ N[0].swapaxes(-1, -2)
    return moved, float(np.abs(added - expected).max() / np.abs(expected).max())


REMEDIES = [
    ("robocentric+oc", PLANAR, "inverse_scaling"),
    ("scale_gauge+oc", PLANAR, "inverse_scaling"),
    ("robocentric+oc2", PLANAR, "inverse_scaling"),
    ("world+oc", PLANAR, "framed_homogeneous"),
    ("world+fej", PLANAR, "inverse_scaling"),
    ("world+fej2", PLANAR, "inverse_scaling"),
    ("world+decoupled", PLANAR, "inverse_scaling"),
    ("invariant", PLANAR, "anchored_homogeneous"),
]


@pytest.mark.parametrize(("name", "geometry", "landmark"), quick_rows(1, REMEDIES))
def test_uncertainty_of_the_gauge_changes_no_estimate_ever(name, geometry, landmark):
    """Through whole steps: K and the mean are the same, and P keeps what was added, N Σ Nᵀ."""
    count = GAUGE[geometry] + (name != "invariant")  # which knows nothing of the scale
    slam = case(geometry).filter(name, landmark)
    moved, forgotten = difference_of_runs(slam, case(geometry), count)
    assert moved < 1e-9
    assert forgotten < 1e-7


@pytest.mark.slow
def test_a_plain_filter_learns_what_it_cannot_see():
    slam = case(PLANAR).filter("robocentric")
    moved, forgotten = difference_of_runs(slam, case(PLANAR), GAUGE[PLANAR] + 1)
    assert moved > 1e-5
    assert forgotten > 1e-2


@pytest.mark.slow
def test_with_odometry_a_robocentric_filter_has_nothing_to_constrain():
    odometry = Case("positions", steps=8, landmarks=6)
    frames = odometry.controls(), *odometry.frames(0)
    plain = odometry.compiled("robocentric", "cartesian")(*frames)[1]
    constrained = odometry.compiled("robocentric+oc", "cartesian")(*frames)[1]
    for x, y in zip(jax.tree.leaves(plain), jax.tree.leaves(constrained), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_where_the_heading_is_known_all_are_the_kalman_filter():
    """Relative positions at a known heading are linear: one filter in every coordinates."""
    case = Case("positions", steps=8, landmarks=6, odometry_sigma=(0.05, 0.05, 0.0))
    frames = case.controls(), *case.frames(0)
    linear = case.compiled("world", "cartesian")(*frames)[1]
    assert np.trace(linear[1][-1]) > 1e-3
    for name in ("world+oc", "world+fej", "world+decoupled", "invariant"):
        same = case.compiled(name, "cartesian")(*frames)[1]
        for x, y in zip(jax.tree.leaves(linear), jax.tree.leaves(same), strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "name", quick_rows(1, ["world+fej2", "world+fej", "robocentric+oc", "world+oc", "invariant"])
)
def test_a_frame_without_measurements_changes_nothing(name):
    """Neither the mean nor the covariance, but for `ROUNDING`: remedies are of corrections."""
    start = case(PLANAR)
    slam, control = start.filter(name), start.controls()[0]
    first, known, _ = start.frames(0)
    blind = jax.tree.map(lambda x: x[0], known)
    blind = replace(blind, valid=jnp.zeros_like(blind.valid))

    def update():
        state = slam.predict(slam.init(5, first), control)
        after, innovation = slam.update(state, control, blind)
        return state, after, innovation.nis

    before, after, nis = quick_jit(update)()
    assert nis == 0
    for x, y in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-12)


@pytest.mark.slow
def test_the_scale_is_read_from_what_is_known_of_it():
    """`L N = I`; an old landmark says more than a new one, and a camera at rest says nothing."""
    model = a_filter(SPATIAL).model
    state = truth(model)
    motion = jnp.zeros_like(state.core.motion)
    core, c = replace(state.core, motion=motion), state.core_dim
    state = replace(state, core=core)
    new = jnp.arange(COUNT) == 0
    sigma = jnp.where(new, 0.5, 0.01)[:, None] * jnp.abs(state.landmarks)
    variances = jnp.concatenate([jnp.ones(c), sigma.ravel() ** 2])
    state = replace(state, covariance=jnp.diag(variances))

    def read():
        N = unobservable_directions(model, state)
        return N, transport(model, state, state)[1]

    N, L = (np.asarray(x) for x in quick_jit(read)())
    np.testing.assert_allclose(L @ N, np.eye(7), atol=1e-10)
    share = (L[-1] * N[:, -1])[c:].reshape(COUNT, -1).sum(axis=1)
    assert share[0] < 0.01 * share[1:].min()
    assert np.abs(L[-1][state.core.part("motion")]).max() < 1e-12
