"""Corners, warped patches and active search, against positions known exactly."""

from typing import NamedTuple

import cv2
import numpy as np
import pytest

from jaxslam.tracking import matching
from jaxslam.tracking.corners import bare_corners, detect_corners
from jaxslam.tracking.matching import PEAKS, match_patches
from jaxslam.tracking.patches import Patch
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import add_noise, synthetic_source

NOWHERE = np.empty((0, 2))


def waves(x, y):
    """A smooth texture that does not repeat within 100 pixels, known at any position."""
    grey = np.full(np.broadcast(x, y).shape, 128.0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        fx, fy = rng.uniform(-0.7, 0.7, 2)
        grey = grey + 14 * np.sin(fx * x + fy * y + rng.uniform(0, 6.28))
    return np.clip(grey, 0, 255)


def picture(warp=((1, 0), (0, 1)), shift=(0.0, 0.0), size=121, sigma=2.0, seed=0):
    """The texture seen through x -> warp x + shift, about the image's centre, with noise."""
    line = np.arange(size) - size // 2
    offset = np.stack(np.meshgrid(line, line), -1)
    at = (offset - np.asarray(shift)) @ np.linalg.inv(warp).T
    image = np.rint(waves(at[..., 0], at[..., 1])).astype(np.uint8)
    return add_noise(image, np.random.default_rng(seed), sigma)


CENTRE = np.array([60.0, 60.0])


class Place(NamedTuple):
    pixel: np.ndarray
    score: float


def places_of(image, templates, centres, covariances, **how):
    """The places of each patch, of a table in their order."""
    found = match_patches(image, templates, centres, covariances, **how)
    assert np.all(np.diff(found.owner) >= 0)
    places = [[] for _ in templates]
    for owner, pixel, score, _ in zip(*found, strict=True):
        places[owner].append(Place(pixel, score))
    first, _ = found.first_of_each(len(templates))
    for row, own in zip(first, places, strict=True):
        np.testing.assert_array_equal(row, own[0].pixel if own else np.full(2, np.nan))
    return places


def match_patch(image, template, centre, covariance, **how):
    """The best place of one patch, if there is one."""
    (found,) = places_of(image, template[None], centre[None], covariance[None], **how)
    return found[0] if found else None


def test_patch_has_the_sub_pixel_position_in_its_centre():
    image = np.arange(60, dtype=np.uint8)[None, :] + 2 * np.arange(60, dtype=np.uint8)[:, None]
    patch = Patch.take(image, np.array([30.25, 28.5]))
    assert patch.stored.shape == (41, 41)
    assert patch.stored[20, 20] == pytest.approx(30.25 + 2 * 28.5, abs=1e-3)
    np.testing.assert_allclose(patch.warped(np.eye(2)), patch.stored[13:28, 13:28], atol=1e-3)


@pytest.mark.parametrize("warp", [[[0.9, -0.4], [0.4, 0.9]], [[0.6, 0.1], [0.0, 0.8]]])
def test_warped_patch_looks_as_the_warped_image(warp):
    warp = np.array(warp)
    patch = Patch.take(picture(sigma=0.0), CENTRE)
    direct = Patch.take(picture(warp, sigma=0.0), CENTRE).warped(np.eye(2))
    assert patch.covers(warp)
    score = np.corrcoef(patch.warped(warp).ravel(), direct.ravel())[0, 1]
    unwarped = np.corrcoef(patch.warped(np.eye(2)).ravel(), direct.ravel())[0, 1]
    assert score > 0.98
    assert score > unwarped + 0.02


def test_warps_beyond_the_stored_patch_are_told():
    patch = Patch.take(picture(), CENTRE)
    assert patch.covers(np.eye(2) * 0.4)
    assert not patch.covers(np.eye(2) * 0.3)
    assert not patch.covers(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="singular"):
        patch.warped(np.ones((2, 2)))


def test_match_is_exact_to_a_tenth_of_a_pixel():
    template = Patch.take(picture(seed=1), CENTRE).warped(np.eye(2))
    errors = []
    for seed, shift in enumerate(np.random.default_rng(2).uniform(-5, 5, (20, 2))):
        match = match_patch(picture(shift=shift, seed=seed), template, CENTRE, np.eye(2) * 9)
        assert match is not None
        assert match.score > 0.95
        errors.append(match.pixel - CENTRE - shift)
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.abs(np.mean(errors, axis=0)).max() < 0.03


def test_the_variance_of_a_place_is_that_of_its_errors_where_pixels_are_noise():
    """Noise on the picture and on the template, as in the tracker; a worse one says so."""
    told, errors = [], []
    for sigma in (3.0, 9.0):
        template = Patch.take(picture(sigma=0.0), CENTRE).warped(np.eye(2))[None]
        found = [
            match_patches(picture(sigma=sigma, seed=seed), template, CENTRE[None], np.eye(2)[None])
            for seed in range(60)
        ]
        told.append(np.mean([one.variances for one in found]))
        errors.append(np.mean([(one.pixels - CENTRE) ** 2 for one in found]))
    np.testing.assert_allclose(told, errors, rtol=0.4)
    assert told[1] > 5 * told[0]


@pytest.mark.parametrize("warp", [[[1.2, 0.05], [-0.05, 0.85]], [[0.85, 0.15], [0.1, 1.05]]])
def test_a_patch_that_is_not_seen_as_it_was_expected_is_where_it_is(warp):
    """As one that does not face its first camera, after a turn about it."""
    centres = np.random.default_rng(3).uniform(45, 75, (20, 2))
    first, second = picture(), picture(warp, seed=1)
    templates = np.array([Patch.take(first, at).warped(np.eye(2)) for at in centres])
    truth = CENTRE + (centres - CENTRE) @ np.transpose(warp)
    found = match_patches(second, templates, truth, np.tile(np.eye(2), (20, 1, 1)))
    errors = np.linalg.norm(found.pixels - truth[found.owner], axis=1)
    assert len(errors) >= 12
    assert np.median(errors) < 0.06


def test_only_the_ellipse_is_searched():
    template = Patch.take(picture(), CENTRE).warped(np.eye(2))
    image = picture(shift=(6.0, 0.0))
    along, across = np.diag([9.0, 0.5]), np.diag([0.5, 9.0])
    assert match_patch(image, template, CENTRE, along) is not None
    assert match_patch(image, template, CENTRE, across) is None
    # A tilted one reaches the same place only along its axis.
    diagonal = picture(shift=(4.0, 4.0))
    tilt = np.array([[4.0, 3.6], [3.6, 4.0]])
    assert match_patch(diagonal, template, CENTRE, tilt) is not None
    assert match_patch(diagonal, template, CENTRE, tilt * [[1, -1], [-1, 1]]) is None


def test_repeated_texture_is_ambiguous():
    x, y = np.meshgrid(np.arange(121), np.arange(121))
    image = np.rint(128 + 50 * np.sin(x * 2 * np.pi / 9) + 50 * np.sin(y * 0.5)).astype(np.uint8)
    template = Patch.take(image, CENTRE).warped(np.eye(2))
    wide = np.diag([16.0, 1.0])
    assert match_patch(image, template, CENTRE, wide) is None
    assert match_patch(image, template, CENTRE, np.eye(2)) is not None


NOISE = np.random.default_rng(0).integers(0, 255, (121, 121), dtype=np.uint8)
FLAT = np.full((121, 121), 90, np.uint8)


@pytest.mark.parametrize(
    ("centre", "covariance", "image"),
    [
        ((-50.0, 60.0), np.eye(2), None),
        ((60.0, 500.0), np.eye(2), None),
        ((np.nan, 60.0), np.eye(2), None),
        ((60.0, 60.0), np.full((2, 2), np.nan), None),
        ((60.0, 60.0), -np.eye(2), None),
        ((60.0, 60.0), 9 * np.eye(2), NOISE),
        ((60.0, 60.0), 9 * np.eye(2), FLAT),
    ],
)
def test_what_cannot_be_searched_or_looks_otherwise_is_not_found(centre, covariance, image):
    template = Patch.take(picture(), CENTRE).warped(np.eye(2))
    image = picture() if image is None else image
    assert match_patch(image, template, np.array(centre), covariance) is None


def test_many_patches_at_once_equal_one_by_one():
    rng = np.random.default_rng(5)
    first, second = picture(seed=1), picture(shift=(1.7, -2.2), seed=2)
    centres = rng.uniform(30, 90, (12, 2))
    templates = np.array([Patch.take(first, centre).warped(np.eye(2)) for centre in centres])
    templates[3] = 7.0  # flat: never found
    centres[5] = np.nan
    covariances = np.einsum("n,ij->nij", rng.uniform(2, 9, 12), np.eye(2))
    together = match_patches(second, templates, centres, covariances)
    for k in range(12):
        one = slice(k, k + 1)
        alone = match_patches(second, templates[one], centres[one], covariances[one])
        np.testing.assert_allclose(together.pixels[together.owner == k], alone.pixels, atol=1e-4)
        # Of one and the same call of OpenCV: exact.
        np.testing.assert_array_equal(together.scores[together.owner == k], alone.scores)
    assert set(together.owner) <= set(range(12)) - {3, 5}
    assert len(set(together.owner)) >= 8
    none = match_patches(second, templates[:0], centres[:0], covariances[:0])
    assert [len(part) for part in none] == [0] * 4
    # In a wide ellipse nothing is found of what is flat, either.
    assert match_patch(texture(), np.full_like(templates[0], 9), CENTRE + 150, WIDE) is None
    flat = np.full((480, 640), 90, np.uint8)
    assert match_patch(flat, templates[0], CENTRE + 150, WIDE) is None


def texture(width=640, height=480, seed=4):
    """Blurred noise: nothing in it is like anything else."""
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 35 * smooth / smooth.std(), 0, 255).astype(np.uint8)


WIDE = np.diag([50.0**2, 50.0**2])  # gate: 152 pixels to each side


@pytest.mark.parametrize(("sigma", "found"), [(8.0, False), (18.0, True)])
def test_a_second_place_that_is_nearly_as_much_alike_is_ambiguous(sigma, found):
    """Their correlations are .03 and .1 apart."""
    image, place, (u, v) = texture(), np.array([250.0, 200.0]), (238, 188)
    template = Patch.take(image, place).warped(np.eye(2))
    other = image[v:, u:][:25, :25].copy()
    image[v:, u + 26 :][:25, :25] = add_noise(other, np.random.default_rng(0), sigma)
    match = match_patch(image, template, place + np.array([13, 0]), np.diag([40.0, 1.0]))
    assert (match is not None) == found


def test_an_ellipse_is_cut_at_a_quarter_of_the_width():
    template = Patch.take(texture(), CENTRE + 150).warped(np.eye(2))
    for away, found in ((158, True), (163, False)):
        match = match_patch(texture(), template, CENTRE + 150 + [away, 0], WIDE * 4)
        there = match is not None and np.linalg.norm(match.pixel - CENTRE - 150) < 1
        assert there == found


def test_the_wide_search_finds_what_the_whole_one_finds(monkeypatch):
    """Of half the size nothing is missed that is found pixel by pixel, whatever its place."""
    first = texture()
    second = add_noise(cv2.GaussianBlur(first, (0, 0), 0.7), np.random.default_rng(1), 6.0)
    rng = np.random.default_rng(2)
    places = rng.uniform((180, 180), (460, 300), (40, 2))
    templates = np.array([Patch.take(first, place).warped(np.eye(2)) for place in places])
    given = templates, places + rng.uniform(-90, 90, (40, 2)), np.tile(WIDE, (40, 1, 1))
    wide = places_of(second, *given)
    found = [(one[0].pixel, place) for one, place in zip(wide, places, strict=True) if one]
    assert np.median([np.linalg.norm(pixel - place) for pixel, place in found]) < 0.1
    assert len(found) > 30
    monkeypatch.setattr(matching, "_NARROW", np.inf)
    for (one, *_), (other,) in zip(wide, places_of(second, *given), strict=True):
        # The starts differ by the rounding of scores of single precision.
        np.testing.assert_allclose(one.pixel, other.pixel, rtol=0, atol=1e-3)
        assert one.score == pytest.approx(other.score, rel=1e-5)


@pytest.mark.parametrize("shift", [(140, 0), (61, 60)])
def test_of_a_texture_that_is_there_twice_in_a_wide_ellipse_both_places_are_told(shift):
    image = texture()
    u, v = 250, 200
    place = np.array([u, v], float)
    image[v + shift[1] - 12 :, u + shift[0] - 12 :][:25, :25] = image[v - 12 :, u - 12 :][:25, :25]
    template = Patch.take(image, place).warped(np.eye(2))
    centre = place + np.array(shift) / 2
    (places,) = places_of(image, template[None], centre[None], WIDE[None])
    assert len(places) <= PEAKS
    scores = [match.score for match in places]
    assert scores == sorted(scores, reverse=True)
    for there in (place, place + shift):
        assert min(np.linalg.norm(match.pixel - there) for match in places[:2]) < 0.1
    assert match_patch(image, template, centre, WIDE, several=False) is None
    assert match_patch(image, template, place - np.array(shift) / 4, WIDE / 4) is not None


def test_likenesses_outside_of_a_wide_ellipse_do_not_count():
    image, (u, v) = texture(), (321, 241)
    patch = image[v - 12 :, u - 12 :][:25, :25].copy()
    template = Patch.take(image, np.array([321.0, 241.0])).warped(np.eye(2))
    along = np.array([[2000.0, 1960.0], [1960.0, 2000.0]])
    for x, y in [(80, -80), (-80, 80), (110, -60), (-110, 60), (50, -100), (-50, 100), (90, -20)]:
        image[v + y - 12 :, u + x - 12 :][:25, :25] = patch
    image[v - 12 :, u - 12 :][:25, :25] = add_noise(patch, np.random.default_rng(0), 12.0)
    match = match_patch(image, template, np.array([340.0, 260.0]), along)
    assert match is not None
    np.testing.assert_allclose(match.pixel, [u, v], atol=0.3)


# --- corners --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frame():
    return next(iter(synthetic_source(1, seed=3))).image


def test_corners_keep_their_distances_and_cover_the_image(frame):
    occupied = np.array([[100.0, 100.0], [500.0, 300.0]])
    corners = detect_corners(frame, 48, occupied=occupied, min_distance=15, border=20)
    assert len(corners) == 48
    points = np.concatenate([corners, occupied])
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert distances[np.triu_indices(len(points), 1)].min() >= 15
    assert np.all((corners >= 20) & (corners <= np.array([639, 479]) - 20))
    quarters = np.bincount((corners[:, 0] > 320) * 2 + (corners[:, 1] > 240), minlength=4)
    assert quarters.min() >= 8


def test_new_corners_go_where_there_are_none(frame):
    left = np.stack(np.meshgrid(np.arange(40, 320, 40), np.arange(40, 480, 40)), -1)
    occupied = left.reshape(-1, 2).astype(float)
    corners = detect_corners(frame, 10, occupied=occupied, min_distance=10, border=20)
    assert len(corners) == 10
    assert np.all(corners[:, 0] > 300)


@pytest.mark.parametrize(
    ("seen", "corners"), [(None, 20), (0, 5), (15, 5), (17, 3), (20, 0), (24, 0)]
)
def test_a_map_is_filled_up_by_a_few_corners_a_frame_to_as_many_as_are_wanted(frame, seen, corners):
    settings = TrackerSettings(wanted=20, new_per_frame=5)
    occupied = None if seen is None else np.full((seen, 2), 100.0)
    assert len(bare_corners(frame, settings, occupied)) == corners


def test_corner_of_a_square_is_found_with_its_fraction():
    big = np.full((8 * 80, 8 * 80), 60, np.uint8)
    big[8 * 30 + 3 :, 8 * 40 + 6 :] = 200
    image = cv2.resize(big, (80, 80), interpolation=cv2.INTER_AREA)
    corners = detect_corners(image, 5, occupied=NOWHERE, min_distance=10, border=10)
    assert len(corners) == 1
    # The edge lies between pixels: position 8 k + j of the large image is k + (j - 3.5) / 8.
    np.testing.assert_allclose(corners[0], [40 + 2 / 8, 30 - 1 / 8], atol=0.25)


def test_flat_and_full_images_give_no_corners(frame):
    flat = np.full((100, 100), 90, np.uint8)
    assert detect_corners(flat, 5, occupied=NOWHERE, min_distance=5, border=5).shape == (0, 2)
    assert len(detect_corners(frame, 0, occupied=NOWHERE, min_distance=5, border=5)) == 0
    grid = np.stack(np.meshgrid(np.arange(0.0, 640, 8), np.arange(0.0, 480, 8)), -1).reshape(-1, 2)
    assert len(detect_corners(frame, 9, occupied=grid, min_distance=20, border=5)) == 0
