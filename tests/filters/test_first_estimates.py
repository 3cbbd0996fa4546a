"""Tests of the filters by first estimates: what FEJ2 leaves out, and how a pose is corrected."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, close, quick_jit

from jaxslam.filters.linear.blocks import minus, observe, placed
from jaxslam.filters.model import COMPOSED
from jaxslam.filters.remedies.invariant import rigid_directions
from jaxslam.geometry import PLANAR, SPATIAL, exp, jacobian
from jaxslam.models.sensors import noises

SPACE = {
    "geometry": "spatial",
    "velocity": (0.0, 0.0, 0.25, 0.0, -0.075, 0.0),
    "odometry_sigma": (0.01, 0.01, 0.01, 0.05, 0.05, 0.05),
}


@cache
def case(geometry):
    space = SPACE if geometry is SPATIAL else {}
    return Case("positions", steps=3, landmarks=6, range=(0.0, 50.0), **space)


def second_update(name, geometry):
    """The model, a predicted state whose landmarks are not their first estimates, what is seen
    then, and the state after the update."""
    start = case(geometry)
    slam = start.filter(name, "cartesian")
    first, known, new = start.frames(0)
    controls = start.controls()

    def run():
        state = slam.init(6, first)
        for i in range(2):
            now, fresh = (jax.tree.map(lambda x, i=i: x[i], part) for part in (known, new))
            state, _ = slam.step(state, controls[i], now, fresh)
        before = slam.predict(state, controls[2])
        seen = jax.tree.map(lambda x: x[2], known)
        return before, seen, *slam.update(before, controls[2], seen)

    return slam, *quick_jit(run)()


def test_fej2_is_the_update_by_the_left_null_space():
    """Of H − H₁, by an SVD: mean and covariance but for the transport are those of what is left."""
    slam, before, seen, after, _ = second_update("world+fej2", PLANAR)
    first = replace(before, landmarks=before.first)
    parts = [observe(slam.model, x, seen.slots, COMPOSED) for x in (before, first)]
    H, H_first = (placed(part[2], seen.slots, len(before.active)) for part in parts)
    used = np.repeat(seen.valid & before.active[seen.slots], 2)
    assert used.sum() >= 6
    H, H_first = np.asarray(H)[used], np.asarray(H_first)[used]
    residual = np.asarray(seen.measured - parts[0][0]).ravel()[used]
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


@pytest.mark.parametrize("geometry", [PLANAR, SPATIAL], ids=lambda x: x.name)
def test_a_decoupled_correction_moves_the_pose_by_its_group(geometry):
    """`Exp(ξ) pose`, ξ of the additive correction of the same gain; landmarks are as in FEJ."""
    slam, before, _, after, _ = second_update("world+decoupled", geometry)
    plain = replace(slam, correction=case(geometry).filter("world+fej", "cartesian").correction)
    _, _, seen, *_ = second_update("world+fej", geometry)
    added, _ = quick_jit(lambda: plain.update(before, case(geometry).controls()[2], seen))()
    start = replace(before, landmarks=before.first)
    _, L = rigid_directions(slam.model, start)
    moved = exp(geometry.group, L @ minus(added, before))
    expected = moved @ before.core.pose.joined()
    close(after.core.pose.joined().as_matrix(), expected.as_matrix(), 1e-12)
    close(after.landmarks, added.landmarks, 1e-12)
    difference = after.core.pose.translation - added.core.pose.translation
    assert np.abs(difference).max() > 1e-9


def test_oc_in_the_world_is_the_affine_filter():
    """Song et al., arXiv:2412.10809: with a rotation's error in B, `P ← A P Aᵀ`, A the identity but
    for `S(p) − S(p⁺)` of the position and of every landmark."""
    slam, before, seen, after, _ = second_update("world+oc", SPATIAL)
    control = case(SPATIAL).controls()[2]
    plain = replace(slam, correction=case(SPATIAL).filter("world", "cartesian").correction)
    added, _ = quick_jit(lambda: plain.update(before, control, seen))()

    def in_base(state):
        """The Jacobian to coordinates whose rotation error is in B: `R Exp(θ) = Exp(R θ) R`."""
        rotation = state.core.pose.rotation.as_matrix()
        return jnp.eye(len(state.covariance)).at[3:6, 3:6].set(rotation)

    def cross(x):
        return jacobian(lambda y: jnp.cross(x, y), jnp.zeros(3))

    A = jnp.eye(len(before.covariance))
    c = before.core_dim
    places = [(0, before.core.pose.translation, added.core.pose.translation)]
    points = zip(before.landmarks, added.landmarks, strict=True)
    places += [(c + 3 * i, *pair) for i, pair in enumerate(points) if before.active[i]]
    for row, old, new in places:
        A = A.at[row : row + 3, 3:6].set(cross(old - new))
    # The update's covariance, as the published filter has it, at the pose before and after.
    before_to_base, after_to_base = in_base(before), in_base(added)
    expected = A @ before_to_base @ added.covariance @ before_to_base.T @ A.T
    found = after_to_base @ after.covariance @ after_to_base.T
    close(found, expected, 1e-10)
