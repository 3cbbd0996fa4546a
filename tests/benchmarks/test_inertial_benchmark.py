"""Tests of benchmarks/inertial.py: the stored table, and that nothing is measured twice."""

import json
from pathlib import Path

import inertial
import numpy as np
import pytest

STORED = Path(__file__).resolve().parents[2] / "benchmarks/results/inertial.json"


def test_the_stored_runs_are_consistent_to_the_end_where_the_page_says_so():
    found = json.loads(STORED.read_text())["udel_gore"]
    for name, row in found.items():
        assert (row["runs"], row["steps"]) == (100, 1600)
        for part in inertial.PARTS:
            for of in inertial.TOLD:
                mean, low, high = row[part][of]
                assert low < mean < high
                if name in ("robocentric", "invariant"):
                    assert low < 1.05
                    assert high > 0.95
    assert found["robocentric"]["lost"] == 0


@pytest.mark.slow
def test_what_was_measured_is_not_measured_again(tmp_path, monkeypatch, shared_data):
    """Would catch NEES that is of other blocks of the covariance."""
    monkeypatch.setenv("JAXSLAM_DATA", str(shared_data))
    few = inertial.Inertial(
        trajectories=("udel_gore",), filters=("robocentric",), runs=8, steps=30, chunk=8,
        out=tmp_path / "x.json", docs=tmp_path,
    )  # fmt: skip
    few()
    row = json.loads(few.out.read_text())["udel_gore"]["robocentric"]
    assert all(0.3 < row[part]["last"][0] < 3 for part in inertial.PARTS)
    assert np.isfinite(row["position"]["rmse"])
    assert not list(few.measure())
