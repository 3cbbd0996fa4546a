"""What `track` writes, whatever goes wrong on the way, and what it says."""

import csv
import json
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam._runtime.files import append_whole
from jaxslam.cli.track import TrackOptions
from jaxslam.io.tum import read_tum
from jaxslam.tracking import estimator as programs
from jaxslam.tracking import overlay, report, summary
from jaxslam.tracking import video as tracking
from jaxslam.tracking.focal import BetterLens
from jaxslam.tracking.places.smoothing import smoothed
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker

SETTINGS = TrackerSettings(filter="world", wanted=12, spare=4)
TEXTS = {"trajectory.txt", "frames.csv"}
NUMBERS = TEXTS | {"covariance.txt", "map.npz"}
ALL = NUMBERS | {"summary.json", "map.ply", "map.png"}


def small(frames):
    return synthetic_source(frames=frames, width=160, height=120)


def tracked(source, out, **how):
    return tracking.track(source, out, SETTINGS, overlay=False, **how)


def names(folder):
    return {path.name for path in folder.iterdir()}


def rows_of(out):
    with (out / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def frames_in(out):
    """How many frames the trajectory and the table have."""
    count = len(rows_of(out))
    assert len(read_tum(out / "trajectory.txt")[0]) == count
    return count


def fail(*_, **__):
    raise np.linalg.LinAlgError("no such numbers")


# --- what is there, whatever ends it --------------------------------------------------------------


@pytest.mark.parametrize(
    ("owner", "name", "left", "frames"),
    [
        (tracking, "plot_map", ALL - {"map.png"}, 3),
        (overlay, "draw_overlay", ALL, None),  # as many as were tracked until it was noticed
        (tracking.Aside, "give", ALL, 1),
        (Tracker, "smoothed", ALL, 3),
        (tracking, "summarised", NUMBERS, 3),
    ],
)
def test_what_fails_ends_the_run_and_leaves_the_files_before_it(
    owner, name, left, frames, tmp_path, monkeypatch
):
    monkeypatch.setattr(owner, name, fail)
    with pytest.raises(np.linalg.LinAlgError, match="no such numbers"):
        tracking.track(small(3), tmp_path, SETTINGS)
    assert names(tmp_path) - {"overlay.mp4"} == left
    assert frames_in(tmp_path) == (frames or frames_in(tmp_path))
    if "summary.json" in left:
        told = json.loads((tmp_path / "summary.json").read_text())
        assert told["frames"] == frames_in(tmp_path)


@pytest.mark.parametrize("after", [1, 3])
def test_an_interruption_leaves_the_files_of_the_frames_so_far(after, tmp_path, monkeypatch):
    """That of the start waits for no program."""
    counts = []

    def look(_):
        if names(tmp_path):
            assert names(tmp_path) == TEXTS
            counts.append(frames_in(tmp_path))
        if len(counts) == after - 1:
            raise KeyboardInterrupt

    if after == 1:
        monkeypatch.setattr(tracking, "_write", fail)
    told = "has the files of the 3 frames" if after > 1 else None
    with pytest.raises(KeyboardInterrupt, match=told):
        tracked(small(20), tmp_path, progress=look)
    assert counts == list(range(2, after + 1))
    assert names(tmp_path) == (ALL if after > 1 else set())


KILLED = """
import os, signal, sys
from pathlib import Path
from jaxslam.tracking import video
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked
from jaxslam.tracking.synthetic import synthetic_source
assert "rerun" not in sys.modules  # which only a recording needs

class Still:
    def __init__(self, *_):
        self.seen = 0
    def track(self, frame):
        self.seen += 1
        if self.seen == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return Tracked(frame.index, frame.time, PoseWithCovariance())

video.Tracker = Still
video.track(synthetic_source(9, width=160, height=120), Path(sys.argv[1]), overlay=False)
"""


def test_a_process_that_is_killed_leaves_what_was_tracked_before(tmp_path):
    ended = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], cwd=Path.cwd())
    assert ended.returncode == -signal.SIGKILL
    assert frames_in(tmp_path) == 4


def test_a_line_for_which_there_is_no_room_is_not_begun(tmp_path):
    path, (soft, hard) = tmp_path / "t.txt", resource.getrlimit(resource.RLIMIT_FSIZE)
    append_whole(path, "a" * 59 + "\n")
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.raises(OSError, match="No space left"):
            append_whole(path, "b" * 59 + "\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_text() == "a" * 59 + "\n"


@pytest.mark.parametrize(("name", "until"), [("_correct", 1), ("_correct", 99), ("_predict", 99)])
def test_a_pose_that_is_not_finite_is_a_lost_frame_and_the_run_goes_on(
    name, until, tmp_path, monkeypatch
):
    """From frame 3 on the filter's steps make no numbers, once or for ever."""
    whole, broken, frames = getattr(programs, name), 0, 0

    def step(*arguments):
        nonlocal broken
        made = whole(*arguments)
        if frames < 3 or broken >= until:
            return made
        broken += 1
        return jax.tree.map(lambda x: x * np.nan if x.dtype == float else x, made)

    def count(more):
        nonlocal frames
        frames += more

    monkeypatch.setattr(programs, name, step)
    written = tracked(small(6), tmp_path, progress=count)
    assert frames_in(tmp_path) == 6
    reasons = [row["reason"] for row in rows_of(tmp_path)]
    assert reasons[:4] == ["", "", "", "not finite"]
    assert (reasons[4:] == ["", ""]) == (until == 1)
    assert written["failed_updates"]["not_finite"] == reasons.count("not finite")
    assert "1 not finite" in summary.describe(written) or until > 1


@pytest.mark.usefixtures("unchecked")
def test_a_map_that_cannot_be_smoothed_stays_as_it_was_tracked():
    """Submaps and loops can leave an information matrix that is singular."""
    solved = SimpleNamespace(T_bc=np.full((2, 4, 4), np.nan), covariances=np.zeros((2, 6, 6)))
    map = SimpleNamespace(number=3, submaps=("one",), graph=lambda *_: graph)
    graph = SimpleNamespace(solved=lambda: solved)
    estimator = SimpleNamespace(settings=None, slam=None)
    points, history = object(), [report.Tracked(0, 0.0, PoseWithCovariance())]
    state: Any = SimpleNamespace(map=map, estimator=estimator, known=list, points=lambda: points)
    with pytest.warns(UserWarning, match="map 3 cannot be smoothed"):
        assert smoothed(state, history) == (history, points)


# --- what the summary says ------------------------------------------------------------------------


def length(T_wc):
    """Of the path."""
    return np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1).sum()


def test_the_map_shows_the_reference_in_its_own_frame_and_unit(tmp_path, monkeypatch):
    """Of the frames tracked; the trajectory's error is the rest, in the reference's unit."""
    drawn = {}
    monkeypatch.setattr(tracking, "plot_map", lambda *data, **more: drawn.update(more, data=data))
    true = small(40).reference
    assert true is not None
    written = tracked(replace(small(12), reference=true), tmp_path)
    estimate, reference = drawn["data"][0], drawn["reference"]
    assert estimate.shape == reference.shape
    # One factor between the lengths of the two worlds, and no turn between their shapes.
    scale = length(true.T_wc[:12]) / length(reference)
    error = scale * (estimate - reference)[:, :3, 3]
    rmse = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert rmse == pytest.approx(written["ate"]["rmse"], rel=1e-6)
    assert drawn["lost"] == [False] * 12


def test_without_a_reference_that_fits_the_map_is_drawn_all_the_same(tmp_path):
    source = small(3)
    assert source.reference is not None
    late = source.reference._replace(times=source.reference.times + 100)
    written = tracked(replace(source, reference=late), tmp_path)
    assert "0 poses" in written["no_ate"]
    assert names(tmp_path) == ALL


@pytest.fixture(scope="module")
def told():
    """What the summary says of four frames of a source, or of one without or of another truth."""
    own = small(4)
    tracker = Tracker(own.calibration, SETTINGS)
    history = [tracker.track(frame) for frame in own]

    def describe(source=own):
        found = summary.summarised(source, tracker, history, tracker.points(), [0.1] * 4)
        return found, summary.describe(found)

    return describe


@pytest.mark.parametrize(
    ("left", "distortion", "said"),
    [
        (0.5, False, "LENS: fx 109 and k1 -0.100 fit the matches better than the given 131 and"),
        (0.9, False, ""),
        (0.4, True, "LENS DISTORTION: fx 133 and k1 -0.100 fit"),
    ],
)
def test_a_lens_that_does_not_fit_is_told(told, monkeypatch, left, distortion, said):
    found = BetterLens(1.01 if distortion else 1 / 1.2, -0.1, np.array([0.01, 0.02]), left)
    monkeypatch.setattr(summary, "better_lens", lambda *_: found)
    written, words = told()
    assert ("better_lens" in written["calibration"]) == bool(said)
    assert said in words
    assert (f"they reduce the squared errors by {1 - left:.0%}" in words) == bool(said)
    if said:
        assert written["calibration"]["better_lens"]["k1"] == -0.1
        assert bool(written["calibration"]["better_lens"]["distortion"]) == distortion


def test_a_camera_that_turned_on_the_spot_is_told_its_orientation_error(told):
    source = small(4)
    assert source.reference is not None
    still = source.reference.T_wc.copy()
    still[:, :3, 3] = 0
    written, words = told(replace(source, reference=source.reference._replace(T_wc=still)))
    assert 0 < written["orientation_rmse"] < 1
    expected = "coincide; an alignment by Sim(3) needs motion; orientation "
    assert f"{expected}error {written['orientation_rmse']:.2f}°" in words


def test_a_video_in_which_nothing_is_seen_is_told_so(tmp_path):
    source = small(4)
    black = replace(source, images=lambda: (0 * image for image in source.images()))
    words = summary.describe(tracked(black, tmp_path))
    assert "no map could be started: none of its 4 frames" in words
    assert "nan" not in words


def test_pictures_that_repeat_are_counted_and_said(tmp_path):
    source = small(4)
    doubled = lambda: (image for image in source.images() for _ in (0, 1))  # noqa: E731
    twice = replace(source, times=np.arange(8) / 60, images=doubled, reference=None)
    written = tracked(twice, tmp_path)
    assert (written["repeated"], written["tracked"], written["lost"]) == (4, 8, 0)
    assert "4 pictures repeat the one before and were not used" in summary.describe(written)
    assert [row["repeated"] for row in rows_of(tmp_path)] == ["0", "1"] * 4
    assert written["matches_per_frame"] > 8


def test_a_scale_that_is_uncertain_is_said_beside_the_covariances(tmp_path, monkeypatch):
    source = small(2)
    tracker = Tracker(source.calibration, SETTINGS)
    history = [replace(tracker.track(frame), sigma_log_scale=0.5) for frame in source]
    monkeypatch.setattr(tracking, "summarised", fail)
    with pytest.raises(np.linalg.LinAlgError):
        tracking._write(source, tracker, history, (history, tracker.points()), [0.1], tmp_path)
    header = (tmp_path / "covariance.txt").read_text().splitlines()[0]
    assert "uncertain by sigma_log_scale (frames.csv)" in header
    assert "scale=given" in header


# --- the command ----------------------------------------------------------------------------------


def test_the_command_hands_over_what_is_wanted_and_says_what_was_written(monkeypatch, capsys):
    asked = {}
    monkeypatch.setattr(tracking, "track", lambda *_, **how: asked.update(how))
    monkeypatch.setattr(summary, "describe", str)
    TrackOptions(overlay=False, viewer=Path("seen.rrd"), frames=5).run()
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
