"""Tests of a filter through a user's own frames."""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

import jaxslam


@cache
def case():
    return Case("matched", steps=4, landmarks=3)


def frames_of(gone=None):
    _, seen, new = case().frames(0)
    return jaxslam.Frames(case().controls(), seen, new, gone)


def test_a_run_is_its_steps_one_by_one():
    """Poses, covariances, NIS and status of each, and the last state; slots are freed before."""
    slam, frames = case().filter("world"), frames_of(jnp.zeros((4, 3), bool).at[2, 1].set(True))
    begun = quick_jit(partial(slam.init, 3))(case().frames(0)[0])
    last, found = quick_jit(partial(jaxslam.run, slam))(frames, begun)

    @quick_jit
    def one(state, frame):
        state = slam.remove(state, frame.gone)
        state, innovation = slam.step(state, frame.control, frame.seen, frame.new)
        return state, (*jaxslam.camera_pose(slam, state), innovation.nis, innovation.nis_dof)

    state = begun
    for k in range(4):
        state, (pose, P, nis, dof) = one(state, jax.tree.map(lambda x, k=k: x[k], frames))
        assert (found.nis_dof[k], found.status[k]) == (dof, jaxslam.Status.OK)
        np.testing.assert_allclose(found.nis[k], nis, rtol=1e-9)
        np.testing.assert_allclose(found.pose.as_matrix()[k], pose.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(found.covariance[k], P, atol=1e-12)
    assert found.nis_dof.tolist() == [3, 3, 2, 2]
    np.testing.assert_allclose(last.covariance, state.covariance, atol=1e-12)


def test_what_is_collected_is_ones_own():
    slam = case().filter("world")
    own = partial(jaxslam.run, slam, output=lambda state, innovation, frame: frame.control + 1)
    _, found = jax.eval_shape(own, frames_of(), slam.init(3))
    assert found.shape == case().controls().shape


class NothingLeaves(jaxslam.AbstractFilter):
    """A filter that keeps every landmark: it asks another, which could remove them."""

    estimator: jaxslam.Slam

    def init(self, capacity, first=None, known=None):
        return self.estimator.init(capacity, first, known)

    def step(self, state, control, seen, new):
        return self.estimator.step(state, control, seen, new)

    def marginal(self, state, function):
        return self.estimator.marginal(state, function)

    def landmark_marginal(self, state, function, slots):
        return self.estimator.landmark_marginal(state, function, slots)


def test_slots_are_not_freed_of_a_filter_that_cannot_remove():
    slam, frames = NothingLeaves(case().filter("world")), frames_of()
    with pytest.raises(ValueError, match=r"NothingLeaves has no remove\(state, gone\)"):
        jaxslam.run(slam, frames_of(jnp.zeros((4, 3), bool)), slam.init(3))
    assert eqx.filter_eval_shape(jaxslam.run, slam, frames, slam.init(3))
