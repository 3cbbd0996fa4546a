"""The chunks as tasks of a Dask cluster, on however many machines.

A task is a pickle of what computes a chunk, and the chunk. Results are taken as they come, and no
more tasks are given out than keep the workers busy, so that neither the scheduler nor a worker's
memory fills. The tasks of a worker that is lost go to another: Dask sees to that.
"""

from __future__ import annotations

import errno
import pickle
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import jax

from jaxslam._runtime.extras import missing
from jaxslam._runtime.files import one_line
from jaxslam._runtime.programs import wide

AT_LEAST = 64
"""The tasks given out however few threads there are, so that a cluster that adapts sees work."""
ANSWER_SECONDS = 10.0
"""Seconds in which a scheduler has to answer."""


@contextmanager
def connected(cluster: Any) -> Generator[Any]:
    """A `distributed.Client` of a scheduler's address, of a Dask cluster, or as it is given.

    None for None. What was connected here is closed. Raises ValueError if no scheduler answers, or
    where the extra is missing.
    """
    if cluster is None or hasattr(cluster, "submit"):
        yield cluster
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise missing("a cluster needs", "cluster", error) from None
    try:
        client = Client(cluster, timeout=ANSWER_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # no scheduler, no address, no cluster
        raise ValueError(
            f"no Dask scheduler answers at {cluster!r} ({one_line(error)}); accepted: the address "
            "of one that runs, as in tcp://127.0.0.1:8786, or a client"
        ) from None
    with client:
        yield client


def on_cluster(
    client: Any, function: Callable[[range], Any], chunks: list[range]
) -> Iterator[tuple[range, Any]]:
    """Yield chunks, in the order in which they are finished, with the function's results.

    Raises OSError where the scheduler is lost; what the function raises comes through.
    """
    import cloudpickle  # Dask's: classes of a notebook go along
    from distributed import as_completed

    whole, waiting, doing = cloudpickle.dumps(function), deque(chunks), {}
    finished = as_completed(loop=client.loop)
    try:
        while waiting or doing:
            if waiting and len(doing) < AT_LEAST:
                # Three for every thread of the cluster: one at work, the others on their way.
                room = max(AT_LEAST, 3 * sum(client.nthreads().values()))
                for chunk in [waiting.popleft() for _ in range(min(room, len(waiting)))]:
                    future = client.submit(_computed, whole, wide(), chunk, pure=False)
                    doing[future] = chunk
                    finished.add(future)
            future = next(finished)
            yield doing.pop(future), _result(client, future)
    finally:
        client.cancel(list(doing))


def _result(client: Any, future: Any) -> Any:
    try:
        return future.result()  # computed again where its worker is lost before it was fetched
    except CancelledError:
        raise OSError(errno.ECONNRESET, "the cluster is lost", client.scheduler.address) from None


def _computed(whole: bytes, as_wide: bool, chunk: range) -> Any:
    """Compute on the worker; every task carries the pickle, as workers may join at any time."""
    with jax.enable_x64(as_wide):  # a thread's own
        return _unpickled(whole)(chunk)


@lru_cache(maxsize=8)
def _unpickled(whole: bytes) -> Callable[[range], Any]:
    return pickle.loads(whole)
