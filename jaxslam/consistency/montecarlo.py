"""Monte Carlo: many simulated runs of many filters on the same worlds, batched by `vmap`.

Run i draws from `fold_in(key(seed), i)`, so that it is the same in every chunk, for every filter,
and whatever the number of runs. Memory is bounded by the chunk: each chunk's records go to a
`Store`, and the summary reads them back chunk by chunk.
"""

from __future__ import annotations

import math
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import lru_cache, partial
from numbers import Integral
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr
from jaxtyping import Array, Int

from jaxslam import native
from jaxslam._numerics.arrays import cast, is_number
from jaxslam._runtime.programs import BATCHED, Exact, Program
from jaxslam._runtime.watchdog import finished, lapack_calls
from jaxslam.consistency.cluster import as_tasks, connected
from jaxslam.consistency.manifest import LAYOUT, Manifest, described, versions
from jaxslam.consistency.recursion import Frame, run_through
from jaxslam.consistency.store import MemoryStore, Records, Store
from jaxslam.consistency.summary import Seconds, Study
from jaxslam.consistency.sums import as_sums, keeps_records
from jaxslam.filters.ekf import EkfSlam
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import (
    camera_pose,
    camera_pose_in_unit,
    landmarks_from_above,
    landmarks_in_camera,
)
from jaxslam.geometry import Pose, difference
from jaxslam.models.motion import AbstractMotion
from jaxslam.models.scale import Metre
from jaxslam.models.sensors import AbstractSensor
from jaxslam.simulation import (
    Room,
    Run,
    Scenario,
    Sightings,
    Trajectory,
    as_data,
    as_scenario,
    sensor_of,
    sightings,
    simulate,
    trajectory_of,
)
from jaxslam.statistics.bands import normalised_squared
from jaxslam.statistics.beyond_scale import SCALE, beyond_scale, reversal

DTYPES = ("float64", "float32")
BACKENDS = ("xla", "native")
"""XLA, or a program in C++ that is made from the same functions where there is a compiler."""
CHUNK = 100
"""Runs that are drawn, handed out and kept together."""
CACHE = 3 * 2**19
"""Bytes of covariances that a processor works on: about what its second cache holds."""
MOST_RUNS = 10**8
"""Of a study."""


def monte_carlo(
    scenario: Scenario | str,
    filters: Mapping[str, AbstractFilter],
    *,
    runs: int = 1000,
    seed: int = 0,
    dtype: str = "float64",
    chunk: int = CHUNK,
    backend: str = "xla",
    store: Store | None = None,
    progress: Callable[[str, int], None] = lambda name, done: None,
    motion: AbstractMotion | Trajectory | None = None,
    sensor: AbstractSensor | None = None,
    cluster: Any = None,
    reduced: bool = False,
) -> Study:
    """Run every filter on the same simulated runs.

    The runs are the scenario's, which may be given by name; with a `motion` (or a `Trajectory`)
    or a `sensor` of one's own the truth moves, or is measured, as that says, in the scenario's
    world.

    `progress(filter name, finished runs)` is called after every chunk, and with no runs before
    the first, when the filter is to be compiled. Chunks that `store` already has are not run again;
    it is told what decides them, and refuses what differs.

    With a `cluster`, the address of a Dask scheduler or a `distributed.Client`, the chunks are
    computed there and kept here; their seconds are of all together, compilation among them.

    With the `backend` "native" filters are compiled by the system's C++ compiler
    (`jaxslam.native`), to the same numbers but for rounding; where that cannot be, a warning says
    why, and XLA computes them.

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
        each = _side_by_side if client is None else partial(as_tasks, client)
        simulator = _Simulator(scenario, seed, dtype, min(chunk, runs), motion, sensor)
        made_by = {**simulator.made_by, "chunk": int(chunk), "backend": backend, "reduced": reduced}
        store.begin(made_by, {name: described(slam) for name, slam in filters.items()})
        missing = {name: [c for c in chunks if not store.has(name, c)] for name in filters}
        room = simulator.room(chunks, each) if any(missing.values()) else None
        for name, slam in filters.items():
            job = _Job(name, slam, simulator, room, backend, reduced)
            seconds[name] = _run_filter(job, missing[name], store, progress, each)
        device = jax.devices()[0].device_kind
    return Study(scenario, filters, runs, seed, dtype, chunks, store, seconds, device, reduced)


def divided(runs: int, chunk: int) -> tuple[range, ...]:
    """So many runs in chunks."""
    return tuple(range(i, min(i + chunk, runs)) for i in range(0, runs, chunk))


class _Simulator:
    """Draws chunks of runs, all of one shape, so that everything compiles once."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        dtype: str,
        size: int,
        motion: AbstractMotion | Trajectory | None,
        sensor: AbstractSensor | None,
    ) -> None:
        motion = trajectory_of(scenario, dtype) if motion is None else motion
        self._given = scenario, seed, dtype, size, motion, sensor
        self.dtype, self.size = jnp.dtype(dtype), size
        self.sensor = cast(sensor_of(scenario) if sensor is None else sensor, dtype)
        self._own = cast((motion, sensor), dtype)
        self._scenario, self._key = as_data(scenario, dtype), jax.random.key(seed)

    @property
    def made_by(self) -> Manifest:
        """What decides which runs are drawn, in which layout their records are kept, and by which
        versions they are made."""
        scenario, seed, dtype, _, motion, sensor = self._given
        return {
            "layout": LAYOUT,
            "version": versions(),
            "scenario": described(scenario),
            "motion": described(motion),
            "sensor": described(sensor),
            "seed": int(seed),
            "dtype": dtype,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """For another machine, which has no file of a trajectory, and makes its own key."""
        return _Simulator, self._given

    def __call__(self, chunk: range) -> tuple[Run, Sightings]:
        """The chunk's runs, padded to `size` by the runs that follow."""
        indices = chunk.start + jnp.arange(self.size)
        return _draw(self._scenario, self._own, self._key, indices)

    def most(self, chunk: range) -> Sightings:
        """Of any of the chunk's runs."""
        with jax.enable_x64(self.dtype == "float64"):  # a thread's own
            return jax.tree.map(np.max, jax.device_get(self(chunk)[1]))

    def room(self, chunks: tuple[range, ...], each: Each) -> Room:
        """What holds every run of the study; no frame has more features than a run has slots."""
        seen = [most for _, most in each(self.most, list(chunks))]
        most = jax.tree.map(lambda *counts: _room_for(int(max(counts))), *seen)
        slots = self(chunks[0])[0].visible.shape[-1]
        return Room(most.landmarks, *(min(n, slots) for n in (most.first, most.known, most.new)))


def draw(
    scenario: Scenario, runs: int, *, seed: int = 0, dtype: str = "float64"
) -> tuple[Room, Run]:
    """The first runs of a study, a batch, and the room that they need.

    Raises ValueError for sizes that make no sense.
    """
    check_sizes(runs, seed, dtype, runs)
    with jax.enable_x64(dtype == "float64"):
        simulator = _Simulator(scenario, seed, dtype, runs, None, None)
        batch, _ = simulator(range(runs))
        return simulator.room((range(runs),), _side_by_side), batch


def _room_for(count: int) -> int:
    """At least one, and above four a multiple of four: other seeds then need no other program."""
    return max(1, count) if count <= 4 else 4 * math.ceil(count / 4)


@partial(Program, options=BATCHED)
def _draw(
    scenario: Scenario,
    own: tuple[AbstractMotion | Trajectory | None, AbstractSensor | None],
    key: Array,
    indices: Int[Array, " runs"],
) -> tuple[Run, Sightings]:
    motion, sensor = own

    def one(index):
        run = simulate(scenario, jax.random.fold_in(key, index), motion=motion, sensor=sensor)
        return run, sightings(run)

    return jax.vmap(one)(indices)


class _Job(NamedTuple):
    """What computes a chunk of a filter's records, here or on another machine."""

    name: str
    slam: AbstractFilter
    simulator: _Simulator
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
        if keeps_records(chunk, self.reduced):
            return {**records, **{f"sample_{k}": v for k, v in sample.items()}}
        return as_sums(records, batch.poses.tangent_dim)

    def program(self, batch: Run) -> Callable[[Any], Any]:
        """Compiled, by the first thread that asks: of the number of runs that are wanted of the
        batch."""
        slam, sensor = cast(self.slam, self.simulator.dtype), self.simulator.sensor
        if self.backend == "native":
            numbers, structure = eqx.partition(slam, is_number)
            shapes = _hashable(_shapes((numbers, sensor, batch)))
            with _COMPILING:
                program = _native(Exact((*_hashable(structure), self.room, *shapes)))
            if program is not None:
                return partial(program, numbers, sensor, batch)
        _filter_batch.compile(slam, self.room, sensor, batch, np.int32(0))
        return partial(_filter_batch, slam, self.room, sensor, batch)


_COMPILING = threading.Lock()

Each = Callable[[Callable[[range], Any], list[range]], Iterator[tuple[range, Any]]]
"""Chunks, as they are finished, with what a function makes of them."""


def _run_filter(
    job: _Job, chunks: list[range], store: Store, progress: Callable[[str, int], None], each: Each
) -> Seconds:
    if not chunks:
        return Seconds(0.0, 0.0)
    progress(job.name, 0)
    start = time.perf_counter()
    if each is _side_by_side:
        job.program(job.simulator(chunks[0])[0])
    compiled_at = time.perf_counter()
    for chunk, records in each(job, chunks):
        store.save(job.name, chunk, records)
        progress(job.name, len(chunk))
    return Seconds(compiled_at - start, time.perf_counter() - compiled_at)


def _side_by_side(function: Callable[[range], Any], chunks: list[range]) -> Iterator[Any]:
    """As they are finished, on a CPU one in each processor: a program's matrices are too small to
    be divided. What has not begun is dropped on an error."""
    alone = jax.default_backend() != "cpu" or len(chunks) == 1
    with ThreadPoolExecutor(1 if alone else processors()) as pool:
        waiting = {pool.submit(function, chunk): chunk for chunk in chunks}
        try:
            for future in as_completed(waiting):
                yield waiting.pop(future), future.result()  # what has been told is not kept
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def processors() -> int:
    """How many this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not everywhere
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


def _hashable(tree: Any) -> tuple[tuple[Any, ...], Any]:
    leaves, structure = jax.tree.flatten(tree)
    return tuple(leaves), structure


@lru_cache(maxsize=32)
def _native(given: Exact) -> Callable[..., Any] | None:
    """What computes as `_filter_batch` does, for a filter of this structure, whatever its numbers,
    and data of these shapes; None, with a warning, where the native backend cannot."""
    leaves, structure, room, shapes, of_data = given.value
    static = jax.tree.unflatten(structure, leaves)
    numbers, sensor, runs = jax.tree.unflatten(of_data, shapes)

    def one(shared, run):
        numbers, sensor = shared
        slam = eqx.combine(numbers, static)
        records, path, state = filter_run(slam, room, sensor, run)
        return records, _sample(slam, room, path, state, run)

    try:
        batch = native.batched(one, (numbers, sensor), runs)
    except ValueError as error:
        warnings.warn(f"{error}; {type(static).__name__} is computed by XLA", stacklevel=2)
        return None

    def computed(numbers, sensor, runs, wanted):
        records, samples = batch((numbers, sensor), jax.tree.map(lambda x: x[:wanted], runs))
        return records, {name: x[0] for name, x in samples.items()}

    return computed


def forget() -> None:
    """Free the programs of all filters, each of which holds some of the memory maps of which a
    process may have only so many."""
    for program in (_draw, _filter_batch):
        program.forget()
    _native.cache_clear()


def _warn_of_lapack(jaxpr: Jaxpr, args: tuple[Any, ...]) -> None:
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
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Records of a batch of runs, and the map and the path of its first run. Of the last chunk
    only the first runs are `wanted`: where there are none of them in a part, it is not computed."""

    def part(runs):
        records, path, state = jax.vmap(partial(filter_run, slam, room, sensor))(runs)
        first = partial(jax.tree.map, lambda x: x[0])
        return records, _sample(slam, room, first(path), first(state), first(runs))

    count = len(runs.visible)
    parts = math.ceil(count / _at_once(room, runs))
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


def _at_once(room: Room, runs: Run) -> int:
    """Runs whose covariances stay in a processor's cache; all where there is no such."""
    if jax.default_backend() != "cpu":
        return len(runs.visible)
    n = 2 * runs.poses.tangent_dim + room.landmarks * (runs.points.shape[-1] + 1)
    return max(1, CACHE // (n * n * runs.points.dtype.itemsize))


def _sample(slam, room: Room, path: Pose, state: Any, run: Run) -> dict[str, Array]:
    """The map and the path of one run."""
    landmarks, covariance = landmarks_from_above(slam, state, jnp.arange(room.landmarks))
    return {
        "path": jax.vmap(lambda pose: pose.as_matrix())(path),
        "true_path": jax.vmap(lambda pose: pose.as_matrix())(run.poses),
        "points": run.points_by_frame[-1],
        "landmarks": landmarks,
        "landmarks_covariance": covariance,
        "active": slam.in_map(state),
    }


def filter_run(
    slam: AbstractFilter, room: Room, sensor: AbstractSensor, run: Run
) -> tuple[dict[str, Array], Pose, Any]:
    """One filter on one simulated run: records of every step, estimated path, final state.

    The records hold, per step: `nees` of the pose; the `log_scale` of the truth at which it is the
    least, and the `log_scale_sigma` that the filter claims of it, with the metre in doubt; the same
    of the pose in the filter's own unit, `beyond_scale`, `unit_log_scale`, `unit_log_scale_sigma`,
    from which `one_scale` makes NEES at one scale a run, and whether that unit is fixed yet;
    whether the displacement is `reversed`, NaN without one; `nis` and `nis_dof`; the update's
    `status`; `error` and `variance` of the camera's position (in camera axes) and orientation; the
    mean `landmark_nees` of the landmarks seen, in the sensor's chart, where it is finite, their
    number, and of how many it is not.
    """

    def told(state, innovation, frame: Frame):
        T_BC = frame.pose
        estimate, covariance = camera_pose(slam, state)
        landmarks = _landmark_nees(slam, sensor, state, frame)
        records = {
            "nees": normalised_squared(*slam.pose_error(state, T_BC)),
            **scale_records(slam, state, T_BC),
            "reversed": reversal(estimate, T_BC),
            "nis": innovation.nis,
            "nis_dof": innovation.nis_dof.astype(innovation.nis.dtype),
            "status": innovation.status,
            "error": _camera_error(estimate, T_BC),
            "variance": jnp.diagonal(covariance),
            **landmarks,
        }
        return records, estimate

    state, (records, path) = run_through(slam, room, run, told)
    return records, path, state


def scale_records(
    slam: AbstractFilter, state: Any, T_BC: Pose, truth_sigma: np.ndarray | None = None
) -> dict[str, Array]:
    """Of one pose: the scale in metres, and `SCALE` in the filter's own unit; of a truth that is
    itself known with σ only, see `beyond_scale`."""
    metric = in_unit = beyond_scale(partial(slam.pose_error, state), T_BC, truth_sigma)
    inner = slam.unwrapped
    if isinstance(inner, EkfSlam) and not isinstance(inner.scale, Metre):
        seen = camera_pose_in_unit(slam, state)
        in_unit = beyond_scale(
            lambda truth: (difference(truth, seen.pose), seen.covariance), T_BC, truth_sigma
        )
    own = (*in_unit, slam.unit_fixed(state).astype(metric.nees.dtype))
    return {
        "log_scale": metric.log_scale,
        "log_scale_sigma": metric.sigma,
        **dict(zip(SCALE, own, strict=True)),
    }


def _camera_error(estimate: Pose, truth: Pose) -> Array:
    """Position error in the estimated camera's axes, then `Log(R_est⁻¹ R_true)`."""
    rotation = estimate.rotation().inverse()
    return jnp.concatenate(
        [
            rotation @ (truth.translation() - estimate.translation()),
            (rotation @ truth.rotation()).log(),
        ]
    )


def _landmark_nees(slam, sensor, state, frame: Frame) -> dict[str, Array]:
    """Of the landmarks seen that are in the map: the mean of what is finite, and both numbers."""
    seen = frame.seen
    counted = seen.valid & slam.in_map(state)[seen.slots]
    truth = jax.vmap(frame.pose.inverse().apply)(frame.points[seen.slots])
    truth = jax.vmap(sensor.chart)(truth, jnp.ones_like(truth[:, 0]))
    chart, covariance = landmarks_in_camera(slam, state, seen.slots, sensor)
    nees = jax.vmap(normalised_squared)(truth - chart, covariance)
    finite = counted & jnp.isfinite(nees)
    total = jnp.sum(jnp.where(finite, nees, 0.0))
    return {
        "landmark_nees": total / jnp.maximum(jnp.sum(finite), 1),
        "landmark_count": jnp.sum(counted).astype(nees.dtype),
        "landmark_not_finite": jnp.sum(counted & ~finite).astype(nees.dtype),
    }


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


def check_backend(backend: str) -> None:
    """Raise ValueError for a backend that is not known."""
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}; known: {', '.join(BACKENDS)}")
