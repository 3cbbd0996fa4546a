"""The overlay and its video, the point cloud and the picture of the map."""

import re
import threading
import time
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest

from jaxslam.tracking import overlay
from jaxslam.tracking.film import WAITING, Aside, OverlayWriter
from jaxslam.tracking.observations import NOTHING as EMPTY
from jaxslam.tracking.observations import Observations
from jaxslam.tracking.overlay import COLOURS, LEAST_RADIUS, draw_overlay, overlay_size
from jaxslam.tracking.pointcloud import Cloud, read_ply, write_ply
from jaxslam.tracking.pose_with_covariance import PoseWithCovariance
from jaxslam.tracking.report import Tracked

GREY = np.full((120, 640), 100, np.uint8)
NOTHING = np.full((1, 2), np.nan)


def coloured(overlay, status):
    """Rows and columns of the image (without the legend) where a status' colour is drawn."""
    difference = np.abs(overlay[: len(GREY)].astype(int) - COLOURS[status]).max(axis=2)
    return np.argwhere(difference < 30)


def draw(predicted, covariance, matched, status):
    table = Observations(
        np.zeros(1, int),
        np.asarray(predicted, float).reshape(-1, 2),
        np.asarray(covariance, float).reshape(-1, 2, 2),
        np.asarray(matched, float).reshape(-1, 2),
        np.zeros(1),
        np.array([status]),
    )
    return draw_overlay(GREY, table)


def lines(overlay):
    """Where anything is drawn in the image, whatever its colour."""
    return overlay[: len(GREY)].max(axis=2) != int(0.75 * 100 + 20)


def test_an_ellipse_reaches_three_sigma_along_its_axes_and_is_tilted_as_its_covariance():
    overlay = draw([200.0, 60.0], np.diag([100.0, 9.0]), [200.0, 60.0], "matched")
    for places, middle, reach in zip(
        coloured(overlay, "matched").T, (60, 200), (9, 30), strict=True
    ):
        ends = places.min(), places.max()
        assert ends == pytest.approx((middle - reach, middle + reach), abs=1)
    overlay = draw([200.0, 60.0], [[50.0, 45.0], [45.0, 50.0]], NOTHING, "unmatched")
    # Positive correlation: right goes with down.
    assert np.corrcoef(*coloured(overlay, "unmatched").T)[0, 1] > 0.5
    # Never too small to be seen, with its seam.
    overlay = draw([200.0, 60.0], 1e-4 * np.eye(2), NOTHING, "unmatched")
    for places in np.nonzero(lines(overlay)):
        assert np.ptp(places) == pytest.approx(2 * LEAST_RADIUS + 3, abs=1.5)


def test_every_status_has_a_shape_of_its_own():
    """Without colours: what is found at the same place in the same ellipse looks different."""
    there, wide = [200.0, 60.0], 36 * np.eye(2)
    matched = lines(draw(there, wide, there, "matched"))
    outlier = lines(draw(there, wide, there, "outlier"))
    unmatched = lines(draw(there, wide, NOTHING, "unmatched"))
    new = lines(draw(NOTHING, np.full((2, 2), np.nan), there, "new"))
    # A full dot, a cross with nothing beside its middle, a square, and nothing.
    assert matched[60 - 1 : 60 + 2, 200 - 1 : 200 + 2].all()
    assert outlier[60 - 3, 200 - 3]
    assert not outlier[60 - 3, 200]
    assert new[60 - 5, 200 - 5]
    assert not new[60 - 2 : 60 + 3, 200 - 2 : 200 + 3].any()
    assert not unmatched[60 - 10 : 60 + 11, 200 - 10 : 200 + 11].any()
    # The ellipse of 18 pixels is whole or dashed.
    angles = np.linspace(0, 2 * np.pi, 200)
    ring = np.rint([60 + 18 * np.sin(angles), 200 + 18 * np.cos(angles)]).astype(int)
    assert matched[*ring].mean() > 0.95
    assert 0.3 < unmatched[*ring].mean() < 0.8


@pytest.mark.parametrize("width", [160, 1280])
def test_the_legend_fits_its_width(width):
    """All of it is written: the longest notes and counts end before the right edge."""
    image = np.full((90, width), 100, np.uint8)
    nowhere = np.full((200, 2), np.nan)
    labels = np.array(["matched", "unmatched", "outlier", "new"] * 50)
    everything = Observations(
        np.arange(200), nowhere, np.full((200, 2, 2), np.nan), nowhere, np.zeros(200), labels
    )
    notes = (
        "frame 12345  1234.56 s  map 12  unit open",
        "sigma: position 0.00123 units  0.123 deg  log scale 0.0123",
    )
    overlay = draw_overlay(image, everything, notes)
    assert overlay.shape == (*overlay_size(width, 90)[::-1], 3)
    assert overlay.dtype == np.uint8
    strip = overlay[90:].max(axis=2)
    assert not np.any(strip[:, -1] > 60)
    for colour in COLOURS.values():  # the legend shows every colour
        assert np.any(np.abs(overlay[90:].astype(int) - colour).max(axis=2) < 60)


def test_unknown_statuses_are_refused():
    with pytest.raises(ValueError, match="unknown label 'seen'; known: matched, unmatched"):
        draw([200.0, 60.0], np.eye(2), NOTHING, "seen")


def with_words(**words):
    return draw_overlay(GREY, EMPTY, **words)


def test_notes_stand_below_the_picture_and_a_banner_in_it():
    plain, noted = with_words(), with_words(notes=("frame 3", "sigma"))
    height = len(GREY)
    assert np.all(plain[:height] == noted[:height])
    assert np.any(plain[height:] != noted[height:])
    banner = with_words(banner="LOST")
    assert np.all(plain[height:] == banner[height:])
    rows, columns = np.nonzero(banner[: height // 6, :, 0] > 120)
    # In the middle, and half as high as the band, a twelfth of the picture.
    assert columns.mean() == pytest.approx(320, abs=10)
    assert np.ptp(rows) == pytest.approx(height / 12, abs=3)
    known = Tracked(3, 0.1, PoseWithCovariance(), loop=4)
    assert overlay._banner(known) == "PLACE KNOWN AGAIN: SUBMAP 4"
    assert overlay._banner(replace(known, loop=None)) == ""


def read_video(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (found := capture.read())[0]:
        frames.append(found[1])
    capture.release()
    return frames


def shade(index):
    return np.full((48, 64, 3), 20 + 40 * index, np.uint8)


@pytest.mark.parametrize("interruption", [None, KeyboardInterrupt])
def test_video_is_whole_whatever_ends_it(tmp_path, interruption):
    path = tmp_path / "overlay.mp4"
    with suppress(KeyboardInterrupt), OverlayWriter(path, (64, 48), 30.0) as writer:
        for index in range(4):
            writer.write(shade(index))
        assert not path.exists()
        if interruption:
            raise interruption
    frames = read_video(path)
    assert [round(frame.mean(), -1) for frame in frames] == [20, 60, 100, 140]
    with OverlayWriter(tmp_path / "without_frames.mp4", (64, 48), 30.0):
        pass
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_given_aside_is_done_in_order_and_elsewhere_whatever_ends_it():
    done, threads, count = [], set(), 3 * WAITING

    def work(number):
        time.sleep(0.001)
        threads.add(threading.current_thread())
        done.append(number)

    with suppress(KeyboardInterrupt), Aside() as aside:
        for number in range(count):
            aside.give(work, number)
            # No more than these wait, and one is being done.
            assert number - len(done) <= WAITING
        raise KeyboardInterrupt
    assert done == list(range(count))
    assert len(threads) == 1
    assert threading.current_thread() not in threads
    assert not any(thread.is_alive() for thread in threads)


@pytest.mark.parametrize("given", [1, 5 * WAITING])
def test_what_fails_aside_is_raised_here(given):
    """At the end, or where more is given; and it ends, although much is waiting."""
    reached = []

    def fail():
        raise ValueError("of the thread")

    def go_on():
        with Aside() as aside:
            for number in range(given):
                aside.give(fail)
                reached.append(number)

    with pytest.raises(ValueError, match="of the thread"):
        go_on()
    assert len(reached) <= WAITING


def test_a_point_cloud_is_read_as_it_was_written_by_names(tmp_path):
    path, A = tmp_path / "map.ply", np.random.default_rng(0).normal(size=(5, 3, 3))
    there = Cloud(A[:, 0], A @ np.swapaxes(A, 1, 2), np.arange(3, 8), np.array([0, 0, 1, 1, 2]))
    write_ply(path, *there)
    for found, expected in zip(read_ply(path), there, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7)
    header, rows = path.read_text().split("end_header\n")
    assert header.startswith("ply\nformat ascii 1.0\n")
    assert "element vertex 5\n" in header
    names = ["x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"]
    assert re.findall(r"property float (\w+)", header) == names
    assert "property int id\nproperty int map\n" in header
    *point_and_covariance, number, of_map = rows.splitlines()[3].split()
    upper = there.covariances[3][np.triu_indices(3)]
    expected = [*there.points[3], *upper]
    np.testing.assert_allclose(np.array(point_and_covariance, float), expected, rtol=1e-7)
    assert (number, of_map) == ("6", "1")
    write_ply(path, *(part[:0] for part in there))
    assert read_ply(path).covariances.shape == (0, 3, 3)
