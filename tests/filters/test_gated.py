"""Tests of a filter that believes only what agrees."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, a_filter, quick_jit

from jaxslam.filters.gate import Gate
from jaxslam.geometry import PLANAR
from jaxslam.landmarks import Cartesian
from jaxslam.models.observations import Features
from jaxslam.models.sensors import RangeBearing
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


@pytest.mark.slow
def test_the_states_are_those_of_the_filter_inside():
    of = case()
    slam = of.filter("robocentric+checked")
    first = of.frames(0)[0]
    inside, around = (quick_jit(partial(f.init, of.capacity))(first) for f in (slam.inner, slam))
    jax.tree.map(np.testing.assert_array_equal, around, inside)


def test_a_tolerance_is_in_the_unit_of_each_number():
    """A bearing that is 20 of its σ off is no right match, whatever the σ of a range in metres."""
    slam = a_filter(PLANAR, Cartesian(), sensor=RangeBearing((0.5, 0.01)), gate=Gate())
    at = jnp.array([[4.0, 0.3], [5.0, -0.2], [6.0, 0.1], [3.0, 0.6]])
    first = Features(jnp.arange(4), at, jnp.ones(4, bool))
    seen = replace(first, measured=at.at[0, 1].add(0.2))

    def used(first, seen):
        state = slam.init(4, first)
        control = jnp.asarray(1.0)
        return slam.update(slam.predict(state, control), control, seen)[1].used

    assert quick_jit(used)(first, first).all()
    assert quick_jit(used)(first, seen).tolist() == [False, True, True, True]
