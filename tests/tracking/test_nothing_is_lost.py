"""What was tracked is kept, whatever comes after it: numbers that are none, a kill, a full disk."""

import csv
import errno
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam._runtime.files import append_whole
from jaxslam.io.tum import read_tum
from jaxslam.tracking import estimator as programs
from jaxslam.tracking import report
from jaxslam.tracking import video as tracking
from jaxslam.tracking.places.smoothing import smoothed
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.summary import describe
from jaxslam.tracking.synthetic import add_noise, synthetic_source
from jaxslam.tracking.tracker import MOST_REPEATS, Tracker

SETTINGS = TrackerSettings(filter="world", wanted=12, spare=4)


def small(frames):
    return synthetic_source(frames=frames, width=320, height=240)


def rows_of(out):
    with (out / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def fails(*_, **__):
    raise np.linalg.LinAlgError("SVD did not converge")


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
    summary = tracking.track(small(7), tmp_path, SETTINGS, overlay=False, progress=count)
    _, T_wc = read_tum(tmp_path / "trajectory.txt")
    assert len(T_wc) == 7
    reasons = [row["reason"] for row in rows_of(tmp_path)]
    assert reasons[:4] == ["", "", "", "not finite"]
    assert (reasons[4:] == ["", "", ""]) == (until == 1)
    assert summary["failed_updates"]["not_finite"] == reasons.count("not finite")
    assert "1 not finite" in describe(summary) or until > 1


def test_trajectory_and_frames_are_whole_after_every_frame(tmp_path):
    counts = []

    def look(_):
        if names := {path.name for path in tmp_path.iterdir()}:
            assert names == {"trajectory.txt", "frames.csv"}
            counts.append((len(read_tum(tmp_path / "trajectory.txt")[0]), len(rows_of(tmp_path))))

    tracking.track(small(5), tmp_path, SETTINGS, overlay=False, progress=look)
    assert counts == [(k, k) for k in (2, 3, 4, 5)]


KILLED = """
import os, signal, sys
from pathlib import Path
from jaxslam.tracking import video
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked
from jaxslam.tracking.synthetic import synthetic_source

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
    assert len(read_tum(tmp_path / "trajectory.txt")[0]) == len(rows_of(tmp_path)) == 4


def test_a_smoothing_that_fails_leaves_the_files_of_all_frames_as_they_were_tracked(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(Tracker, "smoothed", fails)
    with pytest.raises(ValueError, match="SVD did not converge"):
        tracking.track(small(4), tmp_path, SETTINGS, overlay=False)
    assert len(read_tum(tmp_path / "trajectory.txt")[0]) == 4
    assert (tmp_path / "summary.json").exists()
    assert (tmp_path / "map.npz").exists()


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


def test_a_summary_that_fails_leaves_trajectory_and_map(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "summarised", fails)
    with pytest.raises(ValueError, match="SVD did not converge"):
        tracking.track(small(4), tmp_path, SETTINGS, overlay=False)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"trajectory.txt", "covariance.txt", "frames.csv", "map.npz"}
    assert len(rows_of(tmp_path)) == 4


def test_a_disk_that_is_full_leaves_what_was_tracked_before(tmp_path, monkeypatch):
    def full(path, text):
        if text.startswith(("4", "0.133")):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        append_whole(path, text)

    monkeypatch.setattr(report, "append_whole", full)
    monkeypatch.setattr(tracking, "_write", fails)
    with pytest.raises(np.linalg.LinAlgError):
        tracking.track(small(6), tmp_path, SETTINGS, overlay=False)
    assert len(read_tum(tmp_path / "trajectory.txt")[0]) == len(rows_of(tmp_path)) == 4


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


# --- pictures that say nothing ------------------------------------------------------------------


def as_compressed(image, index):
    """A copy in which some pixels are a grey level off."""
    off = np.random.default_rng(index).random(image.shape) < 0.2
    return np.where(off & (image < 255), image + 1, image).astype(np.uint8)


@pytest.fixture(scope="module")
def once():
    """A tracker's results of pictures that come once."""
    source = small(6)
    tracker = Tracker(source.calibration, SETTINGS)
    return source, [tracker.track(frame) for frame in source]


@pytest.mark.parametrize("copied", [lambda image, _: image, as_compressed])
def test_a_picture_that_comes_twice_is_used_once(once, copied):
    source, expected = once
    tracker, results = Tracker(source.calibration, SETTINGS), []
    for frame in source:
        results.append(tracker.track(replace(frame, index=2 * frame.index)))
        again = copied(frame.image, frame.index)
        results.append(tracker.step(again, frame.time + 1 / 60))
    assert [one.repeated for one in results] == [False, True] * 6
    assert tracker.steps == 12
    for used, copy, one in zip(results[::2], results[1::2], expected, strict=True):
        assert not copy.lost
        assert copy.nis_dof == 0
        np.testing.assert_array_equal(copy.T_wc, used.T_wc)
        np.testing.assert_array_equal(copy.covariance, used.covariance)
        np.testing.assert_allclose(used.T_wc, one.T_wc, atol=1e-9)
        np.testing.assert_allclose(used.covariance, one.covariance, atol=1e-9)


def test_pictures_that_repeat_are_counted_and_said(tmp_path):
    source = small(4)
    doubled = lambda: (image for image in source.images() for _ in (0, 1))  # noqa: E731
    twice = replace(source, times=np.arange(8) / 60, images=doubled, reference=None)
    summary = tracking.track(twice, tmp_path, SETTINGS, overlay=False)
    assert (summary["repeated"], summary["tracked"], summary["lost"]) == (4, 8, 0)
    assert "4 pictures repeat the one before and were not used" in describe(summary)
    assert [row["repeated"] for row in rows_of(tmp_path)] == ["0", "1"] * 4
    assert summary["matches_per_frame"] > 8


def test_a_camera_that_stands_still_goes_on_from_there_at_once(once):
    """After a long standstill the time that it took says nothing of how far it can be."""
    source, _ = once
    first, second, third, *_ = source
    tracker = Tracker(source.calibration, SETTINGS)
    for frame in (first, second):
        tracker.track(frame)
    for k in range(40):
        assert tracker.step(second.image, second.time + (k + 1) / 30).repeated
    assert tracker.state.repeats == 40 > MOST_REPEATS
    found = tracker.step(third.image, second.time + 41 / 30)
    assert found.state == "tracked"
    assert found.status.count("matched") > 8


def test_after_a_flash_a_small_motion_is_no_repeated_picture(once):
    """A tenth of what changed between darkness and a picture is more than a slow camera changes."""
    source, _ = once
    image = next(iter(source)).image
    tracker = Tracker(source.calibration, SETTINGS)
    for k in range(4):
        noisy = add_noise(image, np.random.default_rng(k)) * (k != 1)
        assert not tracker.step(noisy.astype(np.uint8), k / 30).repeated


def test_noise_alone_makes_another_picture(once):
    source, _ = once
    image = next(iter(source)).image
    tracker = Tracker(source.calibration, SETTINGS)
    results = [tracker.step(add_noise(image, np.random.default_rng(k)), k / 30) for k in range(3)]
    assert not any(one.repeated for one in results)


def test_seconds_of_darkness_make_no_maps():
    """Its noise has corners, none of which is found again; and the map before is still known."""
    source = small(5)
    settings = replace(SETTINGS, lost_for=2)
    tracker, frames = Tracker(source.calibration, settings), list(source)
    for frame in frames:
        tracker.track(frame)
    known = tracker.map.landmarks.keys()
    results = []
    for k in range(40):
        dark = add_noise(np.zeros_like(frames[0].image), np.random.default_rng(k))
        results.append(tracker.step(dark, 1 + k / 30))
    assert all(one.lost for one in results)
    assert {one.map for one in results} == {0, 1}
    assert sum(one.starts for one in results) == 1
    assert tracker.restarts == 0
    (before,) = tracker.state.left
    assert (before.number, before.landmarks.keys()) == (0, known)


def test_darkness_before_the_first_map_is_no_repeated_picture():
    source = small(1)
    tracker = Tracker(source.calibration, SETTINGS)
    dark = np.zeros((240, 320), np.uint8)
    results = [tracker.step(dark, k / 30) for k in range(3)]
    assert [one.state for one in results] == ["start", "lost", "lost"]
