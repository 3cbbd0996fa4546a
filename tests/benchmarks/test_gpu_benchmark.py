"""Tests of benchmarks/speed/gpu.py, on the CPU: what is measured, compared, left out and shown."""

import dataclasses
import json
from functools import cache

import jax
import pytest

from benchmarks.benchmark import END
from benchmarks.speed import gpu
from benchmarks.speed.gpu import BEGIN, OnGpu, shown
from benchmarks.speed.workload import WORKLOADS

drawn_once = cache(gpu.prepared)


@pytest.fixture
def small(tmp_path, monkeypatch):
    """The benchmark, so small that its programs are compiled soon."""
    monkeypatch.setattr(gpu, "prepared", drawn_once)
    monkeypatch.setitem(WORKLOADS, "A", dataclasses.replace(WORKLOADS["A"], landmarks=3))
    (tmp_path / "speed.md").write_text(f"{BEGIN}\n\n{END}\n")
    with jax.enable_x64(True):
        yield OnGpu(
            device="cpu", workloads=("A",), dtypes=("float64",), batches=(2, 6), drawn=4, steps=2,
            studies=(), mixture_runs=0, repeats=1, out=tmp_path / "gpu.json", docs=tmp_path,
        )  # fmt: skip


@pytest.mark.slow
def test_everything_is_measured_and_compared_with_the_processors(small):
    """Keys of the page that only studies and the mixture fill in, and wrong records of a batch."""
    dataclasses.replace(
        small, dtypes=("float64", "float32"), studies=(4, 6), chunk=4, study_steps=2,
        mixture_runs=2,
    )()  # fmt: skip
    found = json.loads(small.out.read_text())
    of = found["filters"]["A"]["float64"]
    assert list(of["device"]) == ["2", "6"]
    for row in of["device"].values():
        assert row["microseconds_per_step"] > 0
        assert row["bytes_per_run"] > 15**2 * 8
        assert row["largest_difference"] < gpu.AGREEMENT
    assert of["processors"]["xla"] > 0
    assert found["left_out"] == []
    assert {"4", "6", "processors_xla"} <= found["studies"].keys()
    assert found["recommended"]["relative"] > 0
    assert found["float32_beside_float64"]["whole_products"]["nees_of_no_covariance"] == 0
    page = (small.docs / "speed.md").read_text()
    assert "| 6 runs at once |" in page
    assert "on the device, chunks of 4 | 6 |" in page


@pytest.mark.slow
def test_other_numbers_than_the_cpu_s_end_in_an_error_when_all_is_measured(small, monkeypatch):
    """A device that computes wrongly would be shown as fast."""
    monkeypatch.setattr(gpu, "compiler", lambda: None)  # XLA alone
    monkeypatch.setattr(gpu, "AGREEMENT", 0.0)
    with pytest.raises(ValueError, match=r"not the same results.*'A, 6 runs'"):
        small()
    assert len(json.loads(small.out.read_text())["filters"]["A"]["float64"]["device"]) == 2


@pytest.mark.parametrize(
    ("fields", "left", "why"),
    [
        ({"bytes_per_run": 2**30}, 99.0, "needs about 6 GiB of 4"),
        ({"seconds": 9.0}, 99.0, "a call would take about 27 s"),
        ({"compile_seconds": 9.0}, 9.0, "no time left"),
        ({}, 9.0, None),
    ],
)
def test_what_is_too_large_is_left_out_and_it_is_said_why(monkeypatch, fields, left, why):
    monkeypatch.setattr(gpu, "memory_of", lambda device: 2**32)
    last = {"runs": 2, "seconds": 0.1, "bytes_per_run": 9, "compile_seconds": 1.0} | fields
    assert OnGpu().too_much(last, 6, jax.devices()[0], lambda: left) == why
    row = {"microseconds_per_step": 1.0, "compile_seconds": 2.0, "largest_difference": 0.0}
    of = {"device": {"2": row, "6": why or "no time left"}}
    told = shown({"filters": {"A": {"float64": of}}, "left_out": [], "processors": 3})
    assert "| 2 runs at once | 1 |" in told
    assert "| 6 runs at once | – |" in told


def test_after_its_time_nothing_more_is_begun(small):
    dataclasses.replace(small, minutes=0.0)()
    left = json.loads(small.out.read_text())["left_out"]
    assert left == [f"{name}: no time left" for name in ("A, float64", "studies", "recommended")]
    assert "Not measured yet." in (small.docs / "speed.md").read_text()
