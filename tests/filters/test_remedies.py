"""Tests of the remedies: the gauge, and corrections that respect it in each their own way.

What no measurement tells must stay unknown while estimates change: uncertainty added along it at
the start changes no estimate ever after.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, close, named, quick_jit, quick_rows

import jaxslam
from jaxslam.filters.linear.blocks import composition, minus, observe, placed
from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.model import COMPOSED, Context
from jaxslam.filters.remedies.gauge import unobservable_directions
from jaxslam.filters.remedies.invariant import rigid_directions
from jaxslam.filters.remedies.transport import read_from, read_scale_too
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import PLANAR, SPATIAL, exp, jacobian, log
from jaxslam.models.sensors import noises

VELOCITY, LANDMARKS = slice(3, 5), slice(7, 11)


def test_the_scale_is_read_from_pose_velocity_and_landmarks_and_from_nothing_else():
    """Of any gauge of three directions and a scale, and any covariance."""
    draw = np.random.default_rng(0)
    N, half = draw.normal(size=(12, 4)), draw.normal(size=(12, 12))

    def read(N, P):
        return read_scale_too(N, read_from(N[:, :3], 3), P, VELOCITY, LANDMARKS)

    L = quick_jit(read)(N, half @ half.T)
    np.testing.assert_allclose(L @ N, np.eye(4), atol=1e-10)
    np.testing.assert_array_equal(np.flatnonzero(~np.any(np.abs(L) > 1e-12, axis=0)), [5, 6, 11])


def test_the_scale_is_read_from_what_is_known_of_it():
    """A new landmark says less than old ones; a camera at rest nothing, and one that moves all."""
    variances = np.full(12, 1e-4)
    variances[7] = 0.25
    for speed in (0.0, 1.0):
        N = np.zeros((12, 4))
        N[:3, :3], N[3:5, 3], N[7:11, 3] = np.eye(3), speed, 1.0
        N, P = jnp.asarray(N), jnp.diag(jnp.asarray(variances))
        read = read_scale_too(N, read_from(N[:, :3], 3), P, VELOCITY, LANDMARKS)
        np.testing.assert_allclose(read @ N, np.eye(4), atol=1e-12)
        by_velocity, by_new, by_old = read[-1, VELOCITY].sum(), read[-1, 7], read[-1, 8]
        assert by_velocity * speed > 0.99 or (by_velocity == 0 and by_new < 0.01 * by_old)


@cache
def case(name):
    """The start of a run without odometry."""
    return Case(name, steps=6, landmarks=5, placement="prior")


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


DIRECTIONS = {"matched": 4, "matched-6dof": 7, "imu-loose": 6}
"""Of the base frame, and of the scale where no unit measures it."""
REMEDIES = [
    ("scale_gauge+oc", "matched", "inverse_scaling"),
    ("invariant", "matched", "anchored_homogeneous"),
    ("world+oc", "imu-loose", "cartesian"),
    ("robocentric+oc2", "matched", "inverse_scaling"),
    ("robocentric+oc", "matched-6dof", "image_plane"),
    ("world+oc", "matched", "framed_homogeneous"),
    *((f"world+{word}", "matched", "inverse_scaling") for word in ("fej", "fej2", "decoupled")),
    *((name, "imu-loose", "cartesian") for name in ("robocentric", "robocentric+oc", "world+fej")),
    ("invariant", "imu-loose", "anchored_homogeneous"),
]


@pytest.mark.parametrize(("name", "world", "landmark"), quick_rows(3, REMEDIES))
def test_uncertainty_of_the_gauge_changes_no_estimate_ever(name, world, landmark):
    """Through whole steps: K and the mean are the same, and P keeps what was added, N Σ Nᵀ."""
    count = DIRECTIONS[world] - ((name, world) == ("invariant", "matched"))  # it knows no scale
    slam = case(world).filter(name, landmark)
    moved, forgotten = difference_of_runs(slam, case(world), count)
    assert moved < (1e-8 if world == "imu-loose" else 1e-9)
    assert forgotten < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "world", "landmark", "least"),
    [
        ("robocentric", "matched", "inverse_scaling", 1e-2),
        ("world", "imu-loose", "cartesian", 1e-3),
    ],
)
def test_a_plain_filter_learns_what_it_cannot_see(name, world, landmark, least):
    """Else a gauge that nothing feels would pass the test above."""
    slam = case(world).filter(name, landmark)
    moved, forgotten = difference_of_runs(slam, case(world), DIRECTIONS[world])
    assert moved > 1e-5
    assert forgotten > least


MATCHED = jaxslam.scenario("matched-loose", landmarks=3)


@pytest.mark.parametrize(
    ("name", "log_scale"),
    [("scale_gauge", 0.3), ("world_gauge", 0.0), ("scale_gauge+submaps", 0.3)],
)
def test_a_motion_takes_unobservable_directions_to_those_after_it(name, log_scale):
    """`Φ N_k = N_{k+1}`, whatever the filter's unit of length is (noise is not enlarged here)."""
    made: Any = make_filter(name, **scenario_pieces(MATCHED))
    slam = made.one
    pixels = jnp.array([[100.0], [300.0], [500.0]])
    first = jaxslam.Features(jnp.arange(3), pixels, jnp.ones(3, bool))
    control = jnp.asarray(1 / 30)

    def off(log_scale):
        state, group = slam.init(3, first), slam.motion.geometry.group
        moved = exp(group, jnp.array([0.5, 0.7, 0.3]))
        core = replace(
            state.core,
            log_scale=log_scale[None],
            motion=state.core.motion + jnp.array([0.1, 0.3, 0.2]),
            pose=slam.frame.compose(state.core.pose, moved),
        )
        state = replace(state, core=core)
        change = composition(slam.model, state, Context(control))

        def after(both):
            core, landmarks = both
            if change.landmark is not None:
                one = jax.vmap(change.landmark, in_axes=(None, 0))
                landmarks = one(change.view(core), landmarks)
            return change.core(core), landmarks

        Phi = jacobian(after, (state.core, state.landmarks))
        core, landmarks = after((state.core, state.landmarks))
        later = replace(state, core=core, landmarks=landmarks)
        N, N_later = (unobservable_directions(slam.model, x) for x in (state, later))
        keep = np.setdiff1d(np.arange(len(N)), np.r_[core.part("noise")])
        return (Phi @ N - N_later)[keep]

    np.testing.assert_allclose(quick_jit(off)(jnp.asarray(log_scale)), 0, atol=1e-12)


SPACE = {
    "geometry": "spatial",
    "velocity": (0.0, 0.0, 0.25, 0.0, -0.075, 0.0),
    "odometry_sigma": (0.01, 0.01, 0.01, 0.05, 0.05, 0.05),
}


@cache
def positions(geometry):
    space = SPACE if geometry is SPATIAL else {}
    return Case("positions", steps=3, landmarks=6, range=(0.0, 50.0), **space)


def second_update(name, geometry):
    """The model, a predicted state whose landmarks are not their first estimates, what is seen
    then, and the state after the update."""
    start = positions(geometry)
    slam = start.filter(name, "cartesian")
    first, known, new = start.frames(0)
    controls = start.controls()

    def run():
        def step(state, frame):
            return slam.step(state, *frame)[0], None

        two = jax.tree.map(lambda x: x[:2], (controls, known, new))
        before = slam.predict(jax.lax.scan(step, slam.init(6, first), two)[0], controls[2])
        seen = jax.tree.map(lambda x: x[2], known)
        return before, seen, slam.update(before, controls[2], seen)[0]

    return slam, *quick_jit(run)()


def test_fej2_is_the_update_by_the_left_null_space():
    """Of H − H₁, by an SVD: mean and covariance but for the transport are those of what is left."""
    slam, before, seen, after = second_update("world+fej2", PLANAR)

    @quick_jit
    def observed(state):
        part = observe(slam.model, state, seen.slots, COMPOSED)
        return part[0], placed(part[2], seen.slots, len(before.active))

    expected, H = observed(before)
    _, H_first = observed(replace(before, landmarks=before.first))
    used = np.repeat(seen.valid & before.active[seen.slots], 2)
    assert used.sum() >= 6
    H, H_first = np.asarray(H)[used], np.asarray(H_first)[used]
    residual = np.asarray(seen.measured - expected).ravel()[used]
    U, sizes, _ = np.linalg.svd(H - H_first)
    rank = int(np.sum(sizes > 1e-9 * sizes[0]))
    assert rank == 1  # of the heading
    left = U[:, rank:].T
    A, P = left @ H_first, np.asarray(before.covariance)
    R = left @ left.T * float(noises(slam.sensor, seen.measured)[0, 0])
    K = P @ A.T @ np.linalg.inv(A @ P @ A.T + R)
    close(minus(after, before), K @ left @ residual, 1e-5)
    landmarks = slice(before.core_dim, None)
    close(after.covariance[landmarks, landmarks], (P - K @ A @ P)[landmarks, landmarks], 1e-5)


@pytest.mark.parametrize("geometry", quick_rows(1, [PLANAR, SPATIAL]), ids=named)
def test_a_decoupled_correction_moves_the_pose_by_its_group(geometry):
    """`Exp(ξ) pose`, ξ of the additive correction of the same gain; landmarks are as in FEJ."""
    slam, before, seen, after = second_update("world+decoupled", geometry)
    plain = replace(
        slam, correction=positions(geometry).filter("world+fej", "cartesian").correction
    )

    @quick_jit
    def expected():
        added, _ = plain.update(before, positions(geometry).controls()[2], seen)
        _, L = rigid_directions(slam.model, replace(before, landmarks=before.first))
        moved = exp(geometry.group, L @ minus(added, before)) @ before.core.pose.joined()
        return added, moved.as_matrix(), after.core.pose.joined().as_matrix()

    added, moved, pose = expected()
    close(pose, moved, 1e-12)
    close(after.landmarks, added.landmarks, 1e-12)
    difference = after.core.pose.translation - added.core.pose.translation
    assert np.abs(difference).max() > 1e-9


def test_oc_in_the_world_is_the_transformed_and_the_affine_filter():
    """Hao, Tian, He, arXiv:2502.05008 and 2510.23359: an EKF of errors `z = T(x) δ` whose gauge is
    constant, here `δp + p × θ` of the position and of every landmark, with θ in B. Of the affine
    filter (Song et al., arXiv:2412.10809) A is `T(x⁺)⁻¹ T(x)`."""
    slam, before, seen, after = second_update("world+oc", SPATIAL)
    predicted, _, H = quick_jit(lambda x: observe(slam.model, x, seen.slots, COMPOSED))(before)

    def transformation(state):
        """From coordinates whose rotation error is in the camera: `R Exp(θ) = Exp(R θ) R`."""
        core = state.core
        rotation = core.pose.rotation.as_matrix()
        T = jnp.eye(len(state.covariance)).at[3:6, 3:6].set(rotation)
        landmarks = enumerate(state.landmarks)
        places = [(state.core_dim + 3 * i, p) for i, p in landmarks if state.active[i]]
        for row, p in [(0, core.pose.translation), *places]:
            T = T.at[row : row + 3, 3:6].set(jnp.cross(p, rotation.T).T)
        return T

    used = np.repeat(seen.valid & before.active[seen.slots], 3)
    T, T_after = transformation(before), transformation(after)
    H = placed(H, seen.slots, len(before.active))[used] @ jnp.linalg.inv(T)
    P, R = T @ before.covariance @ T.T, noises(slam.sensor, seen.measured)
    K = P @ H.T @ jnp.linalg.inv(H @ P @ H.T + jnp.kron(jnp.eye(used.sum() // 3), R))
    z = K @ (seen.measured - predicted).ravel()[used]
    close(minus(after, before), jnp.linalg.solve(T, z), 1e-9)
    root = jnp.linalg.inv(T_after)
    close(after.covariance, root @ (P - K @ H @ P) @ root.T, 1e-9)
    plain = replace(slam, correction=Kalman())
    added, _ = quick_jit(lambda: plain.update(before, positions(SPATIAL).controls()[2], seen))()
    assert np.abs(after.covariance - added.covariance).max() > 1e-4 * added.covariance.max()


def predicted(slam, world):
    """A predicted state whose pose and landmarks are uncertain together, and its measurements."""
    start = case(world)
    first, known, _ = start.frames(0)
    state = slam.predict(slam.init(5, first), start.controls()[0])
    # A heading uncertain enough for a large correction.
    t = slam.motion.geometry.tangent_dim
    moved = state.covariance.at[jnp.arange(t), jnp.arange(t)].add(1e-2)
    features = jax.tree.map(lambda x: x[0], known)
    features = replace(features, measured=features.measured + 60.0)  # of 650 a radian
    return replace(state, covariance=moved), features


@pytest.mark.parametrize("world", ["matched", "matched-6dof"])
def test_cartesian_landmarks_are_corrected_as_published(world):
    """`p ← R p + V ξ`, V by `Exp(ξ, θ) = (R, V ξ)`, but for θ²/24 of a landmark's own ξ."""
    slam = case(world).filter("invariant", "cartesian")
    geometry = slam.motion.geometry
    n = geometry.point_dim

    def corrected():
        state, features = predicted(slam, world)
        added, _ = Kalman().update(slam.model, state, features, slam.sensor.noise, COMPOSED)
        after, _ = slam.update(state, None, features)
        return state, added, after

    before, added, after = quick_jit(corrected)()
    T, T_added = before.core.pose.joined(), added.core.pose.joined()
    turn = T.rotation().inverse() @ T_added.rotation()
    theta = log(turn) if n == 2 else T.rotation() @ log(turn)

    def cross(x):
        return theta[0] * jnp.array([-x[1], x[0]]) if n == 2 else jnp.cross(theta, x)

    size = float(jnp.linalg.norm(theta))
    assert size > 0.02

    def xi(x, x_added):
        return x_added - x - cross(x)

    def published(x, x_added):
        return exp(geometry.group, jnp.append(xi(x, x_added), theta)) @ x

    expected = jax.vmap(published)(before.landmarks, added.landmarks)
    own = jax.vmap(xi)(before.landmarks, added.landmarks)
    own -= xi(T.translation(), T_added.translation())
    # V(θ) and R(θ/2) differ by θ²/24.
    bound = size**2 / 20 * np.linalg.norm(own, axis=1)
    assert np.all(np.linalg.norm(after.landmarks - expected, axis=1) < bound)
    close(after.core.pose.translation, published(T.translation(), T_added.translation()), 1e-12)
    # Not what addition gives.
    assert np.all(np.linalg.norm(added.landmarks - expected, axis=1) > 2 * bound)


def test_a_feature_of_a_landmark_that_drifts_is_expected_by_so_much_less_surely():
    """`H (P + H⁺ share² R H⁺ᵀ) Hᵀ + R` is `S + share² R`."""
    of = case("matched-6dof")
    first, known, _ = of.frames(0)
    seen = jax.tree.map(lambda x: x[0], known)

    def compared(name):
        slam = of.filter(name)

        def run(first, seen):
            state = slam.predict(slam.init(of.capacity, first), of.controls()[0])
            return slam.update(state, of.controls()[0], seen)[1]

        return quick_jit(run)(first, seen), slam.sensor.noise

    (fixed, R), (drifting, _) = compared("robocentric"), compared("robocentric+drift30")
    m, p = fixed.used.size, len(R)
    more = np.asarray(drifting.covariance - fixed.covariance).reshape(m, p, m, p)
    assert fixed.used.all()
    expected = np.einsum("ij,kl->ikjl", np.eye(m), 0.3**2 * R)
    np.testing.assert_allclose(more, expected, atol=1e-9)
    assert drifting.nis < fixed.nis
