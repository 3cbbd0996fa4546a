"""Tests of the tracker: a synthetic video is followed, and its files say so."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.vision.settings import TrackerSettings
from jaxslam.vision.sources import open_source
from jaxslam.vision.synthetic import synthetic_source
from jaxslam.vision.track import track
from jaxslam.vision.tracker import Tracker
from jaxslam.vision.trajectory import (
    absolute_trajectory_error,
    pose_nees,
    read_covariances,
    read_tum,
)

FRAMES = 45


def shortened(source, frames):
    images = source.images
    return replace(
        source, times=source.times[:frames], images=lambda: itertools.islice(images(), frames)
    )


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    out = tmp_path_factory.mktemp("tracked")
    source = synthetic_source(frames=FRAMES)
    return out, source, track(source, out, TrackerSettings(wanted=30))


def test_the_synthetic_camera_is_tracked(tracked):
    _, _, summary = tracked
    assert summary["tracked"] == summary["frames"] == FRAMES
    assert summary["restarts"] == 0
    assert summary["matches_per_frame"] > 20
    # Measured 0.5 %; a tracker that loses rotation or scale is above 5 %.
    assert summary["ate"]["rmse"] < 0.02 * summary["ate"]["path_length"]
    # Matches are rejected by χ², so that their NIS is below its number; 4 would be a wrong σ.
    assert 0.1 < summary["nis"]["mean"] / summary["nis"]["dof"] < 2


def test_the_files_hold_every_frame_and_agree_with_the_summary(tracked):
    out, source, summary = tracked
    times, T_wc = read_tum(out / "trajectory.txt")
    np.testing.assert_allclose(times, source.times, atol=1e-6)
    np.testing.assert_allclose(T_wc[0], np.eye(4), atol=1e-9)
    covariance_times, covariances = read_covariances(out / "covariance.txt")
    np.testing.assert_array_equal(covariance_times, times)
    np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))
    assert np.linalg.eigvalsh(covariances[1:])[:, 0].min() > 0
    assert pose_nees(T_wc[1:], covariances[1:], source.reference.T_wc[1:]).min() > 0
    ate = absolute_trajectory_error(times, T_wc, *source.reference)
    assert ate["rmse"] == pytest.approx(summary["ate"]["rmse"], rel=1e-3)
    assert json.loads((out / "summary.json").read_text())["frames"] == FRAMES
    assert (out / "map.ply").read_text().startswith("ply")
    assert {path.name for path in out.iterdir()} == {
        "trajectory.txt", "covariance.txt", "map.ply", "map.png", "overlay.mp4", "summary.json",
    }  # fmt: skip


def test_an_interruption_leaves_the_files_of_the_frames_so_far(tmp_path):
    def stop(frames):
        nonlocal seen
        seen += frames
        if seen == 4:
            raise KeyboardInterrupt

    seen = 0
    with pytest.raises(KeyboardInterrupt):
        track(synthetic_source(frames=20), tmp_path, TrackerSettings(wanted=10), progress=stop)
    assert len(read_tum(tmp_path / "trajectory.txt")[0]) == 4
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 4
    assert len(list(tmp_path.iterdir())) == 6


def test_a_frame_must_be_later_than_the_one_before():
    source = synthetic_source(frames=2)
    tracker = Tracker(source.calibration, TrackerSettings(wanted=10))
    frame = next(iter(source))
    tracker.track(frame)
    with pytest.raises(ValueError, match="not later than the one before"):
        tracker.track(frame)


def test_a_gaussian_sum_tracks_too():
    """Its members share one search, and give another estimate than one filter does."""
    source = synthetic_source(frames=10)
    settings = TrackerSettings(wanted=12, spare=4)
    one = Tracker(source.calibration, replace(settings, filter="robocentric"))
    some = Tracker(source.calibration, replace(settings, filter="robocentric+mixture3"))
    for frame in source:
        alone, summed = one.track(frame), some.track(frame)
    assert not summed.lost
    assert summed.status.count("matched") >= 10
    assert len(some.points()[1]) >= 12
    assert np.linalg.eigvalsh(summed.covariance)[0] > 0
    assert not np.allclose(summed.T_wc, alone.T_wc, atol=1e-6)


def test_the_default_is_the_recommended_filter():
    assert TrackerSettings(filter="recommended") == TrackerSettings()


@pytest.mark.parametrize("options", [{"filter": "nothing"}, {"landmarks": "nothing"}])
def test_unknown_names_are_refused(options):
    with pytest.raises(ValueError, match=r"unknown .* 'nothing'; known:"):
        TrackerSettings(**options)


def test_a_real_sequence_is_tracked(shared_data, tmp_path):
    source = shortened(open_source(shared_data / "costado"), 60)
    summary = track(source, tmp_path, TrackerSettings(wanted=30))
    assert summary["tracked"] == 60
    # Measured on all 720 frames: 0.2 %.
    assert summary["ate"]["rmse"] < 0.03 * summary["ate"]["path_length"]
