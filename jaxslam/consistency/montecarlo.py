"""Monte Carlo: many simulated runs of many filters on the same worlds, batched by `vmap`.

Run i draws from `fold_in(key(seed), i)`, so that it is the same in every chunk, for every filter,
and whatever the number of runs. Memory is bounded by the chunk: each chunk's records go to a
`Store`, and the summary reads them back chunk by chunk.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from numbers import Integral
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxslam._numerics.arrays import cast
from jaxslam._runtime.watchdog import finished
from jaxslam.consistency.backends import AUTO, BACKENDS, BatchProgram, check_backend, chosen
from jaxslam.consistency.cluster import connected, on_cluster
from jaxslam.consistency.manifest import described
from jaxslam.consistency.simulator import MapChunks, Simulator
from jaxslam.consistency.store import NATIVE, MemoryStore, Records, Store
from jaxslam.consistency.summary import Seconds, Study
from jaxslam.consistency.sums import as_sums, keeps_records
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import RecordedMotion, Room, Run, Scenario, as_scenario

DTYPES = ("float64", "float32")
CHUNK = 100
"""The runs that are drawn, handed out and kept together."""
MOST_RUNS = 10**8
"""The most runs of a study."""
Result = TypeVar("Result")


def monte_carlo(
    scenario: Scenario | str,
    filters: Mapping[str, AbstractFilter],
    *,
    runs: int = 1000,
    seed: int = 0,
    dtype: str = "float64",
    chunk: int = CHUNK,
    backend: str = AUTO,
    store: Store | None = None,
    progress: Callable[[str, int], None] = lambda name, done: None,
    motion: AbstractMotion | RecordedMotion | None = None,
    sensor: AbstractSensor | None = None,
    cluster: Any = None,
    reduced: bool = False,
) -> Study:
    """Run every filter on the same simulated runs.

    The runs are the scenario's, which may be given by name; with a `motion` (or a `RecordedMotion`)
    or a `sensor` of one's own the truth moves, or is measured, as that says, in the scenario's
    world.

    `progress(filter name, finished runs)` is called after every chunk, and with no runs twice: when
    the filter is to be compiled, and when it is (not with a `cluster`). An interruption is raised
    at once, and leaves in `store` the chunks that are finished. Chunks that `store` already has are
    not run again; it is given what decides them, and refuses what differs.

    With a `cluster`, the address of a Dask scheduler or a `distributed.Client`, the chunks are
    computed there and kept here; their seconds are of all together, compilation among them.

    With the `backend` "native" filters are compiled by the system's C++ compiler
    (`jaxslam.native`), to the same numbers but for rounding; where that cannot be, a warning says
    why, and XLA ("xla") computes them. "auto" takes it where that is worth it (`backends.chosen`),
    on a cluster never. A resumed study keeps its backend.

    A `reduced` study keeps of every chunk but the first only sums over its runs, made where the
    chunk is computed: all of a summary but the medians, which are then the first chunk's.

    Raises ValueError for sizes that make no sense, and for a store of another study.
    """
    if not filters or not isinstance(filters, Mapping):
        raise ValueError("no filters by name: a dict is accepted, as make_filters gives it")
    check_sizes(runs, seed, dtype, chunk)
    check_backend(backend)
    scenario = as_scenario(scenario)
    store = MemoryStore() if store is None else store
    chunks = divided(runs, chunk)
    seconds = {}
    with jax.enable_x64(dtype == "float64"), connected(cluster) as client:
        map_chunks = in_threads if client is None else partial(on_cluster, client)
        simulator = Simulator(scenario, seed, dtype, min(chunk, runs), motion, sensor)
        made_by = {**simulator.made_by, "chunk": int(chunk), "reduced": reduced}
        store.begin(made_by, {name: described(slam) for name, slam in filters.items()})
        missing = {name: [c for c in chunks if not store.has(name, c)] for name in filters}
        kept = {name: _kept_by(name, chunks, store, backend) for name in filters}
        room = simulator.room(chunks, map_chunks) if any(missing.values()) else None
        open_choice = AUTO if client is None else "xla"
        ahead = ThreadPoolExecutor(2)  # the next filter is compiled beside the one that runs
        asked = {name: kept[name] or (open_choice if backend == AUTO else backend) for name in kept}
        tasks = [ChunkTask(n, filters[n], simulator, room, asked[n], reduced) for n in filters]
        settled = {t.name: ahead.submit(t.settled, missing[t.name], kept[t.name]) for t in tasks}
        try:
            for name in filters:
                seconds[name], asked[name] = _run_filter(
                    settled[name].result, missing[name], store, partial(progress, name), map_chunks
                )
        finally:
            ahead.shutdown(wait=False, cancel_futures=True)
        device = jax.devices()[0].device_kind
    return Study(
        scenario, filters, runs, seed, dtype, chunks, store, seconds, device, reduced, asked
    )


def divided(runs: int, chunk: int) -> tuple[range, ...]:
    """Divide so many runs into chunks."""
    return tuple(range(i, min(i + chunk, runs)) for i in range(0, runs, chunk))


def draw(
    scenario: Scenario, runs: int, *, seed: int = 0, dtype: str = "float64"
) -> tuple[Room, Run]:
    """Return the room that the first runs of a study need, and these runs, a batch.

    Raises ValueError for sizes that make no sense.
    """
    check_sizes(runs, seed, dtype, runs)
    with jax.enable_x64(dtype == "float64"):
        simulator = Simulator(scenario, seed, dtype, runs)
        batch, _ = simulator(range(runs))
        return simulator.room((range(runs),), in_threads), batch


class ChunkTask(NamedTuple):
    """A task that computes a chunk of a filter's records, here or on another machine."""

    name: str
    slam: AbstractFilter
    simulator: Simulator
    room: Room | None
    backend: str = "xla"
    reduced: bool = False

    def __call__(self, chunk: range) -> Records:
        with jax.enable_x64(self.simulator.dtype == "float64"):  # a thread's own
            batch, _ = self.simulator(chunk)
            where = f"{self.name}, runs {chunk.start} to {chunk.stop - 1}"
            found = self.program(batch)(np.int32(len(chunk)))
            records, sample = jax.device_get(finished(found, where))
        records = {key: np.asarray(value)[: len(chunk)] for key, value in records.items()}
        label = {NATIVE: np.array(self.backend == "native")}
        if keeps_records(chunk, self.reduced):
            return {**records, **{f"sample_{k}": v for k, v in sample.items()}, **label}
        return {**as_sums(records, batch.poses.tangent_dim), **label}

    def settled(self, chunks: list[range], kept: str | None) -> ChunkTask:
        """Return the task with the backend that is to compute these chunks, beside some kept.

        Raises ValueError where that of the kept ones cannot.
        """
        if self.backend == "xla" or not chunks:
            return self
        with jax.enable_x64(self.simulator.dtype == "float64"):  # a thread's own
            batch, count = self.simulator(chunks[0])[0], sum(map(len, chunks))
            found = chosen(self.backend, self.name, count, *self._pieces(), batch)
        if kept not in (None, found):
            raise ValueError(f"cannot resume {self.name}, which the {kept} backend has begun")
        return self._replace(backend=found)

    def compile(self, chunk: range) -> None:
        """Compile the program for chunks of this size."""
        with jax.enable_x64(self.simulator.dtype == "float64"):
            self.program(self.simulator(chunk)[0])

    def program(self, batch: Run) -> BatchProgram:
        """Return the program, compiled by the first thread that asks."""
        return BACKENDS[self.backend](*self._pieces(), batch)

    def _pieces(self) -> tuple[AbstractFilter, Room, AbstractSensor]:
        assert self.room is not None, "a chunk is computed after the room for it is known"
        return cast(self.slam, self.simulator.dtype), self.room, self.simulator.sensor


def _kept_by(name: str, chunks: tuple[range, ...], store: Store, backend: str) -> str | None:
    """The backend of the records that a store has; ValueError where another is asked for."""
    for chunk in chunks:
        if store.has(name, chunk):
            kept = "native" if store.load(name, chunk, [NATIVE])[NATIVE] else "xla"
            if backend in (AUTO, kept):
                return kept
            raise ValueError(
                f"cannot resume: {name} was made with another backend ({kept!r}, now {backend!r}); "
                "leave the backend out, or use another store"
            )
    return None


def _run_filter(
    settled: Callable[[], ChunkTask],
    chunks: list[range],
    store: Store,
    progress: Callable[[int], None],
    map_chunks: MapChunks,
) -> tuple[Seconds, str]:
    if not chunks:
        return Seconds(0.0, 0.0), settled().backend
    progress(0)
    start = time.perf_counter()
    task = settled()
    if map_chunks is in_threads:
        list(in_threads(task.compile, chunks[:1]))  # aside: XLA's compiler hears no interruption
        progress(0)
    compiled_at = time.perf_counter()
    for chunk, records in map_chunks(task, chunks):
        store.save(task.name, chunk, records)
        progress(len(chunk))
    return Seconds(compiled_at - start, time.perf_counter() - compiled_at), task.backend


def in_threads(
    function: Callable[[range], Result], chunks: list[range]
) -> Iterator[tuple[range, Result]]:
    """Yield chunks, as they are finished, with the function's results.

    On a CPU one runs in each processor: a program's matrices are too small to be divided. What has
    not started is dropped on an error, and what has is not waited for.
    """
    alone = jax.default_backend() != "cpu" or len(chunks) == 1
    pool = ThreadPoolExecutor(1 if alone else processors())
    try:
        waiting = {pool.submit(function, chunk): chunk for chunk in chunks}
        for future in as_completed(waiting):
            yield waiting.pop(future), future.result()  # what was yielded is not kept
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def processors() -> int:
    """The number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not everywhere
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_sizes(runs: Any, seed: Any, dtype: str, chunk: Any) -> None:
    """Raise ValueError for sizes that are no whole numbers or make no sense."""
    for name, value in (("runs", runs), ("chunk", chunk), ("seed", seed)):
        if not isinstance(value, Integral):
            raise ValueError(f"{name} must be a whole number, not {value!r}")
    for name, value in (("runs", runs), ("chunk", chunk)):
        if not 1 <= value <= MOST_RUNS:
            least = "at least 1" if value < 1 else f"at most {MOST_RUNS}"
            raise ValueError(f"{name} must be {least}, not {value}")
    if not 0 <= seed < 2**63:
        bound = "not be negative" if seed < 0 else "be below 2⁶³"
        raise ValueError(f"seed must {bound}, not {seed}")
    if dtype not in DTYPES:
        raise ValueError(f"unknown dtype {dtype!r}; known: {', '.join(DTYPES)}")
