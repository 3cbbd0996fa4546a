"""Video files with times of their own, and live cameras."""

import itertools
import time

import cv2
import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, brightness, picture

from jaxslam.io import camera, file
from jaxslam.io.opening import open_source

RATE = 25.0


@pytest.fixture
def filmed(tmp_path):
    """Six pictures at a constant rate."""
    path = tmp_path / "video.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), RATE, (WIDTH, HEIGHT))
    for index in range(6):
        writer.write(cv2.cvtColor(picture(3 * index), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_a_video_file_has_its_pictures_at_their_times(filmed, calibration):
    source = open_source(filmed, calibration=calibration)
    # To the file's tick.
    np.testing.assert_allclose(source.times, np.arange(6) / RATE, rtol=0, atol=1e-4)
    np.testing.assert_allclose(brightness(source), [5, 35, 65, 95, 125, 155], atol=4)


def test_a_thermal_video_of_sixteen_bits_is_stretched_once_for_all(tmp_path, calibration):
    path, size = tmp_path / "thermal.mkv", (WIDTH, HEIGHT)
    how = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    codec = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, RATE, size, how)
    ramp = np.linspace(0, 300, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    for index in range(3):
        writer.write((7000 + 100 * index + ramp).astype(np.uint16))
    writer.release()
    with pytest.warns(UserWarning, match=r"thermal\.mkv: pictures have more than 8 bits, of which"):
        frames = [frame.image for frame in open_source(path, calibration=calibration)]
    assert len(frames) == 3
    for image in frames:
        assert np.abs(image.ravel() - np.linspace(0, 255, ramp.size)).max() < 3


class Told:
    """A capture that delivers these times and pictures."""

    def __init__(self, times, images, *, rate=RATE, stated=None):
        self.times, self.images = iter(times), iter(images)
        self.stated = len(times) if stated is None else stated
        self.rate, self.now, self.released = rate, 0.0, False

    def grab(self):
        now = next(self.times, None)
        self.now = self.now if now is None else now
        return now is not None

    def get(self, which):
        return {
            cv2.CAP_PROP_POS_MSEC: 1e3 * self.now,
            cv2.CAP_PROP_FPS: self.rate,
            cv2.CAP_PROP_FRAME_COUNT: self.stated,
        }[which]

    def read(self):
        image = next(self.images, None)
        return image is not None, image

    def release(self):
        self.released = True


def test_times_of_a_file_are_its_own_where_they_increase(monkeypatch, tmp_path):
    def times_of(*told, **how):
        monkeypatch.setattr(cv2, "VideoCapture", lambda path: Told(told, [], **how))
        return file.read_times(tmp_path / "v.mkv")

    # Of a file that states no number it is computed from its length, here nine pictures'.
    dropped = [0.0, 0.04, 0.2, 0.32]
    np.testing.assert_array_equal(times_of(*dropped, stated=9), dropped)
    with pytest.warns(
        UserWarning, match=r"picture 2 is at 0\.100 s, after one .* per second are assumed"
    ):
        times = times_of(0.0, 0.1, 0.1, 0.3)
    np.testing.assert_allclose(times, np.arange(4) / RATE, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="its frame rate is unknown"):
        times_of(0.0, 0.0, rate=0.0)
    with pytest.warns(UserWarning, match="only 2 of the 9 pictures"):
        assert len(times_of(0.0, 0.1, stated=9)) == 2


def test_a_file_that_is_no_video_or_is_none_any_more_is_refused(filmed, calibration):
    source = open_source(filmed, calibration=calibration)
    filmed.write_bytes(b"")
    with pytest.raises(ValueError, match=r"video\.mp4: image 0 cannot be read; the sequence ends"):
        list(source)
    filmed.write_text("no video")
    with pytest.raises(ValueError, match="cannot be read as a video"):
        open_source(filmed, calibration=calibration)


class Filming(Told):
    """A camera that delivers a picture every 2 ms."""

    def __init__(self, count=None):
        pictures = (np.dstack([picture(i % 20)] * 3) for i in itertools.count())
        super().__init__([], itertools.islice(pictures, count))

    def read(self):
        time.sleep(0.002)
        return super().read()


def test_a_live_camera_gives_the_newest_picture_with_the_time_it_came(monkeypatch, calibration):
    opened = []
    monkeypatch.setattr(
        cv2, "VideoCapture", lambda n: opened.append((n, Filming())) or opened[-1][1]
    )
    source = open_source("0", calibration=calibration, frames=4)
    frames = []
    for frame in source:
        frames.append(frame)
        time.sleep(0.02)  # a reader slower than the camera
    assert source.name == "camera 0"
    assert {number for number, _ in opened} == {0}
    assert all(capture.released for _, capture in opened)
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert frames[0].image.shape == (HEIGHT, WIDTH)
    times = np.array([frame.time for frame in frames])
    assert times[0] > 0
    assert np.all(np.diff(times) >= 0.01)
    # What came meanwhile is skipped, not queued.
    numbers = np.array([frame.image[0, 0] // 10 for frame in frames], int)
    assert np.all(np.diff(numbers) % 20 > 1)


def test_a_reader_faster_than_the_camera_waits_for_the_next_picture(monkeypatch, calibration):
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: Filming())
    frames = list(open_source("0", calibration=calibration, frames=5))
    assert np.all(np.diff([int(frame.image[0, 0]) for frame in frames]) != 0)
    assert np.all(np.diff([frame.time for frame in frames]) > 0)


def test_a_camera_without_a_picture_or_with_a_start_is_refused(monkeypatch, calibration):
    monkeypatch.setattr(camera, "PATIENCE", 0.2)
    for count, start, message in (
        (0, 0.0, "camera 7 delivers no pictures"),
        (None, 1.0, "a live camera starts when it is opened"),
    ):
        monkeypatch.setattr(cv2, "VideoCapture", lambda n, count=count: Filming(count))
        with pytest.raises(ValueError, match=message):
            open_source("7", calibration=calibration, start=start)
