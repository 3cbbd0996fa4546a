"""Pictures that say nothing: those that come twice, and the dark."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import add_noise, synthetic_source
from jaxslam.tracking.tracker import MOST_REPEATS, Tracker

SETTINGS = TrackerSettings(filter="world", wanted=12, spare=4)


def as_compressed(image, index):
    """A copy in which some pixels are a grey level off."""
    off = np.random.default_rng(index).random(image.shape) < 0.2
    return np.where(off & (image < 255), image + 1, image).astype(np.uint8)


@pytest.fixture(scope="module")
def once():
    """Frames, a tracker's results of them, and a new one."""
    source = synthetic_source(frames=6, width=320, height=240)
    tracker, frames = Tracker(source.calibration, SETTINGS), list(source)
    return frames, [tracker.track(frame) for frame in frames], source.calibration


def noisy(image, seed):
    return add_noise(image, np.random.default_rng(seed))


@pytest.mark.parametrize("copied", [lambda image, _: image, as_compressed])
def test_a_picture_that_comes_twice_is_used_once(once, copied):
    frames, expected, calibration = once
    tracker, results = Tracker(calibration, SETTINGS), []
    for frame in frames:
        results.append(tracker.track(replace(frame, index=2 * frame.index)))
        results.append(tracker.step(copied(frame.image, frame.index), frame.time + 1 / 60))
    assert [one.repeated for one in results] == [False, True] * 6
    assert tracker.steps == 12
    for used, copy, one in zip(results[::2], results[1::2], expected, strict=True):
        assert not copy.lost
        assert copy.nis_dof == 0
        np.testing.assert_array_equal(copy.T_wc, used.T_wc)
        np.testing.assert_array_equal(copy.covariance, used.covariance)
        np.testing.assert_allclose(used.T_wc, one.T_wc, atol=1e-9)
        np.testing.assert_allclose(used.covariance, one.covariance, atol=1e-9)


def test_a_camera_that_stands_still_goes_on_from_there_at_once(once):
    """After a long standstill the time that it took says nothing of how far it can be."""
    (first, second, third, *_), _, calibration = once
    tracker = Tracker(calibration, SETTINGS)
    for frame in (first, second):
        tracker.track(frame)
    for k in range(40):
        assert tracker.step(second.image, second.time + (k + 1) / 30).repeated
    assert tracker.state.repeats == 40 > MOST_REPEATS
    found = tracker.step(third.image, second.time + 41 / 30)
    assert found.state == "tracked"
    assert found.status.count("matched") > 8


@pytest.mark.parametrize("flash", [False, True])
def test_noise_alone_makes_another_picture(once, flash):
    """After a flash, too: a tenth of what changed between darkness and a picture is more than a
    slow camera changes."""
    (first, *_), _, calibration = once
    tracker = Tracker(calibration, SETTINGS)
    for k in range(4):
        image = noisy(first.image, k) * (not flash or k != 1)
        assert not tracker.step(image.astype(np.uint8), k / 30).repeated


def test_seconds_of_darkness_make_no_maps(once):
    """Its noise has corners, none of which is found again; and the map before is still known."""
    frames, _, calibration = once
    tracker = Tracker(calibration, replace(SETTINGS, lost_for=2))
    for frame in frames:
        tracker.track(frame)
    known, dark = tracker.map.landmarks.keys(), np.zeros_like(frames[0].image)
    results = [tracker.step(noisy(dark, k), 1 + k / 30) for k in range(20)]
    assert all(one.lost for one in results)
    assert {one.map for one in results} == {0, 1}
    assert sum(one.starts for one in results) == 1
    assert not any(len(one.created) for one in results if one.map == 0)
    assert tracker.restarts == 0
    (before,) = tracker.state.left
    assert (before.number, before.landmarks.keys()) == (0, known)


def test_darkness_before_the_first_map_is_no_repeated_picture(once):
    tracker = Tracker(once[2], SETTINGS)
    results = [tracker.step(np.zeros((240, 320), np.uint8), k / 30) for k in range(3)]
    assert [one.state for one in results] == ["start", "lost", "lost"]
