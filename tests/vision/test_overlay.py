"""The overlay and its video, the point cloud and the picture of the map."""

import re

import cv2
import numpy as np
import pytest

from jaxslam.plots.tracking import plot_map
from jaxslam.vision.overlay import COLOURS, STRIP, OverlayWriter, draw_overlay, overlay_size
from jaxslam.vision.pointcloud import write_ply

GREY = np.full((120, 640), 100, np.uint8)
NOTHING = np.full((1, 2), np.nan)


def coloured(overlay, status):
    """Rows and columns of the image (without the legend) where a status' colour is drawn."""
    difference = np.abs(overlay[:-STRIP].astype(int) - COLOURS[status]).max(axis=2)
    return np.argwhere(difference < 30)


def draw(predicted, covariance, matched, status):
    return draw_overlay(
        GREY,
        predicted=np.asarray(predicted, float).reshape(-1, 2),
        covariances=np.asarray(covariance, float).reshape(-1, 2, 2),
        matched=np.asarray(matched, float).reshape(-1, 2),
        status=[status],
        index=3,
        time=0.1,
    )


def test_ellipse_reaches_three_sigma_along_its_axes():
    overlay = draw([200.0, 60.0], np.diag([100.0, 9.0]), NOTHING, "unmatched")
    rows, columns = coloured(overlay, "unmatched").T
    assert columns.min() == pytest.approx(200 - 30, abs=1)
    assert columns.max() == pytest.approx(200 + 30, abs=1)
    assert rows.min() == pytest.approx(60 - 9, abs=1)
    assert rows.max() == pytest.approx(60 + 9, abs=1)


def test_ellipse_is_tilted_as_its_covariance():
    overlay = draw([200.0, 60.0], [[50.0, 45.0], [45.0, 50.0]], NOTHING, "unmatched")
    rows, columns = coloured(overlay, "unmatched").T
    # Positive correlation: right goes with down.
    assert np.corrcoef(rows, columns)[0, 1] > 0.5


def test_match_is_drawn_at_its_pixel_and_joined_to_the_prediction():
    overlay = draw([200.0, 60.0], np.eye(2), [240.0, 60.0], "matched")
    drawn = {tuple(place) for place in coloured(overlay, "matched")}
    assert {(60, 200), (60, 220), (60, 240), (61, 240)} <= drawn


def test_new_landmark_without_prediction_is_drawn():
    overlay = draw(NOTHING, np.full((2, 2), np.nan), [50.0, 40.0], "new")
    rows, columns = coloured(overlay, "new").T
    assert (rows.mean(), columns.mean()) == pytest.approx((40, 50), abs=0.5)


def test_overlay_adds_a_strip_and_refuses_unknown_statuses():
    overlay = draw([200.0, 60.0], np.eye(2), NOTHING, "unmatched")
    assert overlay.shape == (120 + STRIP, 640, 3)
    assert overlay.dtype == np.uint8
    assert overlay_size(640, 120) == (640, 120 + STRIP)
    for colour in COLOURS.values():  # the legend shows every colour
        assert np.any(np.all(overlay[-STRIP:] == colour, axis=2))
    with pytest.raises(ValueError, match="'seen' is unknown; matched, unmatched"):
        draw([200.0, 60.0], np.eye(2), NOTHING, "seen")


def test_a_note_stands_in_the_strip_and_leaves_the_picture():
    plain, noted = (
        draw_overlay(
            GREY,
            predicted=np.zeros((0, 2)),
            covariances=np.zeros((0, 2, 2)),
            matched=np.zeros((0, 2)),
            status=[],
            index=3,
            time=0.1,
            note=note,
        )
        for note in ("", "LOST")
    )
    assert np.all(plain[:-STRIP] == noted[:-STRIP])
    assert np.any(plain[-STRIP:] != noted[-STRIP:])


def read_video(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (found := capture.read())[0]:
        frames.append(found[1])
    capture.release()
    return frames


def shade(index):
    return np.full((48, 64, 3), 20 + 40 * index, np.uint8)


@pytest.mark.parametrize("interruption", [None, KeyboardInterrupt, RuntimeError])
def test_video_is_whole_whatever_ends_it(tmp_path, interruption):
    path = tmp_path / "overlay.mp4"

    def record():
        with OverlayWriter(path, (64, 48), 30.0) as writer:
            for index in range(4):
                writer.write(shade(index))
            assert not path.exists()
            if interruption:
                raise interruption

    if interruption:
        with pytest.raises(interruption):
            record()
    else:
        record()
    frames = read_video(path)
    assert [round(frame.mean(), -1) for frame in frames] == [20, 60, 100, 140]
    assert list(tmp_path.iterdir()) == [path]


def test_video_without_frames_leaves_nothing(tmp_path):
    with OverlayWriter(tmp_path / "overlay.mp4", (64, 48), 30.0):
        pass
    assert list(tmp_path.iterdir()) == []


def test_video_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"ending in \.mp4"):
        OverlayWriter(tmp_path / "overlay.gif", (64, 48), 30.0)
    with (
        pytest.raises(ValueError, match="cannot be opened"),
        OverlayWriter(tmp_path / "missing" / "overlay.mp4", (64, 48), 30.0),
    ):
        pass
    with (
        pytest.raises(ValueError, match="does not fit"),
        OverlayWriter(tmp_path / "overlay.mp4", (64, 48), 30.0) as writer,
    ):
        writer.write(np.zeros((48, 66, 3), np.uint8))


def test_point_cloud_holds_points_and_covariances(tmp_path):
    points = np.array([[1.0, 2.0, 3.0], [-1.5, 0.25, 8.0]])
    covariances = np.array([np.diag([1.0, 2.0, 3.0]), [[4, 1, 2], [1, 5, 3], [2, 3, 6]]])
    write_ply(tmp_path / "map.ply", points, covariances, [7, 9], [0, 1])
    header, rows = (tmp_path / "map.ply").read_text().split("end_header\n")
    assert header.startswith("ply\nformat ascii 1.0\n")
    assert "element vertex 2\n" in header
    assert re.findall(r"property float (\w+)", header) == (
        ["x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"]
    )
    assert "property int id\nproperty int map\n" in header
    table = np.array([row.split() for row in rows.splitlines()], float)
    # Few binary or decimal digits, all of which are written: exact.
    np.testing.assert_array_equal(table[:, :3], points)
    np.testing.assert_array_equal(table[1, 3:9], [4, 1, 2, 5, 3, 6])
    assert table[:, 9:].tolist() == [[7, 0], [9, 1]]


def test_point_cloud_refuses_what_does_not_fit(tmp_path):
    with pytest.raises(ValueError, match="2 points, 1 covariances"):
        write_ply(tmp_path / "map.ply", np.zeros((2, 3)), np.eye(3)[None], [1, 2])
    with pytest.raises(ValueError, match="not finite"):
        write_ply(tmp_path / "map.ply", [[np.nan, 0, 0]], np.eye(3)[None], [1])
    assert list(tmp_path.iterdir()) == []


def test_map_is_drawn_with_and_without_landmarks_and_reference(tmp_path):
    T_wc = np.tile(np.eye(4), (20, 1, 1))
    T_wc[:, 0, 3] = np.linspace(0, 1, 20)
    points = np.random.default_rng(0).normal((0, 0, 4), 1, (30, 3))
    points[0] = (0, 0, 1e6)
    covariances = np.tile(0.01 * np.eye(3), (30, 1, 1))
    plot_map(T_wc, points, covariances, reference=T_wc, path=tmp_path / "full.png")
    plot_map(T_wc, np.empty((0, 3)), np.empty((0, 3, 3)), path=tmp_path / "bare.png")
    full = cv2.imread(str(tmp_path / "full.png"))
    bare = cv2.imread(str(tmp_path / "bare.png"))
    green = np.array([115, 158, 0])  # the landmarks' colour, blue first

    def landmarks(image):
        return int(np.sum(np.abs(image.astype(int) - green).max(axis=2) < 10))

    plot_map(
        T_wc,
        points,
        covariances,
        path=tmp_path / "two.png",
        begun=[10],
        begun_covariances=[0.3 * np.eye(3)],
    )
    two = cv2.imread(str(tmp_path / "two.png"))

    def of_new_maps(image):
        return int(np.sum(np.abs(image.astype(int) - [167, 121, 204]).max(axis=2) < 10))

    # The two marks and the legend's, and the ellipses around them.
    assert of_new_maps(two) > 100
    assert of_new_maps(full) == 0
    assert landmarks(full) > 200
    assert landmarks(bare) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bare.png", "full.png", "two.png"]
