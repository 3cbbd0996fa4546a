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
    return OnGpu(
        device="cpu", workloads=("A",), dtypes=("float64",), batches=(2, 6), drawn=4, steps=2,
        studies=(), mixture_runs=0, repeats=1, out=tmp_path / "gpu.json", docs=tmp_path,
    )  # fmt: skip


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.mark.slow
def test_batches_are_timed_and_compared_with_the_processors(small):
    """Against the native backend too, which is compiled; quickly a batch is timed below."""
    small()
    found = json.loads(small.out.read_text())
    of = found["filters"]["A"]["float64"]
    assert list(of["device"]) == ["2", "6"]
    for row in of["device"].values():
        assert row["microseconds_per_step"] > 0
        assert row["bytes_per_run"] > 15**2 * 8
        assert row["largest_difference"] < gpu.AGREEMENT
    assert of["processors"]["xla"] > 0
    page = (small.docs / "speed.md").read_text()
    assert "| 6 runs at once |" in page


@pytest.mark.slow
def test_other_numbers_than_the_cpu_s_end_in_an_error_when_all_is_measured(small, monkeypatch):
    """A device that computes wrongly would be shown as fast."""
    monkeypatch.setattr(gpu, "compiler", lambda: None)  # XLA alone
    monkeypatch.setattr(gpu, "AGREEMENT", 0.0)
    with pytest.raises(ValueError, match=r"not the same results.*'A, 6 runs'"):
        small()
    assert len(json.loads(small.out.read_text())["filters"]["A"]["float64"]["device"]) == 2


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        pytest.param({"call_seconds": 1e-9}, "a call would take", marks=pytest.mark.slow),
        ({}, "needs about"),
    ],
)
def test_what_is_too_large_is_left_out_and_it_is_said_why(small, monkeypatch, limits, why):
    monkeypatch.setattr(gpu, "compiler", lambda: None)  # XLA alone
    if not limits:
        monkeypatch.setattr(gpu, "memory_of", lambda device: 2**10)
    dataclasses.replace(small, **limits)()
    found = json.loads(small.out.read_text())["filters"]["A"]["float64"]["device"]
    assert found["2"]["microseconds_per_step"] > 0
    assert found["2"]["largest_difference"] < gpu.AGREEMENT
    assert why in found["6"]
    page = (small.docs / "speed.md").read_text()
    assert "| 6 runs at once | – |" in page


def test_after_its_time_nothing_more_is_begun(small):
    dataclasses.replace(small, minutes=0.0)()
    left = json.loads(small.out.read_text())["left_out"]
    assert left == [f"{name}: no time left" for name in ("A, float64", "studies", "recommended")]
    assert "Not measured yet." in (small.docs / "speed.md").read_text()


@pytest.mark.slow
def test_studies_and_products_of_single_precision_are_measured_too(small):
    """Keys of the page that only studies and the mixture fill in."""
    whole = dataclasses.replace(
        small, dtypes=("float64", "float32"), batches=(2,), studies=(4, 6), chunk=4, study_steps=2,
        mixture_runs=2,
    )  # fmt: skip
    whole()
    found = json.loads(small.out.read_text())
    assert found["left_out"] == []
    assert {"4", "6", "processors_xla"} <= found["studies"].keys()
    assert found["recommended"]["relative"] > 0
    assert found["float32_beside_float64"]["whole_products"]["nees_of_no_covariance"] == 0
    assert "on the device, chunks of 4 | 6 |" in shown(found)
