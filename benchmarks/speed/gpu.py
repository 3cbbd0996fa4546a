"""Microseconds of a run's step on a GPU, beside the processors of the same machine.

    python -m benchmarks.speed.gpu

The filter alone for batches of a thousand to a million runs in both precisions, whole studies, and
a Gaussian sum. NEES of every step and the last covariances of the first runs are compared with the
CPU's: in float64 another result is an error. What is too large for the memory, would take too long,
or is beyond the time of the whole is left out, and the results say why. The most telling parts come
first. `--device cpu` tries the program out where there is no GPU.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np

import jaxslam
from benchmarks.benchmark import RESULTS, Benchmark, number, table
from benchmarks.speed.__main__ import difference
from benchmarks.speed.workload import (
    WORKLOADS,
    Inputs,
    Records,
    Workload,
    by_native,
    filtered_run,
    filters_of,
    prepared,
    scenario_of,
)
from jaxslam._numerics.arrays import cast, is_number
from jaxslam._runtime.files import one_line
from jaxslam.consistency.montecarlo import processors
from jaxslam.native.build import compiler

BEGIN = "<!-- speed on a gpu -->"
AGREEMENT = 1e-6
"""In float64, between a GPU and a CPU: relative, of every NEES and of the last covariance."""
PART = 100
"""The most runs that a processor computes at a time, as in a study."""
MEMORY_SHARE = 0.9
"""Of the memory that JAX may use: the most that a batch is expected to need."""
Left = Callable[[], float]
"""The seconds that are left."""
Row = dict[str, Any] | str
"""What was measured, or why it was left out."""


@dataclass(frozen=True, kw_only=True)
class OnGpu(Benchmark):
    """The filter alone and whole studies, on a GPU and on the processors beside it."""

    device: Literal["gpu", "cpu"] = "gpu"
    """Where the batches are computed; "cpu" tries the program out."""
    workloads: tuple[str, ...] = tuple(WORKLOADS)
    """A is planar with 12 landmarks, B has six degrees of freedom and 30 landmarks."""
    dtypes: tuple[str, ...] = ("float64", "float32")
    batches: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
    """Runs in a batch: those that were drawn, over and over."""
    drawn: int = 1_000
    """Runs that are drawn, that the CPU computes, and that are compared."""
    steps: int = 20
    """Of a run of the filter alone."""
    studies: tuple[int, ...] = (10_000, 100_000)
    """Runs of whole studies of the first workload."""
    chunk: int = 10_000
    """Runs of a study that are computed at a time: on a GPU many, where a processor has 100."""
    study_steps: int = 50
    mixture_runs: int = 10_000
    """Of the study of `recommended`; none where this is 0."""
    mixture_chunk: int = 2_500
    """Each of these runs has seventeen members in memory."""
    repeats: int = 5
    """Calls; the median counts."""
    call_seconds: float = 20.0
    """A call that would take longer is left out; after so many seconds nothing is repeated."""
    minutes: float = 8.0
    """After these no further part is begun."""
    out: Path = RESULTS / "gpu.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        device, end = jax.devices(self.device)[0], time.monotonic() + 60 * self.minutes
        results = {**surroundings(device), "steps": self.steps, "filters": {}, "left_out": []}

        def left() -> float:
            return end - time.monotonic()

        for name, part in self.parts(device, left, results):
            if left() <= 0:
                results["left_out"].append(f"{name}: no time left")
                continue
            print(f"{name} ({left():.0f} s left)", file=sys.stderr, flush=True)
            try:
                for _ in part():
                    yield results
            except jax.errors.JaxRuntimeError as error:  # what else was measured counts
                results["left_out"].append(f"{name}: {one_line(error)}")
        yield results | {"minutes": rounded(self.minutes - left() / 60)}
        if wrong := disagreeing(results):
            raise ValueError(f"not the same results on the device and on the CPU: {wrong}")

    def parts(
        self, device: jax.Device, left: Left, results: dict[str, Any]
    ) -> Iterator[tuple[str, Callable[[], Iterator[None]]]]:
        """All that is measured, each with its name."""
        inputs = cache(self.inputs)
        first = self.workloads[0]
        for dtype in self.dtypes:
            for name in self.workloads:
                of = results["filters"].setdefault(name, {}).setdefault(dtype, {})
                given = partial(inputs, name)
                yield f"{name}, {dtype}", partial(self.filters, given, dtype, device, left, of)
                if name == first and dtype == self.dtypes[0]:
                    yield "studies", partial(self.whole_studies, first, left, results)
                    yield "recommended", partial(self.mixture, results)
        if "float32" in self.dtypes:
            given = partial(inputs, first)
            yield "short products", partial(self.short_products, given, device, results)

    def work(self, name: str, runs: int, steps: int) -> Workload:
        """A workload of this size."""
        return dataclasses.replace(WORKLOADS[name], runs=runs, steps=steps)

    def inputs(self, name: str) -> Inputs:
        """Runs that are drawn on the CPU."""
        with jax.default_device(jax.devices("cpu")[0]):
            return prepared(self.work(name, self.drawn, self.steps))

    def filters(
        self, inputs: Callable[[], Inputs], dtype: str, device: jax.Device, left: Left,
        of: dict[str, Any],
    ) -> Iterator[None]:  # fmt: skip
        """One workload in one precision: all processors, then ever larger batches."""
        given = inputs()
        of["processors"], wanted = self.on_processors(given, dtype)
        yield
        filters, of["device"] = Filters(given, dtype, device), {}
        last = None
        for runs in self.batches:
            row = self.too_much(last, runs, device, left) or self.batch(filters, runs, wanted)
            of["device"][str(runs)] = row
            last = last if isinstance(row, str) else {**row, "runs": runs}
            yield

    def too_much(
        self, last: dict[str, Any] | None, runs: int, device: jax.Device, left: Left
    ) -> str | None:
        """Why a batch is not to be tried after the last one that was measured."""
        if last is None:
            return None
        seconds = last["seconds"] * runs / last["runs"]
        needed = last["bytes_per_run"] * runs
        limit = memory_of(device)
        if needed > MEMORY_SHARE * limit:
            return f"needs about {needed / 2**30:.0f} GiB of {limit / 2**30:.0f}"
        if seconds > self.call_seconds:
            return f"a call would take about {seconds:.0f} s"
        if 1.5 * last["compile_seconds"] + 2 * seconds > left():
            return "no time left"
        return None

    def batch(self, filters: Filters, runs: int, wanted: Records) -> Row:
        """A batch on the device, whose first runs are compared with the CPU's."""
        try:
            data = filters.data(np.arange(runs) % self.drawn)
            program, compile_seconds = filters.compiled(data)
            found = tuple(np.asarray(x[: self.drawn]) for x in program(*data))
            seconds = self.median(lambda: jax.block_until_ready(program(*data)))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            return "not enough memory"
        return {
            "microseconds_per_step": rounded(1e6 * seconds / runs / self.steps),
            "seconds": rounded(seconds),
            "compile_seconds": rounded(compile_seconds),
            "bytes_per_run": bytes_of(program) // runs,
            "largest_difference": rounded(difference(found, wanted)),
        }

    def on_processors(self, inputs: Inputs, dtype: str) -> tuple[dict[str, float], Records]:
        """All processors, each with parts of the runs as in a study; and the records."""
        threads = processors()
        parts = max(threads, -(-self.drawn // PART))
        size = -(-self.drawn // parts)
        filters = Filters(inputs, dtype, jax.devices("cpu")[0])
        data = [filters.data((k * size + np.arange(size)) % self.drawn) for k in range(parts)]
        program, compile_seconds = filters.compiled(data[0])
        with ThreadPoolExecutor(threads) as pool:

            def call():
                return list(pool.map(lambda x: jax.block_until_ready(program(*x)), data))

            nees, covariance = (np.concatenate(x)[: self.drawn] for x in zip(*call(), strict=True))
            seconds = self.median(call)
        row = {
            "xla": rounded(1e6 * seconds / (parts * size) / self.steps),
            "xla_compile_seconds": rounded(compile_seconds),
        }
        if dtype == "float64" and compiler() is not None:
            began = time.perf_counter()
            native = by_native(inputs, dtype, threads)
            row["native_compile_seconds"] = rounded(time.perf_counter() - began)
            row["native"] = rounded(1e6 * self.median(native) / self.drawn / self.steps)
        return row, (nees, covariance)

    def whole_studies(self, name: str, left: Left, results: dict[str, Any]) -> Iterator[None]:
        """Studies by XLA on the default device, and by the processors in another process."""
        of: dict[str, Any] = {"steps": self.study_steps, "chunk": self.chunk}
        results["studies"] = of
        each = 0.0
        for runs in self.studies:
            if each * runs > left():
                of[str(runs)] = "no time left"
                continue
            of[str(runs)] = self.study(name, runs)
            each = of[str(runs)]["seconds"] / runs
            yield
        backends = ("xla", "native") if compiler() is not None else ("xla",)
        for backend in backends if self.studies else ():
            of[f"processors_{backend}"] = self.study_on_processors(name, backend)
            yield

    def study(self, name: str, runs: int) -> dict[str, float]:
        """A study with its summary; without the compilation of the filter."""
        scenario = scenario_of(self.work(name, runs, self.study_steps))
        filters, chunk = filters_of(scenario), min(runs, self.chunk)
        draw = partial(jaxslam.monte_carlo, scenario, filters, chunk=chunk, backend="xla")
        began = time.perf_counter()
        draw(runs=chunk)  # compiles
        compiled = time.perf_counter()
        study = draw(runs=runs)
        jaxslam.summarise(study)
        seconds = time.perf_counter() - compiled
        (of_filter,) = study.seconds.values()
        return {
            "microseconds_per_step": rounded(1e6 * seconds / runs / self.study_steps),
            "seconds": rounded(seconds),
            "filter_seconds": rounded(of_filter.run),
            "first_chunk_and_compile_seconds": rounded(compiled - began),
        }

    def study_on_processors(self, name: str, backend: str) -> dict[str, Any]:
        """What `benchmarks.speed.study` prints of the smallest study, in chunks for a processor."""
        sizes = {
            "workload": name, "runs": min(self.studies), "steps": self.study_steps,
            "landmarks": WORKLOADS[name].landmarks, "chunk": PART, "backend": backend,
            "processors": processors(), "repeats": 1,
        }  # fmt: skip
        command = [sys.executable, "-m", "benchmarks.speed.study"]
        command += [text for key, value in sizes.items() for text in (f"--{key}", str(value))]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=environment)
        return {"runs": sizes["runs"], "chunk": PART, **json.loads(done.stdout)}

    def mixture(self, results: dict[str, Any]) -> Iterator[None]:
        """The Gaussian sum of `recommended`, relative to the filter that it is made of."""
        if not self.mixture_runs:
            return
        names = ["robocentric", "recommended"]
        scenario = jaxslam.scenario("matched", steps=self.study_steps)
        filters = jaxslam.make_filters(scenario, names, ["inverse_scaling"])
        chunk = min(self.mixture_chunk, self.mixture_runs)
        study = jaxslam.monte_carlo(
            scenario, filters, runs=self.mixture_runs, chunk=chunk, backend="xla"
        )
        seconds = dict(zip(names, study.seconds.values(), strict=True))
        steps = self.mixture_runs * self.study_steps
        results["recommended"] = {
            "runs": self.mixture_runs,
            "steps": self.study_steps,
            "chunk": chunk,
            "microseconds_per_step": {k: rounded(1e6 * x.run / steps) for k, x in seconds.items()},
            "compile_seconds": {k: rounded(x.compile) for k, x in seconds.items()},
            "relative": rounded(seconds["recommended"].run / seconds["robocentric"].run),
        }
        yield

    def short_products(
        self, inputs: Callable[[], Inputs], device: jax.Device, results: dict[str, Any]
    ) -> Iterator[None]:
        """Single precision with whole products, and with what JAX takes on a device unasked."""
        given = inputs()

        def records(*settings: Any) -> Records:
            filters = Filters(given, *settings)
            data = filters.data(np.arange(self.drawn))
            nees, covariance = filters.compiled(data)[0](*data)
            return np.asarray(nees), np.asarray(covariance)

        wanted = records("float64", jax.devices("cpu")[0])
        of: dict[str, Any] = {"mean_nees": rounded(np.mean(wanted[0]))}
        results["float32_beside_float64"] = of
        for kind, precision in (("whole_products", "highest"), ("short_products", "default")):
            found = records("float32", device, precision)
            of[kind] = {
                "mean_nees": rounded(np.mean(found[0])),
                "largest_difference": rounded(difference(found, wanted)),
                "nees_of_no_covariance": int(np.sum(~(found[0] >= 0))),
            }
        yield

    def median(self, call: Callable[[], Any]) -> float:
        """Median seconds of a call, after one that does not count."""
        call()
        seconds: list[float] = []
        while len(seconds) < self.repeats and sum(seconds) < self.call_seconds:
            began = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - began)
        return float(np.median(seconds))

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "speed.md", BEGIN, shown(results)


class Filters:
    """The filter of a workload in one precision on one device, for batches of any size."""

    def __init__(
        self, inputs: Inputs, dtype: str, device: jax.Device, precision: str = "highest"
    ) -> None:
        self._dtype, self._device = dtype, device
        self._precision = None if device.platform == "cpu" else precision  # as in a study
        with self._settings():
            numbers, self._static = eqx.partition(cast(inputs.slam, dtype), is_number)
            *shared, runs = numbers, cast(inputs.seconds, dtype), cast(tuple(inputs[2:]), dtype)
            self._shared, self._runs = jax.device_put((shared, runs), device)

    @contextmanager
    def _settings(self) -> Generator[None]:
        with (
            jax.enable_x64(self._dtype == "float64"),
            jax.default_device(self._device),
            jax.default_matmul_precision(self._precision),
        ):
            yield

    def data(self, chosen: np.ndarray) -> tuple[Any, ...]:
        """The program's arguments for these of the runs, gathered on the device."""
        with self._settings():
            gather = jax.jit(lambda runs, at: jax.tree.map(lambda x: x[at], runs))
            return (*self._shared, *gather(self._runs, chosen))

    def compiled(self, data: tuple[Any, ...]) -> tuple[jax.stages.Compiled, float]:
        """The program for such arguments, and the seconds of its compilation."""

        def batch(numbers, seconds, *runs):
            slam = eqx.combine(numbers, self._static)
            return jax.vmap(partial(filtered_run, slam, seconds))(*runs)

        began = time.perf_counter()
        with self._settings():
            return jax.jit(batch).lower(*data).compile(), time.perf_counter() - began


def surroundings(device: jax.Device) -> dict[str, Any]:
    """Where it is measured."""
    return {
        "device": device.device_kind,
        "memory_GiB": rounded(memory_of(device) / 2**30),
        "processors": processors(),
        "jax": jax.__version__,
    }


def memory_of(device: jax.Device) -> int:
    """The bytes that JAX may use on a device."""
    told = device.memory_stats() or {}
    return told.get("bytes_limit") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def bytes_of(program: jax.stages.Compiled) -> int:
    """The bytes that a program works on, as its compiler plans them."""
    plan = program.memory_analysis()
    names = ("argument_size_in_bytes", "output_size_in_bytes", "temp_size_in_bytes")
    return sum(getattr(plan, name, 0) for name in names)


def rounded(value: Any) -> float:
    """A number with three digits that count."""
    return float(f"{float(value):.3g}")


def disagreeing(results: dict[str, Any]) -> dict[str, float]:
    """The batches in float64 whose numbers are not those of the CPU."""
    found = {
        f"{name}, {runs} runs": row["largest_difference"]
        for name, of in results["filters"].items()
        for runs, row in of.get("float64", {}).get("device", {}).items()
        if not isinstance(row, str)
    }
    return {name: x for name, x in found.items() if not x < AGREEMENT}


def shown(results: dict[str, Any]) -> str:
    """The page's tables: of the filter alone, and of whole studies."""
    columns = {
        f"{name}, {dtype}": of
        for name, each in results["filters"].items()
        for dtype, of in each.items()
        if of
    }
    if not columns:
        return "Not measured yet."
    rows = filter_rows(results["processors"], list(columns.values()))
    parts = [table(("µs a step of a run", *columns), rows)]
    if of := results.get("studies"):
        header = (f"a whole study of {of['steps']} steps", "runs", "µs a step of a run", "s")
        parts.append(table(header, study_rows(results["processors"], of)))
    if left := results["left_out"]:
        parts.append("\n".join(["Left out:", "", *(f"- {why}" for why in left)]))
    return "\n\n".join(parts)


def filter_rows(count: int, columns: list[dict[str, Any]]) -> Iterator[list[str]]:
    """The rows of the filter alone; a dash where memory or time is too short."""
    for key, backend in (("xla", "XLA"), ("native", "native")):
        cells = (digits(of.get("processors", {}).get(key)) for of in columns)
        yield [f"{count} processors, {backend}", *cells]
    sizes = sorted({int(n) for of in columns for n in of.get("device", {})})

    def row(what: str, key: str, runs: int) -> list[str]:
        rows = [of.get("device", {}).get(str(runs)) for of in columns]
        return [what, *(digits(row[key] if isinstance(row, dict) else None) for row in rows)]

    for runs in sizes:
        yield row(f"{runs:,} runs at once", "microseconds_per_step", runs)
    for runs in sizes[:1]:
        yield row(f"compilation for {runs:,}, s", "compile_seconds", runs)
        yield row("largest difference from the CPU", "largest_difference", runs)


def study_rows(count: int, of: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """The rows of whole studies."""
    names = {f"processors_{key.lower()}": f"{count} processors, {key}" for key in ("XLA", "native")}
    for key, row in of.items():
        if isinstance(row, dict):
            where = names.get(key, f"on the device, chunks of {of['chunk']:,}")
            numbers = digits(row["microseconds_per_step"]), digits(row["seconds"])
            yield where, f"{row.get('runs') or int(key):,}", *numbers


def digits(value: float | None) -> str:
    """A number with about three digits that count."""
    return number(value, ".3g" if value is None or abs(value) < 1000 else ".0f")


if __name__ == "__main__":
    # Read when JAX takes the memory: three quarters, if nothing is said.
    os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.92")
    OnGpu.run()
