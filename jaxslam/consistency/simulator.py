"""The simulated runs, chunk by chunk: run i is the same in any chunk, batch and number of runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxslam._numerics.arrays import cast
from jaxslam._runtime.programs import BATCHED, Program
from jaxslam.consistency.manifest import LAYOUT, Manifest, described, versions
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import (
    RecordedMotion,
    Room,
    Run,
    World,
    as_data,
    sightings,
    simulate,
    trajectory_of,
    with_own,
)

MapChunks = Callable[[Callable[[range], Any], list[range]], Iterator[tuple[range, Any]]]
"""A function that applies another to chunks, and yields each with its result when finished."""
DRAWN = 2**27
"""Bytes of runs that are kept, as every filter is given the same."""


class Simulator:
    """A source of chunks of runs, all of one shape, so that everything compiles once.

    Run i draws from `fold_in(key(seed), i)`. Raises ValueError for a scenario without a motion.
    """

    def __init__(
        self,
        scenario: World,
        seed: int,
        dtype: str,
        size: int,
        motion: AbstractMotion | RecordedMotion | None = None,
        sensor: AbstractSensor | None = None,
    ) -> None:
        world = with_own(scenario, motion, sensor)
        world = replace(world, trajectory=trajectory_of(world))
        self._given = world, seed, dtype, size
        self.dtype, self.size = jnp.dtype(dtype), size
        self.sensor = cast(world.sensor, dtype)
        self._world, self._key = as_data(world, dtype), jax.random.key(seed)
        self._drawn: dict[int, tuple[Run, Room]] = {}

    @property
    def made_by(self) -> Manifest:
        """The manifest of the runs that are drawn, the layout of records, and the versions."""
        world, seed, dtype, _ = self._given
        return {
            "layout": LAYOUT,
            "version": versions(),
            "scenario": described(world),
            "seed": int(seed),
            "dtype": dtype,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle for another machine, which has no file of a trajectory, and makes its own key."""
        return Simulator, self._given

    def __call__(self, chunk: range) -> tuple[Run, Room]:
        """Return the chunk's runs, padded to `size` by the runs that follow."""
        drawn = self._drawn.get(chunk.start)
        if drawn is None:
            drawn = _draw(self._world, self._key, chunk.start + jnp.arange(self.size))
            size = sum(x.nbytes for x in jax.tree.leaves(drawn))
            if size * (1 + len(self._drawn)) < DRAWN:
                self._drawn[chunk.start] = drawn
        return drawn

    def max_sightings(self, chunk: range) -> Room:
        """Return the most that any of the chunk's runs sees."""
        with self.precision():
            return jax.tree.map(np.max, jax.device_get(self(chunk)[1]))

    def precision(self) -> AbstractContextManager[None]:
        """Return a context in which JAX has the precision of the runs, which is a thread's own."""
        return jax.enable_x64(self.dtype == "float64")

    def room(self, chunks: tuple[range, ...], map_chunks: MapChunks) -> Room:
        """Return the room that holds every run of the study.

        No frame has more features than a run has slots.
        """
        seen = [most for _, most in map_chunks(self.max_sightings, list(chunks))]
        most = jax.tree.map(lambda *counts: _rounded_up(int(max(counts))), *seen)
        slots = self(chunks[0])[0].visible.shape[-1]
        return Room(most.landmarks, *(min(n, slots) for n in (most.first, most.known, most.new)))


def _rounded_up(count: int) -> int:
    """Round up to one at least, above four to a multiple of four: seeds then share a program."""
    return max(1, count) if count <= 4 else 4 * math.ceil(count / 4)


@partial(Program, options=BATCHED)
def _draw(world: World, key: Array, indices: Int[Array, " runs"]) -> tuple[Run, Room]:
    def one(index):
        run = simulate(world, jax.random.fold_in(key, index))
        return run, sightings(run)

    return jax.vmap(one)(indices)
