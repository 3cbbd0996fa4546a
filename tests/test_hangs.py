"""Tests of benchmarks/hangs.py: what stands still, and what dies, is noticed."""

import queue
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import hangs

from jaxslam.names import make_filters


def process(alive: bool) -> SimpleNamespace:
    return SimpleNamespace(is_alive=lambda: alive, exitcode=-9)


def test_what_is_told_is_heard():
    told = queue.Queue()
    told.put((3, "finished"))
    assert hangs.heard(told, process(True), limit=60.0) == (3, "finished")


def test_silence_has_a_limit():
    assert hangs.heard(queue.Queue(), process(True), limit=0.1) is None


def test_a_process_that_died_is_not_waited_for():
    assert hangs.heard(queue.Queue(), process(False), limit=1e9) is None


def test_a_study_that_hangs_and_one_that_dies_cost_no_other(monkeypatch):
    """A process tells what it begins; the first hangs, the second dies, the third does the rest."""
    cases = [hangs.Case("matched", f"filter{i}", "inverse_scaling") for i in range(4)]
    alive = iter([True, False, True])

    class Context:
        Queue = queue.Queue

        def Process(self, target, args):
            told, _, left, *_ = args
            lives = next(alive)
            whole = len(left) == 2
            for number, _ in left if whole else left[:1]:
                told.put((number, None))
                if whole:
                    told.put((number, "finished"))
            return SimpleNamespace(
                start=lambda: None, kill=lambda: None, join=lambda: None, **vars(process(lives))
            )

    monkeypatch.setattr(hangs.multiprocessing, "get_context", lambda how: Context())
    monkeypatch.setenv("NPROC", "8")
    ended = hangs.tried(cases, 2, hangs.Options(out=Path("unused"), limit=0.1))
    assert ended == {0: "hangs", 1: "exit status -9", 2: "finished", 3: "finished"}


def test_all_that_is_drawn_goes_together(unchecked):
    draw = np.random.default_rng(1)
    for case in (hangs.drawn(draw) for _ in range(20)):
        assert make_filters(case.scenario, [case.filter], [case.landmark])
