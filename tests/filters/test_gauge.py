"""Tests of jaxslam.filters.remedies.gauge: the motion takes N to N, in any unit of length."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from cases import crossed, quick_jit

import jaxslam
from jaxslam.filters.linear.blocks import composition
from jaxslam.filters.model import Context
from jaxslam.filters.remedies.gauge import unobservable_directions
from jaxslam.filters.words import make_filter, scenario_pieces
from jaxslam.geometry import exp, jacobian

MATCHED = jaxslam.scenario("matched-loose", landmarks=3)


@crossed(
    ("name", "log_scale"),
    ["scale_gauge", "world_gauge", "scale_gauge+submaps"],
    [0.0, 0.3],
    quick=[("scale_gauge", 0.3), ("world_gauge", 0.0), ("scale_gauge+submaps", 0.3)],
)
def test_a_motion_takes_unobservable_directions_to_those_after_it(name, log_scale):
    """`Φ N_k = N_{k+1}`, whatever the filter's unit of length is (noise is not enlarged here)."""
    made: Any = make_filter(name, **scenario_pieces(MATCHED))
    slam = made.one
    pixels = jnp.array([[100.0], [300.0], [500.0]])
    first = jaxslam.Features(jnp.arange(3), pixels, jnp.ones(3, bool))
    control = jnp.asarray(1 / 30)

    def difference(log_scale):
        state, group = slam.init(3, first), slam.motion.geometry.group
        moved = exp(group, jnp.array([0.5, 0.7, 0.3]))
        core = replace(
            state.core,
            log_scale=log_scale[None],
            motion=state.core.motion + jnp.array([0.1, 0.3, 0.2]),
            pose=slam.frame.compose(state.core.pose, moved),
        )
        state = replace(state, core=core)
        change = composition(slam.model, state, Context(control))

        def after(both):
            core, landmarks = both
            if change.landmark is not None:
                one = jax.vmap(change.landmark, in_axes=(None, 0))
                landmarks = one(change.view(core), landmarks)
            return change.core(core), landmarks

        Phi = jacobian(after, (state.core, state.landmarks))
        core, landmarks = after((state.core, state.landmarks))
        later = replace(state, core=core, landmarks=landmarks)
        N, N_later = (unobservable_directions(slam.model, x) for x in (state, later))
        keep = np.setdiff1d(np.arange(len(N)), np.r_[core.part("noise")])
        return (Phi @ N - N_later)[keep]

    np.testing.assert_allclose(quick_jit(difference)(jnp.asarray(log_scale)), 0, atol=1e-12)
