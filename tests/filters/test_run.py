"""Tests of a filter through a user's own frames."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from cases import Case, quick_jit

import jaxslam


def test_a_run_is_its_steps_one_by_one():
    """Poses, covariances, NIS and status of each, and the last state; slots are freed before."""
    case = Case("matched", steps=4, landmarks=3)
    slam, (first, seen, new) = case.filter("world"), case.frames(0)
    gone = jnp.zeros((4, 3), bool).at[2, 1].set(True)
    frames = jaxslam.Frames(case.controls(), seen, new, gone)
    begun = quick_jit(partial(slam.init, 3))(first)
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
