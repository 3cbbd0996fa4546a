"""The prior on 1/z of new landmarks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, each_geometry, named, quick_jit
from scipy import integrate

import jaxslam
from jaxslam import InverseDepth
from jaxslam.filters.remedies.gauge import act
from jaxslam.geometry import identity


@pytest.mark.parametrize(("near", "far"), [(1.0, 6.0), (5.0, 50.0), (2.0, 2.1)])
def test_uniform_depths_have_the_moments_of_quadrature(near, far):
    depth = InverseDepth.from_depths(near, far)
    first, second = (
        integrate.quad(lambda z, k=k: z**-k / (far - near), near, far)[0] for k in (1, 2)
    )
    np.testing.assert_allclose(depth.mean, first, rtol=1e-9)
    np.testing.assert_allclose(depth.sigma, np.sqrt(second - first**2), rtol=1e-6)


@pytest.mark.parametrize("depths", [(0.0, 1.0), (2.0, 2.0), (3.0, 1.0), (1.0, np.inf), (1, np.nan)])
def test_depths_are_between_two_positive_ones(depths):
    with pytest.raises(ValueError, match="between 0 < near < far < ∞, not"):
        InverseDepth.from_depths(*depths)


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_the_long_scenarios_are_told_their_depths_or_not(geometry):
    end = "" if geometry.name == "planar" else "-6dof"
    told, thrown, change = (
        jaxslam.scenario(f"laps-{name}{end}") for name in ("prior", "thrown", "change")
    )
    right = InverseDepth.from_depths(*told.depth_range)
    for world in (told, change):
        np.testing.assert_allclose(world.inverse_depth, (right.mean, right.sigma), rtol=1e-12)
    assert right.mean > thrown.depth.mean + 2 * thrown.depth.sigma
    assert thrown.depth_range == told.depth_range == change.depth_range[:2]


@pytest.mark.parametrize("name", ["scale_gauge+scene50", "world+scene50"])
def test_a_common_error_that_walks_forgets_as_much_in_every_frame(name):
    """Of a filter that sees nothing; and it is the same one where it does not walk."""
    of = Case("matched", steps=3, landmarks=2)
    first, known, new = of.frames(0)
    seen = jax.tree.map(lambda x: x[0], known)
    none = [
        replace(x, valid=np.zeros_like(x.valid)) for x in (seen, jax.tree.map(lambda x: x[0], new))
    ]
    still = of.filter(name)

    def variances(walk):
        slam = replace(still, depth=replace(still.depth, walk=walk))
        place = slam.init(of.capacity).core.part("depth_error").start

        def run(first, control):
            state, found = slam.init(of.capacity, first), []
            for _ in range(3):
                state, _ = slam.step(state, control, *none)
                found.append(state.covariance[place, place])
            return found

        return np.array(quick_jit(run)(first, of.controls()[0]))

    start = variances(None)
    np.testing.assert_allclose(variances(0.3), start + 0.3**2 * np.arange(1, 4), rtol=1e-9)
    np.testing.assert_allclose(start, start[0], rtol=1e-9)


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


@pytest.mark.parametrize("geometry", each_geometry, ids=named)
def test_no_unit_of_length_is_in_a_walk(geometry):
    """All lengths enlarged, it stays what it is: a share of the σ of a prior."""
    of = Case("matched" if geometry.name == "planar" else "matched-6dof", steps=2, landmarks=2)
    slam = of.filter("scale_gauge+oc+scene50+walk3")
    state = slam.init(of.capacity)
    noise = jnp.arange(1.0, state.core.noise.size + 1)
    core = replace(state.core, noise=noise)
    still = identity(slam.motion.geometry, noise.dtype)
    larger, _ = act(slam.model, still, jnp.asarray(2.0), core, state.landmarks)
    n = slam.motion.geometry.point_dim
    np.testing.assert_array_equal(larger.noise[:n], 2 * noise[:n])
    np.testing.assert_array_equal(larger.noise[n:], noise[n:])


def test_a_walk_is_of_a_common_error():
    with pytest.raises(ValueError, match="give its σ, common, too"):
        InverseDepth(0.2, 0.1, walk=0.1)
