"""Which matches are believed, of a table of what was searched and a table of what was found."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import binom, chi2

pytest.importorskip("cv2")

from jaxslam.io.calibration import from_field_of_view
from jaxslam.tracking.landmarks import Landmark
from jaxslam.tracking.matching import Matches
from jaxslam.tracking.observations import NOTHING, Lost, Observations, Prediction
from jaxslam.tracking.patches import STORED, Patch
from jaxslam.tracking.policy import (
    BY_CHANCE,
    CHANCE_LOST,
    LEAST_MATCHES,
    PROVEN,
    TOGETHER,
    Policy,
    more_than_chance,
)
from jaxslam.tracking.settings import TrackerSettings

COUNT = 20
CAMERA = from_field_of_view(640, 480)
POLICY = Policy(CAMERA, TrackerSettings(), ambiguous_start=False)
PATCH = Patch(np.zeros(2), np.zeros((STORED, STORED), np.float32))
ASIDE = np.array([1.0, 0.0])
PLACES = np.random.default_rng(0).uniform(50, 400, (COUNT, 2))
SLOTS = np.arange(COUNT) + 3
LANDMARKS = {slot: Landmark(slot, PATCH, np.eye(4), np.zeros(2)) for slot in SLOTS.tolist()}


def table(sigma=2.0):
    covariances = np.tile(sigma**2 * np.eye(2), (COUNT, 1, 1))
    nowhere, labels = np.full((COUNT, 2), np.nan), np.full(COUNT, "unmatched")
    return Observations(SLOTS, PLACES, covariances, nowhere, np.zeros(COUNT), labels)


def agreeing(found, agreeing, lost=False, sigma=2.0, variances=0.0, landmarks=LANDMARKS):
    """Of landmarks found a pixel aside, those agree whose rows are told."""
    owner = np.array(found, int)
    scores, variances = np.ones(len(owner), np.float32), np.resize(variances, len(owner))
    matches = Matches(owner, PLACES[owner] + ASIDE, scores, variances)

    def agree(slots, those):
        assert those is matches
        return np.isin(slots, SLOTS[list(agreeing)])

    return POLICY.agreeing(table(sigma), matches, landmarks, agree, lost=lost)


def test_what_agrees_is_matched_and_the_rest_of_what_was_found_is_an_outlier():
    seen = agreeing(range(12), range(8))
    assert seen.labels.tolist() == ["matched"] * 8 + ["outlier"] * 4 + ["unmatched"] * 8
    np.testing.assert_array_equal(seen.pixels[:12], PLACES[:12] + ASIDE)
    assert np.isnan(seen.pixels[12:]).all()
    assert np.isnan(seen.believed[8:]).all()
    np.testing.assert_array_equal(seen.places, np.where(seen.matched[:, None], seen.pixels, PLACES))


@pytest.mark.parametrize(
    ("others", "own", "first", "believed"),
    [(1e-4, 0.0135, 0, True), (1e-4, 0.0137, 0, False), (1e-4, 0.0137, 1, True),
     (0.01, 0.0399, 0, True), (0.01, 0.0401, 0, False)],
)  # fmt: skip
def test_a_landmark_is_first_matched_where_its_window_fits(others, own, first, believed):
    """By σ of .7 px with the factor of 6, or by that of twice the median where all fit badly."""
    landmarks = LANDMARKS | {SLOTS[0]: replace(LANDMARKS[SLOTS[0]], found=first)}
    variances = np.append(own, np.full(7, others))
    seen = agreeing(range(8), range(8), variances=variances, landmarks=landmarks)
    assert seen.labels[0] == ("matched" if believed else "outlier")
    assert seen.matched[1:8].all()


def test_fewer_than_chance_would_give_are_not_believed_and_a_lost_camera_needs_more():
    least, more = more_than_chance(COUNT), more_than_chance(COUNT, CHANCE_LOST)
    assert least < more < COUNT
    for count, lost, believed in (
        (least, False, least), (least - 1, False, 0), (more - 1, True, 0), (more, True, more),
    ):  # fmt: skip
        assert agreeing(range(COUNT), range(count), lost).matched.sum() == believed


@pytest.mark.parametrize("searched", [4, 8, 12, 50])
def test_so_many_matches_are_not_there_by_chance(searched):
    """One in twenty landmarks is found by chance, a frame is believed by chance once in 1000; and
    three matches agree with some pose, of which a fourth is a check."""
    least = more_than_chance(searched)
    assert binom.sf(least - 1, searched, 0.05) < 1e-3
    assert least == LEAST_MATCHES == 4 or binom.sf(least - 2, searched, 0.05) > 1e-3
    assert searched > 8 or least == 4


def test_where_a_linear_test_puts_out_most_of_what_moved_together_that_is_believed():
    """Of a start that no linear prediction expects; half of it is not most."""
    policy = Policy(CAMERA, TrackerSettings(), ambiguous_start=True)
    landmarks = {
        slot: replace(LANDMARKS[slot], seen_at=place)
        for slot, place in zip(SLOTS.tolist(), PLACES, strict=True)
    }
    matches = Matches(np.arange(COUNT), PLACES + ASIDE, np.ones(COUNT, np.float32), np.zeros(COUNT))
    for linear, believed in ((COUNT // 2, COUNT // 2), (COUNT // 2 - 1, COUNT)):

        def agree(slots, matches, association=None, linear=linear):
            return np.isin(slots, SLOTS[:linear]) | (association is not None)

        chosen = policy._of_several(SLOTS, matches, landmarks, agree, LEAST_MATCHES)
        np.testing.assert_array_equal(chosen, np.arange(believed))


def test_what_the_filter_did_not_use_is_an_outlier_and_new_landmarks_are_rows_below():
    seen = agreeing(range(6), range(6)).but_for(np.arange(COUNT) < 4)
    assert seen.labels.tolist() == ["matched"] * 4 + ["outlier"] * 2 + ["unmatched"] * 14
    longer = seen.with_new(np.array([[7.0, 8.0]]))
    assert longer.labels[-1] == "new"
    np.testing.assert_array_equal(longer.labelled("new").pixels, [[7.0, 8.0]])
    assert len(longer.slots) == COUNT + 1


def proven_landmarks(count=COUNT):
    return {
        slot: replace(LANDMARKS[slot], found=PROVEN if row < count else PROVEN - 1)
        for row, slot in enumerate(SLOTS.tolist())
    }


def likely(seen):
    """NIS of pixels that are expected where they are found."""
    return 0.0, 2 * len(seen.slots)


def nothing(slots, matches):
    """No motion that these agree with."""
    return np.zeros(len(slots), bool)


def everything(slots, matches):
    """They all agree with one motion."""
    return np.ones(len(slots), bool)


def found(matched, outliers):
    labels = np.full(COUNT, "unmatched")
    labels[:matched], labels[matched : matched + outliers] = "matched", "outlier"
    return table()._replace(pixels=PLACES + ASIDE, labels=labels)


def test_proven_landmarks_that_agree_with_another_motion_contradict():
    """As many as a third of those that agree, and most of those that do not."""
    half = np.arange(COUNT) % 2 == 0

    def judged(matched, outliers, agree=everything, count=COUNT):
        seen = found(matched, outliers)
        return POLICY.reason(seen, proven_landmarks(count), agree, likely)[0]

    assert judged(12, 8) is judged(15, 5) is Lost.CONTRADICTED
    assert judged(16, 4) is None
    assert judged(12, 8, nothing) is None
    assert judged(12, 8, lambda slots, _: half[: len(slots)]) is None
    assert judged(12, 8, count=15) is None  # three of the eight are proven


def test_after_a_contradiction_most_of_the_proven_landmarks_must_agree():
    """The picture's other half may have gone from where it is looked for."""
    doubtful = False

    def judged(*counts):
        nonlocal doubtful
        seen = found(*counts), proven_landmarks(), everything, likely
        reason, doubtful = POLICY.reason(*seen, doubtful=doubtful)
        return reason

    assert judged(10, 0) is None
    assert judged(10, 10) is Lost.CONTRADICTED
    assert judged(13, 0) is Lost.CONTRADICTED
    assert judged(14, 0) is None
    assert judged(10, 0) is None
    assert judged(10, 10) is Lost.CONTRADICTED
    doubtful = False  # in another map
    assert judged(10, 0) is None


def test_proven_landmarks_that_are_improbable_together_contradict():
    for count, reason in ((COUNT, Lost.CONTRADICTED), (0, None)):
        for beyond, expected in ((1.01, reason), (0.99, None)):
            worst = beyond * chi2.isf(BY_CHANCE, 2 * COUNT)

            def nis(seen, worst=worst):
                return worst * (len(seen.slots) == COUNT), 2 * len(seen.slots)

            seen, landmarks = found(COUNT, 0), proven_landmarks(count)
            assert POLICY.reason(seen, landmarks, everything, nis)[0] is expected


def test_a_frame_without_expected_landmarks_and_one_without_matches_say_so():
    judged = partial(POLICY.reason, agree=nothing, nis=likely)
    assert judged(NOTHING, {}) == (Lost.NOTHING_EXPECTED, False)
    assert judged(table(), LANDMARKS, doubtful=True) == (Lost.FEW_AGREE, True)
    seen = table()._replace(pixels=PLACES, labels=np.full(COUNT, "matched"))
    assert judged(seen, LANDMARKS) == (None, False)


def test_a_second_search_is_wider_by_the_square_of_the_turn_over_twice_the_focal_length():
    seen = found(COUNT, 0)._replace(pixels=PLACES + np.array([60.0, 80.0]))
    covariances, ones = table().covariances, np.ones(COUNT)
    fields = PLACES, covariances, ones > 0, np.eye(4), np.ones((COUNT, 3)), ones
    given = Prediction(*fields)
    added = POLICY._closer(seen, given).covariances - covariances
    sigma = 1.5 + 100**2 / (2 * CAMERA.fx)
    np.testing.assert_allclose(added, np.tile(sigma**2 * np.eye(2), (COUNT, 1, 1)))


def test_matches_that_are_not_proven_must_be_likely_given_those_that_are():
    """Where there are some of both: those that are all proven, or hardly any, are not asked."""

    def judged(count, beyond):
        more = chi2.isf(TOGETHER, 2 * (COUNT - count)) if count < COUNT else 1.0

        def nis(seen):
            return 5.0 + beyond * more * (len(seen.slots) > count), 2 * len(seen.slots)

        return POLICY._likely_given_proven(found(COUNT, 0), proven_landmarks(count), nis)

    for count in (LEAST_MATCHES, COUNT - 1):
        assert judged(count, 0.99)
        assert not judged(count, 1.01)
    assert judged(LEAST_MATCHES - 1, 1.01)
    assert judged(COUNT, 1.01)
