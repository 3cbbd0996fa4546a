"""Tests of the right-invariant filter: its retraction, and that the base frame does not matter."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, close, named, pose, quick_jit, quick_rows

from jaxslam.filters.linear.blocks import plus
from jaxslam.filters.linear.kalman import Kalman
from jaxslam.filters.model import COMPOSED
from jaxslam.filters.remedies.gauge import act
from jaxslam.geometry import PLANAR, SPATIAL, difference, exp, log
from jaxslam.landmarks import Cartesian, InverseScaling, UnifiedInverseDepth

NAMES = {PLANAR: "matched", SPATIAL: "matched-6dof"}


@cache
def case(geometry):
    return Case(NAMES[geometry], steps=2, landmarks=4)


def predicted(slam, geometry):
    """A predicted state whose pose and landmarks are uncertain together, and its measurements."""
    start = case(geometry)
    first, known, _ = start.frames(0)
    state = slam.predict(slam.init(4, first), start.controls()[0])
    # A heading uncertain enough for a large correction.
    t = geometry.tangent_dim
    moved = state.covariance.at[jnp.arange(t), jnp.arange(t)].add(1e-2)
    features = jax.tree.map(lambda x: x[0], known)
    features = replace(features, measured=features.measured + 60.0)  # of 650 a radian
    return replace(state, covariance=moved), features


def seen_from_elsewhere(slam, state, rigid):
    """The same state in another base frame, `P' = J P Jᵀ`."""
    one = jnp.ones(())
    core, landmarks = act(slam.model, rigid, one, state.core, state.landmarks)

    def error(delta):
        x = plus(state, delta)
        moved = act(slam.model, rigid, one, x.core, x.landmarks)
        return jnp.append(difference(moved[0], core), (moved[1] - landmarks).ravel())

    J = jax.jacfwd(error)(jnp.zeros(state.covariance.shape[0]))
    return replace(state, core=core, landmarks=landmarks, covariance=J @ state.covariance @ J.T)


@pytest.mark.parametrize(
    ("geometry", "landmark"),
    # Angles of a ray in space do not turn by addition.
    quick_rows(
        1, [(PLANAR, InverseScaling()), (PLANAR, UnifiedInverseDepth()), (SPATIAL, Cartesian())]
    ),
    ids=named,
)
def test_an_update_is_the_same_in_every_base_frame(geometry, landmark):
    slam = case(geometry).filter("invariant", landmark.name)

    def both():
        state, features = predicted(slam, geometry)
        rigid = pose(geometry, 4, 1.2)
        elsewhere = seen_from_elsewhere(slam, state, rigid)
        a, b = (slam.update(s, None, features)[0] for s in (state, elsewhere))
        return seen_from_elsewhere(slam, a, rigid), b, state

    expected, actual, before = quick_jit(both)()
    np.testing.assert_allclose(difference(actual.core, expected.core), 0, atol=1e-10)
    close(actual.landmarks, expected.landmarks, 1e-10)
    close(actual.covariance, expected.covariance, 1e-8)
    assert np.abs(difference(actual.core, before.core)).max() > 1e-3


@pytest.mark.parametrize("geometry", quick_rows(1, [PLANAR, SPATIAL]), ids=lambda g: g.name)
def test_cartesian_landmarks_are_corrected_as_published(geometry):
    """`p ← R p + V ξ`, V by `Exp(ξ, θ) = (R, V ξ)`, but for θ²/24 of a landmark's own ξ."""
    slam = case(geometry).filter("invariant", Cartesian().name)
    n = geometry.point_dim

    def corrected():
        state, features = predicted(slam, geometry)
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
