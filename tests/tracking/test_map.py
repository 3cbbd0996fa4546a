"""The map's upkeep: which landmarks are searched, in view, and given up."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.io.calibration import Calibration
from jaxslam.tracking.landmarks import MEMORY, Landmark, Points
from jaxslam.tracking.map import Map, TrackerState, failing, in_view, note_found, worst_first
from jaxslam.tracking.observations import Observations, Prediction
from jaxslam.tracking.patches import Patch
from jaxslam.tracking.search import to_search
from jaxslam.tracking.settings import FIT, TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.unit import MapInWorld

CAMERA = Calibration(640, 480, 500.0, 500.0, 319.5, 239.5)
SETTINGS = TrackerSettings(filter="world", wanted=5)
PATCH = Patch.take(np.zeros((60, 60), np.uint8), np.array([30.0, 30.0]))


def landmark(number, **counts):
    return Landmark(number, PATCH, np.eye(4), np.zeros(2), **counts)


def pair(**counts):
    return {3: landmark(0, **counts), 4: landmark(1, **counts)}


def search(landmarks, found, times):
    slots, labels = np.array(list(landmarks), int), np.where(found, "matched", "unmatched")
    seen = Observations(slots, pixels=np.array([[7.0, 8.0]] * len(slots)), labels=labels)
    for _ in range(times):
        landmarks = note_found(landmarks, seen, SETTINGS)
    return landmarks


@pytest.mark.parametrize(
    ("before", "in_vain", "goes"), [(400, 15, True), (400, 5, False), (0, 9, False), (0, 12, True)]
)
def test_a_landmark_is_judged_by_its_latest_searches(before, in_vain, goes):
    landmarks = search(search(pair(), [True, True], before), [False, True], in_vain)
    assert failing(landmarks, SETTINGS) == ([3] if goes else [])


def test_a_landmark_that_is_found_often_enough_is_kept():
    least = SETTINGS.least_success
    landmarks = {3: landmark(0, success=least), 4: landmark(1, success=np.nextafter(least, 0))}
    assert failing(landmarks, SETTINGS) == [4]


def test_a_frame_in_which_nothing_is_found_is_held_against_none():
    landmarks = search(pair(), [False, False], 40)
    assert failing(landmarks, SETTINGS) == []
    assert in_view(landmarks, [3, 4], SETTINGS).all()
    assert [one.unseen for one in landmarks.values()] == [40, 40]


def test_a_landmark_counts_as_in_view_until_it_was_missed_some_times():
    absent = SETTINGS.absent_after
    landmarks = search(pair(), [False, True], absent)
    assert [one.seen_at.tolist() for one in landmarks.values()] == [[0.0, 0.0], [7.0, 8.0]]
    assert in_view(landmarks, [4, 3, 9], SETTINGS).tolist() == [True, True, False]
    landmarks = search(landmarks, [False, True], 1)
    assert in_view(landmarks, [4, 3], SETTINGS).tolist() == [True, False]
    assert (landmarks[3].missed, landmarks[3].unseen) == (absent + 1,) * 2
    landmarks = search(landmarks, [True, True], 1)
    assert in_view(landmarks, [4, 3], SETTINGS).all()
    assert (landmarks[3].missed, landmarks[3].unseen) == (0, 0)


def test_a_landmark_that_slides_is_less_sure_and_one_that_stays_is_not():
    """Where one is off by one σ for long, every match says nearly the same."""
    draw, slides, stays = np.random.default_rng(3), landmark(0), landmark(1)
    assert slides.noise_factor == 1.0
    factors = []
    for _ in range(2000):
        slides = slides.compared(np.array([1.0, 0.0]))
        stays = stays.compared(draw.standard_normal(2))
        factors.append(stays.noise_factor)
    assert slides.noise_factor == pytest.approx((1 + MEMORY) / (1 - MEMORY) / 2)
    # Half a χ² of two degrees of freedom is x, of density exp(−x): E max(1, x) = 1 + 1/e.
    assert np.mean(factors) == pytest.approx(1 + np.exp(-1), rel=0.1)


def test_a_noise_factor_is_of_all_that_a_match_is_used_for():
    """Of one whose window fits as of one whose does not."""
    variances = np.array([0.0, 3.0]) * SETTINGS.pixel_sigma**2 / FIT
    for factors in ([1.0, 1.0], [4.0, 2.5]):
        more = SETTINGS.noise_factors(SETTINGS.noisier(variances, np.array(factors)))
        np.testing.assert_allclose(more, SETTINGS.noise_factors(variances) * factors)


def predicted(points, position=(0.0, 0.0, 0.0), omega=1.0):
    """Of points in the first camera, by one at `position` that looks the same way."""
    here = np.asarray(points, float) - omega * np.asarray(position)
    pixels = 500 * here[:, :2] / here[:, 2:] + [319.5, 239.5]
    T_wc = np.eye(4)
    T_wc[:3, 3] = position
    count = len(points)
    covariances = np.tile(np.eye(2), (count, 1, 1))
    return Prediction(pixels, covariances, here[:, 2] > 0, T_wc, here, np.full(count, omega))


def searched(landmarks, prediction):
    return to_search(landmarks, prediction, CAMERA, SETTINGS)


def test_what_is_in_the_picture_is_searched_the_longest_known_first():
    points = [(0, 0, 4.0), (1, 0, 4.0), (3, 0, 4.0), (0, 0, -4.0), (0, 1, 4.0)]
    landmarks = {slot: landmark(10 - slot) for slot in range(5)}
    slots, affines = searched(landmarks, predicted(points))
    assert slots.tolist() == [4, 1, 0]
    np.testing.assert_allclose(affines, np.tile(np.eye(2), (3, 1, 1)), atol=1e-12)
    landmarks[4] = replace(landmarks[4], missed=SETTINGS.absent_after + 1)
    assert searched(landmarks, predicted(points))[0].tolist() == [1, 0, 4]
    many = {slot: landmark(slot) for slot in range(9)}
    assert searched(many, predicted([(0.1 * i, 0, 4.0) for i in range(9)]))[0].tolist() == [
        *range(5)
    ]
    assert searched({}, predicted(np.zeros((0, 3))))[0].shape == (0,)


@pytest.mark.parametrize(
    ("ahead", "seen"), [(1.8, True), (2.2, False), (-3.6, True), (-4.4, False)]
)
def test_what_looks_twice_as_large_or_half_as_large_is_not_searched(ahead, seen):
    prediction = predicted([(0.1, 0, 4.0)], (0, 0, ahead))
    slots, affines = searched({0: landmark(0)}, prediction)
    assert len(slots) == seen
    if seen:
        np.testing.assert_allclose(affines[0], np.eye(2) * 4 / (4 - ahead), rtol=1e-2)


@pytest.mark.parametrize(("degrees", "seen"), [(0, True), (60, True), (73, False), (100, False)])
def test_what_is_seen_from_the_side_is_searched_as_far_as_its_patch_reaches(degrees, seen):
    """A patch of 41 pixels has the 15 of a window that is narrower by 41/15 at the most."""
    angle = np.radians(degrees)
    cos, sin, place = np.cos(angle), np.sin(angle), np.array([0, 0, 4.0])
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    T_wc[:3, 3] = place - T_wc[:3, :3] @ place
    slots, affines = searched({0: landmark(0)}, predicted([place])._replace(T_wc=T_wc))
    assert len(slots) == seen
    if seen:
        np.testing.assert_allclose(affines[0], np.diag([cos, 1]), atol=0.01)


def test_what_is_at_infinity_looks_the_same_from_anywhere():
    slots, affines = searched({0: landmark(0)}, predicted([(0.1, 0, 1.0)], (3, 0, 5), omega=0.0))
    assert slots.tolist() == [0]
    np.testing.assert_allclose(affines[0], np.eye(2), atol=1e-12)


@pytest.mark.parametrize(
    ("sigmas", "unseen", "missed", "order"),
    [
        (
            [0.1, 0.1, 5.0, np.nan, 0.1, 0.2],
            [100, 300, 40, 20, 8, 100],
            [0, 0, 0, 2, 6, 0],
            [4, 2, 3, 1, 5, 0],
        ),
        # σ of 2.5 distances is worth as little as no known depth.
        ([5.0, np.nan], [40, 60], [SETTINGS.absent_after + 1] * 2, [1, 0]),
    ],
)
def test_the_worst_known_and_longest_unseen_go_first(sigmas, unseen, missed, order):
    count = len(sigmas)
    landmarks = [landmark(i, unseen=unseen[i], missed=missed[i]) for i in range(count)]
    covariances = np.array(sigmas)[:, None, None] ** 2 * np.eye(3) / 3
    nothing, places = np.zeros(count, int), np.tile([0.0, 0.0, 2.0], (count, 1))
    points = Points(np.arange(count), nothing, nothing, places, covariances, covariances)
    assert worst_first(landmarks, points, SETTINGS).tolist() == order


@pytest.mark.usefixtures("unchecked")
def test_a_filter_that_is_begun_anew_in_metres_goes_on_in_the_unit_of_its_map():
    """Of which it had believed that it is 2 m; nothing is known of it any more."""
    failed = SimpleNamespace(failed=True)
    broken: Any = SimpleNamespace(
        empty=lambda _: "empty", predict=lambda *_: None, correct=lambda *_: ("broken", failed)
    )
    before: Any = Map("of before", MapInWorld(log_unit=0.3, log_scale=np.log(2.0)))
    predicted: Any = SimpleNamespace(control=0.1)
    after = TrackerState(broken, CAMERA, before).coasted(predicted)
    assert after.map.state == "empty"
    assert after.map.place.unit == pytest.approx(0.5)


def test_what_is_covered_makes_room_for_new_landmarks_elsewhere():
    source = synthetic_source(frames=14, width=320, height=240)
    settings = TrackerSettings(filter="world", wanted=12, spare=4, spacing=8.0)
    tracker = Tracker(source.calibration, settings)
    for frame in source:
        frame.image[:, :160][frame.index >= 5] = 0
        tracked = tracker.track(frame)
        right = tracked.observations.predicted[:, 0] > 170
        found = np.array(tracked.status)[right] == "matched" if frame.index else right
        if frame.index == 5 + settings.absent_after:
            before = found.sum()
    assert before < 10
    assert found.sum() >= 11
    assert len(tracker.landmarks) <= settings.capacity
    assert len(tracker.points().numbers) == tracker.created
    assert tracker.created == len(tracker.landmarks) + tracker.deleted
