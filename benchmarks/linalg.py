"""Batched Cholesky factors with their inverses: `jaxslam._numerics.linalg` against jaxlib's LAPACK.

    python benchmarks/linalg.py

Both in one run, alternating, compilation apart; writes benchmarks/results/linalg.json and the table
of docs/dead-lock.md. LAPACK's batches are run one program at a time: two at once can stand still.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.scipy.linalg import solve_triangular

from jaxslam._numerics.linalg import cholesky
from jaxslam._runtime.files import write_atomically, write_json

SIZES = [(100, 3), (100, 12), (100, 24), (1700, 24), (1, 48), (100, 48), (100, 105), (20, 250)]
"""Matrices in a batch and their rows: poses, updates of 12 and 24 numbers, windows."""
REPEATS = 15
HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "dead-lock.md"
MARK = "<!-- benchmarks/linalg.py -->"


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


def table(rows: list[dict[str, float]]) -> str:
    lines = ["| matrices × rows | JAX, µs a matrix | LAPACK, µs | compile JAX, s | LAPACK, s |"]
    lines.append("|---|---|---|---|---|")
    for r in rows:
        lines.append(
            f"| {r['batch']} × {r['rows']} | {r['own_microseconds']:.2f} "
            f"| {r['lapack_microseconds']:.2f} | {r['own_compile_seconds']:.1f} "
            f"| {r['lapack_compile_seconds']:.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    with jax.enable_x64(True):
        rows = [measured(*size) for size in SIZES]
    write_json(HERE / "results" / "linalg.json", rows)
    before, _, after = PAGE.read_text().partition(MARK)
    rest = after.partition("\n\nThe larger sizes")
    with write_atomically(PAGE) as path:
        path.write_text(f"{before}{MARK}\n{table(rows)}{rest[1]}{rest[2]}")
    print(table(rows))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
