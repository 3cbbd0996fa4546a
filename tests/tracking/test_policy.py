"""Which matches are believed, of a table of what was searched and a table of what was found."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from jaxslam.io.calibration import from_field_of_view
from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.matching import Matches
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.patches import STORED, Patch
from jaxslam.tracking.policy import ASTRAY, Policy, more_than_chance
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
    return Observations(SLOTS, PLACES, covariances, nowhere, labels)


def judged(found, agreeing, lost=False, sigma=2.0):
    """Of landmarks found a pixel aside, those agree whose rows are told."""
    owner = np.array(found, int)
    matches = Matches(owner, PLACES[owner] + ASIDE, np.ones(len(owner), np.float32))
    policy = Policy(CAMERA, TrackerSettings(), ambiguous_start=False)

    def agree(slots, pixels):
        np.testing.assert_array_equal(pixels, matches.pixels)
        return np.isin(slots, SLOTS[list(agreeing)])

    return policy.judged(table(sigma), matches, LANDMARKS, agree, lost=lost)


def test_what_agrees_is_matched_and_the_rest_of_what_was_found_is_an_outlier():
    seen = judged(range(12), range(8))
    assert seen.labels.tolist() == ["matched"] * 8 + ["outlier"] * 4 + ["unmatched"] * 8
    np.testing.assert_array_equal(seen.pixels[:12], PLACES[:12] + ASIDE)
    assert np.isnan(seen.pixels[12:]).all()
    assert np.isnan(seen.believed[8:]).all()
    np.testing.assert_array_equal(seen.places, np.where(seen.matched[:, None], seen.pixels, PLACES))


def test_fewer_than_chance_would_give_are_not_believed_and_a_lost_camera_needs_half():
    least = more_than_chance(COUNT)
    assert least < COUNT // 2
    for count, lost, believed in (
        (least, False, least), (least - 1, False, 0), (COUNT // 2 - 1, True, 0),
        (COUNT // 2, True, COUNT // 2),
    ):  # fmt: skip
        assert judged(range(COUNT), range(count), lost).matched.sum() == believed


def test_nothing_is_believed_where_directions_are_expected_too_widely():
    widest = ASTRAY * CAMERA.fx
    assert judged(range(12), range(12), sigma=0.99 * widest).matched.sum() == 12
    seen = judged(range(12), range(12), sigma=1.01 * widest)
    assert seen.labels.tolist() == ["outlier"] * 12 + ["unmatched"] * 8
    assert np.isnan(seen.pixels).all()


def test_what_the_filter_did_not_use_is_an_outlier_and_new_landmarks_are_rows_below():
    seen = judged(range(6), range(6)).but_for(np.arange(COUNT) < 4)
    assert seen.labels.tolist() == ["matched"] * 4 + ["outlier"] * 2 + ["unmatched"] * 14
    longer = seen.with_new(np.array([[7.0, 8.0]]))
    assert longer.labels[-1] == "new"
    np.testing.assert_array_equal(longer.labelled("new").pixels, [[7.0, 8.0]])
    assert len(longer.slots) == COUNT + 1
