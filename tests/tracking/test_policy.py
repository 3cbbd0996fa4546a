"""Which matches are believed, of a table of what was searched and a table of what was found."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.io.calibration import from_field_of_view
from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.matching import Matches
from jaxslam.tracking.observations import NOTHING, Lost, Observations
from jaxslam.tracking.patches import STORED, Patch
from jaxslam.tracking.policy import CHANCE_LOST, PROVEN, Policy, more_than_chance
from jaxslam.tracking.settings import TrackerSettings

COUNT = 20
CAMERA = from_field_of_view(640, 480)
PATCH = Patch(np.zeros(2), np.zeros((STORED, STORED), np.float32))
ASIDE = np.array([1.0, 0.0])
PLACES = np.random.default_rng(0).uniform(50, 400, (COUNT, 2))
SLOTS = np.arange(COUNT) + 3
LANDMARKS = {slot: Landmark(slot, PATCH, np.eye(4), np.zeros(2)) for slot in SLOTS.tolist()}


def table(sigma=2.0):
    covariances = np.tile(sigma**2 * np.eye(2), (COUNT, 1, 1))
    nowhere, labels = np.full((COUNT, 2), np.nan), np.full(COUNT, "unmatched")
    return Observations(SLOTS, PLACES, covariances, nowhere, np.zeros(COUNT), labels)


def agreeing(found, agreeing, lost=False, sigma=2.0):
    """Of landmarks found a pixel aside, those agree whose rows are told."""
    owner = np.array(found, int)
    scores, variances = np.ones(len(owner), np.float32), np.zeros(len(owner))
    matches = Matches(owner, PLACES[owner] + ASIDE, scores, variances)
    policy = Policy(CAMERA, TrackerSettings(), ambiguous_start=False)

    def agree(slots, those):
        assert those is matches
        return np.isin(slots, SLOTS[list(agreeing)])

    return policy.agreeing(table(sigma), matches, LANDMARKS, agree, lost=lost)


def test_what_agrees_is_matched_and_the_rest_of_what_was_found_is_an_outlier():
    seen = agreeing(range(12), range(8))
    assert seen.labels.tolist() == ["matched"] * 8 + ["outlier"] * 4 + ["unmatched"] * 8
    np.testing.assert_array_equal(seen.pixels[:12], PLACES[:12] + ASIDE)
    assert np.isnan(seen.pixels[12:]).all()
    assert np.isnan(seen.believed[8:]).all()
    np.testing.assert_array_equal(seen.places, np.where(seen.matched[:, None], seen.pixels, PLACES))


def test_fewer_than_chance_would_give_are_not_believed_and_a_lost_camera_needs_more():
    least, more = more_than_chance(COUNT), more_than_chance(COUNT, CHANCE_LOST)
    assert least < more < COUNT // 2
    for count, lost, believed in (
        (least, False, least), (least - 1, False, 0), (more - 1, True, 0), (more, True, more),
    ):  # fmt: skip
        assert agreeing(range(COUNT), range(count), lost).matched.sum() == believed


def test_what_the_filter_did_not_use_is_an_outlier_and_new_landmarks_are_rows_below():
    seen = agreeing(range(6), range(6)).but_for(np.arange(COUNT) < 4)
    assert seen.labels.tolist() == ["matched"] * 4 + ["outlier"] * 2 + ["unmatched"] * 14
    longer = seen.with_new(np.array([[7.0, 8.0]]))
    assert longer.labels[-1] == "new"
    np.testing.assert_array_equal(longer.labelled("new").pixels, [[7.0, 8.0]])
    assert len(longer.slots) == COUNT + 1


def test_what_contradicts_for_long_is_put_out_and_the_map_stays():
    """After as many frames as a lost camera waits, those that agree are the map."""
    policy = Policy(CAMERA, TrackerSettings(lost_for=5), ambiguous_start=False)
    landmarks = {
        slot: Landmark(slot, PATCH, np.eye(4), np.zeros(2), found=PROVEN) for slot in SLOTS.tolist()
    }
    labels = np.where(np.arange(COUNT) < 10, "matched", "outlier")
    moved = PLACES + np.where(np.arange(COUNT) < 10, 0.0, 5.0)[:, None] * ASIDE
    seen = table()._replace(pixels=moved, labels=labels)
    reasons = [policy.reason(seen, landmarks) for _ in range(10)]
    first = reasons.index(Lost.CONTRADICTED)
    assert reasons[first : first + 6] == [Lost.CONTRADICTED] * 5 + [None]


def test_a_frame_without_expected_landmarks_and_one_without_matches_say_so():
    policy = Policy(CAMERA, TrackerSettings(), ambiguous_start=False)
    assert policy.reason(NOTHING, {}) is Lost.NOTHING_EXPECTED
    assert policy.reason(table(), LANDMARKS) is Lost.FEW_AGREE
    seen = table()._replace(pixels=PLACES, labels=np.full(COUNT, "matched"))
    assert policy.reason(seen, LANDMARKS) is None
