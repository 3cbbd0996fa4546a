"""The backends for a batch of runs: XLA, or a C++ program generated from the same functions."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable
from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr
from jaxtyping import Array, Int, PyTree

from jaxslam._numerics.arrays import is_number
from jaxslam._runtime.programs import BATCHED, Exact, Program
from jaxslam._runtime.watchdog import lapack_calls
from jaxslam.consistency.runs import filter_run, map_and_path
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import Room, Run

CACHE = 3 * 2**19
"""The bytes of covariances that a processor works on: about what its second cache holds."""

Records = dict[str, Array]
BatchProgram = Callable[[np.integer], tuple[Records, Records]]
"""Computes the records of so many first runs of a batch, and the map and the path of its first."""


def by_xla(slam: AbstractFilter, room: Room, sensor: AbstractSensor, runs: Run) -> BatchProgram:
    """Return XLA's program for a filter on a batch of runs."""
    _filter_batch.compile(slam, room, sensor, runs, np.int32(0))
    return partial(_filter_batch, slam, room, sensor, runs)


def _warn_of_lapack(jaxpr: Jaxpr, args: tuple[PyTree, ...]) -> None:
    if calls := lapack_calls(jaxpr):
        warnings.warn(
            f"{type(args[0]).__name__} calls LAPACK in a batch ({', '.join(sorted(calls))}), "
            "which can stand still on few processors: jaxslam._numerics.linalg has what does not",
            stacklevel=2,
        )


@partial(Program, options=BATCHED, seen=_warn_of_lapack)
def _filter_batch(
    slam: AbstractFilter,
    room: Room,
    sensor: AbstractSensor,
    runs: Run,
    wanted: Int[Array, ""],
) -> tuple[Records, Records]:
    """Compute a batch in parts that fit the cache.

    Of the last chunk only the first runs are `wanted`: a part without any is not computed.
    """

    def part(runs):
        records, path, state = jax.vmap(partial(filter_run, slam, room, sensor))(runs)
        first = partial(jax.tree.map, lambda x: x[0])
        return records, map_and_path(slam, room, first(path), first(state), first(runs))

    count = len(runs.visible)
    parts = math.ceil(count / _runs_in_cache(room, runs))
    if parts == 1:
        return part(runs)
    size = math.ceil(count / parts)
    again = jnp.arange(parts * size) % count
    in_parts = jax.tree.map(lambda x: x[again].reshape(parts, size, *x.shape[1:]), runs)
    traced_once = jax.jit(part)
    shapes = jax.eval_shape(traced_once, jax.tree.map(lambda x: x[0], in_parts))

    def part_if_wanted(given):
        first, runs = given
        nothing = jax.tree.map(jnp.zeros_like, shapes)
        return jax.lax.cond(first < wanted, traced_once, lambda _: nothing, runs)

    records, samples = jax.lax.map(part_if_wanted, (size * jnp.arange(parts), in_parts))
    records = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], records)
    return records, jax.tree.map(lambda x: x[0], samples)


def _runs_in_cache(room: Room, runs: Run) -> int:
    """The number of runs whose covariances fit a processor's cache; all where there is none."""
    if jax.default_backend() != "cpu":
        return len(runs.visible)
    n = 2 * runs.poses.tangent_dim + room.landmarks * (runs.points.shape[-1] + 1)
    return max(1, CACHE // (n * n * runs.points.dtype.itemsize))


def by_native(slam: AbstractFilter, room: Room, sensor: AbstractSensor, runs: Run) -> BatchProgram:
    """Return the C++ program for a filter on a batch of runs; with a warning XLA's if none."""
    numbers, structure = eqx.partition(slam, is_number)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (numbers, sensor, runs))
    with _compiling:  # two threads that ask for one program wait for it
        program = _native_program(Exact((*_hashable(structure), room, *_hashable(shapes))))
    if program is None:
        return by_xla(slam, room, sensor, runs)
    return partial(program, numbers, sensor, runs)


_compiling = threading.Lock()


def _hashable(tree: PyTree) -> tuple[tuple[PyTree, ...], jax.tree_util.PyTreeDef]:
    leaves, structure = jax.tree.flatten(tree)
    return tuple(leaves), structure


@lru_cache(maxsize=32)
def _native_program(key: Exact) -> Callable[..., tuple[Records, Records]] | None:
    """The program for a filter of this structure, whatever its numbers, and data of these shapes.

    None, with a warning, where the native backend cannot compile it.
    """
    from jaxslam.native import batched

    leaves, structure, room, shapes, of_data = key.value
    static = jax.tree.unflatten(structure, leaves)
    numbers, sensor, runs = jax.tree.unflatten(of_data, shapes)

    def one(shared, run):
        numbers, sensor = shared
        slam = eqx.combine(numbers, static)
        records, path, state = filter_run(slam, room, sensor, run)
        return records, map_and_path(slam, room, path, state, run)

    try:
        batch = batched(one, (numbers, sensor), runs)
    except ValueError as error:
        warnings.warn(f"{error}; {type(static).__name__} is computed by XLA", stacklevel=2)
        return None

    def computed(numbers, sensor, runs, wanted):
        records, samples = batch((numbers, sensor), jax.tree.map(lambda x: x[:wanted], runs))
        return records, {name: x[0] for name, x in samples.items()}

    return computed


BACKENDS: dict[str, Callable[[AbstractFilter, Room, AbstractSensor, Run], BatchProgram]] = {
    "xla": by_xla,
    "native": by_native,
}
"""The functions that compile a filter for a batch of runs."""


def check_backend(backend: str) -> None:
    """Raise ValueError for a backend that is not known."""
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}; known: {', '.join(BACKENDS)}")
