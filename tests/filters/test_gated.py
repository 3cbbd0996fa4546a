"""Tests of a filter that believes only what agrees."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit

from jaxslam.statistics.bands import lost_threshold

RUNS = 8


@cache
def case():
    return Case("matched-6dof", RUNS, steps=12, landmarks=15)


def nees_with_wrong_matches(name, share):
    """Of the last pose of every run, a share of whose matches is off by tens of pixels."""
    of = case()
    slam = of.filter(name)
    rng = np.random.default_rng(0)
    first, known, new = of.features
    shape = known.measured.shape
    off = rng.normal(0, 25.0, shape) * (rng.uniform(size=shape[:-1]) < share)[..., None]
    known = replace(known, measured=known.measured + jnp.asarray(off))

    def run(first, known, new, controls, pose):
        def step(state, frame):
            control, seen, entering = frame
            return slam.step(state, control, seen, entering)

        state, innovation = jax.lax.scan(
            step, slam.init(of.capacity, first), (controls, known, new)
        )
        return *slam.pose_error(state, pose), innovation.used

    last = jax.tree.map(lambda x: x[:, -1], of.runs.poses)
    error, P, used = quick_jit(jax.vmap(run))(first, known, new, of.runs.controls, last)
    nees = np.einsum("ri,ri->r", error, np.linalg.solve(P, np.asarray(error)[..., None])[..., 0])
    wrong = np.any(off != 0, axis=-1) & np.asarray(known.valid)
    return nees, np.asarray(used)[wrong].mean() if wrong.any() else 0.0


@pytest.mark.slow
def test_wrong_matches_are_not_believed():
    nees, believed = nees_with_wrong_matches("robocentric+checked", 0.3)
    assert believed < 0.05
    assert nees.max() < lost_threshold(6)
    alone, believed = nees_with_wrong_matches("robocentric", 0.3)
    assert believed > 0.9
    assert np.median(alone) > lost_threshold(6)


@pytest.mark.slow
def test_right_matches_are():
    nees, _ = nees_with_wrong_matches("robocentric+checked", 0.0)
    assert nees.mean() == pytest.approx(
        nees_with_wrong_matches("robocentric", 0.0)[0].mean(), rel=0.2
    )


def test_the_states_are_those_of_the_filter_inside():
    of = case()
    slam = of.filter("robocentric+checked")
    first = of.frames(0)[0]
    inside, around = (quick_jit(partial(f.init, of.capacity))(first) for f in (slam.inner, slam))
    jax.tree.map(np.testing.assert_array_equal, around, inside)
