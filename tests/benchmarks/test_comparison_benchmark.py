"""Tests of benchmarks/comparison.py: its page says what its numbers on disk say."""

import json
from pathlib import Path

import comparison as benchmark

FOLDER = Path(__file__).resolve().parents[2]


def on_disk():
    return json.loads((FOLDER / "benchmarks/results/comparison.json").read_text())


def test_the_page_has_the_numbers_on_disk():
    assert (FOLDER / "docs/comparison.md").read_text() == benchmark.page(on_disk())


def test_the_answer_of_the_page_is_that_of_its_numbers():
    for name, found in on_disk()["scenarios"].items():
        nees = {key: one["nees"] for key, one in found.items()}
        scaling = nees["robocentric/inverse_scaling"]
        assert scaling <= 1.01 * min(nees.values())
        assert abs(nees["robocentric/unit_homogeneous"] / scaling - 1) < 0.001
        assert nees["robocentric/inverse_depth"] > scaling
        assert (found["robocentric/cartesian"]["lost"] > 0.5) is (name != "circle")


def test_rows_of_fewer_runs_have_a_mark():
    page = benchmark.page(on_disk())
    row = next(line for line in page.splitlines() if line.startswith("| world image_plane "))
    assert row.count(" †") == 4
    assert "†: fewer runs, 200 instead of 1000." in page
