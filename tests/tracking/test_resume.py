"""Pictures one by one, and a tracker that goes on from a file as if nothing had been."""

from dataclasses import replace

import numpy as np
import pytest

import jaxslam
from jaxslam.io.pictures import as_grey
from jaxslam.tracking.persistence import save
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker, start, step

FRAMES, HALF = 10, 5
SETTINGS = TrackerSettings(filter="world", wanted=12, spare=4)


@pytest.fixture(scope="module")
def video():
    source = synthetic_source(frames=FRAMES, width=320, height=240)
    return source.calibration, list(source)


def same(one, other):
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)
    np.testing.assert_array_equal(one.T_wc, other.T_wc)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    of_unit = "map", "sigma_log_scale", "log_scale"
    for name in ("index", "time", "state", "status", "nis", "nis_dof", *of_unit):
        assert getattr(one, name) == getattr(other, name), name


def test_a_tracker_is_a_fold_and_a_state_that_is_kept_is_gone_on_from_again(video):
    calibration, frames = video
    slam, tracker = SETTINGS.make_filter(calibration), Tracker(calibration, SETTINGS)
    assert isinstance(slam, jaxslam.Slam)
    state, kept, images = start(slam, SETTINGS, calibration), [], Tracker(calibration, SETTINGS)
    for frame in frames[:4]:
        kept.append(state)
        state, tracked = step(slam, SETTINGS, state, frame)
        same(tracked, tracker.track(frame))
        same(tracked, images.step(frame.image, frame.time))
    numbers = [(one.steps, one.created, one.map.number) for one in kept]
    _, again = step(slam, SETTINGS, kept[2], frames[2])
    after, _ = step(slam, SETTINGS, kept[2], replace(frames[3], image=0 * frames[3].image))
    assert after.unmeasured == 1
    same(step(slam, SETTINGS, kept[3], frames[3])[1], tracked)
    assert again.index == 2
    assert [(one.steps, one.created, one.map.number) for one in kept] == numbers


def test_what_several_records_share_is_written_once_and_shared_again(video, tmp_path):
    calibration, frames = video
    tracker = Tracker(calibration, SETTINGS)
    tracker.track(frames[0])
    state = tracker.state
    kept = replace(state, seen=state.map, left=(state.map, replace(state.map, number=7)))
    save(tmp_path / "once.npz", state, SETTINGS, None)
    save(tmp_path / "t.npz", kept, SETTINGS, None)
    again = Tracker.load(tmp_path / "t.npz").state
    assert again.seen is again.map is again.left[0]
    assert again.left[1].landmarks[2] is again.map.landmarks[2]
    sizes = [(tmp_path / name).stat().st_size for name in ("once.npz", "t.npz")]
    assert sizes[1] < 1.1 * sizes[0]


def test_a_filter_of_ones_own_is_given_again(video, tmp_path):
    calibration, frames = video
    own = TrackerSettings(filter="world", acceleration_sigma=2.0).make_filter(calibration)
    assert isinstance(own, jaxslam.Slam)
    tracker = Tracker(calibration, SETTINGS, own)
    tracker.track(frames[0])
    tracker.save(tmp_path / "t.npz")
    with pytest.raises(ValueError, match=r"t\.npz was saved with the filter Slam; pass that"):
        Tracker.load(tmp_path / "t.npz")
    loaded = Tracker.load(tmp_path / "t.npz", own)
    same(tracker.track(frames[1]), loaded.track(frames[1]))
    longer = TrackerSettings(filter="world", landmarks="inverse_depth")
    other = longer.make_filter(calibration)
    assert isinstance(other, jaxslam.Slam)
    with pytest.raises(ValueError, match="the saved state belongs to a different filter"):
        Tracker.load(tmp_path / "t.npz", other)


def test_a_picture_becomes_grey_bytes():
    draw = np.random.default_rng(0)
    grey = draw.integers(0, 256, (6, 8), dtype=np.uint8)
    assert as_grey(grey) is grey
    floats = grey / 255
    for same in (grey[..., None], np.dstack([grey] * 3), floats, floats.astype(np.float32)):
        np.testing.assert_array_equal(as_grey(same), grey)
    np.testing.assert_array_equal(as_grey(grey[:, ::-1]), grey[:, ::-1])
    # OpenCV's order: the last colour is red, of which grey has 0.299.
    red = np.zeros((6, 8, 3), np.uint8)
    red[..., 2] = 200
    np.testing.assert_allclose(as_grey(red), 0.299 * 200, rtol=0, atol=0.6)
