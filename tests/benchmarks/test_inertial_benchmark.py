"""Test of benchmarks/inertial.py: NEES is of the blocks of its covariance."""

import json

import inertial
import numpy as np
import pytest


@pytest.mark.slow
def test_orientation_and_position_are_judged_each_by_its_own_block(
    tmp_path, monkeypatch, shared_data
):
    """NEES that is of other blocks of the covariance."""
    monkeypatch.setenv("JAXSLAM_DATA", str(shared_data))
    few = inertial.Inertial(
        trajectories=("udel_gore",), filters=("robocentric",), runs=8, steps=30, chunk=4,
        out=tmp_path / "x.json", docs=tmp_path,
    )  # fmt: skip
    few()
    row = json.loads(few.out.read_text())["udel_gore"]["robocentric"]
    assert all(0.3 < row[part]["last"][0] < 3 for part in inertial.PARTS)
    assert np.isfinite(row["position"]["rmse"])
