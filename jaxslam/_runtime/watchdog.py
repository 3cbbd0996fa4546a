"""Computations that hang end with an error that says where, instead of waiting for ever."""

from __future__ import annotations

import atexit
import os
import sys
import time
from typing import TypeVar

import jax
import jax.core
from jax.extend.core import Jaxpr, subjaxprs

Values = TypeVar("Values")

DEADLOCK_SECONDS = 120.0
"""Seconds without any work after which a computation counts as standing still."""
LOOK_SECONDS = 1.0
"""Seconds between two looks at the processor time."""


LAPACK = {"cholesky", "triangular_solve", "eigh", "eig", "svd", "qr", "geqrf", "lu", "lu_solve"} | {
    "householder_product", "ormqr", "schur", "hessenberg", "tridiagonal", "tridiagonal_solve"
}  # fmt: skip
"""JAX's primitives that are LAPACK's kernels on a CPU."""


class DeadlockError(RuntimeError):
    """A computation whose threads all sleep."""


def finished(values: Values, where: str, patience: float = DEADLOCK_SECONDS) -> Values:
    """The arrays once they are computed; raises `DeadlockError` if nothing works on them any more.

    What is watched is the processor time of this process, not the clock: a long computation is no
    dead-lock. On an accelerator the work is elsewhere, and nothing is watched. Threads that hang
    cannot be stopped, and the interpreter would wait for them at its end: after this error the
    process exits with status 1.
    """
    if jax.default_backend() != "cpu":
        return jax.block_until_ready(values)
    arrays = [x for x in jax.tree.leaves(values) if isinstance(x, jax.Array)]
    arrays = [x for x in arrays if not isinstance(x, jax.core.Tracer)]  # inside another program
    began = looked = time.monotonic()
    worked, idle = time.process_time(), 0.0
    while not all(x.is_ready() for x in arrays):
        now = time.monotonic()
        time.sleep(min(0.05, (now - began) / 50 + 1e-4))
        if now - looked < LOOK_SECONDS:
            continue
        # Share of one processor below which a process does not work. One that computes has far more
        # on however loaded a machine, and one whose threads wait for one another has none.
        busy = time.process_time() - worked > 0.01 * (now - looked)
        # A process that was stopped and goes on has one long pause, which counts as one look.
        idle = 0.0 if busy else idle + min(now - looked, 2 * LOOK_SECONDS)
        looked, worked = now, time.process_time()
        if idle >= patience:
            atexit.register(_leave)
            raise DeadlockError(
                f"{where} stands still: no thread has worked for {idle:.0f} s. Batched LAPACK "
                "calls do this on few processors: where they are in code of your own, use "
                "jaxslam.linalg, or set NPROC=8 in the environment"
            )
    return values


def lapack_calls(jaxpr: Jaxpr) -> set[str]:
    """Return which of `LAPACK` a program `jax.make_jaxpr(f)(x).jaxpr` calls, however deep."""
    own = {equation.primitive.name for equation in jaxpr.eqns} & LAPACK
    return own.union(*(lapack_calls(inner) for inner in subjaxprs(jaxpr)))


def _leave() -> None:
    """End the process although some of its threads never will."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(1)
