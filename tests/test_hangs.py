"""Tests of benchmarks/hangs.py: what stands still, and what dies, is noticed."""

import json
import queue
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import hangs

from jaxslam.filters.registry import make_filters


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
    ended, written = [], []
    options = hangs.Options(out=Path("unused"), limit=0.1)
    hangs.tried(cases, 2, options, ended, lambda: written.append(len(ended)))
    assert ended == ["hangs", "exit status -9", "finished", "finished"]
    assert written == [1, 2, 3, 4, 4]


def test_what_is_written_is_gone_on_with(tmp_path, monkeypatch):
    """Only what is not there is tried, and a file of other studies is left as it is."""
    file, asked = tmp_path / "hangs.json", []
    file.write_text('{"studies": 3, "seed": 0, "1 threads": {"ended": ["finished"], "seconds": 5}}')

    def tried(cases, threads, options, ended, save):
        asked.append((threads, len(cases), list(ended)))
        ended += ["finished"] * (len(cases) - len(ended))
        save()

    monkeypatch.setattr(hangs, "tried", tried)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    arguments = ["hangs.py", "--out", str(file), "--threads", "1", "2", "--studies"]
    monkeypatch.setattr(sys, "argv", [*arguments, "3"])
    hangs.main()
    assert asked == [(1, 3, ["finished"]), (2, 3, [])]
    result = json.loads(file.read_text())
    assert result["1 threads"]["ended"] == result["2 threads"]["ended"] == ["finished"] * 3
    assert result["1 threads"]["seconds"] >= 5
    monkeypatch.setattr(sys, "argv", [*arguments, "4"])
    with pytest.raises(ValueError, match="of other studies"):
        hangs.main()
    assert json.loads(file.read_text()) == result


def test_all_that_is_drawn_goes_together(unchecked):
    draw = np.random.default_rng(1)
    for case in (hangs.drawn(draw) for _ in range(20)):
        assert make_filters(case.scenario, [case.filter], [case.landmark])
