"""Does any study stand still? Studies of all filters, on thread pools of one, two and four.

    python benchmarks/hangs.py --out benchmarks/results/hangs.json

A study is a filter with a modifier, a parametrization and a scenario, drawn at random of all that
go together; its runs are few but of several chunks side by side. All are computed one after
another in a process, which tells what it begins. Where it is silent for too long it is ended, the
study is written down as one that hangs, and another process goes on with the next. It takes hours:
the file is written after every study, and the same command goes on where it ends.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import queue
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import write_json
from jaxslam.consistency import montecarlo
from jaxslam.filters.registry import FILTERS, MODIFIERS, make_filters
from jaxslam.landmarks import LANDMARKS
from jaxslam.simulation.scenario import BUILT_IN

NAMES = [*FILTERS, "recommended"]
MEMBERS = {"lag": 3, "scales": 3, "directions": 3, "mixture": 3, "rest": 8}
"""Numbers behind modifiers whose programs would otherwise take minutes to compile."""


class Case(NamedTuple):
    """What a study is of."""

    scenario: str
    filter: str
    landmark: str


@dataclass(frozen=True)
class Options:
    """What to try."""

    out: Path
    """JSON file; one that is there is gone on with."""
    studies: int = 200
    threads: tuple[int, ...] = (1, 2, 4)
    """Of XLA's pool. With one, the process has one processor; else all of the machine."""
    runs: int = 90
    steps: int = 5
    limit: float = 400.0
    """Seconds in which a study ends, its compilation included."""
    seed: int = 0


def drawn(draw: np.random.Generator) -> Case:
    """One of all that go together."""
    while True:
        scenario, landmark = (str(draw.choice(list(of))) for of in (BUILT_IN, LANDMARKS))
        name, word = str(draw.choice(NAMES)), str(draw.choice(["", *MODIFIERS]))
        if word:
            name += f"+{word}{MEMBERS.get(word, '')}"
        try:
            make_filters(scenario, [name], [landmark])
        except ValueError:
            continue
        return Case(scenario, name, landmark)


def study(case: Case, runs: int, steps: int) -> str:
    """How it ended."""
    scenario = jaxslam.scenario(case.scenario, steps=steps)
    filters = make_filters(scenario, [case.filter], [case.landmark])
    try:
        found = jaxslam.summarise(
            jaxslam.monte_carlo(scenario, filters, runs=runs, chunk=max(1, runs // 6))
        )
    except Exception as error:  # whatever it is, it has ended
        return f"{type(error).__name__}: {error}"
    return "finished" if found["runs"] == runs else "incomplete"


def work(told: Any, threads: int, cases: list[tuple[int, Case]], runs: int, steps: int) -> None:
    """In a process of its own: each case's number when it begins, and how it ended."""
    if threads == 1:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    jax.config.update("jax_enable_x64", True)
    for number, case in cases:
        told.put((number, None))
        told.put((number, study(case, runs, steps)))
        montecarlo.forget()
        jax.clear_caches()


def heard(told: Any, process: Any, limit: float) -> tuple[int, str | None] | None:
    """What the process tells next; None where it is silent for too long, or has died."""
    until = time.monotonic() + limit
    while time.monotonic() < until:
        try:
            return told.get(timeout=1.0)
        except queue.Empty:
            if not process.is_alive():
                return None
    return None


def tried(
    cases: list[Case],
    threads: int,
    options: Options,
    ended: list[str],
    save: Callable[[], None] = lambda: None,
) -> None:
    """How every case ended on a pool of so many threads, added to what has `ended` before."""
    os.environ["NPROC"] = str(threads)
    context = multiprocessing.get_context("spawn")
    while len(ended) < len(cases):
        left = list(enumerate(cases))[len(ended) :]
        told = context.Queue()
        process = context.Process(
            target=work, args=(told, threads, left, options.runs, options.steps)
        )
        process.start()
        while len(ended) < len(cases):
            message = heard(told, process, options.limit)
            if message is None:
                ended.append("hangs" if process.is_alive() else f"exit status {process.exitcode}")
                break
            if (end := message[1]) is not None:
                ended.append(end)
                save()
        process.kill()
        process.join()
        save()


def begun(options: Options) -> dict[str, Any]:
    """What has been found so far. Raises ValueError for a file of other studies."""
    of = {"studies": options.studies, "seed": options.seed}
    if not options.out.exists():
        return of
    result = json.loads(options.out.read_text())
    if any(result.get(name) != value for name, value in of.items()):
        raise ValueError(f"{options.out} is of other studies than {of}: write to another file")
    return result


def main() -> None:
    """Try all, write."""
    options = tyro.cli(Options, description=__doc__)
    draw = np.random.default_rng(options.seed)
    cases = [drawn(draw) for _ in range(options.studies)]
    result = begun(options)
    with tempfile.TemporaryDirectory() as folder:  # what one pool has compiled the next one reads
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder)
        for threads in options.threads:
            found = result.setdefault(f"{threads} threads", {"ended": [], "seconds": 0})
            began = time.perf_counter() - found["seconds"]

            def save(found: dict[str, Any] = found, began: float = began) -> None:
                found["seconds"] = round(time.perf_counter() - began)
                write_json(options.out, result)

            tried(cases, threads, options, found["ended"], save)
            ends = [end.partition(":")[0] for end in found["ended"]]
            print(f"{threads} threads: {Counter(ends)}", flush=True)
            for case, end in zip(cases, found["ended"], strict=True):
                if end != "finished":
                    print("  ", "/".join(case), end)


if __name__ == "__main__":
    main()
