"""Batched Cholesky factors with their inverses: `jaxslam._numerics.linalg` against jaxlib's LAPACK.

    python benchmarks/linalg.py

Both in one run, alternating, compilation apart; writes `linalg.json` and the table of
`docs/dead-lock.md`. LAPACK's batches are run one program at a time: two at once can stand still.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, Benchmark, table, write_table
from jax.scipy.linalg import solve_triangular

from jaxslam._numerics.linalg import cholesky

SIZES = [(100, 3), (100, 12), (100, 24), (1700, 24), (1, 48), (100, 48), (100, 105), (20, 250)]
"""Matrices in a batch and their rows: poses, updates of 12 and 24 numbers, windows."""
REPEATS = 15
MARK = "<!-- linalg.py -->"


def by_lapack(A):
    root = jnp.linalg.cholesky(A)
    return root, solve_triangular(root, jnp.eye(len(A), dtype=A.dtype), lower=True)


def compiled(function, A):
    began = time.perf_counter()
    program = jax.jit(jax.vmap(function)).lower(A).compile()
    return program, time.perf_counter() - began


def measured(batch: int, n: int) -> dict[str, float]:
    half = np.random.default_rng(0).normal(size=(batch, n, n + 5))
    A = jnp.asarray(half @ np.swapaxes(half, 1, 2))
    programs = {name: compiled(f, A) for name, f in (("own", cholesky), ("lapack", by_lapack))}
    seconds = {name: [] for name in programs}
    for _ in range(REPEATS + 1):
        for name, (program, _) in programs.items():
            began = time.perf_counter()
            jax.block_until_ready(program(A))
            seconds[name].append(time.perf_counter() - began)
    found: dict[str, float] = {"batch": batch, "rows": n}
    for name, (_, compile_seconds) in programs.items():
        median = statistics.median(seconds[name][1:])
        found[f"{name}_microseconds"] = round(1e6 * median / batch, 2)
        found[f"{name}_compile_seconds"] = round(compile_seconds, 2)
    return found


@dataclass(frozen=True, kw_only=True)
class Linalg(Benchmark):
    """Both by the size of the batch."""

    out: Path = RESULTS / "linalg.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        rows = []
        for size in SIZES:
            rows.append(measured(*size))
            yield {"rows": rows}

    def report(self, results: dict[str, Any]) -> None:
        header = "matrices × rows", "JAX, µs a matrix", "LAPACK, µs", "compile JAX, s", "LAPACK, s"
        rows = [
            (
                f"{r['batch']} × {r['rows']}",
                *(f"{r[f'{name}_microseconds']:.2f}" for name in ("own", "lapack")),
                *(f"{r[f'{name}_compile_seconds']:.1f}" for name in ("own", "lapack")),
            )
            for r in results["rows"]
        ]
        write_table(self.docs / "dead-lock.md", MARK, table(header, rows))


if __name__ == "__main__":
    Linalg.run()
