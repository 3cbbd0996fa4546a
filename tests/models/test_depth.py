"""The prior on 1/z of new landmarks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, quick_jit
from scipy import integrate

import jaxslam
from jaxslam import InverseDepth


@pytest.mark.parametrize(("near", "far"), [(1.0, 6.0), (5.0, 50.0), (2.0, 2.1)])
def test_uniform_depths_have_the_moments_of_quadrature(near, far):
    depth = InverseDepth.from_depths(near, far)
    first, second = (
        integrate.quad(lambda z, k=k: z**-k / (far - near), near, far)[0] for k in (1, 2)
    )
    np.testing.assert_allclose(depth.mean, first, rtol=1e-9)
    np.testing.assert_allclose(depth.sigma, np.sqrt(second - first**2), rtol=1e-6)


@pytest.mark.parametrize("end", ["", "-6dof"])
def test_the_long_scenarios_are_told_their_depths_or_not(end):
    told, thrown, change = (
        jaxslam.scenario(f"laps-{name}{end}") for name in ("prior", "thrown", "change")
    )
    right = InverseDepth.from_depths(*told.depth_range)
    for world in (told, change):
        np.testing.assert_allclose(world.inverse_depth, (right.mean, right.sigma), rtol=1e-12)
    assert right.mean > thrown.depth.mean + 2 * thrown.depth.sigma
    assert thrown.depth_range == told.depth_range == change.depth_range[:2]


def test_a_common_error_that_walks_forgets_as_much_in_every_frame():
    """Of a filter that sees nothing."""
    of = Case("matched", steps=3, landmarks=2)
    first, known, new = of.frames(0)
    none = [replace(x, valid=np.zeros_like(x.valid)) for x in (known, new)]
    slam = of.filter("scale_gauge+scene50+walk3")
    place = slam.init(of.capacity).core.part("depth_error").start

    @quick_jit
    def variances(walk):
        walking = replace(slam, depth=replace(slam.depth, walk=walk))

        def step(state, frame):
            state, _ = walking.step(state, *frame)
            return state, state.covariance[place, place]

        frames = (of.controls(), *none)
        return jax.lax.scan(step, walking.init(of.capacity, first), frames)[1]

    start = variances(0.0)
    np.testing.assert_allclose(start, start[0], rtol=1e-9)
    np.testing.assert_allclose(variances(0.3), start + 0.3**2 * np.arange(1, 4), rtol=1e-9)


def test_where_a_common_error_walks_depths_scatter_as_their_mean_does():
    """And to first order it is the sum of both errors that it is where it stays."""
    still = InverseDepth(0.2, 0.1, common=0.5)
    walks = replace(still, walk=0.03)
    own = jnp.array([0.1, 0.2, 0.5])  # −1, 0 and 3 σ
    twice = walks.with_common(own, jnp.log(2.0) * 0.2 / 0.1)
    np.testing.assert_allclose(twice, 2 * own, rtol=1e-12)
    one, other = (
        jax.jvp(lambda e, of=of: of.with_common(own[1], e), (own[0] * 0,), (own[0] / own[0],))
        for of in (still, walks)
    )
    np.testing.assert_allclose(one, [0.2, 0.1], rtol=1e-6)
    np.testing.assert_allclose(other, one, rtol=1e-6)


def test_priors_that_make_no_sense_are_refused():
    for depths in ((0.0, 1.0), (2.0, 2.0), (1.0, np.inf), (1, np.nan)):
        with pytest.raises(ValueError, match="between 0 < near < far < ∞, not"):
            InverseDepth.from_depths(*depths)
    with pytest.raises(ValueError, match="give its σ, common, too"):
        InverseDepth(0.2, 0.1, walk=0.1)
