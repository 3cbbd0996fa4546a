"""Known points: their file, where the first picture shows them, the metre that they give."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.cli import main
from jaxslam.io.opening import open_source
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import room, synthetic_source
from jaxslam.tracking.target import KnownPoint, Target, read_target, sighted
from jaxslam.tracking.tracker import Tracker

FRAMES = 8
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
SMALL = TrackerSettings(filter="world", wanted=12, spare=4)


@pytest.fixture(scope="module")
def video():
    source = synthetic_source(frames=FRAMES, width=480, height=360)
    return source, list(source)


@pytest.fixture(scope="module")
def card(video):
    """The nearest card's four corners: positions in a frame of its own, points and pixels seen."""
    source, _ = video
    quad = room(0, source.calibration.fx)[-1]
    ends = quad.corner + np.array([0 * quad.right, quad.right, quad.right + quad.down, quad.down])
    pixels = ends @ source.calibration.matrix.T
    return (ends - ends.mean(axis=0)) @ TURN.T, ends, pixels[:, :2] / pixels[:, 2:]


def patch(image, pixel):
    u, v = np.rint(pixel).astype(int)
    return image[v - 6 : v + 7, u - 6 : u + 7]


def target(card, image=None):
    """Of pixels, or of patches out of a picture."""
    positions, _, pixels = card
    points = [
        KnownPoint(str(i), position, pixel=pixel)
        if image is None
        else KnownPoint(str(i), position, patch=patch(image, pixel))
        for i, (position, pixel) in enumerate(zip(positions, pixels, strict=True))
    ]
    return Target(tuple(points))


def test_pixels_tell_the_pose_and_the_depths(video, card):
    source, frames = video
    seen = sighted(target(card), frames[0].image, source.calibration, 0.3)
    _, ends, pixels = card
    np.testing.assert_array_equal(seen.pixels, pixels)
    # Exact pixels.
    np.testing.assert_allclose(1 / seen.inverse_depths, ends[:, 2], rtol=1e-6)
    np.testing.assert_allclose(seen.T_ct[:3, :3], TURN.T, rtol=0, atol=1e-6)
    np.testing.assert_allclose(seen.T_ct[:3, 3], ends.mean(axis=0), rtol=0, atol=1e-6)
    assert seen.rms < 1e-4


def test_patches_are_found_all_over_the_picture(video, card):
    source, frames = video
    seen = sighted(target(card, frames[0].image), frames[0].image, source.calibration, 0.3)
    _, ends, pixels = card
    # The card's frame has no sharp corner: its edges are averaged over a pixel.
    np.testing.assert_allclose(seen.pixels, pixels, rtol=0, atol=1.0)
    assert np.all(np.abs(seen.inverse_depths - 1 / ends[:, 2]) < 3 * seen.sigma)


def test_the_sigma_of_the_depths_covers_what_pixels_do(video, card):
    """Of all weighted sums of depths, those that errors have in common included."""
    source, frames = video
    exact, draw = target(card), np.random.default_rng(0)
    said = sighted(exact, frames[0].image, source.calibration, 0.3).sigma
    errors = []
    for _ in range(100):
        pixels = card[2] + 0.3 * draw.normal(size=(4, 2))
        noisy = target((card[0], card[1], pixels))
        seen = sighted(noisy, frames[0].image, source.calibration, 0.3)
        errors.append(seen.inverse_depths - 1 / card[1][:, 2])
    covariance = np.cov(np.transpose(errors))
    # 100 draws tell a σ to 7 %; the bound is met with equality where all is common, by √4 of each.
    assert np.linalg.eigvalsh(np.diag(1.3 * said**2) - covariance)[0] > 0
    np.testing.assert_allclose(said, 2 * np.sqrt(np.diag(covariance)), rtol=0.25)


@pytest.fixture(scope="module")
def tracked(video, card):
    """By a tracker with the target, and a prior on depth that is far off."""
    source, frames = video
    settings = replace(SMALL, nearest_depth=5.0)
    tracker = Tracker(source.calibration, settings, target=target(card, frames[0].image))
    return tracker, [tracker.track(frame) for frame in frames]


def test_the_map_is_in_metres_and_the_targets_points_are_its_first_landmarks(video, card, tracked):
    tracker, (*_, last) = tracked
    assert tracker.sighting is not None
    points = tracker.points()
    order = np.argsort(points.numbers)[:4]
    np.testing.assert_allclose(points.points[order], card[1], rtol=0, atol=0.05)
    assert last.state == "tracked"
    assert video[0].reference is not None
    moved = np.linalg.norm(last.T_wc[:3, 3])
    # A map without a target has no metre, and is twice as large.
    assert moved == pytest.approx(np.linalg.norm(video[0].reference.T_wc[-1][:3, 3]), rel=0.2)


def test_other_landmarks_keep_away_from_the_targets(video, card):
    source, frames = video
    tracker = Tracker(source.calibration, SMALL, target=target(card))
    created = tracker.track(frames[0]).created
    assert len(created) <= SMALL.wanted
    np.testing.assert_array_equal(created[:4], card[2])
    apart = np.linalg.norm(created[4:, None] - card[2], axis=2)
    assert apart.min() >= SMALL.spacing


def test_a_picture_without_the_target_is_refused_and_nothing_changes(video, card):
    source, frames = video
    shown = target((card[0], card[1], card[2][[1, 0, 2, 3]]))
    tracker = Tracker(source.calibration, SMALL, target=shown)
    with pytest.raises(ValueError, match=r"does not show the target: its points are off by .* px"):
        tracker.track(frames[0])
    assert tracker.steps == tracker.created == 0
    dark = np.zeros_like(frames[0].image)
    with pytest.raises(ValueError, match="shows nothing like the patch of point 0"):
        sighted(target(card, frames[0].image), dark, source.calibration, 0.3)


def write(path, fields):
    path.write_text(fields if isinstance(fields, str) else json.dumps(fields))
    return path


def test_a_target_is_read_with_patches_beside_it(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.arange(121, dtype=np.uint8).reshape(11, 11))
    corners = [{"position": [x, y, 0.0], "pixel": [1.0, 2.0]} for x, y in ((0, 0), (1, 0), (1, 1))]
    points = [*corners, {"name": "d", "position": [0, 1, 0.5], "patch": "0.png"}]
    read = read_target(write(tmp_path / "t.json", {"unit": "metre", "points": points}))
    np.testing.assert_array_equal(read.positions[3], [0, 1, 0.5])
    assert read.points[0].pixel is not None
    assert read.points[0].pixel.tolist() == [1.0, 2.0]
    assert read.points[3].patch is not None
    assert read.points[3].patch[1, 0] == 11
    assert [p.name for p in read.points] == ["0", "1", "2", "d"]


@pytest.mark.slow
def test_the_command_takes_a_target(video, card, tmp_path, capsys):
    """The way from the file to the filter, and into the summary."""
    _, frames = video
    film = tmp_path / "film"
    film.mkdir()
    for frame in frames[:3]:
        cv2.imwrite(str(film / f"{frame.index}.png"), frame.image)
    points = [
        {"position": p.tolist(), "pixel": u.tolist()} for p, u in zip(card[0], card[2], strict=True)
    ]
    file = write(tmp_path / "target.json", {"points": points})
    lens = ["--fov", "62.7", "--calibration-treatment", "known", "--wanted", "12"]
    main(["track", str(film), *lens, "--target", str(file), "--out", str(tmp_path / "out")])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    # The field of view is right to half a percent.
    np.testing.assert_allclose(summary["target"]["depths"], card[1][:, 2], rtol=0.02)
    assert summary["target"]["reprojection_rms"] < 1
    assert summary["calibration"]["treatment"] == "known"
    assert "3 of 3 frames tracked" in capsys.readouterr().out


def test_the_desks_target_is_found_in_its_first_picture(shared_data):
    desk = shared_data / "monoslam_desk"
    source = open_source(desk, start=1.8)
    frame = next(iter(source))
    assert frame.index == 54
    seen = sighted(read_target(desk / "target.json"), frame.image, source.calibration, 0.3)
    measured = np.loadtxt(desk / "target_pixels.txt")
    pixels = measured[measured[:, 0] == 54, 1:].reshape(4, 2)
    np.testing.assert_allclose(seen.pixels, pixels, rtol=0, atol=0.2)
    assert source.reference is not None
    T_ct = np.linalg.inv(source.reference.T_wc[54])
    positions = read_target(desk / "target.json").positions
    depths = (positions @ T_ct[:3, :3].T + T_ct[:3, 3])[:, 2]
    assert np.all(np.abs(seen.inverse_depths - 1 / depths) < 3 * seen.sigma)
