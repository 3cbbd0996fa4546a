"""The backends for a batch of runs: XLA, or a C++ program generated from the same functions."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr
from jaxtyping import Array, Int, PyTree

from jaxslam._runtime.files import one_line
from jaxslam._runtime.lookup import lookup
from jaxslam._runtime.programs import (
    BATCHED,
    QUICK,
    Program,
    in_background,
    keep,
    place_of,
    read,
)
from jaxslam._runtime.watchdog import finished, lapack_calls
from jaxslam.consistency.runs import filter_run, map_and_path
from jaxslam.filters.layer import AbstractSlam
from jaxslam.filters.mixture.mixture import Mixture
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import Room, Run
from jaxslam.statistics.bands import lost_threshold

AUTO = "auto"
"""The backend of a study for which none is asked: `chosen` says which it is."""
WORTH = 100_000
"""The steps of all runs of a filter from which on the native backend pays for its compilation."""
WORTH_OF_SUMS = 400_000
"""The same of a Gaussian sum in a plane; in space it takes minutes to build."""
LARGEST = 200
"""The numbers of a state up to which it is faster; its program grows with them."""
FIRST_RUNS = 8
"""The runs that XLA computes too before it is believed; two, where all are not 64 times as many."""
AGREEMENT = {"float64": 1e-6, "float32": 3e-2}
"""The most by which the backends may differ, as a share of a record's largest value."""
CACHE = 3 * 2**19
"""The bytes of covariances that a processor works on: about what its second cache holds."""

Records = dict[str, Array]
BatchProgram = Callable[[np.integer], tuple[Records, Records]]
Backend = Callable[[AbstractFilter, Room, AbstractSensor, Run], BatchProgram]
"""Computes the records of so many first runs of a batch, and the map and the path of its first."""


def by_xla(slam: AbstractFilter, room: Room, sensor: AbstractSensor, runs: Run) -> BatchProgram:
    """Return XLA's program for a filter on a batch of runs."""
    _filter_batch.compile(slam, room, sensor, runs, np.int32(0))
    return partial(_filter_batch, slam, room, sensor, runs)


def _warn_of_lapack(jaxpr: Jaxpr, args: tuple[PyTree, ...]) -> None:
    if calls := lapack_calls(jaxpr):
        warnings.warn(
            f"{type(args[0]).__name__} calls LAPACK in a batch ({', '.join(sorted(calls))}), "
            "which can stand still on few processors: jaxslam.linalg has what does not",
            stacklevel=2,
        )


@partial(Program, options=BATCHED, seen=_warn_of_lapack)
def _filter_batch(
    slam: AbstractFilter, room: Room, sensor: AbstractSensor, runs: Run, wanted: Int[Array, ""]
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
    return max(1, CACHE // (_numbers(room, runs) ** 2 * runs.points.dtype.itemsize))


def _numbers(room: Room, runs: Run) -> int:
    """About how many a filter's state has."""
    return 2 * runs.poses.tangent_dim + room.landmarks * (runs.points.shape[-1] + 1)


def by_native(slam: AbstractFilter, room: Room, sensor: AbstractSensor, runs: Run) -> BatchProgram:
    """Return the C++ program for a filter on a batch of runs.

    Raises ValueError, which says why, where there is none.
    """
    program = native_programs()(room, (slam, sensor), runs)

    def computed(wanted):
        records, samples = program(wanted)
        return records, {name: x[0].copy() for name, x in samples.items()}

    return computed


@cache
def native_programs() -> Any:
    """The `NativePrograms` of this process: without any, the compiler is not imported."""
    from jaxslam.native import NativePrograms

    return NativePrograms(_records_and_map)


def _records_and_map(room, given, run):
    slam, sensor = given
    records, path, state = filter_run(slam, room, sensor, run)
    return records, map_and_path(slam, room, path, state, run)


@partial(Program, options=QUICK)
def _first_runs(slam: AbstractFilter, room: Room, sensor: AbstractSensor, runs: Run) -> Records:
    return jax.vmap(lambda run: native_programs().one(room, (slam, sensor), run)[0])(runs)


BACKENDS: dict[str, Backend] = {"xla": by_xla, "native": by_native}
"""The functions that compile a filter for a batch of runs."""


def check_backend(backend: str) -> None:
    """Raise ValueError for a backend that is not known."""
    lookup("backend", [backend], dict.fromkeys((*BACKENDS, AUTO)))


def chosen(
    backend: str, name: str, count: int, slam: AbstractFilter, room: Room, sensor: AbstractSensor,
    runs: Run,
) -> str:  # fmt: skip
    """Return the backend that computes so many runs of a filter, of which these are the first.

    `AUTO` is the native backend on a CPU with a C++ compiler for a `Slam` of one Gaussian, or a
    sum in a plane, whose state is at most `LARGEST`, if there are `WORTH` steps or its program
    exists; else XLA.
    Where there can be no native program, or its records of the first runs are not XLA's, it is XLA
    too, with a warning unless the choice was open.
    """
    from jaxslam.native import compiler, difference

    able = backend != "xla" and jax.default_backend() == "cpu" and compiler() is not None
    there = able and native_programs().is_there(room, (slam, sensor), runs)
    small = isinstance(slam, AbstractSlam) and _numbers(room, runs) <= LARGEST
    of_sum = small and isinstance(slam.layer, Mixture) and runs.poses.tangent_dim == 3
    faster = small and (of_sum or not slam.layered)
    long = count * (runs.visible.shape[1] - 1) >= (WORTH_OF_SUMS if of_sum else WORTH)
    if backend == "xla" or (backend == AUTO and not (able and faster and (there or long))):
        return "xla"
    few = min(len(runs.visible), FIRST_RUNS if count >= 64 * FIRST_RUNS else 2)
    first = jax.tree.map(lambda x: np.asarray(x)[:few], runs)
    place = place_of("records", (slam, room, sensor, first))
    wanted = read(*place, lambda records: records) if place else None
    if able and not there and wanted is None:
        in_background(partial(_first_runs.compile, slam, room, sensor, first))
    try:
        found, _ = by_native(slam, room, sensor, first)(np.int32(few))
    except ValueError as error:
        if backend != AUTO:
            warnings.warn(f"{one_line(error)}; {name} is computed by XLA", stacklevel=2)
        return "xla"
    if wanted is None:
        wanted = finished(_first_runs(slam, room, sensor, first), f"{name}, by XLA")
        wanted = jax.device_get(wanted)
        if place:  # a study that is run again needs no program of XLA's
            keep(place[0], lambda: (wanted,))
    lost = ~(wanted["nees"] <= lost_threshold(runs.poses.tangent_dim, wanted["nees"].shape[1]))
    sane = ~np.logical_or.accumulate(lost, axis=1)  # what is lost magnifies rounding
    if told := difference(found, wanted, sane, AGREEMENT[wanted["nees"].dtype.name]):
        told = f"{told} in the program in C++: please report this, with the command"
        warnings.warn(f"{name} is computed by XLA, since {told}", stacklevel=2)
        return "xla"
    if backend == AUTO:
        _log.info("%s is computed by a program in C++ (--backend xla: by XLA)", name)
    return "native"


_log = logging.getLogger(__name__)
