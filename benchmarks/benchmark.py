"""What a benchmark is: options of a command, numbers that are measured, their file, their pages."""

from __future__ import annotations

import itertools
import json
import math
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Union

import jax
import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import read_json, write_atomically, write_json

RESULTS = Path("benchmarks/results")
END = "<!-- end -->"
"""Behind a table that a benchmark writes; before it stands a mark of its own."""


def data_folder() -> Path:
    """The folder of recordings: $JAXSLAM_DATA, or else the one beside a clone, which is then set,
    so that scenarios named after a recording find it too."""
    return Path(os.environ.setdefault("JAXSLAM_DATA", "../shared/data"))


Row = dict[str, Any]
Case = tuple[tuple[str, ...], Row, Callable[[], Row]]
"""The keys of a row of results, what it is of, and the function that measures the rest of it."""


@dataclass(frozen=True, kw_only=True)
class Benchmark(ABC):
    """A benchmark is its options: `measure` finds the results, `tables` are what pages say of them.

    `Subclass.run()` is the command. What its file holds is written after every part, whole.
    """

    out: Path
    """JSON file of the results."""
    docs: Path = Path("docs")
    """Folder of the pages."""
    page: bool = False
    """Measure nothing; write the pages from the results that are there."""

    double: ClassVar[bool] = True
    """Whether JAX computes in float64 wherever nothing else is said."""

    @abstractmethod
    def measure(self) -> Iterator[Any]:
        """Yield the results so far, all of them, after every part."""

    def tables(self, results: Any) -> Iterator[tuple[str, str, str]]:
        """A page, a mark on it, and what is written behind that."""
        del results
        yield from ()

    def report(self, results: Any) -> None:
        """Write the tables into their pages; without any, print the results."""
        written = False
        for page, mark, text in self.tables(results):
            written = True
            write_table(self.docs / page, mark, text)
        if not written:
            print(json.dumps(results, indent=1, ensure_ascii=False), flush=True)

    def found(self) -> dict[str, Any]:
        """The results that are there; none where there is no file.

        Raises ValueError, naming the file, where it holds something else.
        """
        return read_json(self.out, "results", dict) if self.out.exists() else {}

    def added(self, cases: Iterable[Case]) -> Iterator[dict[str, Any]]:
        """The results that are there with a case more, as often as one is not there yet."""
        results = self.found()
        for (*above, last), of, measure in cases:
            place = results
            for key in above:
                place = place.setdefault(key, {})
            if any(place.get(last, {}).get(key) != value for key, value in of.items()):
                place[last] = of | measure()
                print(*above, last, flush=True)
                yield results

    def save(self, results: Any) -> None:
        """Write the results, whole or not at all."""
        write_json(self.out, results, ensure_ascii=False)

    def __call__(self) -> None:
        """Measure, write, report; where there is nothing to be measured, report what is there."""
        for folder in (self.out.parent, self.docs):
            folder.mkdir(parents=True, exist_ok=True)
        measured = False
        for results in () if self.page else self.measure():
            measured = True
            self.save(results)
            self.report(results)
        if not measured:  # all was there
            self.report(self.found())

    @classmethod
    def run(cls) -> None:
        """The command line, which a file's first lines describe."""
        run_one(cls)


@dataclass(frozen=True, kw_only=True)
class OfRuns(Benchmark):
    """A benchmark of simulated runs."""

    runs: int = 200
    """Runs of every filter in every world."""
    seed: int = 0
    """Run i draws from this seed and i alone."""
    chunk: int = 25
    """Runs in one batch."""

    def each(
        self, measure: Callable[[str, str], Row], worlds: Iterable[str], names: Iterable[str],
        above: tuple[str, ...] = (), **of: Any,
    ) -> Iterator[Row]:  # fmt: skip
        """The results with every name in every world, name by name: worlds share its programs."""
        of |= {"runs": self.runs, "seed": self.seed}
        yield from self.added(
            ((*above, world, name), of, partial(measure, world, name))
            for name, world in itertools.product(names, worlds)
        )

    def study(
        self, scenario: jaxslam.Scenario, name: str, seed: int | None = None
    ) -> tuple[jaxslam.consistency.Study, dict[str, Any]]:
        """A study of one filter, `name` or `name/landmarks`, and its summary."""
        frame, _, landmarks = name.partition("/")
        filters = jaxslam.make_filters(scenario, [frame], [landmarks or "inverse_scaling"])
        seed = self.seed if seed is None else seed
        study = jaxslam.monte_carlo(scenario, filters, runs=self.runs, seed=seed, chunk=self.chunk)
        (found,) = jaxslam.summarise(study)["filters"].values()
        return study, found


def run_one(*benchmarks: type[Benchmark]) -> None:
    """The command line of a file of several benchmarks: the name of one, and its options."""
    first, *_ = benchmarks
    jax.config.update("jax_enable_x64", first.double)
    tyro.cli(Union[benchmarks], description=sys.modules[first.__module__].__doc__)()  # noqa: UP007  # ty: ignore[invalid-type-form]


def at_end(found: dict[str, Any]) -> dict[str, Any]:
    """What a summary says of the last step."""
    return {
        **{key: found[key] for key in ("dof", "band95", "inside", "diverged")},
        **{key: found[key][-1] for key in ("nees", "nees_median", "nees_not_lost", "lost")},
        **{key: found[key]["position"][-1] for key in ("rmse", "sigma")},
    }


def by_batch(program: Callable[[Any], Any], runs: Any, size: int) -> Any:
    """What a program says of all runs, a pytree with a leading axis, given so many at a time."""
    count = len(jax.tree.leaves(runs)[0])
    parts = [
        jax.device_get(program(jax.tree.map(lambda x, i=i: x[i : i + size], runs)))
        for i in range(0, count, size)
    ]
    return jax.tree.map(lambda *of_parts: np.concatenate(of_parts), *parts)


def write_page(path: Path, text: str) -> None:
    """Write a whole page, or leave it as it was."""
    with write_atomically(path) as temporary:
        temporary.write_text(text)


def write_table(page: Path, begin: str, table: str) -> None:
    """Put the table after its mark on the page, in place of an older one.

    Raises ValueError where the page has no such place.
    """
    before, mark, rest = page.read_text().partition(begin)
    _, end, after = rest.partition(END)
    if not mark or not end:
        raise ValueError(f"the page has no place for the table: {begin} … {END}")
    write_page(page, f"{before}{begin}\n\n{table}\n\n{END}{after}")


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as Markdown."""
    lines = (f"| {' | '.join(map(str, row))} |" for row in rows)
    return "\n".join([f"| {' | '.join(header)} |", "|" + "---|" * len(header), *lines])


def number(value: float | None, form: str = ".2f") -> str:
    """A number in a table: – where there is none, and few digits where it is large."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.1e}" if abs(value) >= 1e4 else format(value, form)
