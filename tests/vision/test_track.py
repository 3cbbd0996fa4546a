"""What `track` writes: which files, in which order, whatever goes wrong on the way."""

import json

import pytest

pytest.importorskip("cv2")

from jaxslam.vision import track as tracking
from jaxslam.vision.settings import TrackerSettings
from jaxslam.vision.synthetic import synthetic_source

SETTINGS = TrackerSettings(wanted=10, spare=4)
NUMBERS = {"trajectory.txt", "covariance.txt", "frames.csv", "summary.json"}
FIGURES = {"map.ply", "map.png"}


def small(frames):
    return synthetic_source(frames=frames, width=160, height=120)


def names(folder):
    return {path.name for path in folder.iterdir()}


def fail(*_, **__):
    raise ValueError("cannot draw")


def test_the_overlay_can_be_left_out(tmp_path):
    tracking.track(small(3), tmp_path, SETTINGS, overlay=False)
    assert names(tmp_path) == NUMBERS | FIGURES


def test_numbers_are_there_before_a_figure_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "plot_map", fail)
    with pytest.raises(ValueError, match="cannot draw"):
        tracking.track(small(3), tmp_path, SETTINGS, overlay=False)
    assert names(tmp_path) == NUMBERS | {"map.ply"}
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 3


def test_an_overlay_that_cannot_be_drawn_ends_the_run_and_leaves_the_files(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "draw_overlay", fail)
    with pytest.raises(ValueError, match="cannot draw"):
        tracking.track(small(3), tmp_path, SETTINGS)
    assert names(tmp_path) == NUMBERS | FIGURES
