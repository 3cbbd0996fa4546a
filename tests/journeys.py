"""What a filter computes in this process, or in another one to which it was sent."""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import numpy as np
from cases import Case, quick_options

from jaxslam.models.observations import Capacity

FEW = {"steps": 3, "landmarks": 5}
WORLDS = {"matched": FEW, "standstill": FEW, "laps": {**FEW, "landmarks": 12, "in_view": 4}}
"""Scenarios of few steps, so that compiling is nearly all that a filter takes."""


@cache
def case(world, runs):
    return Case(world, runs=runs, **WORLDS[world])


OPTIONS: Any = {"compiler_options": quick_options()}
"""Of `jax.jit`, to which they are handed on."""


@eqx.filter_jit(**OPTIONS)
def _run(slam, room, first, known, new, controls):
    def of_one(first, known, new, controls):
        def step(state, frame):
            return slam.step(state, *frame)

        return jax.lax.scan(step, slam.init(room, first), (controls, known, new))

    return jax.vmap(of_one)(first, known, new, controls)


def ends(world, slam, runs):
    """The leaves of the last state of every run, and of the innovations of all steps."""
    of = case(world, len(runs))
    room = Capacity(of.room.landmarks, of.room.known, of.room.new)
    found = _run(slam, room, *of.features, of.runs.controls)
    return [np.asarray(leaf) for leaf in jax.tree.leaves(found)]
