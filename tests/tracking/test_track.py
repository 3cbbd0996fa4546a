"""What `track` writes: which files, in which order, whatever goes wrong on the way."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tqdm.auto

pytest.importorskip("cv2")

import cv2

from jaxslam.cli.track import TrackOptions
from jaxslam.io.calibration import from_field_of_view
from jaxslam.tracking import overlay, summary
from jaxslam.tracking import video as tracking
from jaxslam.tracking.focal import BetterLens
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker

SETTINGS = TrackerSettings(filter="world", wanted=12, spare=4)
NUMBERS = {"trajectory.txt", "covariance.txt", "frames.csv", "summary.json", "map.npz"}
FIGURES = {"map.ply", "map.png"}


def small(frames):
    return synthetic_source(frames=frames, width=160, height=120)


def names(folder):
    return {path.name for path in folder.iterdir()}


def length(T_wc):
    """Of the path."""
    return np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1).sum()


def fail(*_, **__):
    raise ValueError("cannot draw")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "in_doubt"), [("scale_gauge+mixture3", True), ("world", False)])
def test_a_filter_with_a_unit_of_its_own_says_so_beside_its_covariances(tmp_path, name, in_doubt):
    tracking.track(small(3), tmp_path, replace(SETTINGS, filter=name), overlay=False)
    header = (tmp_path / "covariance.txt").read_text().splitlines()[0]
    assert ("uncertain by sigma_log_scale (frames.csv)" in header) == in_doubt
    titles, *_, last = (tmp_path / "frames.csv").read_text().splitlines()
    last = dict(zip(titles.split(","), last.split(","), strict=True))
    assert (last["sigma_log_scale"] != "") == in_doubt


def test_numbers_are_there_before_a_figure_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "plot_map", fail)
    with pytest.raises(ValueError, match="cannot draw"):
        tracking.track(small(3), tmp_path, SETTINGS, overlay=False)
    assert names(tmp_path) == NUMBERS | {"map.ply"}
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 3


def test_an_overlay_that_cannot_be_drawn_ends_the_run_and_leaves_the_files(tmp_path, monkeypatch):
    monkeypatch.setattr(overlay, "draw_overlay", fail)
    with pytest.raises(ValueError, match="cannot draw"):
        tracking.track(small(3), tmp_path, SETTINGS)
    assert names(tmp_path) == NUMBERS | FIGURES


def test_the_map_shows_the_reference_in_its_own_frame_and_unit(tmp_path, monkeypatch):
    """Of the frames tracked; the trajectory's error is the rest, in the reference's unit."""
    drawn = {}
    monkeypatch.setattr(tracking, "plot_map", lambda *data, **more: drawn.update(more, data=data))
    whole, source = small(40), small(12)
    written = tracking.track(
        replace(source, reference=whole.reference), tmp_path, SETTINGS, overlay=False
    )
    estimate, reference = drawn["data"][0], drawn["reference"]
    assert estimate.shape == reference.shape
    # One factor between the lengths of the two worlds, and no turn between their shapes.
    ate, true = written["ate"], whole.reference
    assert true is not None
    scale = length(true.T_wc[:12]) / length(reference)
    error = scale * (estimate - reference)[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(ate["rmse"], rel=1e-6)
    assert drawn["lost"] == [False] * 12


def test_without_a_reference_that_fits_the_map_is_drawn_all_the_same(tmp_path):
    source = small(3)
    assert source.reference is not None
    late = source.reference._replace(times=source.reference.times + 100)
    written = tracking.track(replace(source, reference=late), tmp_path, SETTINGS, overlay=False)
    assert "0 poses" in written["no_ate"]
    assert names(tmp_path) == NUMBERS | FIGURES


def test_a_video_in_which_nothing_is_seen_is_told_so(tmp_path):
    source = small(4)

    def black():
        for image in source.images():
            yield np.zeros_like(image)

    written = tracking.track(replace(source, images=black), tmp_path, SETTINGS, overlay=False)
    told = summary.describe(written)
    assert "no map could be started: none of its 4 frames" in told
    assert "nan" not in told


def test_an_interruption_of_the_start_waits_for_no_program(tmp_path, monkeypatch):
    def stop(frames):
        raise KeyboardInterrupt

    monkeypatch.setattr(tracking, "_write", fail)
    with pytest.raises(KeyboardInterrupt):
        tracking.track(small(3), tmp_path, SETTINGS, progress=stop)
    assert not names(tmp_path)


def test_what_ends_before_a_frame_is_timed_leaves_the_files_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking.Aside, "give", fail)
    with pytest.raises(ValueError, match="cannot draw"):
        tracking.track(small(3), tmp_path, SETTINGS)
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 1


@pytest.mark.parametrize(("left", "said"), [(0.5, True), (0.9, False)])
def test_a_focal_length_that_does_not_fit_is_told(tmp_path, monkeypatch, left, said):
    found = BetterLens(1 / 1.2, -0.1, np.array([0.01, 0.02]), left)
    monkeypatch.setattr(summary, "better_lens", lambda *_: found)
    written = tracking.track(small(3), tmp_path, SETTINGS, overlay=False)
    told = "LENS: fx 109 and k1 -0.100 fit the matches better than the given 131 and 0.000: "
    told += "they reduce the squared errors by 50%"
    assert (told in summary.describe(written)) == said
    assert ("better_lens" in written["calibration"]) == said


def test_a_distortion_that_nobody_told_is_told_loudly(tmp_path, monkeypatch):
    found = BetterLens(1.01, -0.08, np.array([0.01, 0.02]), 0.4)
    monkeypatch.setattr(summary, "better_lens", lambda *_: found)
    written = tracking.track(small(3), tmp_path, SETTINGS, overlay=False)
    assert "LENS DISTORTION: fx 133 and k1 -0.080 fit" in summary.describe(written)
    assert written["calibration"]["better_lens"]["k1"] == -0.08
    assert written["calibration"]["better_lens"]["distortion"]


def test_a_focal_length_that_is_estimated_is_not_tried(monkeypatch):
    monkeypatch.setattr(summary, "better_lens", fail)
    guessed = Tracker(from_field_of_view(160, 120), SETTINGS)
    nothing = Points(*[np.zeros(0, int)] * 3, np.zeros((0, 3)), *[np.zeros((0, 3, 3))] * 2)
    assert "better_lens" not in summary._calibration(guessed, [], nothing)


def test_what_was_estimated_of_a_lens_is_told_by_name_with_its_sigma():
    guessed = Tracker(from_field_of_view(160, 120), SETTINGS)
    lens = summary._lens(guessed)
    assert list(lens) == ["fx", "fy", "cx", "cy", "k1", "k2"]
    assert lens["k1"] == {"value": 0.0, "sigma": pytest.approx(0.15)}
    known = replace(SETTINGS, calibration="known")
    assert summary._lens(Tracker(small(1).calibration, known)) == {}


def test_a_camera_that_turned_on_the_spot_is_told_its_orientation_error(tmp_path):
    source = small(4)
    assert source.reference is not None
    still = source.reference.T_wc.copy()
    still[:, :3, 3] = 0
    reference = source.reference._replace(T_wc=still)
    written = tracking.track(
        replace(source, reference=reference), tmp_path, SETTINGS, overlay=False
    )
    assert 0 < written["orientation_rmse"] < 1
    told = "coincide; an alignment by Sim(3) needs motion; orientation "
    told += f"error {written['orientation_rmse']:.2f}°"
    assert told in summary.describe(written)


def test_the_command_says_that_it_compiles_and_hands_over_what_is_wanted(monkeypatch, capsys):
    said, asked = [], {}

    class Bar(tqdm.tqdm):
        def __init__(self, **options):
            super().__init__(**options)
            said.append(self.desc)

        def set_description(self, desc=None, refresh=True):
            said.append((self.n, desc))

    def tracked(source, out, settings, *, progress, **more):
        asked.update(more)
        for _ in range(5):
            progress(1)
        return {}

    monkeypatch.setattr(tqdm.auto, "tqdm", Bar)
    monkeypatch.setattr(tracking, "track", tracked)
    monkeypatch.setattr(summary, "describe", str)
    TrackOptions(overlay=False, viewer=Path("seen.rrd"), frames=5).run()
    assert said == ["compiling …", (summary.WARM_UP, "tracking")]
    assert (asked["overlay"], asked["viewer"]) == (False, Path("seen.rrd"))
    printed = capsys.readouterr().out
    assert "summary.json" in printed
    assert "seen.rrd" in printed
    assert "overlay.mp4" not in printed


def test_the_pixels_of_a_target_are_those_of_the_pictures_as_they_are(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((30, 1400), np.uint8))
    asked = TrackOptions(tmp_path, fov=60.0, target=tmp_path / "target.json")
    assert asked._source().calibration.width == 1400
    assert replace(asked, scale=0.5)._source().calibration.width == 700
    with pytest.warns(UserWarning, match="1/2 of their size"):
        assert replace(asked, target=None)._source().calibration.width == 700
