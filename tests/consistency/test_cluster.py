"""Tests of studies on a Dask cluster: the same numbers as here, although a worker is killed."""

import os
import pickle
import signal
import subprocess
import sys
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
from journeys import case, ends
from refusals import refused

import jaxslam
from jaxslam.consistency.cluster import on_cluster
from jaxslam.filters.words import FILTERS, MODIFIERS, make_filter

SCENARIO = jaxslam.scenario("matched-tight", steps=4, landmarks=3)
RUNS, CHUNK = 120, 3
TESTS = Path(__file__).resolve().parents[1]


def filters():
    return jaxslam.make_filters(SCENARIO, ["robocentric"], ["inverse_scaling"])


def records(study):
    (name,) = study.filters
    return [study.store.load(name, chunk) for chunk in study.chunks]


def assert_same(found, wanted):
    for one, other in zip(found, wanted, strict=True):
        assert one.keys() == other.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)


@contextmanager
def cluster(workers):
    """A client, and the processes of workers, as a person starts them."""
    distributed = pytest.importorskip("distributed")
    # Workers compile as the tests do, every program anew, and find the modules of tests.
    told = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "true", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    env = {**os.environ, **told, "PYTHONPATH": str(TESTS)}
    started = []

    def start(program, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments]
        started.append(subprocess.Popen(command, env=env, stderr=subprocess.DEVNULL))

    port = distributed.utils.open_port()
    address = f"tcp://127.0.0.1:{port}"
    start("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", "--no-show")
    for _ in range(workers):
        start("worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard")
    try:
        with distributed.Client(address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=90)
            yield client, started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait(30)


@pytest.fixture(scope="module")
def client():
    """Of one worker, a process, for all filters."""
    with cluster(workers=1) as (client, _):
        yield client


MODIFIED = {
    **{word: (f"world+{word}", "matched") for word in ("fej", "fej2", "decoupled")},
    "walk": ("robocentric+scene50+walk", "matched"),
    "rest": ("recommended+rest4", "standstill"),  # a window of few frames compiles sooner
    "submaps": ("robocentric+submaps", "laps"),
}
"""Filters with a word that is not of every one; the others modify the paper's."""
EVERY_WORD = [
    *((base, "matched") for base in FILTERS),
    *(MODIFIED.get(word, (f"robocentric+{word}", "matched")) for word in MODIFIERS),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "world"), EVERY_WORD)
def test_a_filter_ends_in_the_same_bits_wherever_it_was_sent(client, name, world):
    """Every base, every modifier: a piece that says less, or another thing, in the process it was
    sent to, where nothing was compiled or kept before. Equality after a pickle does not see that.
    """
    ends_in = {"particles": "cartesian", "rays": "cartesian", "nodes": "image_plane"}
    landmark = ends_in.get(name.rpartition("+")[2], "inverse_scaling")
    slam = make_filter(name, landmark=landmark, **case(world, 2).pieces())
    wanted = ends(world, slam, range(2))
    sent = on_cluster(client, partial(ends, world, slam), [range(2)])
    travelled = [library.loads(library.dumps(slam)) for library in (pickle, cloudpickle)]
    for found in (*(ends(world, again, range(2)) for again in travelled), next(sent)[1]):
        assert [leaf.dtype for leaf in found] == [leaf.dtype for leaf in wanted]
        assert [leaf.tobytes() for leaf in found] == [leaf.tobytes() for leaf in wanted]


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_a_study_on_a_cluster_is_the_same_although_a_worker_is_killed():
    """Whole and in sums, which a worker has added up: here two processes share a study."""
    done = []

    def progress(name, runs):
        done.append(runs)
        if sum(done) == 5 * CHUNK:
            workers[0].send_signal(signal.SIGKILL)
            assert workers[0].wait(30) == -signal.SIGKILL

    with cluster(workers=2) as (client, workers):
        sizes: dict[str, Any] = {"runs": RUNS, "chunk": CHUNK}
        study = jaxslam.monte_carlo(SCENARIO, filters(), **sizes, cluster=client, progress=progress)
        assert len(client.nthreads()) == 1  # it was killed before the end
        sums = jaxslam.monte_carlo(SCENARIO, filters(), **sizes, cluster=client, reduced=True)
    wanted = jaxslam.monte_carlo(SCENARIO, filters(), **sizes)
    assert sum(done) == RUNS
    assert_same(records(study), records(wanted))
    found, expected = (jaxslam.summarise(s)["filters"] for s in (study, wanted))
    for one, other in zip(found.values(), expected.values(), strict=True):
        del one["seconds"], other["seconds"]
    assert found == expected
    wanted = jaxslam.monte_carlo(SCENARIO, filters(), **sizes, reduced=True)
    assert_same(records(sums), records(wanted))


def test_nobody_at_an_address_and_no_extra_are_said_in_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("jaxslam.consistency.cluster.ANSWER_SECONDS", 0.5)

    study = partial(jaxslam.monte_carlo, SCENARIO, runs=2, cluster="tcp://127.0.0.1:9")
    refused(study, "no Dask scheduler answers at 'tcp://127.0.0.1:9'", filters())
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(study, r"needs the cluster extra .* pip install '\.\[cluster\]'$", filters())
