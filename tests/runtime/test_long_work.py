"""Tests of work that takes long: what it tells, and what is left of it when it is killed."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from jaxslam.cli import main

KILLS = 2
"""In the tests; `python tests/runtime/test_long_work.py 20` does twenty."""
COMMAND = [
    "consistency", "--scenario", "matched-tight", "--landmarks", "inverse_scaling", "--steps", "5",
    "--set", "landmarks=3", "--runs", "600", "--chunk", "10",
]  # fmt: skip


def started(out, *arguments):
    command = [sys.executable, "-m", "jaxslam.cli", *COMMAND, "--out", str(out), *arguments]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def chunks(out):
    return sorted(path.name for path in out.glob("runs/*/[0-9]*.npz"))


def killed_at_random(out, seed, kills):
    """The study, killed so often after a random number of chunks more and resumed; how many
    chunks were there at every kill."""
    choose, found = random.Random(seed), []
    for _ in range(kills):
        wanted = min(60, len(chunks(out)) + choose.randint(1, 60 // kills))
        process = started(out, "--resume")
        while process.poll() is None and len(chunks(out)) < wanted:
            time.sleep(0.001)
        time.sleep(choose.uniform(0, 0.02))
        process.send_signal(choose.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGINT]))
        process.wait(120)
        found.append(len(chunks(out)))
    return found


def assert_resumes_to_the_same(folder, seed, kills):
    main([*COMMAND, "--out", str(folder / "whole")])
    found = killed_at_random(folder / "killed", seed, kills)
    assert found == sorted(found)  # nothing that was kept is lost
    main([*COMMAND, "--out", str(folder / "killed"), "--resume"])
    whole, killed = (json.loads((folder / x / "consistency.json").read_text()) for x in _BOTH)
    for summary in (whole, killed):
        for of_filter in summary["filters"].values():
            del of_filter["seconds"]
    assert whole == killed
    assert not list(folder.glob("killed/runs/*/.*"))  # nor is anything half written left
    return found


_BOTH = ("whole", "killed")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_study_that_is_killed_resumes_to_the_same(tmp_path, monkeypatch):
    told = jax.config.values["jax_compilation_cache_dir"]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", told or str(tmp_path / "programs"))
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")
    found = assert_resumes_to_the_same(tmp_path, 0, KILLS)
    assert any(0 < count < 60 for count in found)  # it was killed in mid-study


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        many = int(sys.argv[1])
        print(many, "kills, chunks there:", assert_resumes_to_the_same(Path(name), many, many))
