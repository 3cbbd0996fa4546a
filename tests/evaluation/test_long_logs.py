"""Long logs are evaluated in blocks of poses; some of them serve for what needs no more."""

from functools import partial

import numpy as np
import pytest
from logs import logged

import jaxslam
from jaxslam.evaluation import alignment, convention, inputs
from jaxslam.evaluation.inputs import Poses, checked_poses


@pytest.mark.parametrize(("align", "error"), [("yaw", "left"), ("sim3", "split")])
def test_blocks_of_poses_have_the_nees_of_all_together(align, error, monkeypatch):
    T, P, truth = logged(jaxslam.Convention(error), runs=2, steps=40, spread=0.5)
    P = P * np.linspace(1, 2, 40)[:, None, None]

    def nees():
        told = jaxslam.Convention(error)
        return jaxslam.evaluate_poses(T, P, truth, told, align=align).nees

    whole = nees()
    for module in (alignment, convention):
        monkeypatch.setattr(module, "blocks", partial(convention.blocks, size=7))
    monkeypatch.setattr(inputs, "BLOCK", 14)
    monkeypatch.setattr(inputs, "MOST", 20)
    np.testing.assert_allclose(nees(), whole, rtol=1e-9)


def test_some_poses_hold_the_first_of_every_run(monkeypatch):
    monkeypatch.setattr(inputs, "MOST", 20)
    T, P, truth = (x.copy() for x in logged(jaxslam.Convention(), runs=2, steps=40))
    T[1, :3] = P[1, :3] = truth[1, :3] = np.nan
    poses = checked_poses(T, P, truth, jaxslam.Convention())
    few = poses.some()
    assert isinstance(few, Poses)
    steps = np.union1d(np.arange(0, 40, 4), [3])
    np.testing.assert_array_equal(few.estimates, poses.estimates[:, steps])
    np.testing.assert_array_equal(few.logged, poses.logged[:, steps])


def test_a_covariance_of_a_later_block_that_is_none_is_named_by_its_own_step(monkeypatch):
    monkeypatch.setattr(inputs, "BLOCK", 10)
    e, P = np.ones((1, 40, 2)), np.tile(np.eye(2), (1, 40, 1, 1))
    P[0, 33, 0, 0] = -1.0
    with pytest.raises(ValueError, match="run 0, step 33 has variance -1"):
        jaxslam.evaluate(e, P)
