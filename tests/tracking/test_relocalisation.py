"""A camera that was lost is back in a map that it knows; in another place it is not."""

from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest

from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.patches import Patch
from jaxslam.tracking.places.descriptors import (
    LOOKS,
    candidates,
    describe,
    described_corners,
    with_looks,
)
from jaxslam.tracking.places.relocalisation import FEWEST, pose_of
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker

SETTINGS = TrackerSettings(filter="world", wanted=50, lost_for=5)


def interrupted(source, during, image):
    """The source's frames, with another picture in some."""
    for frame in source:
        yield replace(frame, image=image(frame)) if frame.index in during else frame


@pytest.mark.slow
def test_another_room_is_another_map_and_the_first_is_known_again():
    """Places that are taken for one another."""
    source, other = (
        synthetic_source(frames=85, seed=3),
        list(synthetic_source(frames=85, seed=1003)),
    )
    tracker, during = Tracker(source.calibration, SETTINGS), range(35, 65)
    frames = interrupted(source, during, lambda frame: other[frame.index].image)
    tracked = [tracker.track(frame) for frame in frames]
    maps = [one.map for one in tracked]
    begins = [one.index for one in tracked if one.starts]
    assert len(begins) == 2
    assert during.start < begins[1] < during.stop
    assert maps[begins[1] : during.stop] == [1] * (during.stop - begins[1])
    (back,) = [one.index for one in tracked if one.relocalised]
    assert during.stop <= back <= during.stop + 5
    assert maps[back:] == [0] * (len(maps) - back)
    assert not any(one.lost for one in tracked[back:])
    # Every landmark is told of once, in the map that it is of.
    points = tracker.points()
    assert len(set(points.numbers.tolist())) == len(points.numbers) == tracker.created
    assert set(points.maps.tolist()) == {0, 1}
    # A map that comes next has a number of its own.
    with jax.enable_x64(True):
        assert tracker.state.restarted().map.number == 2


@pytest.mark.slow
def test_where_no_map_is_known_another_begins(tmp_path):
    """A search without an end."""
    source, other = synthetic_source(frames=40, seed=4), synthetic_source(frames=12, seed=77)
    tracker = Tracker(source.calibration, SETTINGS)
    for frame in source:
        tracker.track(frame)
    tracker.save(tmp_path / "map.npz")
    later = Tracker.localising(tmp_path / "map.npz", source.calibration)
    found = [later.track(frame) for frame in other]
    assert [one.starts for one in found] == [k == SETTINGS.lost_for - 1 for k in range(12)]
    assert not any(one.relocalised for one in found)
    assert {one.map for one in found} == {1}


def test_a_map_of_another_camera_is_refused(tmp_path):
    source = synthetic_source(frames=2, width=320, height=240)
    tracker = Tracker(source.calibration, TrackerSettings(filter="world", wanted=12, spare=4))
    tracker.track(next(iter(source)))
    tracker.save(tmp_path / "map.npz")
    wrong = replace(source.calibration, fx=source.calibration.fx * 1.1)
    with pytest.raises(
        ValueError, match=r"a map of another camera \(320 × 240, fx .* not of this one"
    ):
        Tracker.localising(tmp_path / "map.npz", wrong)


def test_a_pose_is_found_among_wrong_matches_and_none_among_wrong_ones_alone():
    rng, calibration = np.random.default_rng(0), synthetic_source(frames=2).calibration
    points = rng.uniform([-2, -2, 3], [2, 2, 8], (40, 3))
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], [0.3, -0.1, 0.5]
    T_cw = np.linalg.inv(T_wc)
    lens = calibration.matrix, np.array(calibration.distortion, float)
    pixels = cv2.projectPoints(points, cv2.Rodrigues(T_cw[:3, :3])[0], T_cw[:3, 3], *lens)[0][:, 0]
    pixels = pixels + rng.normal(0, 0.5, pixels.shape)
    pixels[:20] = rng.uniform(0, 480, (20, 2))
    found = pose_of(points, pixels, calibration)
    assert found is not None
    assert np.abs(found[0] - T_wc).max() < 0.03
    assert set(found[1].tolist()) == set(range(20, 40))
    assert pose_of(points[:20], pixels[:20], calibration) is None
    assert pose_of(points[:5], pixels[:5], calibration) is None
    # In any unit of length; points that are all one have none.
    small = pose_of(1e-3 * points, pixels, calibration)
    assert small is not None
    assert np.abs(small[0][:3, 3] - 1e-3 * T_wc[:3, 3]).max() < 1e-4
    assert pose_of(np.tile(points[:1], (20, 1)), pixels[20:], calibration) is None


def test_landmarks_are_known_by_their_looks():
    """In a picture that is moved; a picture of noise has none of them."""
    source = synthetic_source(frames=2, seed=5)
    image = next(iter(source)).image
    corners = cv2.goodFeaturesToTrack(image, 40, 0.01, 20)[:, 0].astype(float)
    landmarks = {
        2 * i: Landmark(i, Patch.take(image, corner), np.eye(4), corner)
        for i, corner in enumerate(corners)
    }
    there = describe(image, corners)[1]
    assert there.mean() > 0.7
    assert not describe(image, np.array([[3.0, 3.0]]))[1].any()
    for _ in range(LOOKS + 2):
        landmarks = with_looks(landmarks, image)
    assert {len(one.looks) for one in landmarks.values()} == {0, LOOKS}
    found = candidates(landmarks, described_corners(np.roll(image, (5, 12), axis=(0, 1))))
    slots, pixels = np.array(list(found)), np.array(list(found.values()))
    moved = pixels - corners[slots // 2] - [12, 5]
    assert np.mean(np.linalg.norm(moved, axis=1) < 2) > 0.8
    assert len(slots) > 0.5 * there.sum()
    noise = np.random.default_rng(1).integers(0, 255, image.shape, dtype=np.uint8)
    assert len(candidates(landmarks, described_corners(noise))) < FEWEST
    assert len(candidates(landmarks, described_corners(np.zeros_like(image)))) == 0
