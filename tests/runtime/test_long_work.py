"""Tests of work that takes long: what it tells, and what is left of it when it is killed."""

import json
import random
import signal
import subprocess
import sys
import time

import jax
import pytest

from jaxslam.cli import main

COMMAND = [
    "consistency", "--scenario", "matched-tight", "--landmarks", "inverse_scaling", "--steps", "5",
    "--set", "landmarks=3", "--runs", "600", "--chunk", "10",
]  # fmt: skip


def started(out, *arguments):
    command = [sys.executable, "-m", "jaxslam.cli", *COMMAND, "--out", str(out), *arguments]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def chunks(out):
    return sorted(path.name for path in out.glob("runs/*/[0-9]*.npz"))


def killed_at_random(out, kills):
    """The study, killed so often after a random number of chunks more and resumed; how many
    chunks were there at every kill."""
    choose, found = random.Random(0), []
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


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_study_that_is_killed_resumes_to_the_same(tmp_path, monkeypatch):
    told = jax.config.values["jax_compilation_cache_dir"]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", told or str(tmp_path / "programs"))
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    main([*COMMAND, "--out", str(whole)])
    found = killed_at_random(killed, kills=2)
    assert found == sorted(found)  # nothing that was kept is lost
    assert any(0 < count < 60 for count in found)  # it was killed in mid-study
    main([*COMMAND, "--out", str(killed), "--resume"])
    told = [json.loads((out / "consistency.json").read_text()) for out in (whole, killed)]
    for summary in told:
        for of_filter in summary["filters"].values():
            del of_filter["seconds"]
    assert told[0] == told[1]
    assert not list(killed.glob("runs/*/.*"))  # nor is anything half written left
