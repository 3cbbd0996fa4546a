"""Monte Carlo: many simulated runs of many filters on the same worlds, batched by `vmap`.

Run i draws from `fold_in(key(seed), i)`, so that it is the same in every chunk, for every filter,
and whatever the number of runs. Memory is bounded by the chunk: each chunk's records go to a
`Store`, and the summary reads them back chunk by chunk.
"""

from __future__ import annotations

import logging
import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from functools import partial
from numbers import Integral
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxslam._numerics.arrays import cast
from jaxslam._runtime.lookup import lookup
from jaxslam._runtime.progress import StudyBar
from jaxslam._runtime.watchdog import finished
from jaxslam.consistency.backends import AUTO, BACKENDS, BatchProgram, check_backend, chosen
from jaxslam.consistency.cluster import connected, on_cluster
from jaxslam.consistency.manifest import described, unseen
from jaxslam.consistency.results import Seconds
from jaxslam.consistency.simulator import MapChunks, Simulator
from jaxslam.consistency.store import NATIVE, MemoryStore, Records, Store
from jaxslam.consistency.summary import Study, divided, treatment
from jaxslam.consistency.sums import as_sums, keeps_records
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.words import make_filters
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import RecordedMotion, Room, Run, Scenario, as_scenario

DTYPES = ("float64", "float32")
CHUNK = 100
"""The most runs that are drawn, handed out and kept together where no chunk is given."""
LEAST_CHUNK = 12
"""The fewest of them: a batch of fewer runs costs twice as much a run, or more."""
CHUNKS = 4
"""The chunks of every processor, down to `LEAST_CHUNK` runs: the time left is known from the first,
and processors end at about the same time."""
CHUNK_SECONDS = 20.0
"""The longest that a chunk should take, down to `LEAST_CHUNK` runs, so that a bar moves."""
MOST_RUNS = 10**8
"""The most runs of a study."""
Result = TypeVar("Result")


def monte_carlo(
    scenario: Scenario | str,
    filters: Mapping[str, AbstractFilter] | str | Iterable[str],
    *,
    runs: int = 1000,
    seed: int = 0,
    dtype: str = "float64",
    chunk: int | None = None,
    backend: str = AUTO,
    store: Store | None = None,
    progress: Callable[[str, int], None] | bool = False,
    motion: AbstractMotion | RecordedMotion | None = None,
    sensor: AbstractSensor | None = None,
    cluster: Any = None,
    reduced: bool = False,
) -> Study:
    """Run every filter on the same simulated runs.

    The runs are the scenario's, which may be given by name. With a `motion` (or a `RecordedMotion`)
    or a `sensor` of your own the truth moves, or is measured, as that says, in the scenario's
    world. Filters are given by name, as `make_filters` returns them; a list of words makes those of
    the scenario, as `robocentric`, which has Inverse Scaling, or `robocentric/inverse_depth`. One
    filter has one set of numbers; several that differ in numbers alone share a program.

    With `progress=True` a bar shows how far it is. Or `progress(filter name, finished runs)` is
    called after every chunk, and with no runs twice: before the filter is compiled and after it
    (not with a `cluster`). An `Interruption` is raised at once, and leaves in `store` the chunks
    that are finished. Chunks that `store` already has are not run again; it is given what decides
    them, and refuses what differs. A `chunk` is the runs that are computed and kept together: by
    default those of the store, or so many that every processor has several, at most `CHUNK`.

    With a `cluster`, the address of a Dask scheduler or a `distributed.Client`, the chunks are
    computed there and kept here; their seconds are of all together, compilation among them.

    With the `backend` "native" filters are compiled by the system's C++ compiler
    (`jaxslam.native`), to the same numbers but for rounding; if that is impossible, a warning says
    why, and XLA ("xla") computes them. "auto" takes it where that is worth it (`backends.chosen`),
    on a cluster never. A resumed study keeps its backend.

    A `reduced` study keeps of every chunk but the first only sums over its runs, made where the
    chunk is computed: all of a summary but the medians, which are then the first chunk's.

    Raises ValueError for sizes that make no sense, and for a store of another study.
    """
    check_sizes(runs, seed, dtype, CHUNK if chunk is None else chunk)
    check_backend(backend)
    scenario = as_scenario(scenario)
    filters = _as_filters(scenario, filters)
    kept_in, store = store, MemoryStore() if store is None else store
    with jax.enable_x64(dtype == "float64"), connected(cluster) as client:
        map_chunks = in_threads if client is None else partial(on_cluster, client)
        if chunk is None:
            seconds = [scenario.steps * _step_seconds(slam) for slam in filters.values()]
            chunk = _chunk(runs, store, client, max(seconds), reduced=reduced)
            if (total := runs * sum(seconds) / _workers(client)) > CHUNK_SECONDS * CHUNKS:
                _log.info("by a rule of thumb it takes %.0f min, within a factor of 3", total / 60)
        chunks = divided(runs, chunk)
        simulator = Simulator(scenario, seed, dtype, min(chunk, runs), motion, sensor)
        made_by = {**simulator.made_by, "chunk": int(chunk), "reduced": reduced}
        descriptions = {name: described(slam) for name, slam in filters.items()}
        store.begin(made_by, descriptions)
        if kept_in is not None and (hidden := unseen([made_by, descriptions])):
            warnings.warn(
                f"not seen: {', '.join(sorted(hidden))}; a study that is resumed does not notice "
                "when the code behind changes",
                stacklevel=2,
            )
        missing = {name: [c for c in chunks if not store.has(name, c)] for name in filters}
        kept = {name: _kept_by(name, chunks, store, backend) for name in filters}
        open_choice = AUTO if client is None else "xla"
        asked = {name: kept[name] or (open_choice if backend == AUTO else backend) for name in kept}
        left, total = sum(len(c) for x in missing.values() for c in x), runs * len(filters)
        seconds = {}
        told = (lambda name, runs: None) if isinstance(progress, bool) else progress
        bar = StudyBar(total, total - left) if progress is True else nullcontext(told)
        with bar as report:
            ahead = ThreadPoolExecutor(2)  # the next filter is compiled beside the one that runs
            try:
                room = simulator.room(chunks, map_chunks) if left else None
                tasks = [
                    ChunkTask(n, s, simulator, room, asked[n], reduced) for n, s in filters.items()
                ]
                settled = {
                    t.name: ahead.submit(t.settled, missing[t.name], kept[t.name]) for t in tasks
                }
                for name in filters:
                    seconds[name], asked[name] = _run_filter(
                        settled[name].result, missing[name], store, partial(report, name),
                        map_chunks,
                    )  # fmt: skip
            except KeyboardInterrupt:
                done = sum(len(c) for name in filters for c in chunks if store.has(name, c))
                raise Interruption(done, total, chunk, kept_in) from None
            finally:
                ahead.shutdown(wait=False, cancel_futures=True)
        device = jax.devices()[0].device_kind
    return Study(
        scenario, filters, runs, seed, dtype, chunks, store, seconds, device, reduced, asked,
        made_by, {name: treatment(slam) for name, slam in filters.items()},
    )  # fmt: skip


class Interruption(KeyboardInterrupt):
    """The interruption of a study; its text says what is kept, and what to do."""

    def __init__(self, kept: int, total: int, chunk: int, store: Store | None) -> None:
        super().__init__(kept, total, chunk, store)
        self.kept, self.total, self.chunk, self.store = kept, total, chunk, store

    def told(self, where: object, again: str, smaller: str) -> str:
        """Return what is kept `where`, and what to do: run `again`, or with `smaller` chunks."""
        if self.kept:
            return f"{self.kept} of {self.total} runs are kept in {where}; {again}"
        nothing = f"nothing of {self.total} is kept in {where}"
        if self.chunk == 1:
            return f"no run was finished, so that {nothing}"
        none = f"no chunk of {self.chunk} runs was finished, so that {nothing}"
        return f"{none}; with {smaller} the first runs are kept sooner"

    def __str__(self) -> str:
        if self.store is None:
            done = f"{self.kept} of {self.total} runs were finished"
            return f"{done}, and are not kept; with a FolderStore they would be"
        again = "the same study with this store goes on from there"
        where = getattr(self.store, "folder", "the store")
        return self.told(where, again, f"a chunk smaller than {self.chunk}")


def _as_filters(scenario: Scenario, filters: Any) -> Mapping[str, AbstractFilter]:
    """The filters by name, made of words where these are given. Raises ValueError."""
    if isinstance(filters, str) and filters:
        filters = [filters]
    if isinstance(filters, Iterable) and not isinstance(filters, Mapping):
        filters = list(filters)
        if filters and all(isinstance(word, str) for word in filters):
            return make_filters(scenario, filters)
    if not filters or not isinstance(filters, Mapping):
        raise ValueError(
            "no filters by name: a dict is accepted, as make_filters gives it, or a list of words "
            "as ['robocentric', 'recommended']"
        )
    if wrong := [name for name in filters if not isinstance(name, str) or not name]:
        raise ValueError(f"the name of a filter is a word, not {wrong[0]!r}")
    if wrong := [n for n, slam in filters.items() if not isinstance(slam, AbstractFilter)]:
        given = filters[wrong[0]]
        kind = f"the class {given.__name__}" if isinstance(given, type) else type(given).__name__
        raise ValueError(f"{wrong[0]} is no AbstractFilter but {kind}; an instance is accepted")
    return filters


def _step_seconds(slam: AbstractFilter) -> float:
    """About how long a step of a filter takes."""
    state = jax.eval_shape(lambda: slam.init(12))
    # So many seconds for each number of its state, by XLA on one processor: a rule of thumb, right
    # within a factor of 3 for the filters of the package.
    return 35e-9 * sum(x.size for x in jax.tree.leaves(state))


def _workers(client: Any) -> int:
    """The processors that compute, at least one."""
    return max(1, processors() if client is None else sum(client.nthreads().values()))


def _chunk(runs: int, store: Store, client: Any, seconds: float, *, reduced: bool = False) -> int:
    """The chunk of a store that has one; else halves of `CHUNK`, so that programs are shared.

    A run takes about so many seconds. Of a reduced study the medians are of the first chunk.
    """
    if kept := getattr(store, "manifest", {}).get("made_by", {}).get("chunk"):
        return kept
    if reduced or jax.default_backend() != "cpu":
        return CHUNK
    most = min(runs / (CHUNKS * _workers(client)), CHUNK_SECONDS / seconds)
    chunk = CHUNK
    while chunk > max(LEAST_CHUNK, most) and runs > LEAST_CHUNK:
        chunk //= 2
    return chunk


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
        with self.simulator.precision():
            batch, _ = self.simulator(chunk)
            where = f"{self.name}, runs {chunk.start} to {chunk.stop - 1}"
            found = self.program(batch)(np.int32(len(chunk)))
            records, sample = jax.device_get(finished(found, where))
        records = {key: np.asarray(value)[: len(chunk)] for key, value in records.items()}
        if keeps_records(chunk, self.reduced):
            records |= {f"sample_{k}": v for k, v in sample.items()}
        else:
            records = as_sums(records, batch.poses.tangent_dim)
        return {**records, NATIVE: np.array(self.backend == "native")}

    def settled(self, chunks: list[range], kept: str | None) -> ChunkTask:
        """Return the task with the backend that is to compute these chunks, beside some kept.

        Raises ValueError where that of the kept ones cannot.
        """
        if self.backend == "xla" or not chunks:
            return self
        with self.simulator.precision():
            batch, count = self.simulator(chunks[0])[0], sum(map(len, chunks))
            found = chosen(self.backend, self.name, count, *self._pieces(), batch)
        if kept not in (None, found):
            raise ValueError(f"cannot resume {self.name}, which the {kept} backend has begun")
        return self._replace(backend=found)

    def compile(self, chunk: range) -> None:
        """Compile the program for chunks of this size."""
        with self.simulator.precision():
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
    sizes = (("runs", runs), ("chunk", chunk), ("seed", seed))
    for name, value in sizes:
        if not isinstance(value, Integral):
            raise ValueError(f"{name} must be a whole number, not {value!r}")
    for name, value in sizes[:2]:
        if not 1 <= value <= MOST_RUNS:
            least = "at least 1" if value < 1 else f"at most {MOST_RUNS}"
            raise ValueError(f"{name} must be {least}, not {value}")
    if not 0 <= seed < 2**63:
        bound = "not be negative" if seed < 0 else "be below 2⁶³"
        raise ValueError(f"seed must {bound}, not {seed}")
    lookup("dtype", [dtype], dict.fromkeys(DTYPES))


_log = logging.getLogger(__name__)
