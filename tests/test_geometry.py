"""Tests of jaxslam.geometry: ⊞ and ⊟ on mixed pytrees, their Jacobian, and the planar axes."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import central, close, each_geometry, named, pose, quick_jit
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from jaxslam.geometry import (
    PLANAR,
    SplitPose,
    difference,
    exp,
    jacobian,
    joined,
    log,
    retract,
    scaled,
    tangent_dim,
)
from jaxslam.models.motion import ConstantVelocity

# Rotation vectors shorter than π have one logarithm; with |δ| ≤ 1 per axis, √3 at the most.
# Multiples of 1/64 include 0 and keep clear of tiny angles, which have a test of their own.
coordinate = st.integers(-64, 64).map(lambda k: k / 64)


def mixed(geometry, seed):
    """Two poses and two vectors, nested: what the core of a filter looks like."""
    rng = np.random.default_rng(seed)
    return {
        "pose": pose(geometry, seed, scale=3.0),
        "vectors": [jnp.asarray(rng.normal(size=4)), jnp.asarray(rng.normal(size=1))],
        "anchor": pose(geometry, seed + 1, scale=1.0),
    }


@cache
def compiled():
    """`retract` and `difference`, compiled once for each geometry."""
    return quick_jit(retract), quick_jit(difference)


def size(geometry):
    return 2 * geometry.tangent_dim + 5


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_dimensions_agree_with_the_group(geometry):
    T = geometry.group.identity()
    assert T.translation().size == geometry.point_dim == geometry.pixel_dim + 1
    assert T.log().size == geometry.tangent_dim == tangent_dim(SplitPose.of(T))
    assert geometry.tangent_dim == geometry.point_dim + geometry.rotation_group.tangent_dim
    assert tangent_dim(mixed(geometry, 0)) == size(geometry)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
@settings(deadline=None, max_examples=25, derandomize=True)
@given(data=st.data(), seed=st.integers(0, 100))
def test_difference_undoes_retract(geometry, data, seed):
    n = size(geometry)
    delta = np.array(data.draw(st.lists(coordinate, min_size=n, max_size=n)))
    move, subtract = compiled()
    tree = mixed(geometry, seed)
    # 1e-11: jaxlie's SE(2) loses 1e-16/θ², up to 1e-12 at 1/64, by cancellation in 1 − cos θ.
    np.testing.assert_allclose(subtract(move(tree, delta), tree), delta, rtol=0, atol=1e-11)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
@settings(deadline=None, max_examples=25, derandomize=True)
@given(seeds=st.tuples(st.integers(0, 100), st.integers(0, 100)))
def test_retract_undoes_difference(geometry, seeds):
    move, subtract = compiled()
    origin, tree = (mixed(geometry, seed) for seed in seeds)
    again = move(origin, subtract(tree, origin))
    for name in ("pose", "anchor"):
        # Of poses the matrix: quaternions have two signs. 1e-10: log near π loses digits.
        np.testing.assert_allclose(again[name].as_matrix(), tree[name].as_matrix(), atol=1e-10)
    for a, b in zip(again["vectors"], tree["vectors"], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_perturbations_are_right_perturbations(geometry):
    T = pose(geometry, 5)
    delta = jnp.zeros(geometry.tangent_dim).at[0].set(0.5)
    # In the pose's own frame, half a metre along its x axis.
    expected = T.translation() + 0.5 * T.rotation().as_matrix()[:, 0]
    np.testing.assert_allclose(retract(T, delta).translation(), expected, atol=1e-14)


def test_planar_angle_turns_from_x_towards_z():
    quarter = PLANAR.group.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
    np.testing.assert_allclose(quarter @ jnp.array([1.0, 0.0]), [0.0, 1.0], atol=1e-15)


ANGLES = (0.0, 1e-7, 1e-4, 1e-2)


@cache
def step_aside(geometry, dtype):
    """Where a step of 1 along x that turns by θ towards the second axis ends there, and d/dθ."""
    t = geometry.tangent_dim

    def aside(angle):
        velocity = jnp.zeros(t, dtype).at[0].set(1).at[-1].set(angle)
        still = jnp.zeros(t, dtype)
        motion = ConstantVelocity(still, still, still)
        step = motion.displacement(velocity, still, jnp.ones((), dtype))
        return step.translation()[1]

    return quick_jit(jax.value_and_grad(aside))


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_motion_and_its_derivative_are_right_near_straight_ahead(geometry, dtype, angle):
    with jax.enable_x64(dtype == "float64"):
        value, slope = step_aside(geometry, dtype)(np.asarray(angle, dtype))
    # (1 − cos θ)/θ by its series, exact to 1e-10 for θ ≤ 0.01.
    bound = {"float64": 1e-6, "float32": 1e-3}[dtype]
    np.testing.assert_allclose(value, angle / 2 - angle**3 / 24, rtol=bound, atol=1e-12)
    np.testing.assert_allclose(slope, 0.5 - angle**2 / 8, rtol=bound)


@pytest.mark.parametrize("angle", [*ANGLES, 0.49, 0.51, 3.0])
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_exp_is_the_matrix_exponential_and_log_its_inverse(geometry, angle):
    direction = np.array([0.6, -0.7, 1.1, 0.48, -0.6, 0.64])[-geometry.tangent_dim :]
    delta = direction.copy()
    n, k = geometry.point_dim, geometry.rotation_group.tangent_dim
    delta[n:] *= angle / np.linalg.norm(direction[n:])
    pose = exp(geometry.group, jnp.asarray(delta))
    generator = np.zeros((n + 1, n + 1))
    generator[:n, n] = delta[:n]
    if k == 1:
        generator[:2, :2] = [[0, -delta[2]], [delta[2], 0]]
    else:
        x, y, z = delta[3:]
        generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    np.testing.assert_allclose(pose.as_matrix(), expm(generator), atol=1e-14)
    np.testing.assert_allclose(log(pose), delta, atol=1e-13)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_jacobians_of_poses_whole_and_split_agree_with_central_differences(geometry):
    """`jacobian` differentiates through `nudge`; the definition is through `retract`."""
    step, point = pose(geometry, 9, scale=1.0), jnp.arange(1.0, geometry.point_dim + 1)
    of = {"whole": pose(geometry, 4), "split": SplitPose.of(pose(geometry, 10, scale=1.0))}

    def function(of):
        T, U = of["split"].joined(), of["whole"]
        seen = (T @ U).inverse() @ point
        return {"seen": seen, "whole": U @ T @ U, "after": SplitPose.of(T @ step)}

    value = function(of)
    error = quick_jit(lambda delta: difference(function(retract(of, delta)), value))
    exact = np.asarray(quick_jit(lambda: jacobian(function, of))())
    t = geometry.tangent_dim
    assert exact.shape == (geometry.point_dim + 2 * t, 2 * t)
    close(central(error, np.zeros(2 * t)), exact, relative=1e-9)


# --- a pose whose position and orientation are perturbed apart ----------------------------------


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_a_split_pose_moves_along_the_axes_of_its_frame_and_turns_in_its_own(geometry):
    T = pose(geometry, 7, scale=2.0)
    delta = np.array([0.3, -0.8, 0.5, 0.4, -0.9, 0.7])[: geometry.tangent_dim]
    n = geometry.point_dim
    for again in (SplitPose.of(T).joined(), joined(T.rotation(), T.translation())):
        np.testing.assert_allclose(again.as_matrix(), T.as_matrix(), rtol=0, atol=1e-14)
    move, subtract = compiled()
    moved = move(SplitPose.of(T), delta)
    np.testing.assert_allclose(moved.translation, T.translation() + delta[:n], atol=1e-15)
    turn = exp(geometry.rotation_group, jnp.asarray(delta[n:]))
    np.testing.assert_allclose(
        moved.rotation.as_matrix(), T.rotation().as_matrix() @ turn.as_matrix(), atol=1e-15
    )
    np.testing.assert_allclose(subtract(moved, SplitPose.of(T)), delta, rtol=0, atol=1e-14)
    # The other way round, from one pose to another.
    other = SplitPose.of(pose(geometry, 8, scale=1.0))
    there = move(other, subtract(moved, other))
    np.testing.assert_allclose(
        there.joined().as_matrix(), moved.joined().as_matrix(), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("split", [False, True], ids=["whole", "split"])
@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_scaling_a_pose_scales_its_lengths_and_nothing_else(geometry, split):
    T = pose(geometry, 1)
    twice = scaled({"pose": SplitPose.of(T) if split else T}, jnp.asarray(2.0))["pose"]
    assert isinstance(twice, SplitPose if split else geometry.group)
    twice = twice.joined() if isinstance(twice, SplitPose) else twice
    np.testing.assert_allclose(twice.translation(), 2 * T.translation(), rtol=1e-15)
    rotation = T.rotation().as_matrix()
    np.testing.assert_allclose(twice.rotation().as_matrix(), rotation, rtol=0, atol=1e-15)
