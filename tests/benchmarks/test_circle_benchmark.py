"""Tests of benchmarks/circle.py: what it stores is of the study that it draws."""

import json

import circle
import PIL.Image
import pytest


@pytest.mark.slow
def test_what_is_stored_is_of_the_figure_and_of_the_first_runs(tmp_path):
    """A record of other runs than are drawn would let an old figure pass for a new one."""
    circle.Circle(
        runs=6, printed=4, seeds=(3, 5), steps=3, out=tmp_path / "x.json", docs=tmp_path
    )()
    found = json.loads((tmp_path / "x.json").read_text())
    with PIL.Image.open(tmp_path / "consistency.png") as picture:
        assert json.loads(picture.info["Drawn"]) == found["drawn"]
    assert "circle, 6 runs, seed 3;" in found["drawn"]["title"]
    assert list(found["printed"]) == list(found["verdicts"])
    for name, verdicts in found["verdicts"].items():
        assert list(verdicts) == ["3", "5"]
        assert found["printed"][name] not in found["drawn"]["title"]  # of fewer runs
