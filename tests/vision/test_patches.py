"""Corners, warped patches and active search, against positions known exactly."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxslam.video.opening import open_source
from jaxslam.vision.corners import detect_corners
from jaxslam.vision.matching import match_patch, match_patches
from jaxslam.vision.patches import Patch
from jaxslam.vision.synthetic import add_noise, synthetic_source

DATA = Path(__file__).parents[3] / "shared" / "data"
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
    corners = detect_corners(
        frame, 10, occupied=left.reshape(-1, 2).astype(float), min_distance=10, border=20
    )
    assert len(corners) == 10
    assert np.all(corners[:, 0] > 300)


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


def test_patch_has_the_sub_pixel_position_in_its_centre():
    image = np.arange(60, dtype=np.uint8)[None, :] + 2 * np.arange(60, dtype=np.uint8)[:, None]
    patch = Patch.take(image, np.array([30.25, 28.5]))
    assert patch.stored.shape == (41, 41)
    assert patch.stored[20, 20] == pytest.approx(30.25 + 2 * 28.5, abs=1e-3)
    np.testing.assert_allclose(patch.warped(np.eye(2)), patch.stored[13:28, 13:28], atol=1e-3)


@pytest.mark.parametrize(
    "warp", [[[1.3, 0.0], [0.0, 1.3]], [[0.9, -0.4], [0.4, 0.9]], [[0.6, 0.1], [0.0, 0.8]]]
)
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
    with pytest.raises(ValueError, match="odd sides"):
        Patch.take(picture(), CENTRE, window=14)


def test_match_is_exact_to_a_tenth_of_a_pixel():
    template = Patch.take(picture(seed=1), CENTRE).warped(np.eye(2))
    errors = []
    for seed, shift in enumerate(np.random.default_rng(2).uniform(-5, 5, (40, 2))):
        match = match_patch(picture(shift=shift, seed=seed), template, CENTRE, np.eye(2) * 9)
        assert match is not None
        assert match.score > 0.95
        errors.append(match.pixel - CENTRE - shift)
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02


def test_match_does_not_depend_on_gain_and_offset():
    template = Patch.take(picture(sigma=0.0), CENTRE).warped(np.eye(2))
    bright = cv2.convertScaleAbs(picture(shift=(2.3, -1.6), sigma=0.0), alpha=0.5, beta=100)
    match = match_patch(bright, template, CENTRE, np.eye(2) * 4)
    assert match is not None
    np.testing.assert_allclose(match.pixel, [62.3, 58.4], atol=0.05)


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
    assert match_patch(image, template, CENTRE, along * 100, max_radius=4.0) is None


def test_certain_prediction_still_finds_its_pixel():
    template = Patch.take(picture(), CENTRE).warped(np.eye(2))
    match = match_patch(picture(shift=(0.4, 0.4), seed=1), template, CENTRE, np.eye(2) * 1e-4)
    assert match is not None
    np.testing.assert_allclose(match.pixel, CENTRE + 0.4, atol=0.1)


def test_repeated_texture_is_ambiguous():
    x, y = np.meshgrid(np.arange(121), np.arange(121))
    image = np.rint(128 + 50 * np.sin(x * 2 * np.pi / 9) + 50 * np.sin(y * 0.5)).astype(np.uint8)
    template = Patch.take(image, CENTRE).warped(np.eye(2))
    wide = np.diag([16.0, 1.0])
    assert match_patch(image, template, CENTRE, wide) is None
    assert match_patch(image, template, CENTRE, wide, ambiguity=0.0) is not None
    assert match_patch(image, template, CENTRE, np.eye(2)) is not None


@pytest.mark.parametrize(
    ("centre", "covariance"),
    [
        ((-50.0, 60.0), np.eye(2)),
        ((60.0, 500.0), np.eye(2)),
        ((np.nan, 60.0), np.eye(2)),
        ((60.0, 60.0), np.full((2, 2), np.nan)),
        ((60.0, 60.0), -np.eye(2)),
    ],
)
def test_predictions_that_cannot_be_searched_give_none(centre, covariance):
    template = Patch.take(picture(), CENTRE).warped(np.eye(2))
    assert match_patch(picture(), template, np.array(centre), covariance) is None


def test_different_and_flat_images_do_not_match():
    template = Patch.take(picture(), CENTRE).warped(np.eye(2))
    noise = np.random.default_rng(0).integers(0, 255, (121, 121), dtype=np.uint8)
    assert match_patch(noise, template, CENTRE, np.eye(2) * 9) is None
    flat = np.full((121, 121), 90, np.uint8)
    assert match_patch(flat, template, CENTRE, np.eye(2) * 9) is None
    assert match_patch(picture(), np.full((15, 15), 9, np.float32), CENTRE, np.eye(2)) is None


def test_matches_of_a_real_video_obey_the_epipolar_geometry():
    if not (DATA / "costado").is_dir():
        pytest.skip("the shared data set costado is not beside this repository")
    source = open_source(DATA / "costado")
    frames = [frame.image for frame, _ in zip(source, range(11), strict=False)]
    first, last = frames[0], frames[10]
    corners = detect_corners(first, 120, occupied=NOWHERE, min_distance=12, border=25)
    pairs = []
    for corner in corners:
        template = Patch.take(first, corner).warped(np.eye(2))
        match = match_patch(last, template, corner, np.eye(2) * 100, max_radius=25)
        if match is not None:
            pairs.append((corner, match.pixel))
    assert len(pairs) > 60
    before, after = np.array(pairs, np.float32).transpose(1, 0, 2)
    camera, distortion = source.calibration.matrix, np.array(source.calibration.distortion)
    before, after = (
        cv2.undistortPoints(points[:, None], camera, distortion, P=camera)[:, 0]
        for points in (before, after)
    )
    essential, _ = cv2.findEssentialMat(before, after, camera, cv2.RANSAC, 0.999, 1.0)
    fundamental = np.linalg.inv(camera).T @ essential @ np.linalg.inv(camera)
    x, y = (np.column_stack([points, np.ones(len(points))]) for points in (before, after))
    lines, back = x @ fundamental.T, y @ fundamental
    gradient = np.sum(lines[:, :2] ** 2 + back[:, :2] ** 2, axis=1)
    sampson = np.abs(np.sum(y * lines, axis=1)) / np.sqrt(gradient)
    assert np.median(sampson) < 0.25
    assert np.mean(sampson < 1.0) > 0.9


def test_many_patches_at_once_equal_one_by_one():
    rng = np.random.default_rng(5)
    first, second = picture(seed=1), picture(shift=(1.7, -2.2), seed=2)
    centres = rng.uniform(30, 90, (12, 2))
    templates = np.array([Patch.take(first, centre).warped(np.eye(2)) for centre in centres])
    templates[3] = 7.0  # flat: never found
    centres[5] = np.nan
    covariances = np.einsum("n,ij->nij", rng.uniform(2, 9, 12), np.eye(2))
    together = match_patches(second, templates, centres, covariances)
    for index, match in enumerate(together):
        alone = match_patch(second, templates[index], centres[index], covariances[index])
        assert (match is None) == (alone is None)
        if match is not None and alone is not None:
            np.testing.assert_allclose(match.pixel, alone.pixel, atol=1e-4)
            assert match.score == alone.score  # of one and the same call of OpenCV: exact
    assert together[3] is None
    assert together[5] is None
    assert sum(match is not None for match in together) >= 8
    assert match_patches(second, templates[:0], centres[:0], covariances[:0]) == []
