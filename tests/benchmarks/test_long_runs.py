"""Tests of benchmarks/long_runs.py: what is drawn is what was measured."""

import json
from pathlib import Path
from typing import Any

import long_runs
import numpy as np
import PIL.Image
import pytest

from jaxslam.plots.style import drawn

ROOT = Path(__file__).resolve().parents[2]


def test_the_stored_figure_is_of_the_stored_runs():
    found = long_runs.LongRuns().found()
    with PIL.Image.open(ROOT / "docs/long-runs.png") as picture:
        assert json.loads(picture.info["Drawn"]) == json.loads(drawn(long_runs.drawn_of(found)))


def test_the_mean_is_drawn_of_every_filter():
    row = {"at": [10, 30], "nees": [3.0, 4.5], "runs": 7}
    (axes,) = long_runs.drawn_of({"laps-thrown": {"world": row, "invariant": row}}).axes
    lines = axes.get_lines()[1:]  # behind that of the ideal
    assert [line.get_label() for line in lines] == ["world", "invariant"]
    np.testing.assert_array_equal(lines[0].get_xydata(), [[10, 3.0], [30, 4.5]])
    assert "7 runs" in axes.get_title()


@pytest.mark.slow
def test_numbers_are_kept_of_some_steps(tmp_path):
    """Numbers of another step than the one that they are said to be of."""
    few: dict[str, Any] = {"scenarios": ("laps-thrown",), "filters": ("robocentric",), "steps": 12}
    few["with_odometry"] = ()
    long_runs.LongRuns(**few, runs=2, chunk=2, out=tmp_path / "x.json", docs=tmp_path)()
    row = json.loads((tmp_path / "x.json").read_text())["laps-thrown"]["robocentric"]
    assert row["at"] == [10, 11, 12]
    assert len(row["nees"]) == len(row["nees_median"]) == len(row["lost"]) == 3
    assert (tmp_path / "long-runs.png").exists()
